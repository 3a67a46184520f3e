# SPDX-License-Identifier: Apache-2.0
"""What a scan does before its first point: surface and normals found by touch, what is not clear left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from tactile_resonance.scan.clearance import TipUse
from tactile_resonance.scan.hands import PointFailed, ScanEnded, Touch
from tactile_resonance.scan.measurement import Skipped
from tactile_resonance.scan.normal_search import find_normals
from tactile_resonance.scan.plan import Plan, make_plan
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.surface import Plane, TouchRequest
from tactile_resonance.scan.surface_search import find_surface

UNCHECKED = Skipped(
    "the check that the housing is clear of the surface",
    "how the sensor is used is not known: it is kept clear of a plane only",
    0.0,
)


def prepare(
    plan: Plan,
    ball_radius_m: float,
    find: Callable[[ScanPoint, float, int], Touch],
    tip_use: Callable[[], TipUse | None] | None,
) -> tuple[Plan, dict[str, Any]]:
    """Touch what the scene asks for, and leave out what is not clear, before and after normals are known.

    Parameters
    ----------
    plan : Plan
        As it was compiled: before anything was touched.
    ball_radius_m : float
    find : callable
        Touches a point with a force, one of so many.
    tip_use : callable or None
        How the sensor is used; it returns None where that is not to be had. None: nothing is moved.

    Returns
    -------
    plan : Plan
        To go by.
    facts : dict
        What the run keeps of surface and normals that were found.

    Raises
    ------
    ValueError
        Where a surface is not found, touches cannot be made, or no point is left.
    """
    scene = plan.scene
    facts: dict[str, Any] = {}
    heading_rad, surface = scene.sensor.heading_rad, scene.surface
    if isinstance(surface, TouchRequest):
        force_n, count = surface.force_n or scene.force_n, len(surface.points_m)
        try:
            found = find_surface(
                surface, ball_radius_m, heading_rad, lambda point: find(point, force_n, count)
            )
        except (ValueError, PointFailed, ScanEnded) as error:
            raise ValueError(f"surface.touch: {error}") from error
        facts["surface"] = found.as_json()
        surface = found.surface
        plan = make_plan(scene, surface)
    use: TipUse | None = None
    # of a plane contact control keeps the sensor clear itself
    if tip_use is not None and not isinstance(surface, Plane):
        use = tip_use()
        if use is None:
            plan = replace(plan, left_out=(UNCHECKED, *plan.left_out))
    plan = plan.clear_of(surface, use)
    asked = scene.normals
    if asked is None:
        return plan, facts
    force_n, count = asked.force_n or scene.force_n, len(plan.points)
    try:
        normals, left = find_normals(
            plan.points,
            asked,
            ball_radius_m,
            heading_rad,
            lambda point: find(point, force_n, count),
        )
    except (PointFailed, ScanEnded) as error:
        raise ValueError(f"normals: {error}") from error
    facts["normals"] = [normal.as_json() for normal in normals]
    plan = plan.with_points([normal.point for normal in normals], left)
    return plan.clear_of(surface, use), facts
