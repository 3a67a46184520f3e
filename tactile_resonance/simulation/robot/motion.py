# SPDX-License-Identifier: Apache-2.0
"""The motions of URScript, one generator each: every step commands one cycle of the target.

A motion is over when the target is; the joints follow a little later. Semantics: Universal Robots,
URScript manual, e-series (SW 5.11), chapter "Motion". Where the manual leaves details open the
model's choice is stated at the function.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.kinematics import jacobian, link_frames
from tactile_resonance.simulation.robot.poses import turn_between, turned
from tactile_resonance.simulation.robot.profile import Trapezoid
from tactile_resonance.simulation.robot.target import CYCLE_S, ScriptError, Target

FloatArray = NDArray[np.float64]
Motion = Generator[None, None, None]

# Postures along a joint move at which the speed of the TCP is looked at, and the margin between.
_SPEED_CHECKS = 33
_SPEED_MARGIN = 0.98

# Least speed or acceleration of a motion, in SI units: below, its duration is beyond all numbers.
_SLOWEST = 1e-9

# Acceleration of joints under servoj (assumed; the manual gives none).
SERVO_ACCELERATION_RAD_S2 = 40.0


def movej(target: Target, goal: FloatArray, acceleration: float, speed: float) -> Motion:
    """Move all joints to `goal` (6,), together; acceleration [rad/s^2] and speed of the leading one.

    Begun in motion, it brakes first. The speed is lowered where a joint or the TCP would pass its
    limit.
    """
    _require_positive("movej", acceleration=acceleration, speed=speed)
    yield from stopj(target, acceleration)
    start, goal = target.q, np.array(goal, dtype=float)
    difference = goal - start
    length = float(np.abs(difference).max())
    if length == 0.0:
        return
    direction = difference / length
    speed = min(speed, target.limits.joint_speed_rad_s)
    tool_speed = 0.0  # of the TCP, with the leading joint at 1 rad/s
    for share in np.linspace(0.0, 1.0, _SPEED_CHECKS):
        frames = link_frames(start + share * difference)
        point = frames[-1] @ target.tcp[:, 3]
        velocity = jacobian(frames, point[:3])[:3] @ direction
        tool_speed = max(tool_speed, float(np.linalg.norm(velocity)))
    if tool_speed > 0.0:
        speed = min(speed, _SPEED_MARGIN * target.limits.tool_speed_m_s / tool_speed)
    profile = Trapezoid(length, speed, acceleration)
    yielded = target.yielded_q
    time = 0.0
    while time < profile.duration:
        time += CYCLE_S * target.pace
        way, rate = profile.at(time)
        # exact at the end, whatever the rounding of the direction
        q = goal if way == length else start + direction * way
        target.command(q + (target.yielded_q - yielded), direction * (rate * target.pace))
        yield


def movel(target: Target, goal: FloatArray, acceleration: float, speed: float) -> Motion:
    """Move the TCP straight to a transform `goal` (4, 4), turning about one axis meanwhile.

    Acceleration [m/s^2] and speed [m/s] hold for the way of the TCP or, numerically, for the angle
    [rad] turned where that is larger. Begun in motion, it brakes first.
    """
    _require_positive("movel", acceleration=acceleration, speed=speed)
    yield from stopl(target, acceleration)
    start = target.tool
    shift = goal[:3, 3] - start[:3, 3]
    turn = turn_between(start, goal)
    length = float(max(np.linalg.norm(shift), np.linalg.norm(turn)))
    if length == 0.0:
        return
    profile = Trapezoid(length, min(speed, target.limits.tool_speed_m_s), acceleration)
    direction = np.concatenate([shift, turn]) / length
    yielded_m, yielded_turn = target.yielded_m, target.yielded_turn
    time = 0.0
    while time < profile.duration:
        time += CYCLE_S * target.pace
        way, rate = profile.at(time)
        twist = direction * (rate * target.pace)
        tool = goal.copy()
        if way < length:
            tool = turned(start, direction[:3] * way, direction[3:] * way)
        tool[:3, :3] = target.yielded_turn @ yielded_turn.T @ tool[:3, :3]
        tool[:3, 3] += target.yielded_m - yielded_m
        target.command_tool(tool, twist)
        yield


def speedl(target: Target, twist: FloatArray, acceleration: float, time_s: float = 0.0) -> Motion:
    """Bring the TCP to a twist (6,) [m/s, rad/s] in the base.

    Returns after `time_s`, or once the twist is reached where that is 0. The acceleration [m/s^2]
    holds for turning too, in rad/s^2.
    """
    _require_positive("speedl", acceleration=acceleration)
    goal = np.array(twist, dtype=float)
    fast = float(np.linalg.norm(goal[:3])) / target.limits.tool_speed_m_s
    if fast > 1.0:
        goal /= fast
    goal *= target.pace
    time = 0.0
    while True:
        reached = _step_twist(target, goal, acceleration)
        time += CYCLE_S
        yield
        if (time > time_s - CYCLE_S / 2) if time_s > 0.0 else reached:
            return


def speedj(target: Target, speeds: FloatArray, acceleration: float, time_s: float = 0.0) -> Motion:
    """Bring the joints to speeds (6,) [rad/s]; `acceleration` [rad/s^2] is that of the leading one.

    Returns after `time_s`, or once the speeds are reached where that is 0.
    """
    _require_positive("speedj", acceleration=acceleration)
    goal = np.array(speeds, dtype=float)
    fast = float(np.abs(goal).max()) / target.limits.joint_speed_rad_s
    if fast > 1.0:
        goal /= fast
    goal *= target.pace
    time = 0.0
    while True:
        reached = _step_joints(target, goal, acceleration)
        time += CYCLE_S
        yield
        if (time > time_s - CYCLE_S / 2) if time_s > 0.0 else reached:
            return


def stopl(target: Target, deceleration: float) -> Motion:
    """Stop the TCP on a straight line; deceleration [m/s^2], numerically that of turning too."""
    _require_positive("stopl", deceleration=deceleration)
    while target.qd.any():
        _step_twist(target, np.zeros(6), deceleration, straight=True)
        yield


def stopj(target: Target, deceleration: float) -> Motion:
    """Stop the joints in proportion; deceleration of the leading one [rad/s^2]."""
    _require_positive("stopj", deceleration=deceleration)
    while target.qd.any():
        _step_joints(target, np.zeros(6), deceleration)
        yield


def servoj(target: Target, goal: FloatArray, time_s: float, lookahead_s: float) -> Motion:
    """Follow joint angles `goal` (6,) for a time, beside them by what force mode has yielded.

    The model's choice: the joints approach the goal with the look-ahead time as time constant, under
    `SERVO_ACCELERATION_RAD_S2`; a demand for more than the joints' speed is a protective stop, as on
    the robot. The gain is not modelled.
    """
    if not 0.03 <= lookahead_s <= 0.2:
        raise ScriptError(f"servoj: lookahead_time {lookahead_s:g}; accepted is 0.03 to 0.2 s")
    if not time_s > 0.0:
        raise ScriptError(f"servoj: t {time_s:g}; accepted is above 0 s")
    for _ in range(max(1, round(time_s / CYCLE_S))):
        wanted = (goal + target.aside_q - target.q) / lookahead_s * target.pace
        _step_joints(target, wanted, SERVO_ACCELERATION_RAD_S2)
        yield


def _step_twist(
    target: Target, goal: FloatArray, acceleration: float, straight: bool = False
) -> bool:
    """Change the twist towards `goal` by one cycle and say whether it is there."""
    twist = target.twist
    difference = goal - twist
    allowed = acceleration * CYCLE_S
    moving = float(np.linalg.norm(difference[:3]))
    turning = float(np.linalg.norm(difference[3:]))
    reached = max(moving, turning) <= allowed
    if reached:
        new = goal
    else:
        # when stopping, moving and turning end together, so that the path is kept
        longest = max(moving, turning, allowed)
        new = twist.copy()
        new[:3] += difference[:3] * (allowed / (longest if straight else max(moving, allowed)))
        new[3:] += difference[3:] * (allowed / (longest if straight else max(turning, allowed)))
    mean = (twist + new) / 2 * CYCLE_S
    target.command_tool(turned(target.tool, mean[:3], mean[3:]), new)
    return reached


def _step_joints(target: Target, goal: FloatArray, acceleration: float) -> bool:
    """Change the joints' speeds towards `goal` by one cycle and say whether they are there."""
    difference = goal - target.qd
    largest = float(np.abs(difference).max())
    allowed = acceleration * CYCLE_S
    reached = largest <= allowed
    new = goal if reached else target.qd + difference * (allowed / largest)
    target.command(target.q + (target.qd + new) / 2 * CYCLE_S, new)
    return reached


def _require_positive(motion: str, **values: float) -> None:
    for name, value in values.items():
        if not _SLOWEST <= value < float("inf"):
            raise ScriptError(
                f"{motion}: {name} {value:g}; accepted is above 0 ({_SLOWEST:g} or more)"
            )
