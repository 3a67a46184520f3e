# SPDX-License-Identifier: Apache-2.0
"""A held contact that is calm is looked at seldom: no less safe, and only as long as it is calm."""

import copy
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from contacts import FORCE_N, QUICK, RADIUS_M, contact, stiffer

from tactile_resonance.contact.goal import Cause, State
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.library import Tissue

PERIODS = 4
TISSUE = Tissue("soft", 4.5e3, (1.0,), (0.95,))
TISSUES = {"soft": TISSUE, "stiff": stiffer(TISSUE, 3.0)}


@dataclass
class Jolt:
    """A surface that comes up, or goes down, at a speed, and stays there."""

    begin_s: float
    speed_m_s: float
    way_m: float

    def displacement_m(self, time_s):
        way = np.clip((time_s - self.begin_s) * abs(self.speed_m_s), 0.0, self.way_m)
        return float(np.copysign(way, self.speed_m_s))


@pytest.fixture(scope="module")
def held():
    """Contacts on the beam, held for a second, by the name of the tissue and by the periods of a calm one."""
    made = {}
    for name, tissue in TISSUES.items():
        for periods in (1, PERIODS):
            made[name, periods] = each = contact(
                tissue,
                tip=Tip(RADIUS_M, sensor_modes(read_sensor())),
                parameters=replace(QUICK, beam_stiffness_n_per_m=14.8),
                under_sample=True,
                calm_periods=periods,
                seed=3,
            )
            each.loop.start(each.goal)
            assert each.run_until(State.HOLD)
            each.run(1.0)
    return lambda name, periods: copy.deepcopy(made[name, periods])


@pytest.mark.parametrize("name", TISSUES)
def test_a_calm_contact_is_looked_at_seldom_and_its_force_is_as_even(held, name):
    spread_n, cycles = [], []
    for periods in (1, PERIODS):
        each = held(name, periods)
        before = each.loop.cycles
        each.force_n.clear()
        each.run(3.0)
        cycles.append(each.loop.cycles - before)
        spread_n.append(float(np.sqrt(np.mean((np.array(each.force_n) - FORCE_N) ** 2))))
    assert cycles[0] == pytest.approx(1500, abs=2)
    assert cycles[1] < 1.2 * cycles[0] / PERIODS
    assert spread_n[1] < 1.1 * spread_n[0]


@pytest.mark.parametrize("late_s", [0.0, 0.002, 0.004, 0.006])
@pytest.mark.parametrize(
    ("speed_m_s", "way_m"), [(5e-3, 2e-4), (2e-2, 3e-4), (5e-2, 1e-3), (-2e-2, 3e-4)]
)
@pytest.mark.parametrize("name", TISSUES)
def test_tissue_that_jolts_presses_no_harder(held, name, speed_m_s, way_m, late_s):
    most_n = []
    for periods in (1, PERIODS):
        each = held(name, periods)
        each.force_n.clear()
        plant = each.bench.plant
        plant.motion = Jolt(plant.time_s + 0.02 + late_s, speed_m_s, way_m)
        each.run(0.4)
        assert each.controller.state is State.HOLD
        most_n.append(max(each.force_n))
    assert most_n[1] < most_n[0] + 0.03 * FORCE_N


def found_after_s(each, begin, causes):
    """From when a fault begins until the contact is given up for it."""
    begin(each)
    began_ns = each.bench.now_ns()
    each.loop.run_while(lambda: each.controller.state is State.HOLD, 0.5)
    assert each.controller.state is State.FAULT
    assert each.controller.result.cause in causes
    return (each.bench.now_ns() - began_ns) * 1e-9


@pytest.mark.parametrize(
    ("begin", "causes"),
    [
        (lambda each: setattr(each.bench.cell.faults, "silent", True), {Cause.FORCE_STALE}),
        (lambda each: each.bench.arm.freeze(1.0), {Cause.ARM_STALE, Cause.ARM_LINK}),
    ],
    ids=["cell", "arm"],
)
@pytest.mark.parametrize("late_periods", range(PERIODS))
def test_a_device_that_is_silent_is_found_as_soon(held, begin, causes, late_periods):
    ages_s = []
    for periods in (1, PERIODS):
        each = held("soft", periods)
        each.bench.wait_until(each.bench.now_ns() + 2_000_000 * late_periods)
        ages_s.append(found_after_s(each, begin, causes))
    assert ages_s[1] < ages_s[0] + 1.5 * 0.002
