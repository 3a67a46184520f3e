# SPDX-License-Identifier: Apache-2.0
"""Contacts among random faults, in random states, on tissue that moves: docs/safety.md holds in all of them.

Seeded. What the page says the envelope cannot do is left out: tissue that rises on a tip which an arm in
a fault cannot draw back, and an arm that takes no command at all for good.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.goal import HoldMode, State
from tactile_resonance.contact.interfaces import ArmFault, ForceFault
from tactile_resonance.contact.parameters import Limits
from tactile_resonance.contact.vectors import vector
from tactile_resonance.simulation.cell.transducer import CellParameters
from tactile_resonance.simulation.plant.surfaces import PlantSurface

sys.path.insert(0, str(Path(__file__).parent))
from contacts import QUICK, SOFT, stiffer
from disturbed import broken_promises, disturbed

STATES = [s for s in State if s not in (State.IDLE, State.FAULT)]
HIGHEST_M = 1.9e-3
"""The tissue stays below the standoff, where the tip may stand and nothing is watched any more."""


def of_cell(**faults):
    """A fault of the cell itself."""

    def begin(rig, rng):
        cell = rig.bench.cell.faults
        before = {name: getattr(cell, name) for name in faults}
        for name, value in faults.items():
            setattr(cell, name, value if not callable(value) else value(rng))
        return lambda: [setattr(cell, name, value) for name, value in before.items()]

    return begin


def of_samples(device, change):
    """A device whose samples are not what they were."""

    def begin(rig, rng):
        lying = getattr(rig, device)
        lying.change = change
        return lambda: setattr(lying, "change", lambda sample: sample)

    return begin


def late(device, low_s, high_s):
    """A device whose stamps are off."""

    def begin(rig, rng):
        lying = getattr(rig, device)
        lying.late_ns = round(1e9 * rng.uniform(low_s, high_s))
        return lambda: setattr(lying, "late_ns", 0)

    return begin


def cell_error(rig, rng):
    rig.bench.cell.error = list(ForceFault)[rng.integers(len(ForceFault))]
    return lambda: setattr(rig.bench.cell, "error", None)


def frozen(rig, rng):
    rig.bench.arm.freeze(rng.choice([0.02, 0.1, 1.0]))
    return lambda: None


def stopped(rig, rng):
    stops = [ArmFault.PROTECTIVE_STOP, ArmFault.EMERGENCY_STOP, ArmFault.PROGRAM_STOPPED]
    rig.bench.arm.halt(stops[rng.integers(len(stops))])
    return lambda: repaired(rig)


def lost(rig, rng):
    rig.bench.arm.break_link(ArmFault.LINK_LOST)
    return lambda: repaired(rig)


def repaired(rig):
    rig.bench.arm.repair()
    rig.bench.arm.connect()


def unheard(rig, rng):
    rig.arm.deaf = True
    return lambda: setattr(rig.arm, "deaf", False)


def tissue_moved(by_m):
    def begin(rig, rng):
        rig.rise_m = min(rig.rise_m + by_m, HIGHEST_M - rig.top_m)
        return lambda: None

    return begin


def asked_to_retract(rig, rng):
    rig.controller.retract()
    return lambda: None


def parameters_changed(rig, rng):
    controller, before = rig.controller, rig.controller.parameters
    slower = replace(before, approach_speed_m_s=2e-3)
    if controller.state is State.IDLE:
        controller.configure(slower, controller.limits)
    else:
        with pytest.raises(ValueError, match="accepted in idle"):
            controller.configure(slower, controller.limits)
        with pytest.raises(ValueError, match="accepted in idle"):
            rig.loop.start(rig.goal)
        assert controller.parameters is before
    return lambda: None


def moved_tip(by_m):
    return lambda s: s._replace(position_m=vector(np.add(s.position_m, by_m)))


def not_finite(s):
    return s._replace(rotation_rad=(np.nan,) * 3)


def forced(change):
    return lambda s: s._replace(force_n=vector(change(np.array(s.force_n))))


SHORT_S = (0.0, 0.05)
FAULTS = {
    # name: (what begins it and returns its end, how long it may last [s], a robot's stop)
    "silent": (of_cell(silent=True), None, False),
    "stuck": (of_cell(stuck=True), None, False),
    "no number": (of_cell(invalid=True), None, False),
    "saturated": (of_cell(saturated=True), None, False),
    "flipped": (of_cell(flipped=True), None, False),
    "step up": (of_cell(bias_step_n=-0.03), None, False),
    "step down": (of_cell(bias_step_n=0.03), None, False),
    "small step": (of_cell(bias_step_n=lambda rng: rng.uniform(-7e-3, 7e-3)), None, False),
    "pairs lost": (of_cell(lose_second_every=3), None, False),
    "cell's error": (cell_error, None, False),
    "x no number": (of_samples("force", forced(lambda f: f * [np.nan, 1, 1])), None, False),
    "endless force": (of_samples("force", forced(lambda f: f + [np.inf, -np.inf, 0])), None, False),
    "sideways force": (of_samples("force", forced(lambda f: f + [0.03, 0, 0])), None, False),
    "half the force": (of_samples("force", forced(lambda f: 0.5 * f)), None, False),
    "force ahead": (late("force", -1.0, -0.02), None, False),
    "force late": (late("force", 0.0, 0.03), None, False),
    "frozen": (frozen, None, True),
    "stopped": (stopped, None, True),
    "link lost": (lost, None, True),
    "pose no number": (of_samples("arm", not_finite), None, True),
    "pose too low": (of_samples("arm", moved_tip([0, 0, -2e-3])), SHORT_S, True),
    "pose aside": (of_samples("arm", moved_tip([0.02, 0, 0])), SHORT_S, True),
    "arm ahead": (late("arm", -1.0, -0.03), None, True),
    "arm late": (late("arm", 0.0, 0.05), None, True),
    "unheard": (unheard, SHORT_S, False),
    "tissue gone": (tissue_moved(-5e-3), None, False),
    "tissue up": (tissue_moved(3e-4), None, False),
    "retract": (asked_to_retract, None, False),
    "parameters": (parameters_changed, None, False),
}


def storm(rng, names):
    """One contact in which everything comes at some time; the rig after it."""
    tissue = stiffer(SOFT, np.exp(rng.uniform(np.log(0.5), np.log(4.5))))  # 4.4 to 40 kPa at once
    arm_stands = any(FAULTS[name][2] for name in names)
    breath_m = 0.0 if arm_stands or rng.random() < 0.5 else rng.uniform(0, 2e-3)
    noise_n = rng.choice([1e-3, 2e-3])
    height_m = min(
        rng.choice([rng.uniform(-1e-3, 1e-3), rng.uniform(-4e-3, 2e-3)]), HIGHEST_M - breath_m
    )
    start_m = max(rng.choice([2.1e-3, 0.02, rng.uniform(0, 6e-3)]), height_m + breath_m + 1e-4)
    hold = HoldMode.FORCE if rng.random() < 0.8 else HoldMode.INDENTATION
    rig = disturbed(
        tissue,
        height_m=height_m,
        tilt_rad=rng.choice([0.0, rng.uniform(0, 0.17)]),
        start_m=start_m,
        force_n=rng.choice([0.005, 0.01, 0.018]),
        hold=hold,
        parameters=replace(QUICK, cell_noise_n=noise_n, tare_std_n=0.3 * noise_n),
        limits=Limits(),
        seed=int(rng.integers(1 << 30)),
        cell_parameters=replace(CellParameters.from_yaml(), force_noise_rms_n=noise_n),
    )
    plane, phase = rig.bench.plant.surface, rng.uniform(0, 2 * np.pi)
    rig.rise_m, rig.top_m = 0.0, height_m + breath_m

    def breathe():
        turn = 2 * np.pi * 0.3 * rig.bench.time_ns * 1e-9 + phase
        rise = rig.rise_m + breath_m / 2 * (1 + np.sin(turn))
        rig.bench.plant.surface = PlantSurface(plane.point_m + [0, 0, rise], plane.normal)

    rig.bench.on_step.insert(0, breathe)
    rig.loop.start(rig.goal)
    ends = []
    for name in names:
        begin, lasts_s, _ = FAULTS[name]
        state = STATES[rng.integers(len(STATES))]
        if state is State.RETRACT:
            rig.loop.run_while(lambda: rig.controller.state is not State.HOLD, 1.5)
            rig.controller.retract()
        rig.loop.run_while(
            lambda state=state: rig.controller.state is not state and rig.controller.result is None,
            3.0,
        )
        rig.run(rng.uniform(0, 0.1))
        end = begin(rig, rng)
        if lasts_s is not None or rng.random() < 0.5:
            rig.run(rng.uniform(*(lasts_s or (0.0, 0.5))))
            end()
        else:
            ends.append(end)
    rig.run(0.8)
    for end in ends:
        end()
    repaired(rig)
    rig.bench.cell.start()
    rig.run(0.02)
    rig.controller.retract()
    rig.run_until(State.IDLE, 12.0)
    rig.run(0.2)
    return rig


def check(seed):
    rng = np.random.default_rng(seed)
    names = list(rng.choice(list(FAULTS), rng.integers(1, 4)))
    told = broken_promises(storm(rng, names))
    assert not told, f"seed {seed}, {names}: {'; '.join(told)}"


@pytest.mark.parametrize("seed", range(6))
def test_storms(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("begin", range(1000, 1600, 50))
def test_many_storms(begin):
    for seed in range(begin, begin + 50):
        check(seed)
