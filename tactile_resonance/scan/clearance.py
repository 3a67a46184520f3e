# SPDX-License-Identifier: Apache-2.0
"""How a scan keeps the sensor clear of the surface: points that are left out, and how high its tip needs to be.

Contact control knows the plane through the point that it touches, no more. A scan knows the surface, so
points at which the housing would come down on it beside the tip, or on the way to them, are left out before
anything moves. Looked at are the ball, a line of places along the beam, and the lower edge of its housing;
where the surface is unknown, nothing is checked.

Above its next point the tip needs to be as high as what was touched near by leaves unknown of a plane
surface. How far that lies off its place is taken to be a plane again, little tilted (Bayesian linear
regression, Bishop, Pattern Recognition and Machine Learning, section 3.3).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.geometry import TipGeometry, TipPath, TurningWay
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.parameters import ContactParameters, Limits, Workspace
from tactile_resonance.contact.samples import ArmSample, Pose
from tactile_resonance.contact.vectors import vector
from tactile_resonance.scan.points import LeftOut, ScanPoint
from tactile_resonance.scan.surface import Plane, Surface, TouchRequest

BEAM_PLACES = 32
STEP_M, STEP_RAD = 1e-3, 0.02
"""Of the places on a way that are looked at."""
SURE_STDS = 2.0
"""Standard deviations by which an estimated surface is taken to be higher."""
ANYWHERE = Workspace((-1e3,) * 3, (1e3,) * 3)


@dataclass(frozen=True)
class TipUse:
    """The sensor, and how contact control uses it."""

    tip: TipGeometry
    parameters: ContactParameters
    limits: Limits


def clear_points(
    points: Iterable[ScanPoint], surface: Surface, use: TipUse
) -> tuple[tuple[ScanPoint, ...], tuple[LeftOut, ...]]:
    """Points at which all stays clear, and from each of which the next is reached so; and the others.

    The way to the first point is not looked at: where the tip will begin is not known.
    """
    kept: list[ScanPoint] = []
    left: list[LeftOut] = []
    least = use.limits.clearance_m
    accepted = f"accepted is clearance_m = {1e3 * least:g} mm or more"
    for point in points:
        height = lowest_at_depth(point, surface, use)
        if height < least:
            why = f"at the depth limit of {1e3 * use.limits.depth_m:g} mm the housing would be"
        elif kept and (height := lowest_between(kept[-1], point, surface, use)) < least:
            why = f"on the way from point {len(kept)} the sensor would be"
        else:
            kept.append(point)
            continue
        left.append((point, f"{why} {1e3 * height:.2f} mm above the surface; {accepted}"))
    return tuple(kept), tuple(left)


def lowest_at_depth(point: ScanPoint, surface: Surface, use: TipUse) -> float:
    """Least height of beam and housing above the surface, as deep and as much turned as limits allow [m].

    Of the beam only counts what is clear of a plane then: the part beside the ball is pressed in with it.
    Infinite where nothing of the surface is known.
    """
    tip, limits = use.tip, use.limits
    turned = Rotation.from_rotvec([0.0, -limits.misalignment_rad, 0.0])
    body = turned.apply(_body(tip)[1:])  # (k, 3), without the ball
    flat = tip.ball_radius_m - limits.depth_m + body[:, 2]
    pose = _tip_pose(point, tip.ball_radius_m - limits.depth_m)
    places = pose.position_m + pose.rotation.apply(body[flat >= limits.clearance_m])
    return _lowest(places, surface)


def lowest_between(first: ScanPoint, then: ScanPoint, surface: Surface, use: TipUse) -> float:
    """Least height of ball, beam and housing above the surface from one point's standoff to the next [m].

    Infinite where nothing of the surface is known.
    """
    poses = way_between(first, then, use)
    # beside its lowest place the ball may meet what rises steeply
    body, lowest = np.vstack([_body(use.tip), _ball(use.tip.ball_radius_m)]), math.inf
    drop = np.zeros(len(body))
    drop[0] = use.tip.ball_radius_m
    for start, end in zip(poses[:-1], poses[1:], strict=True):
        places, turns = _on_the_way(start, end)
        at = places[:, None] + np.stack([turn.apply(body) for turn in turns])  # (t, k, 3)
        lowest = min(lowest, _lowest(at, surface, drop))
    return lowest


def way_between(first: ScanPoint, then: ScanPoint, use: TipUse) -> list[Pose]:
    """Poses from one point's standoff to the next, between which contact_node leads the tip straight."""
    radius, standoff = use.tip.ball_radius_m, use.parameters.standoff_m
    start, end = (_tip_pose(point, radius + standoff) for point in (first, then))
    touch = _tip_pose(then, radius)
    path = TipPath(ContactGoal(touch, 1.0), use.tip)
    arm = ArmSample(0, 0.0, vector(start.position_m), vector(start.rotation_rad), (0.0,) * 6)
    if path.off_rad(arm) > use.limits.misalignment_rad / 2:
        limits = replace(use.limits, workspace=ANYWHERE)
        return [start, *TurningWay(path, arm, use.parameters, limits).poses, end]
    if path.must_lift(arm, standoff):
        up = (standoff - path.height_m(arm)) * np.array(path.normal)
        return [start, Pose(start.position_m + up, start.rotation_rad), end]
    return [start, end]


def _body(tip: TipGeometry) -> FloatArray:
    """(k, 3) the ball's centre, places along the beam and the housing's lower edge, in the frame `tip`."""
    beam = np.linspace(0, 1, BEAM_PLACES)[:, None] * tip.sensor.position_m
    return np.vstack([beam, tip.housing_m])


def _ball(radius_m: float) -> FloatArray:
    """(16, 3) places on the ball half and all of its radius beside its axis, in the frame `tip`."""
    along = np.arange(8) * math.pi / 4
    beside = np.column_stack([np.cos(along), np.sin(along), np.zeros(8)])
    return radius_m * np.vstack([beside / 2 - [0.0, 0.0, math.sqrt(0.75)], beside])


def _tip_pose(point: ScanPoint, height_m: float) -> Pose:
    """Of the tip, its ball's centre so high above a point along the normal."""
    turn = Rotation.from_quat(point.orientation_xyzw)
    return Pose(np.array(point.position_m) + height_m * turn.as_matrix()[:, 2], turn.as_rotvec())


def _on_the_way(start: Pose, end: Pose) -> tuple[FloatArray, Rotation]:
    """(t, 3) places and t orientations from one pose to another."""
    way = end.position_m - start.position_m
    angle = (end.rotation * start.rotation.inv()).magnitude()
    count = 2 + math.ceil(max(float(np.linalg.norm(way)) / STEP_M, angle / STEP_RAD))
    share = np.linspace(0, 1, count)
    turns = Slerp([0, 1], Rotation.concatenate([start.rotation, end.rotation]))(share)
    return start.position_m + share[:, None] * way, turns


def _lowest(places_m: FloatArray, surface: Surface, drop_m: FloatArray | float = 0.0) -> float:
    """Least height of (..., 3) places, less a drop (...), over the surface under them, across its slope."""
    xy = places_m[..., :2]
    at, normal = surface.at(xy)
    surely = at + SURE_STDS * surface.height_std_m(xy)
    height = (places_m[..., 2] - surely) * normal[..., 2] - drop_m
    height = height[surface.known(xy) & np.isfinite(height)]
    return float(height.min(initial=math.inf))


NEAR_M = 0.01
"""Beyond this nothing is known from a touch, and the tip goes along at the usual height."""
LEAST_M = 7e-4
"""Height above where the surface may be at most."""
STDS = 3.0
HEIGHT_STD_M, SLOPE_STD, ROUGH_M = 1e-3, 0.03, 5e-5
"""Standard deviations before any touch: of the surface about its place, of its tilt [rad], and of what is not
plane, unless the touches show more."""
STILL_M = 5e-5
"""A surface whose motion goes less than this to either side stays where it is: noise may look like 20 um."""
FLAT_M, ALIKE = 1e-4, 1e-6
"""Points lie in one plane where they are no further off it, and their normals have such a cosine to 1."""


class Standoffs:
    """Of one scan; nothing is known where the surface is not plane, or moves.

    Parameters
    ----------
    surface : Surface or TouchRequest
        Of the scene.
    """

    def __init__(self, surface: Surface | TouchRequest) -> None:
        self._plane = is_plane(surface)
        self._found: list[tuple[ScanPoint, float, float]] = []

    def add(self, point: ScanPoint, off_m: float, std_m: float) -> None:
        """Take a touch: how far above its place the surface was, and the standard deviation of that [m]."""
        if self._plane and math.isfinite(off_m) and math.isfinite(std_m):
            self._found.append((point, off_m, std_m))

    def forget(self) -> None:
        """Know nothing from now on: the surface was where it should not have been, or it moves."""
        self._plane = False

    def lowest_m(self, point: ScanPoint) -> float:
        """Height above a point from which its approach may begin [m]; infinite where that is not known."""
        if not (self._plane and self._found and is_along(self._found[-1][0], point)):
            return math.inf
        ways = np.array(
            [np.subtract(found.position_m, point.position_m) for found, *_ in self._found]
        )
        near = np.linalg.norm(ways, axis=1) <= NEAR_M
        off_m, std_m = np.array([entry[1:] for entry in self._found])[near].T  # (n,) each
        at = np.column_stack(
            [np.ones(near.sum()), ways[near, :2]]
        )  # (n, 3) of height and tilt here
        before = np.diag(np.array([HEIGHT_STD_M, SLOPE_STD, SLOPE_STD]) ** -2.0)
        rough_m = ROUGH_M
        for _ in range(2):
            weight = 1.0 / (std_m**2 + rough_m**2)
            covariance = np.linalg.inv(before + (at.T * weight) @ at)
            mean = covariance @ (at.T @ (weight * off_m))
            rough_m = max(ROUGH_M, float(np.sqrt(np.mean((off_m - at @ mean) ** 2))))
        std = math.sqrt(covariance[0, 0] + rough_m**2 + point.height_std_m**2)
        return max(LEAST_M, LEAST_M + float(mean[0]) + STDS * std)


def is_plane(surface: Surface | TouchRequest) -> bool:
    """Whether a surface is plane, as it is given or will be found."""
    touched = isinstance(surface, TouchRequest) and surface.form == "plane"
    return touched or isinstance(surface, Plane)


def is_along(last: ScanPoint, point: ScanPoint) -> bool:
    """Whether the tip goes to a point along the plane of the last one, no further than what is near."""
    way = np.subtract(point.position_m, last.position_m)
    alike = np.dot(last.normal, point.normal) > 1.0 - ALIKE
    flat = abs(np.dot(last.normal, way)) < FLAT_M
    return bool(alike and flat and np.linalg.norm(way) <= NEAR_M)
