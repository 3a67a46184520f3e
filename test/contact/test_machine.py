# SPDX-License-Identifier: Apache-2.0
"""The life of a contact: reached and held, given up, refused; parameters never move the robot."""

import re
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.clock import WallClock
from tactile_resonance.contact.cell_checks import require_fit
from tactile_resonance.contact.geometry import TipGeometry, touch_pose
from tactile_resonance.contact.goal import Cause, ContactGoal, HoldMode, NotIdleError, State
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.simulation.cell.transducer import CellParameters
from tactile_resonance.simulation.plant.contact_bench import DISH_KG
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.ur5e.machine import TrackingParameters

sys.path.insert(0, str(Path(__file__).parent))
from contacts import FORCE_N, QUICK, RADIUS_M, SOFT, contact, lower, started, stiffer

EARLY = replace(QUICK, early_m=1.55e-3)


@pytest.mark.parametrize("tissue", [stiffer(SOFT, 0.4), SOFT, stiffer(SOFT, 4.0)])
def test_force_is_reached_held_and_reported_with_an_honest_deviation(tissue):
    made = contact(tissue, seed=7)
    result = made.loop.make(made.goal)
    assert result.reached
    made.run(1.0)
    true = np.mean(made.force_n[-500:])
    assert true == pytest.approx(FORCE_N, rel=0.05)
    assert max(made.force_n) < 1.15 * FORCE_N
    assert made.bench.plant.touches == 1
    held = made.controller.result
    assert abs(held.force_n - true) < 4 * held.force_std_n
    assert held.force_std_n < 3e-4
    assert made.loop.retract().retracted
    assert made.controller.state is State.IDLE
    assert made.force_n[-1] == 0


def test_states_follow_each_other():
    made = contact()
    seen = []
    made.bench.on_step.append(lambda: seen.append(made.controller.state))
    made.loop.make(made.goal)
    made.run(0.1)
    made.loop.retract()
    made.run(0.01)
    order = [s for n, s in enumerate(seen) if n == 0 or s is not seen[n - 1]]
    want = ["travel", "tare", "approach", "contact", "settle", "hold", "retract", "idle"]
    assert [s.value for s in order if s is not State.IDLE] + ["idle"] == want


def test_all_six_axes_go_to_the_pose_of_the_point():
    touch = touch_pose([0.02, -0.01, 0.0], [0.1, -0.05, 1.0], [1, 1, 0], RADIUS_M)
    made = contact(height_m=0.0, start_m=0.02)
    made.bench.plant.surface = type(made.bench.plant.surface)(
        np.array([0.02, -0.01, 0.0]), touch.rotation.as_matrix()[:, 2]
    )
    assert made.loop.make(ContactGoal(touch, FORCE_N)).reached
    tip = made.bench.motion.reported
    assert (touch.rotation * tip.rotation.inv()).magnitude() < 0.01
    normal = touch.rotation.as_matrix()[:, 2]
    way = tip.position_m - touch.position_m
    assert np.linalg.norm(way - (normal @ way) * normal) < 1e-4
    assert made.controller.result.surface_m == pytest.approx(0, abs=2e-4)


def test_indentation_is_held_while_the_force_decays():
    made = contact(hold=HoldMode.INDENTATION)
    assert made.loop.make(made.goal).reached
    made.run(0.2)
    place, force = made.bench.motion.reported.position_m[2], made.force_n[-1]
    made.run(1.0)
    assert made.bench.motion.reported.position_m[2] == pytest.approx(place, abs=3e-6)
    assert made.force_n[-1] < 0.9 * force


@pytest.mark.parametrize("state", [s for s in State if s not in (State.IDLE, State.FAULT)])
def test_a_cancelled_contact_draws_back_from_every_state(state):
    made = started()
    if state is State.RETRACT:
        assert made.run_until(State.HOLD)
        made.controller.retract()
    assert made.run_until(state)
    made.controller.retract()
    made.loop.cycle()
    assert made.controller.state in (State.RETRACT, State.IDLE)  # above the standoff: done
    assert made.run_until(State.IDLE, 5.0)
    result = made.controller.result
    assert result.cause is Cause.CANCELLED
    assert result.retracted
    assert result.reached == (state in (State.HOLD, State.RETRACT))
    assert max(made.force_n, default=0.0) < 1.2 * FORCE_N


def test_parameters_are_refused_in_contact_and_nothing_changes():
    made = started()
    assert made.run_until(State.HOLD)
    before = made.controller.parameters
    with pytest.raises(NotIdleError, match="refused in state hold"):
        made.controller.configure(replace(before, approach_speed_m_s=1e-3), Limits())
    with pytest.raises(NotIdleError, match="goal: refused in state hold"):
        made.loop.start(made.goal)
    assert made.controller.parameters is before
    speed = np.abs(made.speed_m_s[-10:]).max()
    made.run(0.1)
    assert np.abs(made.speed_m_s[-50:]).max() < speed + 5e-4
    made.loop.retract()
    made.controller.configure(replace(before, approach_speed_m_s=1e-3), Limits())


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (lambda t: ContactGoal(t, 0.025), "force_n: got 0.025"),
        (lambda t: ContactGoal(Pose(t.position_m * np.nan, t.rotation_rad), 0.01), "finite"),
        (lambda t: ContactGoal(Pose(t.position_m + 5, t.rotation_rad), 0.01), "workspace"),
        (lambda t: ContactGoal(Pose(t.position_m, np.array([1.0, 0, 0])), 0.01), "tilted"),
    ],
)
def test_goals_beyond_the_limits_are_refused(goal, message):
    made = contact()
    with pytest.raises(ValueError, match=message):
        made.loop.start(goal(made.goal.touch))
    assert made.controller.state is State.IDLE
    made.run(0.05)
    assert np.abs(made.speed_m_s).max() == 0


@pytest.mark.parametrize("tissue", [SOFT, stiffer(SOFT, 4.0)])
def test_surface_higher_than_accepted_is_refused(tissue):
    made = contact(tissue, parameters=replace(QUICK, early_m=0.5e-3))
    result = made.loop.make(made.goal)
    assert result.cause is Cause.SURFACE_EARLY
    assert made.run_until(State.IDLE, 3.0)
    assert max(made.force_n) < 1.2 * FORCE_N


def test_hold_ends_after_its_time():
    made = contact(limits=Limits(hold_s=0.2))
    assert made.loop.make(made.goal).reached
    made.run_until(State.IDLE, 3.0)
    result = made.controller.result
    assert result.reached
    assert result.cause is Cause.HOLD_ENDED
    assert result.retracted


def test_unsteady_zero_is_refused():
    parameters = replace(QUICK, cell_noise_n=2e-4)
    made = contact(parameters=parameters)
    result = made.loop.make(made.goal)
    assert result.cause is Cause.TARE
    assert "noise" in result.message
    made.run(0.5)
    assert max(made.force_n) == 0


def test_a_zero_that_nothing_explains_is_refused_and_a_dish_with_its_sample_is_not():
    dish_n = DISH_KG * 9.80665
    made = contact()
    assert made.loop.make(made.goal).reached
    assert abs(made.controller.bias_n[2]) == pytest.approx(dish_n, abs=0.1)
    pressed = contact()
    pressed.bench.cell.faults.bias_step_n = -1.0  # as a hand on the dish, or a step
    result = pressed.loop.make(pressed.goal)
    assert result.cause is Cause.TARE
    read_mn, accepted_mn = (float(mn) for mn in re.findall(r"(\d+) mN", result.message))
    assert (read_mn, accepted_mn) == (pytest.approx(1e3 * (dish_n + 1.0), abs=100), 2500)
    assert max(pressed.force_n) == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_the_usual_force_is_held_and_its_loss_is_told(seed):
    # a source that serves 2 mN by contact.cell_checks: a tenth of it as noise
    cell = replace(CellParameters.from_yaml(), force_noise_rms_n=2e-4, force_divisor=20000.0)
    cell = replace(cell, force_bias_n=(0.0, 0.0, 0.5))  # most of the dish: within its counts
    parameters = replace(QUICK, cell_noise_n=2e-4)
    made = contact(parameters=parameters, cell_parameters=cell, force_n=2e-3, seed=seed)
    require_fit(made.bench.cell.info, 2e-3)
    result = made.loop.make(made.goal)
    assert result.reached, result.message
    begun = len(made.force_n)
    made.run(3.0)
    assert made.controller.state is State.HOLD, made.controller.result.message
    assert np.mean(made.force_n[begun:]) == pytest.approx(2e-3, rel=0.1)
    lower(made.bench, 5e-3)
    assert made.run_until(State.IDLE, 3.0)
    assert made.controller.result.cause is Cause.CONTACT_LOST
    assert "limit 0.4 mN" in made.controller.result.message


def test_same_seed_same_contact_to_the_last_bit():
    forces = []
    for _ in range(2):
        made = contact(seed=5)
        made.loop.make(made.goal)
        forces.append(made.force_n)
    assert forces[0] == forces[1]


def test_thirty_contacts_in_a_row_do_not_drift():
    parameters = replace(QUICK, tare_s=0.1)
    made = contact(
        stiffer(SOFT, 2.0),
        parameters=parameters,
        height_m=1.5e-3,
        tracking=TrackingParameters(),
        seed=11,
    )
    means = []
    for _ in range(30):
        assert made.loop.make(made.goal).reached
        made.run(0.1)
        made.run(0.2)
        means.append(np.mean(made.force_n[-100:]))
        assert made.loop.retract().retracted
    slope, offset = np.polyfit(np.arange(30), means, 1)
    residual = means - (slope * np.arange(30) + offset)
    slope_std = residual.std(ddof=2) / np.sqrt(30 * (30**2 - 1) / 12)
    assert abs(slope) < 3.5 * slope_std
    assert np.mean(means) == pytest.approx(FORCE_N, rel=0.02)
    # bias of a tare, 50 forces of 1 mN, and what the hold leaves over 0.2 s
    assert residual.std() < 0.035 * FORCE_N


def test_wrong_idea_of_the_arm_is_survived():
    # dead time and lag are twice what the controller believes
    slow = TrackingParameters(dead_time_s=0.008, lag_s=0.020)
    made = contact(stiffer(SOFT, 4.0), tracking=slow, seed=2)
    assert made.loop.make(made.goal).reached
    made.run(1.0)
    assert np.mean(made.force_n[-500:]) == pytest.approx(FORCE_N, rel=0.05)
    assert max(made.force_n) < 2 * FORCE_N


def test_housing_stays_clear_of_the_tissue():
    tip = TipGeometry()
    # 64 mm at 0.17 rad rise 10.8 mm; ball 2.5 mm; housing 6 mm below the beam
    up, back = 0.064 * np.sin(0.17) - 6e-3, 0.064 * np.cos(0.17)
    assert tip.worst_height(0.0, 0.0) == pytest.approx(2.5e-3 + up)
    assert tip.worst_height(3e-3, 0.0) == pytest.approx(2.5e-3 + up - 3e-3)
    assert tip.worst_height(0.0, 0.05) == pytest.approx(
        2.5e-3 + up * np.cos(0.05) - back * np.sin(0.05)
    )
    with pytest.raises(ValueError, match="beam_tilt_rad: got 2"):
        TipGeometry(beam_tilt_rad=2)


@pytest.mark.parametrize("state", [State.TRAVEL, State.TARE])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_tip_that_leaves_the_way_of_its_goal_is_stopped(state, axis):
    made = started(start_m=0.1 if state is State.TRAVEL else 2.5e-3)
    assert made.run_until(state)
    made.run(0.05)
    start = np.array(made.bench.motion.reported.position_m)
    away = np.zeros(6)
    away[axis] = 0.1  # [m/s]: somebody else commands the arm
    obeys = made.bench.arm.speed
    made.bench.arm.speed = lambda twist, limit: obeys(away, limit)
    made.bench.arm.stop, stops = lambda limit: obeys(away, limit), made.bench.arm.stop
    made.loop.run_while(lambda: made.controller.result is None, 3.0)
    result = made.controller.result
    assert result.cause is Cause.WORKSPACE, result.message
    assert "off the way of its goal" in result.message
    gone = made.bench.motion.reported.position_m[axis] - start[axis]
    assert 0.045 < gone < 0.055
    made.bench.arm.speed, made.bench.arm.stop = obeys, stops
    assert made.run_until(State.IDLE, 3.0), "beside its way the tip is drawn back"


@pytest.mark.parametrize(("start_m", "turned_rad"), [(0.3, 0.0), (1e-4, 0.0), (0.02, 0.5)])
def test_a_way_from_afar_from_below_or_with_a_turn_is_within_its_box(start_m, turned_rad):
    made = contact(start_m=start_m)
    place_m, turn = made.goal.touch.position_m, made.goal.touch.rotation
    turned = Rotation.from_rotvec([0.0, 0.0, turned_rad]) * turn
    goal = replace(made.goal, touch=Pose(place_m, turned.as_rotvec()))
    result = made.loop.make(goal)
    assert result.reached, result.message


def test_touch_pose_puts_the_ball_on_the_point():
    normal = np.array([0.2, -0.1, 1.0])
    pose = touch_pose([0.1, 0.2, 0.3], normal, [0, 1, 0], RADIUS_M)
    turn = pose.rotation.as_matrix()
    np.testing.assert_allclose(turn[:, 2], normal / np.linalg.norm(normal), atol=1e-12)
    assert turn[1, 0] > 0.9  # x of the tip where it was asked for
    lowest = pose.position_m - RADIUS_M * turn[:, 2]
    np.testing.assert_allclose(lowest, [0.1, 0.2, 0.3], atol=1e-12)
    for bad in ([0, 0, 0], [0, np.nan, 1]):
        with pytest.raises(ValueError, match="normal"):
            touch_pose([0, 0, 0], bad, [1, 0, 0], RADIUS_M)
    with pytest.raises(ValueError, match="towards"):
        touch_pose([0, 0, 0], [0, 0, 1], [0, 0, 1], RADIUS_M)


def test_defaults_of_the_code_are_within_their_ranges():
    Limits().check(ContactParameters())


def test_wall_clock_returns_at_the_time_and_at_once_after_it():
    clock = WallClock()
    time_ns = clock.now_ns() + 3_000_000
    clock.wait_until(time_ns)
    assert clock.now_ns() >= time_ns
    clock.wait_until(time_ns - 10**12)


@pytest.mark.parametrize("step_s", [-1.0, 0.4, 3600.0])
def test_wall_clock_follows_ros_time_that_is_set(monkeypatch, step_s):
    """Else forces over a block, and the age of a contact, would be those of another time from then on."""
    clock, set_s, time_ns = WallClock(), 0.0, time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: time_ns() + round(1e9 * set_s))
    before = clock.ros_ns(0)
    assert clock.ros_ns(0) == before
    set_s = step_s
    assert clock.ros_ns(0) - before == pytest.approx(1e9 * step_s, abs=1e6)
    assert clock.own_ns(clock.ros_ns(123)) == 123


def test_stop_that_the_arm_did_not_hear_is_told_again():
    """Also where the retraction has ended and nothing more is to be told: an arm keeps its velocity."""
    made = started()
    assert made.run_until(State.HOLD)
    made.controller.retract()
    hears, unheard = made.bench.arm.stop, []

    def stop(deceleration_m_s2):
        if made.controller.state is State.IDLE and not unheard:
            unheard.append(made.bench.time_ns)
            raise ArmError(ArmFault.STALE, "the newest state is too old")
        hears(deceleration_m_s2)

    made.bench.arm.stop = stop
    assert made.run_until(State.IDLE)
    made.run(0.3)
    assert unheard
    assert abs(made.speed_m_s[-1]) < 1e-6


def test_tip_left_pressing_beside_the_goal_is_lifted_before_it_goes_along():
    made = contact(height_m=0.0)
    assert made.loop.make(made.goal).reached
    # a new controller knows nothing of that; its goal lies 3 mm beside
    touch = made.goal.touch
    beside = replace(
        made.goal, touch=Pose(touch.position_m + [3e-3, 0, 0], touch.rotation_rad)
    )
    controller = ContactController(QUICK, Limits())
    loop = ContactLoop(made.bench.arm, made.bench.cell, made.bench, controller)
    way, since = [], len(made.force_n)
    made.bench.on_step.append(lambda: way.append(made.bench.plant.tip_m[0]))
    assert loop.make(beside).reached
    force = np.array(made.force_n[since:])
    lifted = int(np.argmax(force == 0))
    assert lifted > 10
    assert np.ptp(way[:lifted]) < 3e-5
    assert way[-1] == pytest.approx(3e-3, abs=1e-4)


def test_force_that_leaves_a_tip_left_pressing_is_no_touch():
    made = contact(height_m=0.0, force_n=0.018)
    assert made.loop.make(made.goal).reached
    # a new controller knows nothing of that, and is to touch at the same place
    controller = ContactController(QUICK, Limits())
    loop = ContactLoop(made.bench.arm, made.bench.cell, made.bench, controller)
    result = loop.make(made.goal)
    assert result.reached, result.message


@pytest.mark.parametrize("seed", range(6))
def test_touch_told_by_noise_above_the_surface_is_no_early_surface(seed):
    # 0.2 mm above the tissue the cell shows 3 mN for 10 ms; the surface lies within what is accepted
    made = started(stiffer(SOFT, 2.0), height_m=1.5e-3, seed=seed, parameters=EARLY)
    assert made.run_until(State.APPROACH)
    tip = made.bench.motion
    made.loop.run_while(lambda: tip.reported.position_m[2] - RADIUS_M > 1.7e-3)
    made.bench.cell.faults.bias_step_n = -3e-3
    made.run(0.01)
    made.bench.cell.faults.bias_step_n = 0.0
    made.loop.run_while(lambda: made.controller.result is None)
    assert made.controller.result.reached, made.controller.result.message
    assert made.controller.result.surface_m < EARLY.early_m


def test_touch_told_by_the_resonance_slows_the_rest_of_the_approach():
    made = started(height_m=0.0)
    assert not made.controller.tell_touch()  # not in an approach
    assert made.run_until(State.APPROACH)
    tip = made.bench.motion
    made.loop.run_while(lambda: tip.reported.position_m[2] - RADIUS_M > 1e-3)
    told_m = tip.reported.position_m[2] - RADIUS_M
    assert made.controller.tell_touch()
    assert not made.controller.tell_touch()
    made.run(0.1)
    began = len(made.speed_m_s)
    made.run(0.3)
    np.testing.assert_allclose(made.speed_m_s[began:], -QUICK.told_speed_m_s, rtol=0.05)
    made.loop.run_while(lambda: made.controller.result is None)
    assert made.controller.result.reached
    assert made.controller.result.told_m == pytest.approx(told_m, abs=2e-5)


def test_pressing_is_limited_from_the_touch_on_however_it_is_divided():
    shaken = contact(
        height_m=5e-4,
        parameters=replace(QUICK, tolerance=0.01, settle_s=2.0),
        limits=Limits(press_s=1.0),
        seed=1,
    )
    bench, since_s = shaken.bench, {}

    def shake():
        t_s = bench.time_ns * 1e-9
        since_s.setdefault(shaken.controller.state, t_s)
        height_m = 5e-4 + 1e-4 * min(1.0, max(0.0, t_s - 0.5)) * np.sin(6 * np.pi * t_s)
        bench.plant.surface = PlantSurface.tilted(height_m, 0.0)

    bench.on_step.append(shake)
    result = shaken.loop.make(shaken.goal)
    assert result.cause is Cause.TIME
    assert State.SETTLE in since_s
    assert bench.time_ns * 1e-9 - since_s[State.CONTACT] == pytest.approx(1.0, abs=0.01)
