# SPDX-License-Identifier: Apache-2.0
"""The arm as a machine: targets, joints, flange sensor and what the tool touches, on one clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.samples import Pose
from tactile_resonance.simulation.robot.compliance import ForceMode
from tactile_resonance.simulation.robot.ft_sensor import (
    STANDARD_GRAVITY_M_S2,
    FtSensor,
    FtSpecification,
    Payload,
)
from tactile_resonance.simulation.robot.joints import Joints
from tactile_resonance.simulation.robot.kinematics import (
    forward,
    jacobian,
    link_frames,
    nearest_inverse,
)
from tactile_resonance.simulation.robot.poses import (
    inverse_transform,
    matrix_from_pose,
    moved_wrench,
    pose_from_matrix,
)
from tactile_resonance.simulation.robot.target import CYCLE_S, MotionLimits, ScriptError, Target
from tactile_resonance.simulation.tracking import TrackingParameters

FloatArray = NDArray[np.float64]

# Cycles for which joint positions are remembered: one second.
HISTORY = 500
# Of rest before the arm counts as steady (``is_steady``, URScript manual): 0.5 s.
STEADY_CYCLES = 250


class Environment(Protocol):
    """What the tool touches; `simulation.plant.Plant` is one.

    Attributes
    ----------
    force_n, torque_nm : (3,) arrays
        On the tip and about it, along the axes of the base [N], [N m].
    """

    force_n: FloatArray
    torque_nm: FloatArray

    def step(self, tip_pose: Pose, dt_s: float) -> None:
        """Move the tip to a true pose in the base within `dt_s`."""
        ...


@dataclass(frozen=True)
class MachineConfig:
    """The arm and what is mounted on it.

    Attributes
    ----------
    start_q : (6,) array
        Joint angles at power-up [rad].
    tip_in_flange : (6,) array
        True pose of the tip in the flange; the program does not know it unless it sets its TCP so.
    tool : Payload
        True mass on the flange; the controller compensates the payload that the program sets.
    limits : MotionLimits
    tracking : TrackingParameters
        Of the joints; the vibration is the tip's.
    ft : FtSpecification
    contact_force_n : float
        Measured force that ``tool_contact`` takes for a contact. The robot's own threshold is not
        published; this is the model's.
    """

    start_q: FloatArray = field(
        default_factory=lambda: np.array([0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0])
    )
    tip_in_flange: FloatArray = field(default_factory=lambda: np.zeros(6))
    tool: Payload = field(default_factory=Payload)
    limits: MotionLimits = field(default_factory=MotionLimits)
    tracking: TrackingParameters = field(default_factory=TrackingParameters)
    ft: FtSpecification = field(default_factory=FtSpecification)
    contact_force_n: float = 15.0


@dataclass(frozen=True)
class ExternalSensor:
    """A force sensor whose wrench a client sends by RTDE in place of the built-in one.

    Attributes
    ----------
    mass_kg : float
        Of the sensor, part of the payload set.
    offset_m, cog_m : (3,) arrays
        Where it measures, and its centre of gravity, in the flange.
    """

    mass_kg: float
    offset_m: FloatArray
    cog_m: FloatArray


class Machine:
    """The arm, moved by its target in steps of 2 ms.

    Attributes
    ----------
    target : Target
    joints : Joints
    sensor : FtSensor
    force_mode : ForceMode
    payload : Payload
        As the program set it.
    gravity_m_s2 : (3,) array
        Acceleration of free fall in the base.
    external : ExternalSensor or None
        Set while ``ft_rtde_input_enable`` is on.
    external_wrench : (6,) array
        RTDE input ``external_force_torque``.
    tcp_force : (6,) array
        Measured wrench on the TCP, along the axes of the base, payload and offset compensated.
    frames : (7, 4, 4) array
        Base and links at the joints' actual angles.
    """

    def __init__(
        self, config: MachineConfig, environment: Environment | None, rng: np.random.Generator
    ) -> None:
        self.config = config
        self.environment = environment
        self.target = Target(config.start_q, config.limits)
        self.joints = Joints(config.start_q, config.tracking, int(rng.integers(2**31)))
        self.sensor = FtSensor(config.ft, rng)
        self.force_mode = ForceMode(self.target)
        self.payload = config.tool
        self.gravity_m_s2 = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
        self.external: ExternalSensor | None = None
        self.external_wrench = np.zeros(6)
        self.tcp_force = np.zeros(6)
        self._tip = matrix_from_pose(config.tip_in_flange)
        self._rest_cycles = 0
        self._history: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=HISTORY)
        self._observe()

    @property
    def flange(self) -> FloatArray:
        """Actual flange in the base, shape (4, 4)."""
        return self.frames[-1]

    @property
    def tcp(self) -> FloatArray:
        """Actual TCP in the base, shape (4, 4)."""
        return self.flange @ self.target.tcp

    @property
    def tcp_twist(self) -> FloatArray:
        """Actual twist of the TCP in the base, shape (6,)."""
        return jacobian(self.frames, self.tcp[:3, 3]) @ self.joints.qd

    @property
    def outer_torque(self) -> FloatArray:
        """Torques (6,) [N m] of the joints against the measured force on the tool."""
        return -jacobian(self.frames, self.tcp[:3, 3]).T @ self.tcp_force

    @property
    def steady(self) -> bool:
        """At rest, with no speed asked for, for half a second."""
        return self._rest_cycles >= STEADY_CYCLES

    def comply(self) -> None:
        """Let force mode move the target aside; raises as `Target.command`."""
        self.force_mode.step(self.tcp_force)

    def step(self, powered: bool) -> None:
        """Follow the target for one cycle and feel what the tool touches."""
        self.target.end_cycle()
        self.joints.step(self.target.q, powered)
        self._rest_cycles = 0 if self.target.qd.any() else self._rest_cycles + 1
        self._observe()

    def catch_with_brakes(self) -> None:
        """Take the place where the brakes hold the joints as the target."""
        self.force_mode.end()
        self.target.hold(self.joints.hold())

    def solve(self, tool: FloatArray, q_near: FloatArray | None = None) -> FloatArray | None:
        """Return joint angles (6,) that bring the TCP to a transform (4, 4); None out of reach."""
        flange = tool @ inverse_transform(self.target.tcp)
        near = self.joints.q if q_near is None else q_near
        return nearest_inverse(flange, near, self.config.limits.joint_range_rad)

    def solved(self, tool: FloatArray, q_near: FloatArray | None = None) -> FloatArray:
        """Return joint angles as `solve`; raises ScriptError out of reach."""
        q = self.solve(tool, q_near)
        if q is None:
            raise ScriptError(
                f"get_inverse_kin: no joint angles reach the position {np.round(tool[:3, 3], 4)} m"
            )
        return q

    def within_limits(self, q: FloatArray | None) -> bool:
        """Say whether joint angles, or None for a pose out of reach, are within the limits."""
        limits = self.config.limits
        if q is None or np.abs(q).max() > limits.joint_range_rad:
            return False
        place = (forward(q) @ self.target.tcp)[:3, 3]
        return all(plane.beyond(place) <= 0.0 for plane in limits.planes)

    def past_joints(self, steps: int) -> FloatArray:
        """Return the joint angles (6,) of some cycles ago.

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

    def contact_steps(self, direction: FloatArray) -> int:
        """Return how many cycles ago the tool began to press along a direction; 0 without contact.

        Parameters
        ----------
        direction : (3,) array
            In the base; zero for any direction.
        """
        length = float(np.linalg.norm(direction))
        threshold = self.config.contact_force_n

        def pressing(force: FloatArray) -> float:
            if length == 0.0:
                return float(np.linalg.norm(force))
            return float(-(force @ direction)) / length

        if pressing(self.tcp_force[:3]) < threshold:
            return 0
        steps = 0
        for _, force in reversed(self._history):
            if pressing(force) < threshold / 3:
                break
            steps += 1
        return min(max(1, steps), len(self._history) - 1)

    def _observe(self) -> None:
        self.frames = link_frames(self.joints.q)
        wrench = self.config.tool.weight(self.flange, self.gravity_m_s2)
        if self.environment is not None:
            tip = self.flange @ self._tip
            tip[:3, 3] += self.joints.tremble_m
            self.environment.step(Pose.from_vector(pose_from_matrix(tip)), CYCLE_S)
            felt = np.concatenate([self.environment.force_n, self.environment.torque_nm])
            # from the tip's place and the base's axes to those of the flange
            place = np.eye(4)
            place[:3, :3] = self.flange[:3, :3].T
            place[:3, 3] = self._tip[:3, 3]
            wrench = wrench + moved_wrench(felt, place)
        weight = self.payload.weight(self.flange, self.gravity_m_s2)
        if self.external is None:
            self.sensor.step(wrench, weight)
        else:
            place = np.eye(4)
            place[:3, 3] = self.external.offset_m
            own = Payload(self.external.mass_kg, self.external.cog_m)
            weight = weight - own.weight(self.flange, self.gravity_m_s2)
            self.sensor.step(wrench, weight, moved_wrench(self.external_wrench, place))
        self.tcp_force = self.sensor.at_tcp(self.flange, self.target.tcp)
        self._history.append((self.joints.q, self.tcp_force[:3]))
