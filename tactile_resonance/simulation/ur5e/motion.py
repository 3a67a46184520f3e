# SPDX-License-Identifier: Apache-2.0
"""The motions of URScript, one generator each: every step commands one cycle of the target.

A motion is over when the target is; the joints follow a little later. Semantics: Universal Robots,
URScript manual, e-series (SW 5.11), chapter "Motion". Where the manual leaves details open the
model's choice is stated at the function. Moves from rest to rest have a trapezoidal speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from tactile_resonance.contact.vectors import (
    ZEROS,
    Numbers,
    Transform,
    largest,
    minus,
    plus,
    transposed,
    turn_between,
    turn_product,
    turned,
)
from tactile_resonance.simulation.ur5e.kinematics import JOINT_SPEED_RAD_S, Posture
from tactile_resonance.simulation.ur5e.target import (
    CYCLE_S,
    TOOL_SPEED_M_S,
    ScriptError,
    Target,
    Thread,
)


@dataclass(frozen=True)
class Trapezoid:
    """Accelerate, cruise, brake; a triangle where the distance is too short to reach the speed.

    Attributes
    ----------
    length, speed, acceleration : float
        All above or equal to 0, speed and acceleration above 0, in units that go together.
    """

    length: float
    speed: float
    acceleration: float

    @property
    def peak(self) -> float:
        """Highest speed reached."""
        return min(self.speed, math.sqrt(self.length * self.acceleration))

    @property
    def duration(self) -> float:
        """Time from rest to rest."""
        return (
            0.0 if self.length == 0.0 else self.length / self.peak + self.peak / self.acceleration
        )

    def at(self, time: float) -> tuple[float, float]:
        """Return distance and speed at a time; at rest before the start and after the end."""
        if time <= 0.0 or self.length == 0.0:
            return 0.0, 0.0
        left = self.duration - time
        if left <= 0.0:
            return self.length, 0.0
        ramp = self.peak / self.acceleration
        if time < ramp:
            return self.acceleration * time**2 / 2, self.acceleration * time
        if left < ramp:
            return self.length - self.acceleration * left**2 / 2, self.acceleration * left
        return self.peak * (time - ramp / 2), self.peak


# Postures along a joint move at which the speed of the TCP is looked at, and the margin between.
_SPEED_CHECKS = 33
_SPEED_MARGIN = 0.98

# Least speed or acceleration of a motion, in SI units: below, its duration is beyond all numbers.
_SLOWEST = 1e-9

# Acceleration of joints under servoj (assumed; the manual gives none).
SERVO_ACCELERATION_RAD_S2 = 40.0


def movej(target: Target, goal: Numbers, acceleration: float, speed: float) -> Thread:
    """Move all joints to `goal`, together; acceleration [rad/s^2] and speed of the leading one.

    Begun in motion, it brakes first. The speed is lowered where a joint or the TCP would pass its
    limit.
    """
    _require_positive("movej", "acceleration", acceleration)
    _require_positive("movej", "speed", speed)
    yield from stopj(target, acceleration)
    start = target.q
    way_to_go = minus(goal, start)
    length = largest(way_to_go)
    if length == 0.0:
        return
    direction = tuple([way / length for way in way_to_go])
    speed = min(speed, JOINT_SPEED_RAD_S)
    tool_speed = 0.0  # of the TCP, with the leading joint at 1 rad/s
    for check in range(_SPEED_CHECKS):
        posture = Posture(_along(start, way_to_go, check / (_SPEED_CHECKS - 1)))
        velocity = posture.twist(posture.tool(target.tcp)[1], direction)[:3]
        tool_speed = max(tool_speed, math.hypot(*velocity))
    if tool_speed > 0.0:
        speed = min(speed, _SPEED_MARGIN * TOOL_SPEED_M_S / tool_speed)
    profile = Trapezoid(length, speed, acceleration)
    yielded = target.yielded_q
    time = 0.0
    while time < profile.duration:
        time += CYCLE_S * target.pace
        way, rate = profile.at(time)
        # exact at the end, whatever the rounding of the direction
        q = goal if way == length else _along(start, direction, way)
        pace = rate * target.pace
        target.command(
            plus(q, minus(target.yielded_q, yielded)),
            tuple([share * pace for share in direction]),
        )
        yield


def movel(target: Target, goal: Transform, acceleration: float, speed: float) -> Thread:
    """Move the TCP straight to a transform `goal`, turning about one axis meanwhile.

    Acceleration [m/s^2] and speed [m/s] hold for the way of the TCP or, numerically, for the angle
    [rad] turned where that is larger. Begun in motion, it brakes first.
    """
    _require_positive("movel", "acceleration", acceleration)
    _require_positive("movel", "speed", speed)
    yield from stopl(target, acceleration)
    start = target.tool
    shift = minus(goal[1], start[1])
    turn = turn_between(start, goal)
    length = max(math.hypot(*shift), math.hypot(*turn))
    if length == 0.0:
        return
    profile = Trapezoid(length, min(speed, TOOL_SPEED_M_S), acceleration)
    direction = tuple([value / length for value in (*shift, *turn)])
    yielded_m, yielded_back = target.yielded_m, transposed(target.yielded_turn)
    time = 0.0
    while time < profile.duration:
        time += CYCLE_S * target.pace
        way, rate = profile.at(time)
        tool = goal
        if way < length:
            x, y, z, rx, ry, rz = (value * way for value in direction)
            tool = turned(start, (x, y, z), (rx, ry, rz))
        aside = turn_product(target.yielded_turn, yielded_back)
        x, y, z = plus(tool[1], minus(target.yielded_m, yielded_m))
        pace = rate * target.pace
        target.command_tool(
            (turn_product(aside, tool[0]), (x, y, z)), tuple([value * pace for value in direction])
        )
        yield


def speedl(target: Target, twist: Numbers, acceleration: float, time_s: float = 0.0) -> Thread:
    """Bring the TCP to a twist [m/s, rad/s] in the base.

    Returns after `time_s`, or once the twist is reached where that is 0. The acceleration [m/s^2]
    holds for turning too, in rad/s^2.
    """
    _require_positive("speedl", "acceleration", acceleration)
    fast = math.hypot(*twist[:3]) / TOOL_SPEED_M_S
    share = target.pace / max(1.0, fast)
    goal = tuple([value * share for value in twist])
    yield from _repeated(lambda: _step_twist(target, goal, acceleration), time_s)


def speedj(target: Target, speeds: Numbers, acceleration: float, time_s: float = 0.0) -> Thread:
    """Bring the joints to speeds [rad/s]; `acceleration` [rad/s^2] is that of the leading one.

    Returns after `time_s`, or once the speeds are reached where that is 0.
    """
    _require_positive("speedj", "acceleration", acceleration)
    share = target.pace / max(1.0, largest(speeds) / JOINT_SPEED_RAD_S)
    goal = tuple([value * share for value in speeds])
    yield from _repeated(lambda: _step_joints(target, goal, acceleration), time_s)


def _repeated(step: Callable[[], bool], time_s: float) -> Thread:
    """Step for a time or, where that is 0, until a step says that the speed is reached."""
    time = 0.0
    while True:
        reached = step()
        time += CYCLE_S
        yield
        if (time > time_s - CYCLE_S / 2) if time_s > 0.0 else reached:
            return


def stopl(target: Target, deceleration: float) -> Thread:
    """Stop the TCP on a straight line; deceleration [m/s^2], numerically that of turning too."""
    _require_positive("stopl", "deceleration", deceleration)
    while any(target.qd):
        _step_twist(target, ZEROS, deceleration, straight=True)
        yield


def stopj(target: Target, deceleration: float) -> Thread:
    """Stop the joints in proportion; deceleration of the leading one [rad/s^2]."""
    _require_positive("stopj", "deceleration", deceleration)
    while any(target.qd):
        _step_joints(target, ZEROS, deceleration)
        yield


def servoj(target: Target, goal: Numbers, time_s: float, lookahead_s: float) -> Thread:
    """Follow joint angles `goal` for a time, beside them by what force mode has yielded.

    The model's choice: the joints approach the goal with the look-ahead time as time constant, under
    `SERVO_ACCELERATION_RAD_S2`; a demand for more than the joints' speed is a protective stop, as on
    the robot. The gain is not modelled.
    """
    if not 0.03 <= lookahead_s <= 0.2:
        raise ScriptError(f"servoj: lookahead_time {lookahead_s:g}; accepted is 0.03 to 0.2 s")
    if not time_s > 0.0:
        raise ScriptError(f"servoj: t {time_s:g}; accepted is above 0 s")
    for _ in range(max(1, round(time_s / CYCLE_S))):
        missing = minus(plus(goal, target.aside_q), target.q)
        wanted = tuple([angle / lookahead_s * target.pace for angle in missing])
        _step_joints(target, wanted, SERVO_ACCELERATION_RAD_S2)
        yield


def _step_twist(target: Target, goal: Numbers, acceleration: float, straight: bool = False) -> bool:
    """Change the twist towards `goal` by one cycle and say whether it is there."""
    if not any(goal) and not any(target.qd):
        target.stay()
        return True
    return target.command_towards(goal, acceleration, straight=straight)


def _step_joints(target: Target, goal: Numbers, acceleration: float) -> bool:
    """Change the joints' speeds towards `goal` by one cycle and say whether they are there."""
    missing = minus(goal, target.qd)
    fastest = largest(missing)
    allowed = acceleration * CYCLE_S
    reached = fastest <= allowed
    new = goal if reached else _along(target.qd, missing, allowed / fastest)
    mean = plus(target.qd, new)
    target.command(_along(target.q, mean, CYCLE_S / 2), new)
    return reached


def _along(start: Numbers, direction: Numbers, way: float) -> Numbers:
    """Return ``start + way direction``, six numbers."""
    return tuple([a + b * way for a, b in zip(start, direction, strict=True)])


def _require_positive(motion: str, name: str, value: float) -> None:
    if not _SLOWEST <= value < math.inf:
        raise ScriptError(f"{motion}: {name} {value:g}; accepted is above 0 ({_SLOWEST:g} or more)")
