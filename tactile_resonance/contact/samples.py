# SPDX-License-Identifier: Apache-2.0
"""What force sensors and robots report: time-stamped wrenches and robot states.

Times are of the monotonic clock (``time.monotonic_ns``), or of a simulation's, which counts from 0.
Numbers are floats in tuples: arithmetic on those of numpy costs a control loop several times as much.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.vectors import (
    Six,
    Turn,
    Vector,
    rotated_back,
    transposed,
    turn_from_vector,
    turn_product,
    vector,
    vector_from_turn,
)
from tactile_resonance.fields import numbers

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


def _read_three(value: object, field: str) -> FloatArray:
    return np.array(numbers(value, field, 3))


@dataclass(frozen=True)
class Pose:
    """A pose as Universal Robots write it.

    Attributes
    ----------
    position_m : (3,) array
    rotation_rad : (3,) array
        Rotation vector: axis times angle [rad].
    """

    position_m: Annotated[FloatArray, _read_three]
    rotation_rad: Annotated[FloatArray, _read_three]

    @classmethod
    def at_origin(cls) -> Pose:
        """Return the pose of a frame in itself."""
        return cls(np.zeros(3), np.zeros(3))

    @classmethod
    def from_vector(cls, vector: FloatArray) -> Pose:
        """Take the six numbers of a UR pose, position [m] and rotation vector [rad]."""
        return cls(np.array(vector[:3], dtype=float), np.array(vector[3:], dtype=float))

    @property
    def vector(self) -> FloatArray:
        """The six numbers of a UR pose, shape (6,)."""
        return np.concatenate([self.position_m, self.rotation_rad])

    @property
    def rotation(self) -> Rotation:
        """Rotation from this frame into the one that the pose is given in."""
        # a third of the start of a node that needs no scipy
        from scipy.spatial.transform import Rotation

        return Rotation.from_rotvec(self.rotation_rad)

    @cached_property
    def turn(self) -> Turn:
        """The same as a matrix of floats."""
        return turn_from_vector(vector(self.rotation_rad))

    def seen_from(self, frame: Pose) -> Pose:
        """Return the same pose in a frame whose pose is given where this one is."""
        place = rotated_back(frame.turn, vector(self.position_m - frame.position_m))
        turn = turn_product(transposed(frame.turn), self.turn)
        return Pose(np.array(place), np.array(vector_from_turn(turn)))


def _read_six(value: object, field: str) -> Pose:
    return Pose.from_vector(np.array(numbers(value, field, 6)))


PoseOfSix = Annotated[Pose, _read_six]
"""In files: six numbers, as Universal Robots write a pose."""


class CellSample(NamedTuple):
    """One wrench as a force sensor reports it.

    Attributes
    ----------
    time_ns : int
        When it was measured.
    wrench : tuple of 6 floats
        What acts on the sensor, force [N] and torque about its origin [N m], in its own frame.
    overload : bool
        A channel is beyond its range.
    """

    time_ns: int
    wrench: Six
    overload: bool = False


class WrenchSample(NamedTuple):
    """One wrench.

    Attributes
    ----------
    time_ns : int
        When it was measured.
    force_n, torque_nm : tuples of 3 floats
        What the environment exerts on the tip [N], [N m], in the frame `tip`: pressing on tissue gives
        a positive z force.
    overload : bool
        A channel of the sensor is beyond its range: the figures are not to be used.
    """

    time_ns: int
    force_n: Vector
    torque_nm: Vector
    overload: bool = False


class ArmSample(NamedTuple):
    """State of the robot.

    Attributes
    ----------
    time_ns : int
        When it held.
    robot_time_s : float
        The controller's own time stamp [s].
    position_m, rotation_rad : tuples of 3 floats
        Of the frame `tip` in the robot's base: place [m] and rotation vector [rad].
    velocity : tuple of 6 floats
        Velocity [m/s] and angular velocity [rad/s] of the tip in the base.
    moving_allowed : bool
        Powered, in normal safety mode and its program running.
    message : str
        Why it may not move; empty where it may.
    tool_wrench : tuple of 6 floats or None
        What the robot's own sensor says the environment exerts on the tip, force [N] and torque about
        it [N m], along the axes of the base; None where it has no such sensor.
    """

    time_ns: int
    robot_time_s: float
    position_m: Vector
    rotation_rad: Vector
    velocity: Six
    moving_allowed: bool = True
    message: str = ""
    tool_wrench: Six | None = None

    @property
    def tip(self) -> Pose:
        """Frame `tip` in the robot's base, for those outside the control loop."""
        return Pose(np.array(self.position_m), np.array(self.rotation_rad))
