# SPDX-License-Identifier: Apache-2.0
"""A tip that is drawn back: by what it is held, what still presses on it, and where its zero went."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.goal import Cause, State
from tactile_resonance.contact.parameters import Limits, Workspace
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import OnSoft, clinging

sys.path.insert(0, str(Path(__file__).parent))
from contacts import QUICK, RADIUS_M, SOFT, contact, started, stiffer

PULL_N = Limits().pull_force_n


def held_by(pull):
    made = started()
    assert made.run_until(State.HOLD)
    plant = made.bench.plant
    held = OnSoft(plant._on[0], clinging(pull))
    held._touched = True
    plant._on = held, held
    made.controller.retract()
    made.run_until(State.IDLE, 4.0)
    return made, held


def test_hook_is_pulled_no_harder_than_accepted_and_the_tip_stays_where_it_is():
    made, _ = held_by(lambda height_m, _: 40.0 * height_m)
    assert made.controller.state is State.FAULT
    result = made.controller.result
    assert result.cause is Cause.HELD
    assert "grow while it is drawn back" in result.message
    assert min(made.force_n) > -(PULL_N + 6e-3)
    assert np.abs(made.speed_m_s[-100:]).max() < 3e-4
    assert made.controller.settled


def test_a_zero_that_creeps_holds_the_tip_too_and_the_reason_leaves_that_open():
    made = started()
    assert made.run_until(State.HOLD)
    faults = made.bench.cell.faults
    made.bench.on_step.append(lambda: setattr(faults, "bias_step_n", faults.bias_step_n + 1e-5))
    made.run(1.0)
    made.controller.retract()
    made.run_until(State.IDLE, 4.0)
    assert made.controller.result.cause is Cause.HELD
    assert min(made.force_n) == 0.0  # nothing pulls
    assert "or the force source is not steady" in made.controller.result.message


def test_hook_that_is_asked_for_again_is_pulled_a_little_harder_each_time():
    made, _ = held_by(lambda height_m, _: 40.0 * height_m)
    for _ in range(5):
        before_n = min(made.force_n)
        made.controller.retract()
        made.run(1.0)
        assert min(made.force_n) > before_n - 5e-3
    assert made.controller.state is State.FAULT


def test_tip_that_is_freed_is_drawn_back_on_request():
    made, held = held_by(lambda height_m, _: 40.0 * height_m)
    held.beside = lambda *_: None
    made.run(0.1)
    made.controller.retract()
    assert made.run_until(State.IDLE, 3.0)
    assert made.controller.result.retracted
    assert made.controller.result.cause is Cause.HELD  # what happened stays said


@pytest.mark.parametrize("damping_ns_per_m", [0.3, 0.6, 1.0])
def test_film_that_pulls_as_fast_as_it_is_drawn_is_left_slowly(damping_ns_per_m):
    # 1 N s/m: at 20 mm/s it would pull with 20 mN; it tears 2 mm above the surface
    def pull(height_m, up_m_s):
        return damping_ns_per_m * max(0.0, up_m_s) if height_m < 2e-3 else None

    made, _ = held_by(pull)
    assert made.controller.state is State.IDLE
    assert made.controller.result.retracted
    assert min(made.force_n) > -5.5e-3


@pytest.mark.parametrize("step_n", [0.02, -0.02])
def test_zero_that_steps_in_the_hold_does_not_keep_the_tip_and_is_reported(step_n):
    # 20 mN are beyond what is accepted as pull, or beyond what may be left at the standoff
    made = started(limits=Limits(abort_force_n=0.04))
    assert made.run_until(State.HOLD)
    made.run(0.2)
    made.bench.cell.faults.bias_step_n = step_n
    made.run_until(State.IDLE, 6.0)
    made.controller.retract()
    assert made.run_until(State.IDLE, 6.0)
    result = made.controller.result
    # the cell under the sample shows a press as a negative force
    assert result.zero_change_n == pytest.approx(-step_n, abs=6e-4)
    assert "zero of the force moved" in result.message
    assert result.force_std_n > abs(step_n) / 3


def test_steady_zero_is_not_reported():
    made = started()
    assert made.run_until(State.HOLD)
    made.run(0.5)
    std_n = made.controller.result.force_std_n
    made.controller.retract()
    assert made.run_until(State.IDLE, 3.0)
    result = made.controller.result
    assert abs(result.zero_change_n) < 1e-3
    assert "zero" not in result.message
    assert result.force_std_n == pytest.approx(std_n, rel=0.2)


@pytest.mark.parametrize("tare_drift_n_per_s", [0.002, 0.01])  # refused by the tare, or later
def test_surface_above_the_standoff_is_left_before_the_tip_is_idle(tare_drift_n_per_s):
    parameters = replace(QUICK, tare_drift_n_per_s=tare_drift_n_per_s)
    made = contact(stiffer(SOFT, 3.0), height_m=2.0e-3, start_m=2.2e-3, parameters=parameters)
    made.loop.start(made.goal)
    assert made.run_until(State.TARE)
    made.run(0.08)
    plane = made.bench.plant.surface

    def rise():
        up_m = min(3e-3, (made.bench.time_ns - began_ns) * 4e-12)  # 4 mm/s
        made.bench.plant.surface = PlantSurface(plane.point_m + [0, 0, up_m], plane.normal)

    began_ns = made.bench.time_ns
    made.bench.on_step.insert(0, rise)
    assert made.run_until(State.IDLE, 6.0), made.controller.result
    assert made.controller.result.cause in (Cause.SURFACE_EARLY, Cause.TARE)
    # by position alone it would press with more than 100 mN at the standoff
    assert made.force_n[-1] < 1e-3


def test_broken_source_does_not_keep_the_tip():
    made = started()
    assert made.run_until(State.HOLD)
    made.bench.cell.faults.stuck = True
    assert made.run_until(State.IDLE, 3.0)
    result = made.controller.result
    assert result.cause is Cause.FORCE_STUCK
    assert result.retracted
    assert result.zero_change_n is None


@pytest.mark.parametrize("under_sample", [True, False])
def test_force_on_the_way_counts_where_the_cell_is_under_the_sample(under_sample):
    made = contact(start_m=0.05, under_sample=under_sample)
    made.loop.start(made.goal)
    made.run(0.2)
    assert made.controller.state is State.TRAVEL
    made.bench.cell.faults.bias_step_n = (
        -0.05
    )  # something is touched, or somebody leans on the dish
    made.run(0.1)
    result = made.controller.result
    assert (result is not None) == under_sample
    if under_sample:
        assert result.cause is Cause.SURFACE_EARLY
        assert "on the way" in result.message


@pytest.mark.parametrize("stiffness", [3.0, 5.0, 8.0])
def test_soft_hook_is_not_taken_for_a_zero_again_and_again(stiffness):
    made, _ = held_by(lambda height_m, _: stiffness * height_m)
    made.run(6.0)
    assert made.controller.result.cause is Cause.HELD
    # once it may pass for a zero
    assert min(made.force_n) > -(2 * PULL_N + 5e-3)


@pytest.mark.parametrize("rate_n_per_s", [0.5e-3, 1.5e-3])
def test_zero_that_crept_in_the_hold_does_not_keep_the_tip_for_good(rate_n_per_s):
    for seed in range(3):
        made = started(seed=seed)
        assert made.run_until(State.HOLD)
        for _ in range(round(8e-3 / rate_n_per_s / 0.1)):  # 8 mN
            made.bench.cell.faults.bias_step_n += 0.1 * rate_n_per_s
            made.run(0.1)
        for _ in range(4):
            made.controller.retract()
            if made.run_until(State.IDLE, 6.0):
                break
        assert made.controller.state is State.IDLE, made.controller.result
        assert made.force_n[-1] == 0.0


def test_a_tip_that_was_held_far_up_comes_free_once_its_force_is_steady():
    """Each request looks into the force anew, from where the tip is."""
    made = started()
    assert made.run_until(State.HOLD)
    made.controller.retract()
    made.loop.cycle()
    faults, creep_n = made.bench.cell.faults, [-8e-3 * QUICK.period_s]

    def creep():
        faults.bias_step_n += creep_n[0]

    made.bench.on_step.append(creep)
    assert made.run_until(State.FAULT, 8.0)
    assert "still changes" in made.controller.result.message
    creep_n[0] = 0.0
    place_m = made.bench.motion.reported.position_m[2]
    made.controller.retract()
    assert made.run_until(State.IDLE, 3.0), made.controller.result.message
    assert made.controller.result.retracted
    assert 0 < made.bench.motion.reported.position_m[2] - place_m < 5e-3


def test_no_room_above_the_standoff_is_said_and_ends():
    limits = Limits(workspace=Workspace((-1.0, -1.0, -0.2), (1.0, 1.0, RADIUS_M + 2.7e-3)))
    made = contact(limits=limits, start_m=2.2e-3)
    made.loop.start(made.goal)
    assert made.run_until(State.HOLD), made.controller.result
    made.bench.cell.faults.bias_step_n = -4e-3
    made.run(0.2)
    made.controller.retract()
    made.run(8.0)
    assert made.controller.settled
    assert made.controller.result.cause is Cause.HELD
    assert "no room" in made.controller.result.message
