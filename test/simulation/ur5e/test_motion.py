# SPDX-License-Identifier: Apache-2.0
"""Motions keep to their limits, end where they should, and go the way they should."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid

from tactile_resonance.contact.vectors import ZEROS, transform_from_pose
from tactile_resonance.simulation.ur5e import motion
from tactile_resonance.simulation.ur5e.kinematics import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from tactile_resonance.simulation.ur5e.motion import Trapezoid
from tactile_resonance.simulation.ur5e.target import (
    BRAKE_RAD_S2,
    CYCLE_S,
    TOOL_SPEED_M_S,
    ProtectiveStop,
    ScriptError,
    Target,
)

sys.path.insert(0, str(Path(__file__).parent))
from matrices import floats, matrix, matrix_from_pose, transform, turn_between

START = np.array([0.2, -1.4, 1.6, -1.8, -1.5, 0.3])
positive = st.floats(1e-3, 1e2)


class Trace:
    """Targets of every cycle of a motion, the first at its start."""

    def __init__(self, target: Target, move, most: int = 20000) -> None:
        self.q, self.qd, self.tool, self.twist = [], [], [], []
        self._note(target)
        for cycle in range(most):
            target.begin_cycle()
            try:
                next(move)
            except StopIteration:
                break
            assert target.commanded
            target.end_cycle()
            self._note(target)
            self.cycles = cycle + 1
        self.q, self.qd = np.array(self.q), np.array(self.qd)
        self.tool, self.twist = np.array(self.tool), np.array(self.twist)

    def _note(self, target: Target) -> None:
        self.q.append(target.q)
        self.qd.append(target.qd)
        self.tool.append(matrix(target.tool))
        self.twist.append(target.twist)

    @property
    def distance(self):
        """Integral of the joints' speeds."""
        return trapezoid(self.qd, dx=CYCLE_S, axis=0)


@pytest.fixture
def target() -> Target:
    made = Target(floats(START))
    made.tcp = transform_from_pose([0.01, 0.02, 0.12, 0.1, -0.2, 0.3])
    return made


@settings(max_examples=200, deadline=None)
@given(length=positive, speed=positive, acceleration=positive)
def test_trapezoid_is_continuous_and_covers_its_length(length, speed, acceleration):
    profile = Trapezoid(length, speed, acceleration)
    assert profile.peak <= speed
    time = np.linspace(0, profile.duration, 2001)
    way, rate = np.array([profile.at(t) for t in time]).T
    assert way[0] == 0
    assert way[-1] == length
    assert np.all(np.diff(way) >= -1e-12 * length)
    step = time[1]
    assert np.abs(np.diff(rate)).max() <= acceleration * step * (1 + 1e-6)
    # the trapezoidal rule cuts the two corners
    corners = acceleration * step**2 / 4
    assert trapezoid(rate, time) == pytest.approx(length, rel=1e-9, abs=1.01 * corners)
    # shortest time under both limits, from the areas of trapezoid and triangle
    if speed**2 / acceleration <= length:
        assert profile.duration == pytest.approx(length / speed + speed / acceleration)
    else:
        assert profile.duration == pytest.approx(2 * np.sqrt(length / acceleration))


@pytest.mark.parametrize(("speed", "acceleration"), [(0.8, 1.4), (3.0, 0.5), (0.05, 30.0)])
def test_movej_keeps_its_limits_and_ends_exactly(target, speed, acceleration):
    goal = START + [0.3, -0.2, 0.1, 0.0, 0.5, -0.4]
    trace = Trace(target, motion.movej(target, floats(goal), acceleration, speed))
    assert np.array_equal(target.q, goal)
    assert not any(target.qd)
    leading = np.abs(trace.qd).max(axis=1)
    assert leading.max() <= speed * (1 + 1e-12)
    assert np.abs(np.diff(trace.qd, axis=0)).max() <= acceleration * CYCLE_S * (1 + 1e-9)
    # all joints move in proportion
    np.testing.assert_allclose(trace.qd, leading[:, None] * (goal - START) / 0.5, atol=1e-12)
    np.testing.assert_allclose(trace.distance, goal - START, atol=acceleration * CYCLE_S**2)
    expected = Trapezoid(0.5, min(speed, np.pi), acceleration).duration
    assert expected <= trace.cycles * CYCLE_S < expected + CYCLE_S


def test_movej_lowers_its_speed_to_the_limits_of_joints_and_tool(target):
    goal = START.copy()
    goal[0] += 3.0
    trace = Trace(target, motion.movej(target, floats(goal), 40.0, 20.0))
    assert np.abs(trace.qd).max() <= JOINT_SPEED_RAD_S
    tool_speed = np.linalg.norm(trace.twist[:, :3], axis=1)
    assert 0.9 * TOOL_SPEED_M_S < tool_speed.max() <= TOOL_SPEED_M_S
    goal[5] += 3.0
    trace = Trace(target, motion.movej(target, floats(goal), 40.0, 20.0))
    assert np.abs(trace.qd).max() == pytest.approx(np.pi, rel=1e-9)


def test_movel_goes_straight_and_turns_about_one_axis(target):
    start = matrix(target.tool)
    goal = start @ matrix_from_pose([0.03, 0.05, -0.06, 0.2, -0.1, 0.15])
    trace = Trace(target, motion.movel(target, transform(goal), 0.6, 0.25))
    np.testing.assert_allclose(matrix(target.tool), goal, atol=1e-12)
    assert not any(target.qd)
    way = goal[:3, 3] - start[:3, 3]
    direction = way / np.linalg.norm(way)
    travelled = trace.tool[:, :3, 3] - start[:3, 3]
    along = travelled @ direction
    np.testing.assert_allclose(travelled, np.outer(along, direction), atol=1e-12)
    turn = turn_between(start, goal)
    for tool, share in zip(trace.tool[::20], along[::20] / np.linalg.norm(way), strict=True):
        np.testing.assert_allclose(turn_between(start, tool), turn * share, atol=1e-12)
    assert np.linalg.norm(trace.twist[:, 3:], axis=1).max() <= 0.25 * (1 + 1e-9)
    change = np.diff(trace.twist, axis=0)
    assert np.linalg.norm(change[:, :3], axis=1).max() <= 0.6 * CYCLE_S * (1 + 1e-6)
    covered = trapezoid(trace.twist[:, :3], dx=CYCLE_S, axis=0)
    np.testing.assert_allclose(covered, way, atol=0.6 * CYCLE_S**2)


def test_a_move_begun_in_motion_brakes_first_and_ends_exactly(target):
    Trace(target, motion.speedj(target, [0.2, 0, 0, 0, 0, 0.4], 1.0))
    assert any(target.qd)
    goal = START + 0.1
    trace = Trace(target, motion.movej(target, floats(goal), 1.0, 0.3))
    assert np.array_equal(target.q, goal)
    assert np.abs(np.diff(trace.qd, axis=0)).max() <= 1.0 * CYCLE_S * (1 + 1e-9)


def test_speedl_ramps_straight_to_its_twist_and_stops_within_v2_over_2a(target):
    start = matrix(target.tool)[:3, 3]
    twist = np.array([0.03, -0.04, 0.0, 0.0, 0.0, 0.1])
    trace = Trace(target, motion.speedl(target, floats(twist), 0.5))
    assert trace.cycles * CYCLE_S == pytest.approx(0.2, abs=1.5 * CYCLE_S)  # the turn needs longer
    np.testing.assert_allclose(target.twist, twist, atol=1e-12)
    before = matrix(target.tool)[:3, 3]
    stop = Trace(target, motion.stopl(target, 0.25))
    assert not any(target.qd)
    # moving and turning stop together, turning at the deceleration asked for
    assert stop.cycles * CYCLE_S == pytest.approx(0.4, abs=1.5 * CYCLE_S)
    way = target.tool[1] - before
    np.testing.assert_allclose(way, twist[:3] * 0.4 / 2, atol=0.05 * CYCLE_S)
    travelled = target.tool[1] - start
    np.testing.assert_allclose(np.cross(travelled, twist[:3]), 0, atol=1e-12)


def test_speedl_takes_its_time_and_no_more_than_the_tool_speed(target, monkeypatch):
    monkeypatch.setattr(motion, "TOOL_SPEED_M_S", 0.3)
    trace = Trace(target, motion.speedl(target, [0, 0, -4.0, 0, 0, 0], 20.0, 0.09))
    assert trace.cycles == 45
    np.testing.assert_allclose(target.twist, [0, 0, -0.3, 0, 0, 0], atol=1e-12)


def test_speedj_and_stopj_keep_joints_in_proportion(target):
    speeds = np.array([0.1, -0.2, 0.3, 0.05, 0.0, 0.4])
    trace = Trace(target, motion.speedj(target, floats(speeds), 0.8))
    np.testing.assert_allclose(trace.qd, np.outer(trace.qd[:, 5] / 0.4, speeds), atol=1e-12)
    before = np.array(target.q)
    Trace(target, motion.stopj(target, 2.0))
    np.testing.assert_allclose(target.q - before, speeds * 0.4 / (2 * 2.0), atol=4e-4)


def test_servoj_approaches_its_goal_with_the_look_ahead_time(target):
    goal = START + [0.004, 0, 0, 0, 0, -0.002]
    Trace(target, motion.servoj(target, floats(goal), 0.5, 0.05))
    left = np.abs(goal - target.q).max()
    # exponential approach; the limit of acceleration delays its beginning by milliseconds
    assert 0.004 * np.exp(-0.5 / 0.05) / 2 < left < 0.004 * np.exp(-0.48 / 0.05)


def test_servoj_far_away_is_a_protective_stop(target):
    with pytest.raises(ProtectiveStop, match="joint 1 would turn"):
        Trace(target, motion.servoj(target, floats(START + [0.8, 0, 0, 0, 0, 0]), 1.0, 0.1))


def test_a_path_out_of_reach_stops_before_a_joint_passes_its_speed(target):
    goal = matrix(target.tool)
    goal[:3, 3] += goal[:3, 3] / np.linalg.norm(goal[:3, 3]) * 1.0
    fastest = 0.0
    move = motion.movel(target, transform(goal), 0.5, 0.25)
    with pytest.raises(ProtectiveStop):  # noqa: PT012 - the motion is stepped until it stops
        while True:
            target.begin_cycle()
            next(move)
            fastest = max(fastest, np.abs(target.qd).max())
    assert 0.25 < fastest <= JOINT_SPEED_RAD_S * (1 + 1e-6)


def test_a_joint_does_not_pass_its_range(target):
    with pytest.raises(ProtectiveStop, match="beyond its range"):
        Trace(target, motion.speedj(target, [0, 0, 0, 0, 0, 3.0], 10.0, 5.0))
    assert np.abs(target.q).max() <= JOINT_RANGE_RAD


def test_two_threads_cannot_move_the_arm_at_once(target):
    target.begin_cycle()
    next(motion.speedj(target, [0.1] * 6, 1.0))
    with pytest.raises(ScriptError, match="another thread"):
        next(motion.speedl(target, [0.1] * 6, 1.0))


def test_a_speed_of_zero_holds_the_arm_where_it_is_and_takes_its_turn(target):
    target.hold(ZEROS)  # stretched: no other speed of the TCP could be had here
    for _ in range(3):
        target.begin_cycle()
        next(motion.speedl(target, ZEROS, 1.0))
        assert target.q == ZEROS
        with pytest.raises(ScriptError, match="another thread"):
            next(motion.speedj(target, (0.1,) * 6, 1.0))
        target.end_cycle()
    target.begin_cycle()
    with pytest.raises(ProtectiveStop):
        next(motion.speedl(target, (0.0, 0.0, 1e-3, 0.0, 0.0, 0.0), 1.0))


@pytest.mark.parametrize("acceleration", [0.0, -1.0, np.nan, np.inf])
def test_accelerations_must_be_positive(target, acceleration):
    with pytest.raises(ScriptError, match="accepted is above 0"):
        next(motion.movej(target, floats(START + 0.1), acceleration, 1.0))


def test_half_the_pace_takes_twice_the_time(target):
    goal = START + 0.2
    full = Trace(target, motion.movej(target, floats(goal), 1.0, 0.4)).cycles
    target.pace = 0.5
    slow = Trace(target, motion.movej(target, floats(START), 1.0, 0.4))
    assert slow.cycles == pytest.approx(2 * full, abs=2)
    assert np.abs(slow.qd).max() == pytest.approx(0.2)


def test_nobody_in_command_the_arm_brakes(target):
    Trace(target, motion.speedj(target, [0.5, 0, 0, 0, 0, 0], 10.0))
    before = np.array(target.q)
    while any(target.qd):
        target.begin_cycle()
        target.end_cycle()
        assert target.qdd[0] >= -BRAKE_RAD_S2 * (1 + 1e-9)
    way = 0.5**2 / (2 * BRAKE_RAD_S2)
    np.testing.assert_allclose(target.q - before, [way, 0, 0, 0, 0, 0], atol=1e-4)
