# SPDX-License-Identifier: Apache-2.0
"""The way of the tip to one goal and back: heights, angles, and the twists that lead along it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import ArmSample

FloatArray = NDArray[np.float64]

RIGHTING_S = 0.1
"""Time constant in which place along the surface and orientation are put right [s]."""

ARRIVED_M, ARRIVED_RAD = 5e-5, 2e-3
"""Distance and angle from the standoff at which it is reached."""

LIFTED_M = 5e-4
"""A tip that begins lower than this below the standoff is lifted first [m]."""

TURNING_M = 2e-3
"""So far above where the surface is near the tip is turned [m]."""


class TipPath:
    """Geometry of one goal.

    Parameters
    ----------
    goal : ContactGoal
    tip : TipGeometry or None
        None: the housing is not watched.

    Attributes
    ----------
    normal : (3,) array
        Out of the tissue, in the base.
    """

    def __init__(self, goal: ContactGoal, tip: TipGeometry | None = None) -> None:
        self._touch, self._tip = goal.touch, tip
        self._rotation = goal.touch.rotation
        self.normal: FloatArray = self._rotation.as_matrix()[:, 2]

    def height_m(self, arm: ArmSample) -> float:
        """Of the tip above the expected first touch, along the normal."""
        return float(self.normal @ (arm.tip.position_m - self._touch.position_m))

    def place_at(self, height_m: float) -> FloatArray:
        """Place (3,) of the tip straight above the touch."""
        return self._touch.position_m + height_m * self.normal

    def turn(self, arm: ArmSample) -> FloatArray:
        """Rotation vector (3,) in the base from the tip's orientation to the goal's."""
        if np.array_equal(arm.tip.rotation_rad, self._touch.rotation_rad):
            return np.zeros(3)
        return (self._rotation * Rotation.from_rotvec(arm.tip.rotation_rad).inv()).as_rotvec()

    def housing_m(self, arm: ArmSample, height_m: float) -> float | None:
        """Height of the housing above the surface, the tip at a height above its first touch."""
        if self._tip is None:
            return None
        return self._tip.housing_height(arm.tip.rotation.as_matrix(), self.normal, height_m)

    def arrived(self, arm: ArmSample, height_m: float) -> bool:
        """Whether the tip is above the touch at a height, and turned as it should be."""
        way = self.place_at(height_m) - arm.tip.position_m
        near = float(np.linalg.norm(way)) < ARRIVED_M
        return near and float(np.linalg.norm(self.turn(arm))) < ARRIVED_RAD

    def must_lift(self, arm: ArmSample, standoff_m: float) -> bool:
        """Whether the tip is so low that it may press on something, at the touch or beside it."""
        return self.height_m(arm) < standoff_m - LIFTED_M

    def turning_height_m(self, parameters: ContactParameters, limits: Limits) -> float:
        """Height of the tip to which it goes while much is to be turned."""
        return max(parameters.standoff_m, limits.near_m + TURNING_M)

    # twists (6,) in the base

    def lift(self, arm: ArmSample, parameters: ContactParameters) -> FloatArray:
        """Straight up to the standoff, neither along the surface nor turning."""
        left = max(0.0, parameters.standoff_m - self.height_m(arm))
        p = parameters
        speed = min(p.retract_speed_m_s, math.sqrt(p.acceleration_m_s2 * left), left / RIGHTING_S)
        return np.concatenate([max(speed, 1e-4) * self.normal, np.zeros(3)])

    def travel(self, arm: ArmSample, parameters: ContactParameters, limits: Limits) -> FloatArray:
        """To the standoff; turned first, out of reach of the surface, where much is to be turned."""
        p, turn, height = parameters, self.turn(arm), parameters.standoff_m
        if float(np.linalg.norm(turn)) > limits.misalignment_rad / 2:
            height = self.turning_height_m(p, limits)
        way = self.place_at(height) - arm.tip.position_m
        distance = float(np.linalg.norm(way))
        braking = math.sqrt(p.acceleration_m_s2 * distance)  # half the limit: the arm lags
        speed = min(p.travel_speed_m_s, braking, distance / RIGHTING_S)
        velocity = way * (speed / max(distance, 1e-9))
        return np.concatenate([velocity, turn / RIGHTING_S])

    def along_normal(self, arm: ArmSample, speed_m_s: float) -> FloatArray:
        """Along the normal, away from the surface positive; keeps place along it and orientation."""
        away = self._touch.position_m - arm.tip.position_m
        away = away - float(self.normal @ away) * self.normal
        velocity = speed_m_s * self.normal + away / RIGHTING_S
        return np.concatenate([velocity, self.turn(arm) / RIGHTING_S])
