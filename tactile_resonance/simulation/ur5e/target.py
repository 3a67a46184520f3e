# SPDX-License-Identifier: Apache-2.0
"""What the trajectory generator wants of the joints in each cycle, within the robot's limits."""

from __future__ import annotations

import math
from collections.abc import Generator
from operator import sub

from tactile_resonance.contact.vectors import (
    IDENTITY,
    NO_TURN,
    ZERO,
    ZEROS,
    Numbers,
    Transform,
    Turn,
    Vector,
    inverse_transform,
    largest,
    minus,
    plus,
    pose_from_transform,
    rounded,
    transposed,
    turn_product,
    turned,
)
from tactile_resonance.simulation.ur5e.kinematics import (
    JOINT_RANGE_RAD,
    JOINT_SPEED_RAD_S,
    Posture,
    motion_to,
    motion_towards,
    nearest_inverse,
    product,
)

# The control period of an e-series [s].
CYCLE_S = 0.002

# Largest speed of the TCP [m/s]; a setting of the safety configuration.
TOOL_SPEED_M_S = 1.5
# Deceleration of stops that no program asks for [rad/s^2] (assumed).
BRAKE_RAD_S2 = 10.0

# Of a program: steps once in a cycle, until it is done.
Thread = Generator[None, None, None]


class ScriptError(Exception):
    """The program did what the controller does not allow; the controller ends it."""


class ProtectiveStop(Exception):
    """A limit of the robot was reached; the controller brakes and waits to be unlocked."""


class Target:
    """Target angles and speeds of the joints, set once in a cycle.

    Attributes
    ----------
    q : 6 floats
        Target angles [rad].
    qd : 6 floats
        Target speeds [rad/s].
    pace : float
        Speed slider: share of the programmed speed, above 0 to 1.
    commanded : bool
        Whether the program moved the arm in this cycle.
    yielded_q : 6 floats
    yielded_m : Vector
    yielded_turn : Turn
        All that force mode has moved the target aside so far, of the joints and of the TCP. A path
        goes on beside itself by what was yielded since it began.
    yield_began_q : 6 floats or None
        `yielded_q` when force mode began; None without it.
    """

    def __init__(self, q: Numbers) -> None:
        self._tcp = self._flange_in_tcp = IDENTITY
        self.pace = 1.0
        self.q, self._posture = q, Posture(q)
        self.qd = ZEROS
        self._cycle_qd = ZEROS
        self._accelerated: tuple[Numbers, Numbers] = (ZEROS, ZEROS)  # from and to, in the last whole cycle
        self.commanded = False
        self.yielded_q = ZEROS
        self.yielded_m: Vector = ZERO
        self.yielded_turn: Turn = NO_TURN
        self.yield_began_q: Numbers | None = None

    @property
    def tcp(self) -> Transform:
        """Tool centre point in the flange, as the program set it."""
        return self._tcp

    @tcp.setter
    def tcp(self, value: Transform) -> None:
        self._tcp, self._flange_in_tcp = value, inverse_transform(value)

    @property
    def posture(self) -> Posture:
        """At the target angles; computed where somebody asks for it."""
        if self._posture.q is not self.q:
            self._posture = Posture(self.q)
        return self._posture

    @property
    def qdd(self) -> Numbers:
        """Target accelerations [rad/s^2]."""
        return rate(*self._accelerated)

    @property
    def aside_q(self) -> Numbers:
        """How far force mode has moved the joints aside since it began; 0 without it."""
        return (
            ZEROS if self.yield_began_q is None else minus(self.yielded_q, self.yield_began_q)
        )

    @property
    def tool(self) -> Transform:
        """The target TCP in the base."""
        return self.posture.tool(self._tcp)

    @property
    def pose(self) -> Numbers:
        """Target pose of the TCP in the base."""
        return pose_from_transform(self.tool)

    @property
    def twist(self) -> Numbers:
        """Target velocity [m/s] and angular velocity [rad/s] of the TCP in the base."""
        return self.posture.twist(self.tool[1], self.qd)

    def begin_cycle(self) -> None:
        """Let one thread of the program move the arm in the cycle that begins."""
        self._cycle_qd = self.qd
        self.commanded = False

    def end_cycle(self) -> None:
        """Brake where nothing moved the arm, and note the acceleration of the cycle."""
        if not self.commanded:
            self._brake()
        self._accelerated = self._cycle_qd, self.qd

    def command(self, q: Numbers, qd: Numbers, *, within: bool = False) -> None:
        """Set target angles and speeds for this cycle; those known to be `within` all limits are not looked at.

        Raises
        ------
        ScriptError
            Where another thread moved the arm in this cycle.
        ProtectiveStop
            Where a joint would pass its range or its speed, as near a singularity.
        """
        if not within and not math.isfinite(sum(qd)):
            raise ProtectiveStop("the path leads through a singularity")
        self._require_turn()
        if not within:
            self._check(q, qd)
        self.commanded, self.q, self.qd = True, q, qd

    def command_tool(self, tool: Transform, twist: Numbers) -> None:
        """Set the target TCP and its twist for this cycle; raises as `command`."""
        self.command(*self._motion_to(tool, twist))

    def command_towards(self, goal: Numbers, acceleration: float, *, straight: bool) -> bool:
        """Bring the target twist nearer to a goal in this cycle, and say whether it is there.

        Acceleration [m/s^2], numerically that of turning too [rad/s^2]; when stopping `straight`, moving and
        turning end together. Raises as `command`.
        """
        numbers = motion_towards(
            *(self.q, self.qd, goal, acceleration * CYCLE_S, CYCLE_S, straight),
            *(*self._tcp, *self._flange_in_tcp),
        )
        if numbers[12] == math.inf:
            raise _out_of_reach(self.tool)
        self.command(numbers[:6], numbers[6:12], within=numbers[14] > 0)
        return numbers[13] > 0

    def stay(self) -> None:
        """Stand still in this cycle, where the arm stands already; raises as `command`."""
        self._require_turn()
        self.commanded, self.qd = True, ZEROS

    def shift(self, shift_m: Vector, turn_rad: Vector) -> None:
        """Move the target TCP aside by a compliance, beside what the program commands."""
        before = self.tool
        aside = turned(before, shift_m, turn_rad)
        q, _ = self._motion_to(aside, ZEROS)
        self._check(q)
        self.yielded_q = plus(self.yielded_q, minus(q, self.q))
        x, y, z = self.yielded_m
        self.yielded_m = (x + shift_m[0], y + shift_m[1], z + shift_m[2])
        turn = turn_product(aside[0], transposed(before[0]))
        self.yielded_turn = turn_product(turn, self.yielded_turn)
        self.q = q

    def _brake(self) -> None:
        """Brake by one cycle, all joints in proportion."""
        if not any(self.qd):
            return
        share = max(0.0, 1.0 - BRAKE_RAD_S2 * CYCLE_S / largest(self.qd))
        limit, way_s = JOINT_RANGE_RAD, (1 + share) / 2 * CYCLE_S
        reached = [q + qd * way_s for q, qd in zip(self.q, self.qd, strict=True)]
        self.q = tuple([max(-limit, min(limit, q)) for q in reached])
        self.qd = tuple([qd * share for qd in self.qd])

    def hold(self, q: Numbers) -> None:
        """Stand still at joint angles."""
        self.q, self.qd = q, ZEROS

    def solve(self, tool: Transform, q_near: Numbers) -> Numbers | None:
        """Return the joint angles for a TCP in the base, nearest to `q_near`; None out of reach."""
        return nearest_inverse(product(tool, self._flange_in_tcp), q_near)

    def _motion_to(self, tool: Transform, twist: Numbers) -> tuple[Numbers, Numbers]:
        """Return angles and speeds of the joints for a TCP in the base, nearest to the present ones."""
        numbers = motion_to(*tool, twist, self.q, *self._tcp, *self._flange_in_tcp)
        if numbers[12] == math.inf:
            raise _out_of_reach(tool)
        return numbers[:6], numbers[6:12]

    def _require_turn(self) -> None:
        if self.commanded:
            raise ScriptError("another thread is already controlling the robot")

    def _check(self, q: Numbers, qd: Numbers = ZEROS) -> None:
        """Refuse angles out of limits, and speeds: those given and those with which it is reached."""
        reached = largest(q)
        if reached > JOINT_RANGE_RAD:
            raise ProtectiveStop(f"a joint would reach {reached:.3f} rad, beyond its range")
        for speeds in (qd, rate(self.q, q)):
            fastest = largest(speeds)
            # rounding of a finite difference must not stop a joint that moves at its limit
            if fastest > JOINT_SPEED_RAD_S * (1 + 1e-6):
                joint = [abs(speed) for speed in speeds].index(fastest) + 1
                raise ProtectiveStop(
                    f"joint {joint} would turn at {fastest:.2f} rad/s, "
                    f"above its limit of {JOINT_SPEED_RAD_S:.2f} rad/s"
                )


def _out_of_reach(tool: Transform) -> ProtectiveStop:
    return ProtectiveStop(f"no joint angles reach the position {rounded(tool[1])} m")


def rate(before: Numbers, now: Numbers) -> Numbers:
    """Return by how much six numbers change in a second, from their change in a cycle."""
    return tuple([change / CYCLE_S for change in map(sub, now, before)])
