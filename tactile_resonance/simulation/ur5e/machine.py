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

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.vectors import (
    ZERO,
    ZEROS,
    Numbers,
    Transform,
    Vector,
    dot,
    largest,
    minus,
    pose_from_transform,
    rounded,
    transform_from_pose,
)
from tactile_resonance.fields import AboveZero, Checked, NotNegative
from tactile_resonance.simulation.noise import Jitter
from tactile_resonance.simulation.ur5e.forces import (
    STANDARD_GRAVITY_M_S2,
    ForceMode,
    FtSensor,
    ToolPayload,
)
from tactile_resonance.simulation.ur5e.kinematics import (
    ARM_ROWS,
    FALL,
    JOINT_RANGE_RAD,
    MASSES,
    SEEN,
    SPEEDS,
    TCP,
    TIP,
    TOOL,
    TOUCH,
    TWIST,
    WRENCHES,
    Posture,
    behind,
    feel,
    follow,
)
from tactile_resonance.simulation.ur5e.target import CYCLE_S, ScriptError, Target, rate


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
    rows : (4 + n, axes) array
        Where the axes are, and the set points that are on their way; see `behind`.
    how : (3,) array
        See `behind`.
    """

    def __init__(
        self, parameters: TrackingParameters, start: Sequence[float], period_s: float
    ) -> None:
        periods = parameters.dead_time_s / period_s
        whole = int(periods + 1e-9)
        self.rows = np.tile(np.array(start, dtype=float), (whole + 4, 1))
        lag = parameters.lag_s
        decay = math.exp(-period_s / lag) if lag > 0 else 0.0
        self.how = np.array([max(0.0, periods - whole), decay, lag / period_s * (1 - decay)])

    def step(self, target: Sequence[float]) -> FloatArray:
        """Advance one period, at whose end the set points are `target`; return where the axes are, (axes,)."""
        self.rows[-1] = target
        behind(self.rows, self.how)
        return self.rows[0].copy()


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
    tracking : TrackingParameters
        Of the joints; the vibration is the tip's.
    ft_errors : float
        Of the sensor in the flange; see `FtSensor`.
    contact_force_n : float
        Measured force that ``tool_contact`` takes for a contact. The robot's own threshold is not
        published; this is the model's.
    """

    start_q: Numbers = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)
    tip_in_flange: Numbers = ZEROS
    tool: ToolPayload = field(default_factory=ToolPayload)
    tracking: TrackingParameters = field(default_factory=TrackingParameters)
    ft_errors: float = 1.0
    contact_force_n: float = 15.0


class Machine:
    """The arm, moved by its target in steps of 2 ms.

    Attributes
    ----------
    target : Target
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
    tremble_m : Vector
        Vibration of the tool in the base, which the encoders do not see.
    pressed_n : float
        Size of the measured force on the TCP, payload and offset compensated.
    """

    def __init__(
        self, config: MachineConfig, environment: Environment | None, random: np.random.Generator
    ) -> None:
        self.config = config
        self.environment = environment
        self.target = Target(config.start_q)
        tracking, seed = config.tracking, int(random.integers(2**31))
        self._jitter = Jitter(tracking.jitter_rms_m, tracking.jitter_corner_rad_s, CYCLE_S, seed)
        self._lag = Lag(tracking, config.start_q, CYCLE_S)
        self.sensor = FtSensor(random, config.ft_errors)
        self.force_mode = ForceMode(self.target)
        self.payload = config.tool
        self.gravity_m_s2: Vector = (0.0, 0.0, -STANDARD_GRAVITY_M_S2)
        self.external: tuple[ToolPayload, Vector] | None = None
        self.external_wrench = ZEROS
        self.tremble_m: Vector = ZERO
        self.pressed_n = 0.0
        self._arm = np.zeros((ARM_ROWS, 12))
        # parts of it that are read in each cycle
        self._q, self._wrench = self._arm[SEEN, :6], self._arm[SEEN, 6:]
        self._qd, self._twist = self._arm[SPEEDS, :6], self._arm[TWIST, :6]
        self._raw, self._seen = self._arm[WRENCHES, :6], self._arm[SEEN]
        self._q[:] = config.start_q
        turn, place = transform_from_pose(config.tip_in_flange)
        self._arm[TIP] = *turn, *place
        self._set: tuple = ()  # what of the program's settings stands in the arm's state
        # TCP of which the pose was told last, and it
        self._posed: tuple[list[float], Numbers] = ([], ZEROS)
        self._rest_cycles = 0
        # joint angles and wrench on the TCP, (12,)
        self._history: deque[FloatArray] = deque(maxlen=HISTORY)
        self._follow(False)
        self._observe()

    @property
    def q(self) -> Numbers:
        """Angles that the joints' encoders say [rad]."""
        return tuple(self._q.tolist())

    @property
    def qd(self) -> Numbers:
        """Speeds of the joints [rad/s]."""
        return tuple(self._qd.tolist())

    @property
    def qdd(self) -> Numbers:
        """Accelerations of the joints [rad/s^2]."""
        return rate(tuple(self._arm[SPEEDS, 6:].tolist()), self.qd)

    @property
    def posture(self) -> Posture:
        """Actual posture of the arm."""
        return Posture(self.q)

    @property
    def tcp(self) -> Transform:
        """Actual TCP in the base."""
        *turn, x, y, z = self._arm[TOOL].tolist()
        return tuple(turn), (x, y, z)

    @property
    def tcp_pose(self) -> Numbers:
        """Its pose."""
        numbers = self._arm[TOOL].tolist()
        if self._posed[0] != numbers:  # that of an arm at rest stays
            self._posed = numbers, pose_from_transform(self.tcp)
        return self._posed[1]

    @property
    def tcp_twist(self) -> Numbers:
        """Actual twist of the TCP in the base [m/s, rad/s]."""
        return tuple(self._twist.tolist())

    @property
    def tcp_force(self) -> Numbers:
        """Measured wrench on the TCP, along the axes of the base, payload and offset compensated."""
        return tuple(self._wrench.tolist())

    @property
    def raw_wrench(self) -> Numbers:
        """Measured at the flange, in its frame, nothing compensated (``ft_raw_wrench``)."""
        return tuple(self._raw.tolist())

    @property
    def outer_torque(self) -> Numbers:
        """Torques [N m] of the joints against the measured force on the tool."""
        return minus(ZEROS, self.posture.torques(self.tcp[1], self.tcp_force))

    @property
    def steady(self) -> bool:
        """At rest, with no speed asked for, for half a second."""
        return self._rest_cycles >= STEADY_CYCLES

    @property
    def rests(self) -> bool:
        """At rest for a second, and its tool touches nothing."""
        environment = self.environment
        free = environment is None or environment.force_n == ZERO == environment.torque_nm
        return self._rest_cycles >= REST_CYCLES and free

    def reseed(self, random: np.random.Generator) -> None:
        """Take vibration and noise of the sensor from a generator, from the next step on."""
        self._jitter.reseed(int(random.integers(2**31)))
        self.sensor.reseed(random)

    def step(self, powered: bool) -> None:
        """Follow the target for one cycle and feel what the tool touches."""
        self.target.end_cycle()
        if powered:
            self.tremble_m = self._jitter.step()
        self._follow(powered)
        self._rest_cycles = 0 if any(self.target.qd) else self._rest_cycles + 1
        self._observe()

    def zero_sensor(self) -> None:
        """Take the wrench without payload as zero (``zero_ftsensor``)."""
        self._arm[TWIST, 6:] = self._arm[WRENCHES, 6:]

    def catch_with_brakes(self) -> None:
        """Take the place where the brakes hold the joints as the target."""
        self.force_mode.end()
        self._lag = Lag(self.config.tracking, self.q, CYCLE_S)
        self._arm[SPEEDS] = self._arm[TWIST, :6] = 0.0
        self.target.hold(self.q)

    def solve(self, tool: Transform, q_near: Numbers | None = None) -> Numbers | None:
        """Return joint angles that bring the TCP to a place in the base; None out of reach."""
        return self.target.solve(tool, self.q if q_near is None else q_near)

    def solved(self, tool: Transform, q_near: Numbers | None = None) -> Numbers:
        """Return joint angles as `solve`; raises ScriptError out of reach."""
        q = self.solve(tool, q_near)
        if q is None:
            raise ScriptError(
                f"get_inverse_kin: no joint angles reach the position {rounded(tool[1])} m"
            )
        return q

    def within_limits(self, q: Numbers | None) -> bool:
        """Say whether joint angles, or None for a pose out of reach, are within the limits."""
        return q is not None and largest(q) <= JOINT_RANGE_RAD

    def past_joints(self, steps: int) -> Numbers:
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
        return tuple(self._history[-1 - steps][:6].tolist())

    def contact_steps(self, direction: Vector) -> int:
        """Return how many cycles ago the tool began to press along a direction; 0 without contact.

        Parameters
        ----------
        direction : Vector
            In the base; zero for any direction.
        """
        length = math.hypot(*direction)
        threshold = self.config.contact_force_n

        def pressing(seen: FloatArray) -> float:
            x, y, z = seen[6:9].tolist()
            return math.hypot(x, y, z) if length == 0.0 else -dot((x, y, z), direction) / length

        if pressing(self._seen) < threshold:
            return 0
        steps = 0
        for seen in reversed(self._history):
            if pressing(seen) < threshold / 3:
                break
            steps += 1
        return min(max(1, steps), len(self._history) - 1)

    def _follow(self, powered: bool) -> None:
        """Let the joints follow for one cycle, where the brakes do not hold them."""
        lag, tcp = self._lag, self.target.tcp
        wanted = (tcp, self.payload, self.gravity_m_s2, self.external, self.external_wrench)
        if wanted != self._set:
            own, own_m = self.external or (ToolPayload(), ZERO)
            self._arm[TCP] = *tcp[0], *tcp[1]
            masses = [(mass.mass_kg, *mass.cog_m) for mass in (self.config.tool, self.payload, own)]
            self._arm[MASSES] = np.ravel(masses)
            self._arm[FALL] = *self.gravity_m_s2, *own_m, *self.external_wrench
            self._set = wanted
        follow(self._arm, lag.rows, lag.how, self.target.q, self.tremble_m, CYCLE_S, powered)

    def _observe(self) -> None:
        """Touch what is there with the tip and measure the wrench at the flange."""
        force = torque = ZERO
        if self.environment is not None:
            *turn, x, y, z = self._arm[TOUCH].tolist()
            self.environment.step((tuple(turn), (x, y, z)), CYCLE_S)
            force, torque = self.environment.force_n, self.environment.torque_nm
        replaced = self.external is not None
        self.pressed_n = feel(self._arm, self.sensor.error(), force, torque, replaced)
        self._history.append(self._seen.copy())
