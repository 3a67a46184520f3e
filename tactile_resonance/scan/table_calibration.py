# SPDX-License-Identifier: Apache-2.0
"""Where a table stands in the robot's base, from touches: height and tilts, with their covariance; its file.

A touch comes down along the table's normal as it is known, so its error is one of height, and the plane is the
weighted least-squares fit of heights over x, y (`fit_surface`). x and y of the origin and the turn about the
normal do not show in any height: they stay as they are known, and have no covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from tactile_resonance._typing import FloatArray
from tactile_resonance.configuration import dump_yaml
from tactile_resonance.contact.samples import Pose
from tactile_resonance.fields import (
    AboveZero,
    Checked,
    Range,
    build,
    number,
    numbers,
    read_yaml,
    require,
)
from tactile_resonance.scan.hands import Touch
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.scene import SensorUse
from tactile_resonance.scan.surface import MOST_SEARCH_M, TouchRequest
from tactile_resonance.scan.surface_search import (
    LEAST_TOUCH_STD_M,
    TouchedSurface,
    find_surface,
    fit_surface,
    fit_touches,
)

MOST_TILT_STD_RAD = 5e-3
"""Standard deviation of the tilt about any axis; beyond it the points lie too close together or to one line."""
FORMAT = "tactile_resonance table 1"
ORDER = ("height_m", "tilt_x_rad", "tilt_y_rad")
NOT_ESTIMATED = ("x", "y", "turn about the normal")
_HEADER = """\
# A table in the robot's base, found by touch: `ros2 launch ... table_in_base:=THIS_FILE` takes it.
# Lengths in m, angles in rad. No touch along the normal determines what is not estimated: it is as given.
"""


@dataclass(frozen=True)
class CalibrationRequest(Checked):
    """What is touched and what is accepted; ``action/CalibrateTable.action`` gives unit and meaning."""

    points_m: tuple[tuple[float, float, float], ...]
    force_n: AboveZero = 0.01
    search_m: Annotated[float, Range(0.0, MOST_SEARCH_M)] = 0.0
    flatness_m: Annotated[float, Range(0.0, 1e-3)] = 0.0
    most_tilt_rad: Annotated[float, Range(1e-6, 0.2)] = 0.05
    heading_rad: float = 0.0
    sensor: str = SensorUse.name
    file: str = ""

    def __post_init__(self) -> None:
        build(SensorUse, "sensor:", self.sensor)
        super().__post_init__()
        number(self.heading_rad, "heading_rad")
        require(len(self.points_m) >= 3, "points", len(self.points_m), "three points or more")
        for index, point in enumerate(self.points_m):
            for value, name in zip(point, "xyz", strict=True):
                number(value, f"points[{index}].{name}")
        heights = sorted({z for _, _, z in self.points_m})
        require(len(heights) == 1, "points: z", heights, "one height, that of the touched surface")
        # what even the best touches there would not determine is not touched
        least = math.hypot(LEAST_TOUCH_STD_M, self.flatness_m)
        best = build(fit_surface, "points:", self.points_m, least)
        _covariance(best, self.height_m)

    @property
    def height_m(self) -> float:
        """Of the touched surface above the table."""
        return self.points_m[0][2]


@dataclass(frozen=True, eq=False)
class TableCalibration:
    """A table found by touch.

    Attributes
    ----------
    table_in_base : Pose
    correction : (3,) float
        Height of the origin along z [m] and rotation vector about x and y [rad], against the table as it was
        known and in its frame.
    covariance : (3, 3) float
        Of the correction [m^2, m rad, rad^2].
    touches : tuple of Touch
        In the frame of the table as it was known.
    residuals_m, std_m : (n,) float
        Of each touch, along z: against the plane, and its standard deviation, flatness included.
    """

    table_in_base: Pose
    correction: FloatArray
    covariance: FloatArray
    touches: tuple[Touch, ...]
    residuals_m: FloatArray
    std_m: FloatArray

    @property
    def std(self) -> FloatArray:
        """(3,) standard deviations of the correction [m, rad, rad]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def reduced_chi_square(self) -> float:
        """Of the residuals, expected 1; NaN where three touches leave nothing to check."""
        spare = self.residuals_m.size - 3
        return float(np.sum((self.residuals_m / self.std_m) ** 2)) / spare if spare else math.nan

    def __str__(self) -> str:
        """Correction and residuals in a sentence."""
        (height, x, y), std = self.correction, self.std
        text = (
            f"height {1e3 * height:+.3f} +- {1e3 * std[0]:.3f} mm, tilt about x {1e3 * x:+.2f} +- "
            f"{1e3 * std[1]:.2f} mrad, about y {1e3 * y:+.2f} +- {1e3 * std[2]:.2f} mrad"
        )
        if self.residuals_m.size == 3:
            return f"{text}; three touches: no residual checks them"
        worst = float(np.max(np.abs(self.residuals_m)))
        return (
            f"{text}; largest residual {1e6 * worst:.0f} um, reduced chi-square "
            f"{self.reduced_chi_square:.2f}"
        )


def calibrate_table(
    request: CalibrationRequest,
    table_in_base: Pose,
    ball_radius_m: float,
    touch: Callable[[ScanPoint], Touch],
) -> TableCalibration:
    """Touch all points of a request and find the table whose surface all balls touch.

    Parameters
    ----------
    request : CalibrationRequest
    table_in_base : Pose
        As it is known: points and touches are in its frame.
    ball_radius_m : float
    touch : callable
        Touches a point of the surface as it is expected, from above.

    Raises
    ------
    ValueError
        If the touches do not determine the tilts or contradict a plane, or the table is tilted further than
        accepted.
    PointFailed
        That `touch` raised, with the number of the touch.
    """
    xy = tuple((x, y) for x, y, _ in request.points_m)
    wanted = TouchRequest(
        xy, "plane", request.height_m, request.force_n, math.inf, request.search_m
    )
    _, touches = find_surface(wanted, ball_radius_m, request.heading_rad, touch)
    wider = [replace(t, std_m=math.hypot(t.std_m, request.flatness_m)) for t in touches]
    surface = fit_touches(wider, "plane", ball_radius_m)
    if not surface.consistent:  # first: their residuals would be taken for points that lie too close together
        raise ValueError(f"touches: {_contradiction(surface, wider, ball_radius_m)}")
    covariance = _covariance(surface, request.height_m)
    slope_x, slope_y = surface.coefficients_m[1:] / surface.scale_m
    slope = math.hypot(slope_x, slope_y)
    tilt = math.atan(slope)
    accepted = f"up to {request.most_tilt_rad:g} rad (most_tilt_rad)"
    require(tilt <= request.most_tilt_rad, "tilt of the table [rad]", round(tilt, 5), accepted)
    # the turn without twist from z to the normal (-slope_x, -slope_y, 1)
    turn = np.array([slope_y, -slope_x]) * (tilt / slope if slope else 1.0)
    # the touched surface lies height_m along the normal above the table
    height = float(surface.height_m((0.0, 0.0))) - request.height_m * math.hypot(1.0, slope)
    rotation = table_in_base.rotation
    position = table_in_base.position_m + rotation.apply([0.0, 0.0, height])
    turned = rotation * Rotation.from_rotvec([*turn, 0.0])
    return TableCalibration(
        Pose(position, turned.as_rotvec()),
        np.array([height, *turn]),
        covariance,
        tuple(touches),
        surface.residuals_m,
        np.array([touch.std_m for touch in wider]),
    )


def _covariance(surface: TouchedSurface, height_m: float) -> FloatArray:
    """(3, 3) of height and tilts, to first order in the tilt; ValueError where the tilts are not determined."""
    center, scale = surface.center_m, surface.scale_m
    slope_x, slope_y = surface.coefficients_m[1:] / scale
    secant = math.hypot(1.0, slope_x, slope_y)
    jacobian = np.array(  # of height, tilt_x, tilt_y by the coefficients of 1, x, y
        [
            [
                1.0,
                (-center[0] - height_m * slope_x / secant) / scale,
                (-center[1] - height_m * slope_y / secant) / scale,
            ],
            [0.0, 0.0, 1.0 / scale],
            [0.0, -1.0 / scale, 0.0],
        ]
    )
    covariance = jacobian @ surface.covariance_m2 @ jacobian.T
    worst = math.sqrt(float(np.linalg.eigvalsh(covariance[1:, 1:])[-1]))
    accepted = f"up to {MOST_TILT_STD_RAD:g}: points further apart, not on one line"
    where = "points: standard deviation of the tilt from them [rad]"
    require(worst <= MOST_TILT_STD_RAD, where, round(worst, 5), accepted)
    return covariance


def _contradiction(
    surface: TouchedSurface, touches: Sequence[Touch], ball_radius_m: float
) -> str:
    """What residuals that are improbably large mean: the one touch without which the others lie on a plane."""
    worst = float(np.max(np.abs(surface.residuals_m)))
    text = f"they lie up to {1e3 * worst:.3f} mm off a plane, which their standard deviations do not explain"
    alone = []
    for index, touch in enumerate(touches if len(touches) > 4 else ()):
        others = [*touches[:index], *touches[index + 1 :]]
        try:
            plane = fit_touches(others, "plane", ball_radius_m)
        except ValueError:  # they lie on one line
            continue
        if plane.consistent:
            foot = touch.ball_m - ball_radius_m * plane.normal(touch.ball_m[:2])
            alone.append((index, float(foot[2] - plane.height_m(foot[:2]))))
    if len(alone) == 1:
        index, off = alone[0]
        return f"{text}: touch {index + 1} lies {1e3 * off:+.3f} mm off the plane of the others"
    if alone:
        numbers = ", ".join(str(index + 1) for index, _ in alone)
        return f"{text}: one of {numbers} is off, more touches would show which"
    return f"{text}: more touches would show which is off, or the surface is not flat (flatness_m)"


def as_text(made: TableCalibration, request: CalibrationRequest, known: Mapping[str, Any]) -> str:
    """Content of the file.

    Parameters
    ----------
    made : TableCalibration
    request : CalibrationRequest
    known : mapping
        What else a reader should know: frames, date, who made it.
    """
    touches = [
        {"ball_m": list(t.ball_m), "std_m": std, "force_n": t.force_n, "residual_m": residual}
        for t, std, residual in zip(
            made.touches, made.std_m.tolist(), made.residuals_m.tolist(), strict=True
        )
    ]
    content = {
        "format": FORMAT,
        "table_in_base": made.table_in_base.vector.tolist(),
        **known,
        "estimated": list(ORDER),
        "not_estimated": list(NOT_ESTIMATED),
        "correction": made.correction.tolist(),
        "covariance": made.covariance.tolist(),
        "reduced_chi_square": made.reduced_chi_square,
        "force_n": request.force_n,
        "flatness_m": request.flatness_m,
        "height_m": request.height_m,
        "sensor": request.sensor,
        "touches": touches,  # in the frame of the table as it was known
    }
    return _HEADER + dump_yaml(content)


def read_table(path: Path, base_frame: str) -> list[float]:
    """Position [m] and rotation vector [rad] of a table in a base, from its file.

    Raises
    ------
    ValueError
        If it cannot be read, or is something else, or of another base; names field, value and what is accepted.
    """
    content = read_yaml(path)
    form = content.get("format")
    require(form == FORMAT, f"{path}: format", form, f"{FORMAT!r}, as calibrate_table writes it")
    base = content.get("base_frame")  # what else the file holds is for people
    require(base == base_frame, f"{path}: base_frame", base, f"{base_frame!r}, the robot's base here")
    return list(numbers(content.get("table_in_base"), f"{path}: table_in_base", 6))
