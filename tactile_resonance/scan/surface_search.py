# SPDX-License-Identifier: Apache-2.0
"""A surface found by touching it: where the ball met it, a form fitted through that, judged."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tactile_resonance.scan.hands import PointFailed, SurfaceMissing, Touch
from tactile_resonance.scan.plan import tip_orientation
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.surface import TouchRequest
from tactile_resonance.scan.touch import TouchedSurface, fit_surface

UP = (0.0, 0.0, 1.0)
# Turns of the fit and of the normals along which the ball meets it; each leaves a hundredth of the error.
_TURNS = 4
# Pose of the arm and time of the forces leave so much of a touch's height unknown, whatever its noise.
LEAST_TOUCH_STD_M = 2e-5
# Less than the height from which a contact comes down: each step begins where the one before found nothing. A
# contact that searches less than that finds the surface early and is refused.
SEARCH_STEP_M = 2e-3


@dataclass(frozen=True, eq=False)
class FoundSurface:
    """A surface and the touches it rests on.

    Attributes
    ----------
    surface : TouchedSurface
    touches : tuple of Touch
    """

    surface: TouchedSurface
    touches: tuple[Touch, ...]

    def as_json(self) -> dict[str, Any]:
        """What a run keeps of it; lengths in metres."""
        spare = len(self.touches) - self.surface.coefficients_m.size
        return {
            "form": self.surface.form,
            "touches": [
                {"ball_m": list(touch.ball_m), "std_m": touch.std_m, "force_n": touch.force_n}
                for touch in self.touches
            ],
            "residuals_m": self.surface.residuals_m.tolist(),
            "consistent": self.surface.consistent if spare else None,
            "center_m": self.surface.center_m.tolist(),
            "scale_m": self.surface.scale_m,
            "coefficients_m": self.surface.coefficients_m.tolist(),
        }


def find_surface(
    request: TouchRequest,
    ball_radius_m: float,
    heading_rad: float,
    touch: Callable[[ScanPoint], Touch],
) -> FoundSurface:
    """Touch all places of a request and fit its form.

    The first place is expected at the height that the request states, the others where those before suggest: on
    their plane as soon as it is known. Before, surfaces are searched for as far as the request says.

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
        height = _expected(touches, (x, y), request.expected_height_m, ball_radius_m)
        label = f"surface, touch {index + 1}"
        search_m = request.search_m if len(touches) < 3 else 0.0
        heights = height + np.linspace(search_m, -search_m, _steps(search_m))
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
    return FoundSurface(surface, tuple(touches))


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


def _steps(search_m: float) -> int:
    """Heights at which a surface is searched for."""
    return 1 + math.ceil(2 * search_m / SEARCH_STEP_M)


def _expected(
    touches: Sequence[Touch], xy_m: tuple[float, float], height_m: float, ball_radius_m: float
) -> float:
    """Height at which the next touch is expected: on the plane through those before, else as configured."""
    if len(touches) >= 3:
        try:
            return float(fit_touches(touches, "plane", ball_radius_m).height_m(xy_m))
        except ValueError:  # on one line: no plane yet
            pass
    if touches:
        return touches[-1].ball_m[2] - ball_radius_m
    return height_m
