# SPDX-License-Identifier: Apache-2.0
"""The way of the tip to one goal and back: heights, angles, and the twists that lead along it."""

from __future__ import annotations

import math

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.parameters import ContactParameters
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.vectors import (
    ZERO,
    Six,
    Turn,
    Vector,
    difference,
    dot,
    scaled,
    transposed,
    turn_from_vector,
    turn_product,
    vector,
    vector_from_turn,
)

RIGHTING_S = 0.1
"""Time constant in which place along the surface and orientation are put right [s]."""

ARRIVED_M, ARRIVED_RAD = 5e-5, 2e-3
"""Distance and angle from the standoff at which it is reached."""

LIFTED_M = 5e-4
"""A tip that begins lower than this below the standoff is lifted first [m]."""


class TipPath:
    """Geometry of one goal.

    Parameters
    ----------
    goal : ContactGoal
    tip : TipGeometry or None
        None: the housing is not watched.

    Attributes
    ----------
    goal, tip
        As given.
    normal : tuple of 3 floats
        Out of the tissue, in the base.
    """

    def __init__(self, goal: ContactGoal, tip: TipGeometry | None = None) -> None:
        self.goal, self.tip = goal, tip
        self._touch_m = vector(goal.touch.position_m)
        self._seen_rad = vector(goal.touch.rotation_rad)
        self._goal = turn_from_vector(self._seen_rad)
        self.normal: Vector = self._goal[2], self._goal[5], self._goal[8]
        # of the orientation seen last; most often the next is the same
        self._seen: Turn = self._goal
        self._turn_rad: Vector = ZERO
        self._off_rad = 0.0

    def height_m(self, arm: ArmSample) -> float:
        """Of the tip above the expected first touch, along the normal."""
        return dot(self.normal, difference(arm.position_m, self._touch_m))

    def place_at(self, height_m: float) -> Vector:
        """Place of the tip straight above the touch."""
        x, y, z = self._touch_m
        nx, ny, nz = self.normal
        return x + height_m * nx, y + height_m * ny, z + height_m * nz

    def turn_rad(self, arm: ArmSample) -> Vector:
        """Rotation vector in the base from the tip's orientation to the goal's."""
        self._see(arm.rotation_rad)
        return self._turn_rad

    def off_rad(self, arm: ArmSample) -> float:
        """Angle between the tip's orientation and the goal's."""
        self._see(arm.rotation_rad)
        return self._off_rad

    def housing_m(self, arm: ArmSample, height_m: float) -> float | None:
        """Height of the housing above the surface, the tip at a height above its first touch."""
        if self.tip is None:
            return None
        self._see(arm.rotation_rad)
        return self.tip.housing_height(self._seen, self.normal, height_m)

    def _see(self, rotation_rad: Vector) -> None:
        if rotation_rad != self._seen_rad:
            self._seen_rad = rotation_rad
            self._seen = turn_from_vector(rotation_rad)
            self._turn_rad = vector_from_turn(turn_product(self._goal, transposed(self._seen)))
            self._off_rad = math.hypot(*self._turn_rad)

    def arrived(self, arm: ArmSample, height_m: float) -> bool:
        """Whether the tip is above the touch at a height, and turned as it should be."""
        near = math.dist(self.place_at(height_m), arm.position_m) < ARRIVED_M
        return near and self.off_rad(arm) < ARRIVED_RAD

    def must_lift(self, arm: ArmSample, standoff_m: float) -> bool:
        """Whether the tip is so low that it may press on something, at the touch or beside it."""
        return self.height_m(arm) < standoff_m - LIFTED_M

    # twists in the base

    def lift(
        self,
        arm: ArmSample,
        parameters: ContactParameters,
        height_m: float | None = None,
        most_m_s: float = math.inf,
    ) -> Six:
        """Straight up to a height, the standoff by default, neither along the surface nor turning."""
        to_m = parameters.standoff_m if height_m is None else height_m
        left = max(0.0, to_m - self.height_m(arm))
        p = parameters
        speed = min(p.retract_speed_m_s, math.sqrt(p.acceleration_m_s2 * left), left / RIGHTING_S)
        return *scaled(max(min(most_m_s, speed), 1e-4), self.normal), *ZERO

    def travel(self, arm: ArmSample, parameters: ContactParameters) -> Six:
        """Straight to the standoff; what little is left is turned meanwhile."""
        way = difference(self.place_at(parameters.standoff_m), arm.position_m)
        return towards(way, self.turn_rad(arm), parameters.travel_speed_m_s, parameters)

    def along_normal(self, arm: ArmSample, speed_m_s: float) -> Six:
        """Along the normal, away from the surface positive; keeps place along it and orientation."""
        away = difference(self._touch_m, arm.position_m)
        speed = speed_m_s - dot(self.normal, away) / RIGHTING_S
        x, y, z = away
        nx, ny, nz = self.normal
        return (
            x / RIGHTING_S + speed * nx,
            y / RIGHTING_S + speed * ny,
            z / RIGHTING_S + speed * nz,
            *scaled(1 / RIGHTING_S, self.turn_rad(arm)),
        )


def towards(
    way_m: Vector, turn_rad: Vector, speed_m_s: float, parameters: ContactParameters
) -> Six:
    """Twist along the rest of a way and of a turn, at up to a speed, which falls off before the end."""
    distance = math.hypot(*way_m)
    braking = math.sqrt(parameters.acceleration_m_s2 * distance)  # half the limit: the arm lags
    speed = min(speed_m_s, braking, distance / RIGHTING_S)
    return *scaled(speed / max(distance, 1e-9), way_m), *scaled(1 / RIGHTING_S, turn_rad)
