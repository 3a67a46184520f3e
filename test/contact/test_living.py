# SPDX-License-Identifier: Apache-2.0
"""Contact on what lives: it moves, and there is bone below it."""

import math
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.contact_living import BONE_ROWS, run_case
from tactile_resonance.contact.goal import Cause, ContactGoal, State
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.pressing import HeldMotion
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.surfaces import SurfaceMotion
from tactile_resonance.simulation.plant.tip import OnSoft, Tip, bone, clinging
from tactile_resonance.simulation.sensor.bimorph import sensor_modes

sys.path.insert(0, str(Path(__file__).parent))
from contacts import FORCE_N, QUICK, RADIUS_M, SOFT, contact, stiffer

HEART = SurfaceMotion(heart_m=4e-4, heart_hz=1.2)
BREATH = SurfaceMotion(breath_m=1e-3, breath_hz=0.25)


def held(motion, seconds=3.0, seed=0):
    made = contact(SOFT, seed=seed)
    made.bench.plant.motion = motion
    made.loop.start(made.goal)
    assert made.run_until(State.HOLD), made.controller.result
    at = len(made.force_n)
    made.run(seconds)
    return made, np.array(made.force_n[at:])


@pytest.mark.parametrize("motion", [HEART, BREATH])
@pytest.mark.parametrize("seed", range(3))
def test_moving_tissue_is_held(motion, seed):
    made, force_n = held(motion, seed=seed)
    assert made.controller.state is State.HOLD
    assert np.sqrt(np.mean((force_n / FORCE_N - 1) ** 2)) < 0.10
    assert 0.6 * FORCE_N < force_n.min() < force_n.max() < 1.4 * FORCE_N


def test_motion_is_said_with_its_size_and_rate():
    made, _ = held(HEART)
    motion = made.controller.motion
    # over 16 seeds 222 +- 9 um: the tip goes somewhat further than the tissue
    assert motion.half_way_m == pytest.approx(222e-6, abs=4 * 9e-6)
    assert motion.rate_hz == pytest.approx(1.2, abs=0.1)
    made.controller.retract()
    made.run(0.01)
    assert re.search(r"moving tissue: \d+ um at 1\.\d Hz", made.controller.result.message)


def test_still_tissue_is_not_said_to_move():
    made, _ = held(None, seconds=1.0)
    assert made.controller.motion is None


def test_motion_that_has_not_turned_has_no_rate():
    motion = HeldMotion()
    for n in range(50):  # half a turn in 1 s
        motion.add(n * 20_000_000 + 10**9, 1e-4 * np.sin(np.pi * n / 50))
    found = motion.describe()
    assert found.rate_hz is None
    assert found.half_way_m == pytest.approx(0.5e-4, rel=0.1)  # the outermost hundredths left out
    assert str(found) == f"moving tissue: {1e6 * found.half_way_m:.0f} um in 1.0 s"


def peak_n(layer_m, parameters, seed, beam=None):
    tip = Tip(RADIUS_M, beam, meets=lambda soft: OnSoft(soft, bone(layer_m, RADIUS_M)))
    tissue = replace(SOFT, relaxation_modulus_1s_pa=1.5e3)  # 3 kPa at once
    made = contact(tissue, parameters=parameters, tip=tip, seed=seed, height_m=1.5e-3)
    made.loop.start(made.goal)
    made.run_until(State.IDLE, 30.0)
    return max(made.force_n), made


@pytest.mark.parametrize("layer_m", [0.0, 3e-4])
@pytest.mark.parametrize("seed", range(3))
def test_bone_is_met_below_the_hard_limit_where_nothing_is_known(layer_m, seed):
    slow = replace(QUICK, unknown_speed_m_s=3e-4)
    most_n, made = peak_n(layer_m, slow, seed)
    assert most_n < Limits().hard_force_n
    assert made.controller.result.cause in (Cause.FORCE_RATE, Cause.FORCE_ABORT)
    assert peak_n(layer_m, QUICK, seed)[0] > 4 * Limits().hard_force_n  # what it would be


def is_known(controller, goal):
    return controller._memory.knows(goal, controller.parameters.known_radius_m)


def test_where_one_pressed_too_hard_the_next_touch_is_slow_again():
    made = contact(parameters=replace(QUICK, unknown_speed_m_s=3e-4))
    assert made.loop.make(made.goal).reached
    made.run(0.1)
    assert made.loop.retract().retracted
    controller = made.controller
    assert is_known(controller, made.goal)
    harder = ContactGoal(made.goal.touch, 0.018)
    assert not is_known(controller, harder)  # as deep as that nobody has been
    made.bench.plant._on = (OnSoft(made.bench.plant._on[0], bone(1e-4, RADIUS_M)),) * 2
    made.loop.make(made.goal)
    made.run_until(State.IDLE, 5.0)
    assert controller.result.cause in (Cause.FORCE_ABORT, Cause.FORCE_RATE, Cause.FORCE_HARD)
    assert not is_known(controller, made.goal)


def test_place_is_forgotten_when_pressed_too_hard_whatever_becomes_of_the_tip():
    made = contact(parameters=replace(QUICK, unknown_speed_m_s=3e-4))
    for _ in range(2):
        assert made.loop.make(made.goal).reached
        assert made.loop.retract().retracted
    controller = made.controller
    assert is_known(controller, made.goal)
    # bone below, and a hook that holds the tip when it is drawn back: `held` is the cause in the end
    on_bone = OnSoft(made.bench.plant._on[0], bone(1e-4, RADIUS_M))
    hook = clinging(lambda height_m, _: 40.0 * height_m)
    made.bench.plant._on = (OnSoft(on_bone, hook),) * 2
    made.loop.make(made.goal)
    made.run_until(State.IDLE, 4.0)
    assert controller.state is State.FAULT
    assert controller.result.cause is Cause.HELD
    assert not is_known(controller, made.goal)


def filtered(read, lag_samples):
    """A cell whose own filter makes neighbouring forces alike."""
    keep = math.exp(-1 / lag_samples) if lag_samples else 0.0
    last = []

    def samples():
        made = []
        for sample in read():
            wrench = np.array(sample.wrench)
            last[:] = [wrench if not last else keep * last[0] + (1 - keep) * wrench]
            made.append(sample._replace(wrench=tuple(last[0].tolist())))
        return made

    return samples


@pytest.mark.parametrize("lag_samples", [0, 3])
def test_still_tissue_is_not_taken_to_move_for_20_s(lag_samples):
    # white noise, and that of a cell behind a filter
    moved = 0
    for seed in range(4):
        made = contact(SOFT, seed=seed)
        made.bench.cell.read = filtered(made.bench.cell.read, lag_samples)
        made.loop.start(made.goal)
        assert made.run_until(State.HOLD), made.controller.result
        made.run(20.0)
        moved += made.controller._observer.model.moving
    assert moved <= 1


def test_beam_protects_from_bone_at_full_speed():
    modes = sensor_modes(read_sensor())
    parameters = replace(
        QUICK, unknown_speed_m_s=3e-4, beam_stiffness_n_per_m=modes.static_stiffness_n_per_m
    )
    assert parameters.first_speed_m_s(Limits().abort_force_n) > parameters.press_speed_m_s
    assert peak_n(0.0, parameters, 0, modes)[0] < Limits().hard_force_n


def test_near_a_contact_that_succeeded_the_next_touch_is_fast():
    made = contact(stiffer(SOFT, 2.0), parameters=replace(QUICK, unknown_speed_m_s=3e-4))
    took_s = []
    for _ in range(2):
        began_ns = made.bench.time_ns
        assert made.loop.make(made.goal).reached
        took_s.append((made.bench.time_ns - began_ns) * 1e-9)
        made.run(0.1)
        assert made.loop.retract().retracted
    assert took_s[0] > 3 * took_s[1]


def test_speed_that_a_beam_allows_is_that_at_which_it_bends_to_half_of_the_abort_force():
    stiff = ContactParameters(beam_stiffness_n_per_m=500.0)
    assert stiff.first_speed_m_s(0.03) == pytest.approx(0.015 / (500.0 * 0.03))
    assert ContactParameters().first_speed_m_s(0.03) == ContactParameters().unknown_speed_m_s


def test_bone_that_is_held_by_chance_is_not_followed_as_tissue_that_moves():
    # a case in which the arm's vibration brings the force within its tolerance on 10 MPa
    bare = next(row for row in BONE_ROWS if row.name == "bare, rigid")
    assert run_case((bare, 36, "")).peak_n < Limits().hard_force_n
