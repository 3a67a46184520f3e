# SPDX-License-Identifier: Apache-2.0
"""Where the tip must be to touch a point of a surface, whether the beam's housing stays clear, the way there.

Frame `tip`: origin at the ball's centre, +z the outward surface normal, +x along the surface from
clamp to tip. The beam itself rises from the ball to its clamp by its tilt.

A tip that has much to turn goes up from where it begins, turns there, goes along, then down. The housing of
the sensor, far out at the clamp, sweeps through an arc while the tip turns. So the tip is turned where arc and
tip are clear of two planes: that of the goal, and that on which the tip may still stand, across its own axis
where it begins. It rises between both normals, which takes it off both. It first swings its axis into the
goal's normal, by the shortest turn, which tilts it no more than the steeper of both ends is; then it turns
about that normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance.contact.envelope import inside
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import ArmSample, Pose
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
from tactile_resonance.fields import BelowOne, Checked, Range, require


@dataclass(frozen=True)
class TipGeometry(Checked):
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

    ball_radius_m: BelowOne = 2.5e-3
    beam_length_m: BelowOne = 0.064
    beam_tilt_rad: Annotated[float, Range(0, 1)] = 0.17
    housing_below_m: Annotated[float, Range(0, 1)] = 6e-3

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

    def check_clear(self, limits: Limits) -> None:
        """Raise ``ValueError`` unless the housing stays clear wherever the limits allow the tip to be."""
        height = self.worst_height(limits.depth_m, limits.misalignment_rad)
        if height < limits.clearance_m:
            raise ValueError(
                f"depth_m: at {1e3 * limits.depth_m:g} mm, the tip off by misalignment_rad = "
                f"{limits.misalignment_rad:g}, the housing is {1e3 * height:.2f} mm above the surface; "
                f"accepted is clearance_m = {1e3 * limits.clearance_m:g} mm or more: less depth, or a "
                "larger beam_tilt_rad"
            )


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


RIGHTING_S = 0.1
"""Time constant in which place along the surface and orientation are put right [s]."""

ARRIVING_S = 0.04
"""Time constant of the last of a way in air [s]: some three times what an arm is late."""

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
    touch_m : tuple of 3 floats
        Place of the tip where the ball touches the surface as it is expected, in the base [m].
    normal : tuple of 3 floats
        Out of the tissue, in the base.
    """

    def __init__(self, goal: ContactGoal, tip: TipGeometry | None = None) -> None:
        self.goal, self.tip = goal, tip
        self.touch_m = vector(goal.touch.position_m)
        self._seen_rad = vector(goal.touch.rotation_rad)
        self._goal = turn_from_vector(self._seen_rad)
        self.normal: Vector = self._goal[2], self._goal[5], self._goal[8]
        # of the orientation seen last; most often the next is the same
        self._seen: Turn = self._goal
        self._turn_rad: Vector = ZERO
        self._off_rad = 0.0

    def height_m(self, arm: ArmSample) -> float:
        """Of the tip above the expected first touch, along the normal."""
        return dot(self.normal, difference(arm.position_m, self.touch_m))

    def place_at(self, height_m: float) -> Vector:
        """Place of the tip straight above the touch."""
        x, y, z = self.touch_m
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
        speed = min(p.retract_speed_m_s, math.sqrt(p.acceleration_m_s2 * left), left / ARRIVING_S)
        return *scaled(max(min(most_m_s, speed), 1e-4), self.normal), *ZERO

    def travel(self, arm: ArmSample, parameters: ContactParameters, near_m: float = 0.0) -> Six:
        """Straight to the standoff; what little is left is turned meanwhile.

        Lower than `near_m` it first goes along the surface, then down: near it what goes down goes slowly.
        """
        way = difference(self.place_at(parameters.standoff_m), arm.position_m)
        up = dot(self.normal, way)
        if up < 0 and self.height_m(arm) < near_m:
            along = difference(way, scaled(up, self.normal))
            way = along if math.hypot(*along) > ARRIVED_M / 2 else way
        return towards(way, self.turn_rad(arm), parameters.travel_speed_m_s, parameters)

    def along_normal(self, arm: ArmSample, speed_m_s: float) -> Six:
        """Along the normal, away from the surface positive; keeps place along it and orientation."""
        away = difference(self.touch_m, arm.position_m)
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
    speed = min(speed_m_s, braking, distance / ARRIVING_S)
    return *scaled(speed / max(distance, 1e-9), way_m), *scaled(1 / RIGHTING_S, turn_rad)


MARGIN_M = 2e-3
"""By which tip and housing are clear beyond what limits ask for: what is left of way and turn below [m]."""

PASSED_M, PASSED_RAD = 5e-4, 1e-2
"""Nearer than this to a place or an orientation on the way, the tip goes on to the next."""


Sweep = tuple[Turn, Vector]
"""A turn of the tip about its ball: orientation where it begins, rotation vector in the base [rad]."""


def _end_of(sweep: Sweep) -> Turn:
    """Orientation where a turn ends."""
    first, rotation_rad = sweep
    return turn_product(turn_from_vector(rotation_rad), first)


def _lowest(sweep: Sweep, normal: Vector, place_m: Vector) -> float:
    """Least height along a normal of a place in the frame `tip`, seen from the ball's centre [m].

    By Rodrigues' formula it is a sinusoid of the angle, whose trough is on the way or not. Half a turn may go
    either way round, by what little the tip is off where it begins.
    """
    first, rotation_rad = sweep
    begun, angle = rotated(first, place_m), math.hypot(*rotation_rad)
    if angle == 0.0:
        return dot(normal, begun)
    axis = scaled(1 / angle, rotation_rad)
    still = dot(normal, axis) * dot(axis, begun)
    cosine, sine = dot(normal, begun) - still, dot(normal, cross(axis, begun))
    trough = math.atan2(-sine, -cosine) % (2 * math.pi)
    if trough <= angle or angle > math.pi - 2 * PASSED_RAD:
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
        swing = begun, _shortest(old, new)
        swung = _end_of(swing)
        spin = swung, vector_from_turn(turn_product(goal.touch.turn, transposed(swung)))
        spun = _end_of(spin)
        # the tip may have been left pressing, as deep as it may
        planes = ((self.departure, limits.depth_m), (path, parameters.early_m))
        up = added(old, new)
        half = math.hypot(*up) / 2  # cosine of half the angle between both normals
        up = scaled(1 / max(2 * half, 1e-9), up)
        off_m = self.departure.place_at(limits.depth_m)
        rise_m = self._lacking(off_m, planes, (swing, spin)) / max(half, 1e-9)
        turn_at_m = added(off_m, scaled(rise_m, up))
        over_m = path.place_at(parameters.standoff_m)
        down_m = self._lacking(over_m, planes, ((spun, ZERO),)) / max(half, 1e-9)
        above_m = added(over_m, scaled(down_m, up))
        for place in (off_m, turn_at_m, above_m):
            self._require_inside(place, path.off_rad(start), limits.depth_m + rise_m, down_m)
        self._stops = tuple(
            TipPath(replace(goal, touch=Pose(np.array(place), np.array(vector_from_turn(turn)))))
            for place, turn in (
                (off_m, begun),
                (turn_at_m, begun),
                (turn_at_m, swung),
                (turn_at_m, spun),
                (above_m, spun),
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
        self,
        place_m: Vector,
        planes: tuple[tuple[TipPath, float], ...],
        sweeps: tuple[Sweep, ...],
    ) -> float:
        """How much higher than at a place the tip must be for all sweeps to be clear of all planes [m].

        A plane is that of a path, and how far above its place it may be.
        """
        limits, lacking = self._limits, 0.0
        for plane, up_m in planes:
            height = dot(plane.normal, difference(place_m, plane.touch_m)) - up_m - MARGIN_M
            lacking = max(lacking, limits.near_m - height)
            if self._tip is not None:
                edge = min(_lowest(s, plane.normal, self._tip.housing_m) for s in sweeps)
                lacking = max(lacking, limits.clearance_m - height - self._tip.ball_radius_m - edge)
        return lacking

    def _require_inside(self, place: Vector, off_rad: float, rise_m: float, down_m: float) -> None:
        box = self._limits.workspace
        if not inside(place, box.low_m, box.high_m):
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
