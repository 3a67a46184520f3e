# SPDX-License-Identifier: Apache-2.0
"""The way of a tip that has much to turn: up from where it begins, turned there, along, then down.

The housing of the sensor, far out at the clamp, sweeps through an arc while the tip turns. So the tip is
turned where arc and tip are clear of two planes: that of the goal, and that on which the tip may still
stand, across its own axis where it begins. It rises between both normals, which takes it off both. It
first swings its axis into the goal's normal, by the shortest turn, which tilts it no more than the steeper
of both ends is; then it turns about that normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import ArmSample, Pose
from tactile_resonance.contact.tip_path import TipPath, towards
from tactile_resonance.contact.vectors import (
    ZERO,
    Six,
    Turn,
    Vector,
    added,
    cross,
    difference,
    dot,
    rotated,
    scaled,
    transposed,
    turn_from_vector,
    turn_product,
    vector,
    vector_from_turn,
)

MARGIN_M = 2e-3
"""By which tip and housing are clear beyond what limits ask for: what is left of way and turn below [m]."""

PASSED_M, PASSED_RAD = 5e-4, 1e-2
"""Nearer than this to a place or an orientation on the way, the tip goes on to the next."""


@dataclass(frozen=True)
class _Plane:
    """A surface as the way takes it.

    Attributes
    ----------
    touch_m : Vector
        Place of the tip where the ball touches it as it is expected.
    normal : Vector
    up_m : float
        So far above its place it may be.
    """

    touch_m: Vector
    normal: Vector
    up_m: float


@dataclass(frozen=True)
class _Sweep:
    """A turn of the tip about its ball.

    Attributes
    ----------
    first : Turn
        Orientation where it begins.
    rotation_rad : Vector
        In the base.
    """

    first: Turn
    rotation_rad: Vector

    @cached_property
    def last(self) -> Turn:
        """Orientation where it ends."""
        return turn_product(turn_from_vector(self.rotation_rad), self.first)

    def lowest(self, normal: Vector, place_m: Vector) -> float:
        """Least height along a normal of a place in the frame `tip`, seen from the ball's centre [m].

        By Rodrigues' formula it is a sinusoid of the angle, whose trough is on the way or not.
        """
        begun, angle = rotated(self.first, place_m), math.hypot(*self.rotation_rad)
        if angle == 0.0:
            return dot(normal, begun)
        axis = scaled(1 / angle, self.rotation_rad)
        still = dot(normal, axis) * dot(axis, begun)
        cosine, sine = dot(normal, begun) - still, dot(normal, cross(axis, begun))
        trough = math.atan2(-sine, -cosine) % (2 * math.pi)
        if trough <= angle:
            return still - math.hypot(cosine, sine)
        return still + min(cosine, cosine * math.cos(angle) + sine * math.sin(angle))


class TurningWay:
    """Leads a tip from where it begins to a place above its goal, turned as the goal is.

    Parameters
    ----------
    path : TipPath
        Of the goal.
    start : ArmSample
        Where the tip begins.
    parameters : ContactParameters
    limits : Limits

    Attributes
    ----------
    departure : TipPath
        Of the surface on which the tip is taken to stand where it begins.

    Raises
    ------
    ValueError
        Where what is high enough lies outside of the workspace.
    """

    def __init__(
        self,
        path: TipPath,
        start: ArmSample,
        parameters: ContactParameters,
        limits: Limits,
    ) -> None:
        self._parameters, self._limits, self._tip = parameters, limits, path.tip
        goal, begun = path.goal, turn_from_vector(start.rotation_rad)
        self.departure = TipPath(replace(goal, touch=start.tip), path.tip)
        old, new = self.departure.normal, path.normal
        swing = _Sweep(begun, _shortest(old, new))
        spin = _Sweep(
            swing.last,
            vector_from_turn(turn_product(goal.touch.turn, transposed(swing.last))),
        )
        # the tip may have been left pressing, as deep as it may
        planes = (
            _Plane(start.position_m, old, limits.depth_m),
            _Plane(vector(goal.touch.position_m), new, parameters.early_m),
        )
        up = added(old, new)
        half = math.hypot(*up) / 2  # cosine of half the angle between both normals
        up = scaled(1 / max(2 * half, 1e-9), up)
        off_m = self.departure.place_at(limits.depth_m)
        rise_m = self._lacking(off_m, planes, (swing, spin)) / max(half, 1e-9)
        turn_at_m = added(off_m, scaled(rise_m, up))
        over_m = path.place_at(parameters.standoff_m)
        held = _Sweep(spin.last, ZERO)
        down_m = self._lacking(over_m, planes, (held,)) / max(half, 1e-9)
        above_m = added(over_m, scaled(down_m, up))
        for place in (off_m, turn_at_m, above_m):
            self._require_inside(place, path.off_rad(start), limits.depth_m + rise_m, down_m)
        self._stops = tuple(
            TipPath(replace(goal, touch=Pose(np.array(place), np.array(vector_from_turn(turn)))))
            for place, turn in (
                (off_m, begun),
                (turn_at_m, begun),
                (turn_at_m, swing.last),
                (turn_at_m, spin.last),
                (above_m, spin.last),
            )
        )
        self._passed = 0

    @property
    def leaving(self) -> bool:
        """Whether the tip is on its way up, not turned yet."""
        return self._passed < 2

    @property
    def poses(self) -> tuple[Pose, ...]:
        """Between which the tip goes straight, or turns where it is, after that in which it begins."""
        return tuple(stop.goal.touch for stop in self._stops)

    def twist(self, arm: ArmSample) -> Six | None:
        """Twist in the base towards the next place on the way; None: the last is reached."""
        while self._passed < len(self._stops):
            stop = self._stops[self._passed]
            way = difference(stop.place_at(0.0), arm.position_m)
            if math.hypot(*way) > PASSED_M or stop.off_rad(arm) > PASSED_RAD:
                p = self._parameters
                speed = p.travel_speed_m_s if self._passed else p.retract_speed_m_s
                return towards(way, stop.turn_rad(arm), speed, p)
            self._passed += 1
        return None

    def _lacking(
        self, place_m: Vector, planes: tuple[_Plane, ...], sweeps: tuple[_Sweep, ...]
    ) -> float:
        """How much higher than at a place the tip must be for all sweeps to be clear of all planes [m]."""
        limits, lacking = self._limits, 0.0
        for plane in planes:
            height = dot(plane.normal, difference(place_m, plane.touch_m)) - plane.up_m - MARGIN_M
            lacking = max(lacking, limits.near_m - height)
            if self._tip is not None:
                edge = min(sweep.lowest(plane.normal, self._tip.housing_m) for sweep in sweeps)
                lacking = max(lacking, limits.clearance_m - height - self._tip.ball_radius_m - edge)
        return lacking

    def _require_inside(self, place: Vector, off_rad: float, rise_m: float, down_m: float) -> None:
        box = self._limits.workspace
        if any(
            x < low or x > high for x, low, high in zip(place, box.low_m, box.high_m, strict=True)
        ):
            x, y, z = place
            raise ValueError(
                f"touch: to turn by {off_rad:.2f} rad clear of the surface and of that which it leaves, "
                f"the tip has to rise by {1e3 * rise_m:.1f} mm, and to come down by {1e3 * down_m:.1f} mm "
                f"to its standoff; {x:.3f}, {y:.3f}, {z:.3f} m on that way lies outside of the workspace "
                f"{box}: begin from an orientation nearer to the goal's, or from further inside"
            )


def _shortest(old: Vector, new: Vector) -> Vector:
    """Rotation vector of the shortest turn from one direction to another [rad]."""
    across = cross(old, new)
    sine = math.hypot(*across)
    if sine == 0.0:
        return ZERO
    return scaled(math.atan2(sine, dot(old, new)) / sine, across)
