# SPDX-License-Identifier: Apache-2.0
"""The arm as a machine: targets, joints, flange sensor and what the tool touches, on one clock.

The joints follow their targets, with dead time and lag, and the tip trembles beside them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from tactile_resonance.contact.vectors import Vector, dot, rotated_back
from tactile_resonance.fields import AboveZero, Checked, NotNegative
from tactile_resonance.simulation.noise import Jitter, Seed
from tactile_resonance.simulation.ur5e.forces import (
    STANDARD_GRAVITY_M_S2,
    ForceMode,
    FtSensor,
    FtSpecification,
    ToolPayload,
)
from tactile_resonance.simulation.ur5e.kinematics import Posture
from tactile_resonance.simulation.ur5e.poses import (
    IDENTITY,
    ORIGIN,
    ZERO,
    Six,
    Transform,
    difference,
    largest,
    pose_from_transform,
    rounded,
    total,
    transform_from_pose,
    wrench_about_origin,
)
from tactile_resonance.simulation.ur5e.target import (
    CYCLE_S,
    MotionLimits,
    ScriptError,
    Target,
    rate,
)


@dataclass(frozen=True)
class TrackingParameters(Checked):
    """How an arm follows; the defaults are chosen to resemble a UR e-series, not measured on one.

    Attributes
    ----------
    dead_time_s : float
        From a command to the first motion [s].
    lag_s : float
        Time constant of the motion behind its set point [s].
    jitter_rms_m : float
        Vibration of the tip on each axis [m], unseen by the joint encoders.
    jitter_corner_rad_s : float
        Its spectrum falls as of white noise through two poles at this rate [rad/s].
    """

    dead_time_s: NotNegative = 0.004
    lag_s: NotNegative = 0.010
    jitter_rms_m: NotNegative = 3e-6
    jitter_corner_rad_s: AboveZero = 50.0


class Lag:
    """Any number of axes behind their set points: dead time, then a first-order lag.

    Exact for set points that run linearly over each period; a dead time that is no multiple of the
    period is interpolated.

    Attributes
    ----------
    value : tuple of float
        Where the axes are.
    """

    def __init__(
        self, parameters: TrackingParameters, start: Sequence[float], period_s: float
    ) -> None:
        self.value = tuple(start)
        periods = parameters.dead_time_s / period_s
        whole = int(periods + 1e-9)
        self._fraction = max(0.0, periods - whole)
        self._line: deque[Sequence[float]] = deque([self.value] * (whole + 2), maxlen=whole + 2)
        self._delayed: Sequence[float] = self.value
        lag = parameters.lag_s
        self._decay = math.exp(-period_s / lag) if lag > 0 else 0.0
        self._slope = lag / period_s * (1 - self._decay)

    def step(self, target: Sequence[float]) -> tuple[float, ...]:
        """Advance one period, at whose end the set points are `target`; return `value`."""
        line, before, decay, slope = self._line, self._delayed, self._decay, self._slope
        line.append(target)
        now = line[1]
        if self._fraction:
            now = [b + self._fraction * (a - b) for a, b in zip(line[0], now, strict=True)]
        if now is before and tuple(now) == self.value:  # at rest
            return self.value
        self._delayed = now
        axes = zip(self.value, before, now, strict=True)
        self.value = tuple([n + decay * (value - b) - slope * (n - b) for value, b, n in axes])
        return self.value


class Joints:
    """Actual angles and speeds of the joints: dead time and lag behind the target.

    Attributes
    ----------
    posture : Posture
        At the angles that the encoders say [rad]; the same object while they do not change.
    qd : 6 floats
        Speeds [rad/s].
    tremble_m : Vector
        Vibration of the tool in the base, which the encoders do not see.
    """

    def __init__(self, q: Six, tracking: TrackingParameters, seed: Seed) -> None:
        self._tracking = tracking
        self._jitter = Jitter(tracking.jitter_rms_m, tracking.jitter_corner_rad_s, CYCLE_S, seed)
        self.posture = Posture(q)
        self.tremble_m: Vector = ORIGIN
        self.hold()

    @property
    def q(self) -> Six:
        """Angles [rad]."""
        return self.posture.q

    @property
    def qdd(self) -> Six:
        """Accelerations [rad/s^2]."""
        return rate(self._slower, self.qd)

    def reseed(self, seed: Seed) -> None:
        """Let vibration follow from a seed, from the next step on."""
        self._jitter.reseed(seed)

    def step(self, target_q: Six, powered: bool) -> None:
        """Follow for one cycle; without power the brakes hold the joints where they are."""
        if not powered:
            self._slower = self.qd = ZERO
            return
        before, self._slower = self.posture.q, self.qd
        q = self._lag.step(target_q)
        if q != before:
            self.posture = Posture(q)
        self.qd = ZERO if q == before else rate(before, q)
        self.tremble_m = self._jitter.step()

    def hold(self) -> Six:
        """Forget what is pending and return the angles at which the brakes caught the joints."""
        self._lag = Lag(self._tracking, self.q, CYCLE_S)
        self._slower = self.qd = ZERO
        return self.q


# Cycles for which joint positions are remembered: one second.
HISTORY = 500
# Of rest before the arm counts as steady (``is_steady``, URScript manual): 0.5 s.
STEADY_CYCLES = 250
# The same where nothing is expected to happen soon: 1 s, longer than a client rests for its tare.
REST_CYCLES = 500


class Environment(Protocol):
    """What the tool touches; `simulation.plant.Plant` is one.

    Attributes
    ----------
    force_n, torque_nm : Vector
        On the tip and about it, along the axes of the base [N], [N m].
    """

    force_n: Vector
    torque_nm: Vector

    def step(self, tip: Transform, dt_s: float) -> None:
        """Move the tip to a true place in the base within `dt_s`."""
        ...


@dataclass(frozen=True)
class MachineConfig:
    """The arm and what is mounted on it.

    Attributes
    ----------
    start_q : 6 floats
        Joint angles at power-up [rad].
    tip_in_flange : 6 floats
        True pose of the tip in the flange; the program does not know it unless it sets its TCP so.
    tool : ToolPayload
        True mass on the flange; the controller compensates the payload that the program sets.
    limits : MotionLimits
    tracking : TrackingParameters
        Of the joints; the vibration is the tip's.
    ft : FtSpecification
    contact_force_n : float
        Measured force that ``tool_contact`` takes for a contact. The robot's own threshold is not
        published; this is the model's.
    """

    start_q: Six = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)
    tip_in_flange: Six = ZERO
    tool: ToolPayload = field(default_factory=ToolPayload)
    limits: MotionLimits = field(default_factory=MotionLimits)
    tracking: TrackingParameters = field(default_factory=TrackingParameters)
    ft: FtSpecification = field(default_factory=FtSpecification)
    contact_force_n: float = 15.0


class Machine:
    """The arm, moved by its target in steps of 2 ms.

    Attributes
    ----------
    target : Target
    joints : Joints
    sensor : FtSensor
    force_mode : ForceMode
    payload : ToolPayload
        As the program set it.
    gravity_m_s2 : Vector
        Acceleration of free fall in the base.
    external : (ToolPayload, Vector) or None
        A force sensor whose wrench a client sends in place of the built-in one, while ``ft_rtde_input_enable``
        is on: what it weighs, part of the payload set, and where it measures in the flange.
    external_wrench : 6 floats
        RTDE input ``external_force_torque``.
    tcp_force : 6 floats
        Measured wrench on the TCP, along the axes of the base, payload and offset compensated.
    """

    def __init__(
        self, config: MachineConfig, environment: Environment | None, random: np.random.Generator
    ) -> None:
        self.config = config
        self.environment = environment
        self.target = Target(config.start_q, config.limits)
        self.joints = Joints(config.start_q, config.tracking, int(random.integers(2**31)))
        self.sensor = FtSensor(config.ft, random)
        self.force_mode = ForceMode(self.target)
        self.payload = config.tool
        self.gravity_m_s2: Vector = (0.0, 0.0, -STANDARD_GRAVITY_M_S2)
        self.external: tuple[ToolPayload, Vector] | None = None
        self.external_wrench = ZERO
        self.tcp_force = ZERO
        self._tip = transform_from_pose(config.tip_in_flange)
        self._posed = (IDENTITY, ZERO)  # of which TCP the pose was asked for last, and it
        self._rest_cycles = 0
        self._history: deque[tuple[Six, Six]] = deque(maxlen=HISTORY)
        self._observe()

    @property
    def posture(self) -> Posture:
        """Actual posture of the arm."""
        return self.joints.posture

    @property
    def tcp(self) -> Transform:
        """Actual TCP in the base."""
        return self.posture.tool(self.target.tcp)

    @property
    def tcp_pose(self) -> Six:
        """Its pose."""
        if self._posed[0] is not self.tcp:  # an arm at rest has the same one
            self._posed = self.tcp, pose_from_transform(self.tcp)
        return self._posed[1]

    @property
    def tcp_twist(self) -> Six:
        """Actual twist of the TCP in the base [m/s, rad/s]."""
        if self.joints.qd is ZERO:
            return ZERO
        return self.posture.twist(self.tcp[1], self.joints.qd)

    @property
    def outer_torque(self) -> Six:
        """Torques [N m] of the joints against the measured force on the tool."""
        return difference(ZERO, self.posture.torques(self.tcp[1], self.tcp_force))

    @property
    def steady(self) -> bool:
        """At rest, with no speed asked for, for half a second."""
        return self._rest_cycles >= STEADY_CYCLES

    @property
    def rests(self) -> bool:
        """At rest for a second, and its tool touches nothing."""
        environment = self.environment
        free = environment is None or environment.force_n == ORIGIN == environment.torque_nm
        return self._rest_cycles >= REST_CYCLES and free

    def reseed(self, random: np.random.Generator) -> None:
        """Take vibration and noise of the sensor from a generator, from the next step on."""
        self.joints.reseed(int(random.integers(2**31)))
        self.sensor.reseed(random)

    def step(self, powered: bool) -> None:
        """Follow the target for one cycle and feel what the tool touches."""
        self.target.end_cycle()
        self.joints.step(self.target.q, powered)
        self._rest_cycles = 0 if any(self.target.qd) else self._rest_cycles + 1
        self._observe()

    def catch_with_brakes(self) -> None:
        """Take the place where the brakes hold the joints as the target."""
        self.force_mode.end()
        self.target.hold(self.joints.hold())

    def solve(self, tool: Transform, q_near: Six | None = None) -> Six | None:
        """Return joint angles that bring the TCP to a place in the base; None out of reach."""
        return self.target.solve(tool, self.joints.q if q_near is None else q_near)

    def solved(self, tool: Transform, q_near: Six | None = None) -> Six:
        """Return joint angles as `solve`; raises ScriptError out of reach."""
        q = self.solve(tool, q_near)
        if q is None:
            raise ScriptError(
                f"get_inverse_kin: no joint angles reach the position {rounded(tool[1])} m"
            )
        return q

    def within_limits(self, q: Six | None) -> bool:
        """Say whether joint angles, or None for a pose out of reach, are within the limits."""
        return q is not None and largest(q) <= self.config.limits.joint_range_rad

    def past_joints(self, steps: int) -> Six:
        """Return the joint angles of some cycles ago.

        Raises
        ------
        ScriptError
            Where that is longer ago than is remembered.
        """
        if not 0 <= steps < len(self._history):
            raise ScriptError(
                f"get_actual_joint_positions_history: steps {steps}; accepted is 0 to "
                f"{len(self._history) - 1}"
            )
        return self._history[-1 - steps][0]

    def contact_steps(self, direction: Vector) -> int:
        """Return how many cycles ago the tool began to press along a direction; 0 without contact.

        Parameters
        ----------
        direction : Vector
            In the base; zero for any direction.
        """
        length = math.hypot(*direction)
        threshold = self.config.contact_force_n

        def pressing(wrench: Six) -> float:
            x, y, z = wrench[:3]
            return math.hypot(x, y, z) if length == 0.0 else -dot((x, y, z), direction) / length

        if pressing(self.tcp_force) < threshold:
            return 0
        steps = 0
        for _, wrench in reversed(self._history):
            if pressing(wrench) < threshold / 3:
                break
            steps += 1
        return min(max(1, steps), len(self._history) - 1)

    def _observe(self) -> None:
        """Touch what is there with the tip and measure the wrench at the flange."""
        turn = self.posture.flange[0]
        wrench = self.config.tool.weight(turn, self.gravity_m_s2)
        if self.environment is not None:
            wrench = total(wrench, self._touch(self.environment))
        weight = self.payload.weight(turn, self.gravity_m_s2)
        measured = None
        if self.external is not None:
            own, place_m = self.external
            weight = difference(weight, own.weight(turn, self.gravity_m_s2))
            fx, fy, fz, tx, ty, tz = self.external_wrench
            measured = wrench_about_origin(place_m, (fx, fy, fz), (tx, ty, tz))
        self.sensor.step(wrench, weight, measured)
        self.tcp_force = self.sensor.at_tcp(turn, self.target.tcp[1])
        self._history.append((self.posture.q, self.tcp_force))

    def _touch(self, environment: Environment) -> Six:
        """Move the tip; return the wrench of what it touches on the flange, in the flange's frame."""
        turn, (x, y, z) = self.posture.tool(self._tip)
        dx, dy, dz = self.joints.tremble_m
        environment.step((turn, (x + dx, y + dy, z + dz)), CYCLE_S)
        if environment.force_n == ORIGIN == environment.torque_nm:
            return ZERO
        flange = self.posture.flange[0]
        force = rotated_back(flange, environment.force_n)
        return wrench_about_origin(self._tip[1], force, rotated_back(flange, environment.torque_nm))
