# SPDX-License-Identifier: Apache-2.0
"""What the trajectory generator wants of the joints in each cycle, within the robot's limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.kinematics import jacobian, link_frames, nearest_inverse
from tactile_resonance.simulation.robot.poses import inverse_transform, pose_from_matrix, turned

FloatArray = NDArray[np.float64]

# The control period of an e-series [s].
CYCLE_S = 0.002


class ScriptError(Exception):
    """The program did what the controller does not allow; the controller ends it."""


class ProtectiveStop(Exception):
    """A limit of the robot was reached; the controller brakes and waits to be unlocked."""


@dataclass(frozen=True)
class SafetyPlane:
    """A plane of the safety configuration that the TCP must not pass.

    Attributes
    ----------
    point_m : (3,) array
        A point of it in the base.
    normal : (3,) array
        Of length 1, to the side where the TCP may be.
    """

    point_m: FloatArray
    normal: FloatArray

    def beyond(self, place_m: FloatArray) -> float:
        """How far a place (3,) is on the wrong side [m]; negative on the right one."""
        return float(-self.normal @ (place_m - self.point_m))


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the arm and of its safety configuration.

    Attributes
    ----------
    joint_range_rad : float
        Largest angle to either side; +-360 degrees (UR5e data sheet).
    joint_speed_rad_s : float
        180 degrees/s (UR5e data sheet).
    tool_speed_m_s : float
        Largest speed of the TCP; a setting of the safety configuration.
    tool_force_n : float
        Measured force at the TCP beyond which the robot stops; a setting of the safety
        configuration.
    brake_rad_s2 : float
        Deceleration of stops that no program asks for (assumed).
    planes : tuple of SafetyPlane
        The model stops at a plane; a robot slows down before it.
    """

    joint_range_rad: float = math.tau
    joint_speed_rad_s: float = math.pi
    tool_speed_m_s: float = 1.5
    tool_force_n: float = 150.0
    brake_rad_s2: float = 10.0
    planes: tuple[SafetyPlane, ...] = ()


class Target:
    """Target angles and speeds of the joints, set once in a cycle.

    Attributes
    ----------
    q, qd, qdd : (6,) arrays
        Target angles [rad], speeds [rad/s], accelerations [rad/s^2].
    frames : (7, 4, 4) array
        Base and links at `q`.
    tcp : (4, 4) array
        Tool centre point in the flange, as the program set it.
    pace : float
        Speed slider: share of the programmed speed, above 0 to 1.
    commanded : bool
        Whether the program moved the arm in this cycle.
    yielded_q : (6,) array
    yielded_m : (3,) array
    yielded_turn : (3, 3) array
        All that force mode has moved the target aside so far, of the joints and of the TCP. A path
        goes on beside itself by what was yielded since it began.
    yield_began_q : (6,) array or None
        `yielded_q` when force mode began; None without it.
    """

    def __init__(self, q: FloatArray, limits: MotionLimits) -> None:
        self.limits = limits
        self.tcp = np.eye(4)
        self.pace = 1.0
        self.q = np.array(q, dtype=float)
        self.qd = np.zeros(6)
        self.qdd = np.zeros(6)
        self.frames = link_frames(self.q)
        self._cycle_qd = self.qd
        self.commanded = False
        self.yielded_q = np.zeros(6)
        self.yielded_m = np.zeros(3)
        self.yielded_turn = np.eye(3)
        self.yield_began_q: FloatArray | None = None

    @property
    def aside_q(self) -> FloatArray:
        """How far force mode has moved the joints aside since it began (6,); 0 without it."""
        return np.zeros(6) if self.yield_began_q is None else self.yielded_q - self.yield_began_q

    @property
    def tool(self) -> FloatArray:
        """Transform of the target TCP in the base, shape (4, 4)."""
        return self.frames[-1] @ self.tcp

    @property
    def pose(self) -> FloatArray:
        """Target pose of the TCP in the base, shape (6,)."""
        return pose_from_matrix(self.tool)

    @property
    def jacobian(self) -> FloatArray:
        """Jacobian of the target TCP, shape (6, 6)."""
        return jacobian(self.frames, self.tool[:3, 3])

    @property
    def twist(self) -> FloatArray:
        """Target velocity [m/s] and angular velocity [rad/s] of the TCP in the base, shape (6,)."""
        return self.jacobian @ self.qd

    def begin_cycle(self) -> None:
        """Let one thread of the program move the arm in the cycle that begins."""
        self._cycle_qd = self.qd
        self.commanded = False

    def end_cycle(self) -> None:
        """Brake where nothing moved the arm, and note the acceleration of the cycle."""
        if not self.commanded:
            self.brake(self.limits.brake_rad_s2)
        self.qdd = (self.qd - self._cycle_qd) / CYCLE_S

    def command(self, q: FloatArray, qd: FloatArray, frames: FloatArray | None = None) -> None:
        """Set target angles and speeds (6,) for this cycle; `frames` where they are known.

        Raises
        ------
        ScriptError
            Where another thread moved the arm in this cycle.
        ProtectiveStop
            Where a joint would pass its range or its speed, as near a singularity.
        """
        if self.commanded:
            raise ScriptError("another thread is already controlling the robot")
        if frames is None:
            frames = link_frames(q)
        self._check(q, frames, qd, (q - self.q) / CYCLE_S)
        self.commanded = True
        self._set(q, qd, frames)

    def command_tool(self, tool: FloatArray, twist: FloatArray) -> None:
        """Set the target TCP (4, 4) and its twist (6,) for this cycle; raises as `command`."""
        q = self.solved(tool, self.q)
        frames = link_frames(q)
        point = frames[-1] @ self.tcp[:, 3]
        try:
            qd = np.linalg.solve(jacobian(frames, point[:3]), twist).astype(float, copy=False)
        except np.linalg.LinAlgError:
            raise ProtectiveStop("the path leads through a singularity") from None
        self.command(q, qd, frames)

    def shift(self, shift_m: FloatArray, turn_rad: FloatArray) -> None:
        """Move the target TCP aside by a compliance, beside what the program commands."""
        before = self.tool
        aside = turned(before, shift_m, turn_rad)
        q = self.solved(aside, self.q)
        frames = link_frames(q)
        self._check(q, frames, (q - self.q) / CYCLE_S)
        self.yielded_q = self.yielded_q + (q - self.q)
        self.yielded_m = self.yielded_m + shift_m
        self.yielded_turn = aside[:3, :3] @ before[:3, :3].T @ self.yielded_turn
        self._set(q, self.qd, frames)

    def brake(self, deceleration_rad_s2: float) -> None:
        """Brake by one cycle, all joints in proportion."""
        fastest = float(np.abs(self.qd).max())
        if fastest == 0.0:
            return
        share = max(0.0, 1.0 - deceleration_rad_s2 * CYCLE_S / fastest)
        slower = self.qd * share
        q = self.q + (self.qd + slower) / 2 * CYCLE_S
        limit = self.limits.joint_range_rad
        self._set(np.clip(q, -limit, limit), slower)

    def hold(self, q: FloatArray) -> None:
        """Stand still at joint angles (6,)."""
        self._set(q, np.zeros(6))

    def solved(self, tool: FloatArray, q_near: FloatArray) -> FloatArray:
        """Return the joint angles (6,) for a TCP (4, 4), nearest to `q_near`.

        Raises
        ------
        ProtectiveStop
            Where the pose is out of reach.
        """
        flange = tool @ inverse_transform(self.tcp)
        q = nearest_inverse(flange, q_near, self.limits.joint_range_rad)
        if q is None:
            raise ProtectiveStop(f"no joint angles reach the position {np.round(tool[:3, 3], 4)} m")
        return q

    def _check(self, q: FloatArray, frames: FloatArray, *speeds: FloatArray) -> None:
        limits = self.limits
        for plane in limits.planes:
            here = plane.beyond(self.tool[:3, 3])
            # a TCP found beyond, as after a change of TCP, may only come back
            if plane.beyond((frames[-1] @ self.tcp)[:3, 3]) > max(0.0, here):
                raise ProtectiveStop("the tool would pass a safety plane")
        reached = float(np.abs(q).max())
        if reached > limits.joint_range_rad:
            raise ProtectiveStop(f"a joint would reach {reached:.3f} rad, beyond its range")
        for speed in speeds:
            fastest = float(np.abs(speed).max())
            # rounding of a finite difference must not stop a joint that moves at its limit
            if fastest > limits.joint_speed_rad_s * (1 + 1e-6):
                raise ProtectiveStop(
                    f"joint {int(np.abs(speed).argmax()) + 1} would turn at {fastest:.2f} rad/s, "
                    f"above its limit of {limits.joint_speed_rad_s:.2f} rad/s"
                )

    def _set(self, q: FloatArray, qd: FloatArray, frames: FloatArray | None = None) -> None:
        self.q, self.qd = q, qd
        self.frames = link_frames(q) if frames is None else frames
