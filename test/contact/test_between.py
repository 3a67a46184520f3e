# SPDX-License-Identifier: Apache-2.0
"""From contact to contact: no rest for the tare, no higher than asked for, and up again in the end."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.goal import Cause, ContactGoal, State
from tactile_resonance.contact.interfaces import ArmFault, ForceFault
from tactile_resonance.contact.parameters import ContactParameters
from tactile_resonance.contact.payload import Mount
from tactile_resonance.contact.samples import Pose
from tactile_resonance.simulation.plant.surfaces import PlantSurface

sys.path.insert(0, str(Path(__file__).parent))
from contacts import FORCE_N, contact

P = replace(ContactParameters(), unknown_speed_m_s=5e-3)
LOW_M = 1.2e-3


def made(**options):
    return contact(height_m=0.0, start_m=5e-3, parameters=P, under_sample=True, **options)


def goal(rig, x_m=0.0, standoff_m=np.inf, turn_rad=0.0):
    touch = rig.goal.touch
    pose = Pose(touch.position_m + [x_m, 0, 0], touch.rotation_rad + [0, 0, turn_rad])
    return ContactGoal(pose, FORCE_N, standoff_m=standoff_m)


def height_m(rig):
    """Of the tip above the expected touch."""
    return rig.bench.motion.reported.position_m[2] - rig.goal.touch.position_m[2]


def states(rig, aim):
    """States of one contact in their order, held for a moment and drawn back."""
    seen = []
    note = rig.bench.on_step
    note.append(lambda: seen.append(rig.controller.state))
    result = rig.loop.make(aim)
    rig.run(0.2)
    held = rig.controller.result
    rig.loop.retract()
    note.pop()
    return list(dict.fromkeys(seen)), result, held


def test_tip_rests_for_the_first_zero_only():
    rig = made(seed=3)
    first, *_ = states(rig, goal(rig))
    assert State.TARE in first
    for k in range(1, 6):
        order, result, _ = states(rig, goal(rig, 5e-3 * (k % 2)))
        assert State.TARE not in order
        assert result.reached
        assert rig.controller.bias_std_n < P.zero_std_n


def test_stated_force_is_as_honest_without_the_rest():
    errors = []
    for seed in range(12):
        rig = made(seed=seed)
        states(rig, goal(rig))
        for k in range(1, 4):
            rig.loop.make(goal(rig, 5e-3 * (k % 2)))
            ready = len(rig.force_n)
            rig.run(0.4)
            held = rig.controller.result
            errors.append((held.force_n - np.mean(rig.force_n[ready:])) / held.force_std_n)
            rig.loop.retract()
    # 36 values: their mean square is within five standard errors of one, or smaller
    assert np.mean(np.square(errors)) < 1.0 + 5 * np.sqrt(2 / len(errors))


@pytest.mark.parametrize("why", ["step", "turned", "cancelled", "on the tool", "long ago", "never"])
def test_tip_rests_again_where_the_zero_is_not_known(why):
    rig = contact(
        height_m=0.0,
        start_m=5e-3,
        parameters=replace(P, zero_std_n=0.0) if why == "never" else P,
        under_sample=why != "on the tool",
    )
    states(rig, goal(rig))
    aim = goal(rig, 5e-3, turn_rad=2e-3 if why == "turned" else 0.0)
    if why == "step":
        rig.bench.cell.faults.bias_step_n = 2e-3
    if why == "cancelled":
        rig.loop.start(aim)
        assert rig.run_until(State.APPROACH)
        rig.loop.retract()
    if why == "long ago":
        rig.bench.wait_until(rig.bench.now_ns() + 100_000_000_000)
        rig.run(0.1)
    order, result, _ = states(rig, aim)
    assert State.TARE in order
    assert result.reached


def test_a_tool_on_the_cell_that_is_moved_along_the_surface_is_no_touch():
    # 30 g at 0.5 m/s2 are 15 mN along the surface, 13 mN (8 times the noise) would be a touch
    tool = replace(P, carried_kg=0.03, cell_noise_n=1.6e-3)
    for push_n, after in ((0.0, State.TARE), (0.02, State.FAULT)):
        rig = contact(height_m=0.0, start_m=3e-3, parameters=tool, mount=Mount.TOOL)
        rig.run(0.1)
        rig.loop.start(goal(rig, x_m=2e-3))
        rig.run(0.02)
        rig.bench.cell.faults.bias_step_n = push_n
        rig.loop.run_while(lambda r=rig: r.controller.state is State.TRAVEL, 5.0)
        assert rig.controller.state is after


def test_a_cell_under_the_sample_feels_no_inertia_of_the_robot():
    rig = contact(
        height_m=0.0, start_m=5e-3, parameters=replace(P, carried_kg=0.03), under_sample=True
    )
    assert rig.loop.make(rig.goal).reached, rig.controller.result


def test_approach_begins_as_low_as_a_goal_asks_for_and_ends_there():
    rig = made()
    states(rig, goal(rig))
    travelled = []
    rig.bench.on_step.append(
        lambda: rig.controller.state is State.TRAVEL and travelled.append(height_m(rig))
    )
    for x_m in (5e-3, 0.0):
        states(rig, goal(rig, x_m, LOW_M))
        assert travelled[-1] == pytest.approx(LOW_M, abs=1e-4)
        assert rig.controller.state is State.IDLE
        assert height_m(rig) == pytest.approx(LOW_M, abs=2e-4)


def test_tip_that_waits_low_rises_after_a_second_and_takes_a_goal_meanwhile():
    rig = made()
    states(rig, goal(rig, 0.0, LOW_M))
    rig.run(0.5)
    assert height_m(rig) < 1.5e-3
    assert rig.run_until(State.RETRACT, 2.0)
    rig.run(0.05)
    order, result, _ = states(rig, goal(rig, 5e-3, LOW_M))
    assert result.reached
    assert State.TARE not in order
    rig.run(3.0)
    assert rig.controller.state is State.IDLE
    assert height_m(rig) == pytest.approx(P.standoff_m, abs=1e-4)
    rig.run(2.0)
    assert rig.controller.result.cause is Cause.CANCELLED


@pytest.mark.parametrize("fault", [None, ForceFault.SILENT])
def test_tip_that_waits_low_rises_at_once_where_it_is_asked_to(fault):
    rig = made()
    states(rig, goal(rig, 0.0, LOW_M))
    rig.bench.cell.error = fault
    rig.run(0.1)
    rig.controller.retract()
    assert not rig.controller.settled
    rig.run(0.6)
    assert rig.controller.settled
    assert height_m(rig) == pytest.approx(P.standoff_m, abs=1e-4)


@pytest.mark.parametrize("for_s", [0.1, 3.0])
def test_tip_that_waits_low_rises_after_a_fault_of_the_arm_only_where_it_is_asked_to(for_s):
    rig = made()
    states(rig, goal(rig, 0.0, LOW_M))
    rig.run(0.2)  # the arm comes to rest
    before_m = height_m(rig)
    rig.bench.arm.halt(ArmFault.PROTECTIVE_STOP)
    rig.run(for_s)
    rig.bench.arm.repair()
    rig.bench.arm.connect()
    rig.run(3.0)
    assert height_m(rig) == pytest.approx(before_m, abs=2e-5)
    _, result, _ = states(rig, goal(rig, 5e-3, LOW_M))
    assert result.reached
    rig.run(2.0)  # of a contact since, nothing was wrong
    assert height_m(rig) == pytest.approx(P.standoff_m, abs=1e-4)


def test_tip_that_waits_low_after_a_fault_of_the_arm_rises_where_it_is_asked_to():
    rig = made()
    states(rig, goal(rig, 0.0, LOW_M))
    rig.bench.arm.break_link(ArmFault.LINK_LOST)
    rig.run(0.1)
    rig.bench.arm.repair()
    rig.bench.arm.connect()
    rig.run(2.0)
    rig.controller.retract()
    rig.run(0.6)
    assert height_m(rig) == pytest.approx(P.standoff_m, abs=1e-4)


def test_a_change_of_parameters_moves_no_tip():
    rig = made()
    states(rig, goal(rig))
    rig.run(0.2)  # the arm comes to rest
    before_m = height_m(rig)
    rig.controller.configure(replace(P, standoff_m=6e-3), rig.controller.limits)
    rig.run(2.0)
    rig.controller.retract()
    rig.run(0.5)
    assert height_m(rig) == pytest.approx(before_m, abs=2e-5)


def test_contact_that_fails_is_drawn_back_to_the_usual_standoff():
    rig = made()
    states(rig, goal(rig))
    rig.loop.start(goal(rig, 0.0, LOW_M))
    assert rig.run_until(State.HOLD)
    surface = rig.bench.plant.surface
    rig.bench.plant.surface = PlantSurface(surface.point_m - [0, 0, 0.01], surface.normal)
    assert rig.run_until(State.IDLE, 4.0)
    assert rig.controller.result.cause is Cause.CONTACT_LOST
    assert height_m(rig) == pytest.approx(P.standoff_m, abs=1e-4)


def test_surface_above_a_low_standoff_is_refused_before_it_is_pressed_on():
    rig = made()
    states(rig, goal(rig))
    surface = rig.bench.plant.surface
    rig.bench.plant.surface = PlantSurface(surface.point_m + [0, 0, 1.15e-3], surface.normal)
    result = rig.loop.make(goal(rig, 0.0, LOW_M))
    assert result.cause is Cause.SURFACE_EARLY
    assert max(rig.force_n) < 1.2 * FORCE_N


def test_standoff_is_never_raised_and_not_below_its_range():
    assert P.lowered(1.0, np.inf) == P
    low = P.lowered(LOW_M, np.inf)
    assert low.standoff_m == LOW_M
    assert low.early_m < low.standoff_m
    with pytest.raises(ValueError, match="standoff_m"):
        P.lowered(1e-4, np.inf)


FAULTS = {
    "silent": True,
    "stuck": True,
    "invalid": True,
    "saturated": True,
    "flipped": True,
    "bias_step_n": 0.03,
}


@pytest.mark.parametrize("state", [State.TRAVEL, State.APPROACH])
@pytest.mark.parametrize("fault", FAULTS)
def test_fault_of_the_cell_on_a_way_without_a_rest_is_named_and_presses_no_harder(fault, state):
    rig = made(seed=5)
    states(rig, goal(rig))
    rig.loop.start(goal(rig, 5e-3, LOW_M))
    assert rig.run_until(state)
    rig.run(0.1)
    assert rig.controller.state is state
    setattr(rig.bench.cell.faults, fault, FAULTS[fault])
    begun = len(rig.force_n)
    rig.loop.run_while(lambda: rig.controller.result is None, 5.0)
    rig.run(0.5)
    result = rig.controller.result
    assert not result.reached
    assert result.cause is not Cause.NONE
    assert max(rig.force_n[begun:]) < 0.03
    # the next contact knows no zero from before
    for name in FAULTS:
        setattr(rig.bench.cell.faults, name, type(FAULTS[name])(0))
    rig.loop.retract()
    rig.run(1.0)
    rig.bench.cell.start()
    order, result, _ = states(rig, goal(rig, 0.0))
    assert State.TARE in order
    assert result.reached
