# SPDX-License-Identifier: Apache-2.0
"""Where the tip must be to touch a point of a surface, and whether the beam's housing stays clear.

Frame `tip`: origin at the ball's centre, +z the outward surface normal, +x along the surface from
clamp to tip. The beam itself rises from the ball to its clamp by its tilt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import (
    Turn,
    Vector,
    dot,
    rotated,
    transposed,
    turn_from_vector,
    vector,
    vector_from_turn,
)
from tactile_resonance.fields import require


@dataclass(frozen=True)
class TipGeometry:
    """Ball, beam and housing.

    Attributes
    ----------
    ball_radius_m, beam_length_m : float
        Of the ball; from its centre to the clamp [m].
    beam_tilt_rad : float
        By which the clamp lies higher than the ball, seen from the surface [rad].
    housing_below_m : float
        How far the housing reaches below the beam at the clamp [m].
    """

    ball_radius_m: float = 2.5e-3
    beam_length_m: float = 0.064
    beam_tilt_rad: float = 0.17
    housing_below_m: float = 6e-3

    def __post_init__(self) -> None:
        for name in ("ball_radius_m", "beam_length_m"):
            value = getattr(self, name)
            require(0 < value < 1, name, value, "above 0, below 1 m")
        tilt = self.beam_tilt_rad
        require(0 <= tilt <= 1, "beam_tilt_rad", tilt, "0 to 1")
        require(0 <= self.housing_below_m < 1, "housing_below_m", self.housing_below_m, "0 to 1 m")

    @cached_property
    def sensor(self) -> Pose:
        """Frame `sensor` in the frame `tip`: origin in the clamp, +x along the beam to the ball."""
        rise = self.beam_length_m * math.sin(self.beam_tilt_rad)
        run = self.beam_length_m * math.cos(self.beam_tilt_rad)
        return Pose(np.array([-run, 0.0, rise]), np.array([0.0, self.beam_tilt_rad, 0.0]))

    @cached_property
    def housing_m(self) -> Vector:
        """Lower edge of the housing from the ball's centre, in the frame `tip` [m]."""
        x, y, z = vector(self.sensor.position_m)
        return x, y, z - self.housing_below_m

    def housing_height(self, turn: Turn, normal: Vector, height_m: float) -> float:
        """Height of the housing's lower edge above a plane [m].

        Parameters
        ----------
        turn : Turn
            Orientation of the frame `tip`.
        normal : tuple of 3 floats
            Of the plane, out of the tissue, length 1.
        height_m : float
            Of the tip above its first touch of the plane [m]; below 0 when pressed in.
        """
        return self.ball_radius_m + height_m + dot(normal, rotated(turn, self.housing_m))

    def worst_height(self, depth_m: float, off_rad: float) -> float:
        """The same at a depth, the clamp turned down by an angle about the ball [m]."""
        turn = turn_from_vector((0.0, -off_rad, 0.0))
        return self.housing_height(turn, (0.0, 0.0, 1.0), -depth_m)


def touch_pose(
    point_m: ArrayLike, normal: ArrayLike, towards: ArrayLike, ball_radius_m: float
) -> Pose:
    """Return the pose of `tip` in which the ball just touches a point of a surface.

    Parameters
    ----------
    point_m : (3,) array
        On the surface, in the base [m].
    normal : (3,) array
        Out of the tissue; any length but 0.
    towards : (3,) array
        Direction from clamp to tip; its part along the surface counts.
    ball_radius_m : float

    Raises
    ------
    ValueError
        If the normal is 0 or not finite, or `towards` lies along it.
    """
    z, x = np.asarray(normal, dtype=float), np.asarray(towards, dtype=float)
    length = float(np.linalg.norm(z))
    require(0 < length < math.inf, "normal", normal, "three numbers, not all 0")
    z = z / length
    x = x - (x @ z) * z
    along = float(np.linalg.norm(x))
    require(1e-6 < along < math.inf, "towards", towards, "a direction not along the normal")
    x = x / along
    columns = vector(x), vector(np.cross(z, x)), vector(z)
    turn = transposed((*columns[0], *columns[1], *columns[2]))
    place = np.asarray(point_m, dtype=float) + ball_radius_m * z
    return Pose(place, np.array(vector_from_turn(turn)))
