# SPDX-License-Identifier: Apache-2.0
"""Surface and normals found by touch: where the ball met them, and what is fitted through that, judged.

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

import contextlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special
from scipy.spatial.transform import Rotation

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.scan.failures import PointDisturbed, PointFailed, SurfaceMissing
from tactile_resonance.scan.hands import Touch
from tactile_resonance.scan.points import LeftOut, ScanPoint, tip_orientation
from tactile_resonance.scan.surface import NormalRequest, Surface, TouchRequest, unit_normal

UP = (0.0, 0.0, 1.0)
_IMPROBABLE = 1e-3  # residuals less probable than this are no noise
_WORST_CONDITION = 1e6
# Turns of the fit and of the normals along which the ball meets it; each leaves a hundredth of the error.
_TURNS = 4
# Pose of the arm and time of the forces leave so much of a touch's height unknown, whatever its noise.
LEAST_TOUCH_STD_M = 2e-5
# Less than the height from which a contact comes down: each step begins where the one before found nothing. A
# contact that searches less than that finds the surface early and is refused.
SEARCH_STEP_M = 2e-3
# Known better than this a plane tells where the next touch meets it, within what one contact searches.
KNOWN_STD_M = SEARCH_STEP_M / 5


@dataclass(frozen=True, eq=False)
class TouchedSurface(Surface):
    """A polynomial surface fitted to contacts.

    Attributes
    ----------
    form : str
        plane or quadric.
    center_m : (2,) float
        Origin of the polynomial, the contacts' mean position.
    scale_m : float
        Its unit of length.
    coefficients_m : (3,) or (6,) float
        Of 1, x, y and x^2, x y, y^2.
    covariance_m2 : square array
        Of the coefficients; scaled up by the residuals where these are larger than the contacts' own
        uncertainty explains.
    residuals_m : (n,) float
        Contact minus surface.
    consistent : bool
        False where the residuals are improbably large (below 0.1 %): another form, or a contact that
        was none. True where there is no contact to spare.
    """

    form: str
    center_m: FloatArray
    scale_m: float
    coefficients_m: FloatArray
    covariance_m2: FloatArray
    residuals_m: FloatArray
    consistent: bool

    def at(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(...) height [m] and (..., 3) unit normal; beyond the contacts too, where `height_std_m` grows."""
        value, by_x, by_y = (each @ self.coefficients_m for each in self._basis(xy_m))
        return np.asarray(value), unit_normal(by_x, by_y)

    def height_std_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) standard deviation of the height [m]."""
        basis, _, _ = self._basis(xy_m)
        return np.sqrt(np.einsum("...i,ij,...j->...", basis, self.covariance_m2, basis))

    def known(self, xy_m: npt.ArrayLike) -> BoolArray:
        """(...) in the square about the contacts: a form fitted to them need not go on beside them."""
        return np.all(np.abs(np.asarray(xy_m, float) - self.center_m) <= self.scale_m, axis=-1)

    def as_json(self, touches: Sequence[Touch]) -> dict[str, Any]:
        """What a run keeps of it and of the touches that it rests on; lengths in metres."""
        spare = len(touches) - self.coefficients_m.size
        return {
            "form": self.form,
            "touches": [asdict(touch) for touch in touches],
            "residuals_m": self.residuals_m.tolist(),
            "consistent": self.consistent if spare else None,
            "center_m": self.center_m.tolist(),
            "scale_m": self.scale_m,
            "coefficients_m": self.coefficients_m.tolist(),
        }

    def _basis(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        return _basis(xy_m, self.form, self.center_m, self.scale_m)


def fit_surface(
    contacts_m: npt.ArrayLike, std_m: npt.ArrayLike, form: str = "plane"
) -> TouchedSurface:
    """Weighted least squares of heights over x, y.

    Parameters
    ----------
    contacts_m : (n, 3) float
        Where the surface was found, as many as the form has terms, or more [m].
    std_m : (n,) float or float
        Standard deviation of each height, above 0 [m].
    form : str
        plane (three contacts or more) or quadric (six or more).

    Raises
    ------
    ValueError
        If the contacts do not determine the form (on one line, say).
    """
    contacts = np.asarray(contacts_m, float)
    std = np.broadcast_to(np.asarray(std_m, float), len(contacts))
    center = contacts[:, :2].mean(axis=0)
    scale = float(np.max(np.abs(contacts[:, :2] - center)))
    require(scale > 0, "contacts_m", "one position", "positions apart from each other")
    design = _basis(contacts[:, :2], form, center, scale)[0] / std[:, None]  # (n, terms)
    condition = float(np.linalg.cond(design * np.median(std)))
    require(
        condition < _WORST_CONDITION,
        "contacts_m",
        f"positions of condition number {condition:.1e}",
        f"positions that determine a {form}, not on one line or conic",
    )
    inverse = np.linalg.pinv(design)
    coefficients = inverse @ (contacts[:, 2] / std)
    covariance = inverse @ inverse.T
    weighted = contacts[:, 2] / std - design @ coefficients
    spare = len(contacts) - coefficients.size
    cost, consistent = float(weighted @ weighted), True
    if spare > 0:
        consistent = bool(special.chdtrc(spare, cost) >= _IMPROBABLE)
        if not consistent:
            covariance = covariance * cost / spare
    return TouchedSurface(form, center, scale, coefficients, covariance, weighted * std, consistent)


def _basis(
    xy_m: npt.ArrayLike, form: str, center_m: FloatArray, scale_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Terms (..., k) and their derivatives by x and y [1/m]."""
    x, y = np.moveaxis((np.asarray(xy_m, float) - center_m) / scale_m, -1, 0)
    zero, one = np.zeros_like(x), np.ones_like(x)
    value, by_x, by_y = [one, x, y], [zero, one, zero], [zero, zero, one]
    if form == "quadric":
        value += [x * x, x * y, y * y]
        by_x += [2 * x, y, zero]
        by_y += [zero, x, 2 * y]
    first, second, third = (np.stack(terms, axis=-1) for terms in (value, by_x, by_y))
    return first, second / scale_m, third / scale_m


def find_surface(
    request: TouchRequest,
    ball_radius_m: float,
    heading_rad: float,
    touch: Callable[[ScanPoint], Touch],
) -> tuple[TouchedSurface, list[Touch]]:
    """Touch all places of a request and fit its form: the surface, and the touches it rests on.

    The first place is expected at the height that the request states, the others where those before suggest: on
    their plane as soon as it is known there. Before, surfaces are searched for as far as the request says.

    Parameters
    ----------
    request : TouchRequest
    ball_radius_m, heading_rad : float
        Of the tip; direction of the beam, seen from above.
    touch : callable
        Touches a point of the surface as it is expected, from above.

    Raises
    ------
    ValueError
        If the touches do not determine the form, or do not lie on it.
    PointFailed
        That `touch` raised, with the number of the touch.
    """
    turn = tuple(tip_orientation(UP, heading_rad).tolist())
    touches: list[Touch] = []
    for index, (x, y) in enumerate(request.points_m):
        height, search_m = _expected(touches, (x, y), request, ball_radius_m)
        label = f"surface, touch {index + 1}"
        steps = 1 + math.ceil(2 * search_m / SEARCH_STEP_M)
        heights = height + np.linspace(search_m, -search_m, steps)
        points = [ScanPoint(index, (x, y, z), UP, turn, label) for z in heights.tolist()]
        try:
            touches.append(_first_found(points, touch))
        except PointFailed as error:
            raise PointFailed(f"touch {index + 1}: {error}") from error
    surface = fit_touches(touches, request.form, ball_radius_m)
    worst = int(np.argmax(np.abs(surface.residuals_m)))
    off = float(surface.residuals_m[worst])
    if abs(off) > request.tolerance_m:
        x, y = request.points_m[worst]
        raise ValueError(
            f"the touch at x = {1e3 * x:.2f}, y = {1e3 * y:.2f} mm lies {1e3 * off:+.2f} mm off "
            f"the {request.form} through all; accepted are {1e3 * request.tolerance_m:g} mm (tolerance_m). "
            "Another form, or a touch that was none?"
        )
    return surface, touches


def fit_touches(touches: Sequence[Touch], form: str, ball_radius_m: float) -> TouchedSurface:
    """Surface that all balls touch.

    A ball that comes down on a slope meets it beside its lowest point: one radius along the normal
    from its centre. The normals are those of the fit, found in turns.
    """
    balls = np.array([touch.ball_m for touch in touches])
    std = np.array([touch.std_m for touch in touches])
    normals = np.broadcast_to(UP, balls.shape)
    for _ in range(_TURNS):
        surface = fit_surface(balls - ball_radius_m * normals, std, form)
        normals = surface.normal((balls - ball_radius_m * normals)[:, :2])
    return surface


def _first_found(points: Sequence[ScanPoint], touch: Callable[[ScanPoint], Touch]) -> Touch:
    """Touch of the first of these points, from above, at which there is a surface."""
    for point in points[:-1]:
        try:
            return touch(point)
        except SurfaceMissing:
            continue
    return touch(points[-1])


def _expected(
    touches: Sequence[Touch], xy_m: tuple[float, float], request: TouchRequest, ball_radius_m: float
) -> tuple[float, float]:
    """Height at which the next touch is expected [m], and how far about it the surface is searched for [m].

    On the plane through those before and no further, where that is known; else about the last one, or as asked.
    """
    if len(touches) >= 3:
        with contextlib.suppress(ValueError):  # on one line: no plane yet
            plane = fit_touches(touches, "plane", ball_radius_m)
            if plane.height_std_m(xy_m) < KNOWN_STD_M:
                return float(plane.height_m(xy_m)), 0.0
    height_m = touches[-1].ball_m[2] - ball_radius_m if touches else request.expected_height_m
    return height_m, request.search_m


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
    turn = Rotation.from_quat(point.orientation_xyzw).as_matrix()
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
    turn, place = Rotation.from_quat(point.orientation_xyzw).as_matrix(), np.array(point.position_m)
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
