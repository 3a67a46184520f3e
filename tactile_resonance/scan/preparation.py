# SPDX-License-Identifier: Apache-2.0
"""What a scan does before its first point: surface and normals found by touch, what is not clear left out.

To find the normal at a point the ball comes down along the normal as it is expected, at places of one circle
about the point, evenly apart. Where its centre is at first touch lies on the surface offset by its radius,
whose normals are those of the surface. The plane through the centres, fitted by least squares in the frame of
the expected normal, has the normal that is sought.

What three touches make of curvature: on an offset surface of radii R1 and R2 (those of the surface plus the
ball's radius where it bulges, less it where it is hollow) and a circle of radius p, the normal is off by up to
``p |1 / R1 - 1 / R2| / 4``: nothing on a sphere that is met along its normal, 0.04 rad on a cylinder of 10 mm
and a circle of 2 mm. Four touches or more leave nothing of that, and check each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require
from tactile_resonance.scan.clearance import TipUse, clear_points
from tactile_resonance.scan.hands import PointDisturbed, PointFailed, ScanEnded, Touch
from tactile_resonance.scan.measurement import Skipped
from tactile_resonance.scan.plan import Plan, make_plan
from tactile_resonance.scan.points import LeftOut, ScanPoint, tip_orientation
from tactile_resonance.scan.surface import NormalRequest, Plane, TouchRequest
from tactile_resonance.scan.surface_search import find_surface, fit_surface

UNCHECKED = Skipped(
    "the check that the housing is clear of the surface",
    "how the sensor is used is not known: it is kept clear of a plane only",
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
            found, touches = find_surface(
                surface, ball_radius_m, heading_rad, lambda point: find(point, force_n, count)
            )
        except (ValueError, PointFailed, ScanEnded) as error:
            raise ValueError(f"surface.touch: {error}") from error
        facts["surface"], surface = found.as_json(touches), found
        plan = make_plan(scene, surface)
    use: TipUse | None = None
    # of a plane contact control keeps the sensor clear itself
    if tip_use is not None and not isinstance(surface, Plane):
        use = tip_use()
        if use is None:
            plan = replace(plan, left_out=(UNCHECKED, *plan.left_out))

    def clear(plan: Plan) -> Plan:
        return plan if use is None else plan.with_points(*clear_points(plan.points, surface, use))

    plan = clear(plan)
    asked = scene.normals
    if asked is None:
        return plan, facts
    force_n, count = asked.force_n or scene.force_n, len(plan.points)
    try:
        points, normals, left = find_normals(
            plan.points,
            asked,
            ball_radius_m,
            heading_rad,
            lambda point: find(point, force_n, count),
        )
    except (PointFailed, ScanEnded) as error:
        raise ValueError(f"normals: {error}") from error
    facts["normals"] = normals
    return clear(plan.with_points(points, left)), facts


def find_normals(
    points: Iterable[ScanPoint],
    request: NormalRequest,
    ball_radius_m: float,
    heading_rad: float,
    touch: Callable[[ScanPoint], Touch],
) -> tuple[list[ScanPoint], list[dict[str, Any]], list[LeftOut]]:
    """`normal_of_touches` about each point; those whose normal is not found, or is refused, are left out.

    Parameters
    ----------
    points : iterable of ScanPoint
    request : NormalRequest
    ball_radius_m, heading_rad : float
        Of the tip; direction of the beam, seen from above.
    touch : callable
        Touches a point of the surface as it is expected, along its normal; may raise `PointFailed`.

    Raises
    ------
    PointDisturbed
        That `touch` raised: it says nothing of the point.
    """
    found: list[ScanPoint] = []
    normals: list[dict[str, Any]] = []
    left: list[LeftOut] = []
    for point in points:
        try:
            touches = tuple(touch(around) for around in places_around(point, request))
            made, facts = normal_of_touches(point, touches, ball_radius_m, heading_rad)
            _require_good(facts, request)
        except PointDisturbed:  # says nothing of the point
            raise
        except (PointFailed, ValueError) as error:
            left.append((point, f"normals: {error}"))
        else:
            found.append(made)
            normals.append(facts)
    return found, normals, left


def places_around(point: ScanPoint, request: NormalRequest) -> list[ScanPoint]:
    """Where the touches about a point come down, on the plane that is expected there."""
    turn = _frame(point.normal)
    angles = 2 * math.pi * np.arange(request.touches) / request.touches
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(request.touches)])
    places = np.array(point.position_m) + request.radius_m * circle @ turn.T
    return [
        replace(point, position_m=(x, y, z), label=f"{point.label}, touch {index + 1}")
        for index, (x, y, z) in enumerate(places.tolist())
    ]


def normal_of_touches(
    point: ScanPoint, touches: tuple[Touch, ...], ball_radius_m: float, heading_rad: float
) -> tuple[ScanPoint, dict[str, Any]]:
    """Normal of the plane through the ball's centres, and the place that it belongs to.

    Parameters
    ----------
    point : ScanPoint
        As it is expected.
    touches : tuple of Touch
        Three or more, along its normal, so that their deviations are those of heights along it.
    ball_radius_m, heading_rad : float

    Returns
    -------
    point : ScanPoint
        With the normal found, where the ball touches the surface when it is straight above the point that was
        asked for: beside that by the ball's radius times the sine of the angle.
    facts : dict
        What a run keeps of it [m, rad]: the angle from the normal that was expected, the standard deviation
        about the axis about which the normal is known least, the largest distance of a touch from the plane.

    Raises
    ------
    ValueError
        If the touches do not determine a plane.
    """
    turn, place = _frame(point.normal), np.array(point.position_m)
    local = (np.array([touch.ball_m for touch in touches]) - place) @ turn  # (n, 3)
    plane = fit_surface(local, [touch.std_m for touch in touches], "plane")
    across = plane.normal([0.0, 0.0])
    slopes = plane.covariance_m2[1:, 1:] / plane.scale_m**2
    normal = turn @ across
    # the ball above the point touches beside it on a slope; of that place, not of the point's, is the normal
    touched = place + float(plane.height_m([0.0, 0.0])) * turn[:, 2] - ball_radius_m * normal
    made = replace(
        point,
        position_m=tuple(touched.tolist()),
        normal=tuple(normal.tolist()),
        orientation_xyzw=tuple(tip_orientation(normal, heading_rad).tolist()),
        height_std_m=float(plane.height_std_m([0.0, 0.0])),
    )
    return made, {
        "position_m": touched.tolist(),
        "normal": normal.tolist(),
        # an angle is no larger than its tangent
        "std_rad": math.sqrt(float(np.linalg.eigvalsh(slopes)[-1])),
        "angle_rad": math.acos(min(1.0, float(across[2]))),
        "worst_m": float(np.max(np.abs(plane.residuals_m))),
        "touches": [{"ball_m": list(touch.ball_m), "std_m": touch.std_m} for touch in touches],
    }


def _require_good(facts: Mapping[str, Any], request: NormalRequest) -> None:
    angle, worst, std = (facts[name] for name in ("angle_rad", "worst_m", "std_rad"))
    off = "a touch off the plane through all [m]"
    for what, value, name, otherwise in (
        ("angle from the expected normal [rad]", round(angle, 4), "most_angle_rad", ""),
        (off, round(worst, 6), "tolerance_m", ": a smaller radius_m, or a smooth place"),
        ("standard deviation [rad]", round(std, 4), "most_std_rad", ": a larger radius_m, or more touches"),
    ):
        most = getattr(request, name)
        require(value <= most, what, value, f"{name} = {most:g} or less{otherwise}")


def _frame(normal: tuple[float, float, float]) -> FloatArray:
    """(3, 3) axes in columns, the third along a normal."""
    z = np.asarray(normal, float)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
