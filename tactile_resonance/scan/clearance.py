# SPDX-License-Identifier: Apache-2.0
"""Whether beam and housing of the sensor stay clear of a surface that is not flat, at points and between them.

Contact control knows the plane through the point that it touches, no more. A scan knows the surface, so
points at which the housing would come down on it beside the tip, or on the way to them, are left out before
anything moves. Looked at are the ball, a line of places along the beam, and the lower edge of its housing;
where the surface is unknown, nothing is checked.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.law import Aim
from tactile_resonance.contact.parameters import ContactParameters, Limits, Workspace
from tactile_resonance.contact.samples import ArmSample, Pose
from tactile_resonance.contact.tip_path import TipPath, TurningWay
from tactile_resonance.contact.vectors import vector
from tactile_resonance.scan.points import LeftOut, ScanPoint
from tactile_resonance.scan.surface import Surface

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
        left.append(LeftOut(point, f"{why} {1e3 * height:.2f} mm above the surface; {accepted}"))
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
    body, lowest = _body(use.tip), math.inf
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
    path = TipPath(ContactGoal(touch, Aim(1.0)), use.tip)
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
    surely = surface.height_m(xy) + SURE_STDS * surface.height_std_m(xy)
    height = (places_m[..., 2] - surely) * surface.normal(xy)[..., 2] - drop_m
    height = height[surface.known(xy) & np.isfinite(height)]
    return float(height.min(initial=math.inf))
