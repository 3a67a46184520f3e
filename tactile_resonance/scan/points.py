# SPDX-License-Identifier: Apache-2.0
"""Where to touch: points of a plan, and patterns of them seen from above (grid, spiral, region ...)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.fields import (
    AboveZero,
    Checked,
    build,
    number,
    numbers,
    one_of,
    require,
)

Pair = tuple[float, float]
Order = Literal["serpentine", "raster"]
MOST_POINTS = 100_000
FARTHEST_M = 10.0
"""From the origin of its frame: out of the reach of any arm that carries the sensor."""


@dataclass(frozen=True)
class ScanPoint:
    """A point of a plan.

    Attributes
    ----------
    index : int
        Place in the plan, from 0.
    position_m : (3,) tuple
        On the surface, in the scan's frame [m]. The ball's centre is one ball radius further along the
        normal when they touch.
    normal : (3,) tuple
        Outward unit normal of the surface.
    orientation_xyzw : (4,) tuple
        Unit quaternion of the frame `tip` there: +z along the normal, +x from clamp to tip.
    label : str
        For people.
    height_std_m : float
        Standard deviation of the surface along z, where it is estimated [m].
    """

    index: int
    position_m: tuple[float, float, float]
    normal: tuple[float, float, float]
    orientation_xyzw: tuple[float, float, float, float]
    label: str = ""
    height_std_m: float = 0.0

    def __post_init__(self) -> None:
        require(self.index >= 0, "index", self.index, "0 or above")


LeftOut = tuple[ScanPoint, str]
"""A point that is left out of a plan, and why."""


def scan_points(
    name: str,
    position_m: FloatArray,
    normal: FloatArray,
    orientation_xyzw: FloatArray,
    height_std_m: FloatArray | None = None,
) -> tuple[ScanPoint, ...]:
    """Points of a scene of a name, numbered: fields of `ScanPoint`, a row each."""
    std_m = np.zeros(len(position_m)) if height_std_m is None else height_std_m
    columns = [each.tolist() for each in (position_m, normal, orientation_xyzw, std_m)]
    return tuple(
        ScanPoint(k, tuple(place), tuple(across), tuple(turn), point_label(name, k), std)
        for k, (place, across, turn, std) in enumerate(zip(*columns, strict=True))
    )


def point_label(name: str, index: int) -> str:
    """Of a point of a scene, for people, who count from 1."""
    return f"{name}, point {index + 1}"


def tip_orientation(normal: npt.ArrayLike, heading_rad: float) -> FloatArray:
    """(..., 4) unit quaternions (x, y, z, w) of the frame `tip`.

    Parameters
    ----------
    normal : (..., 3) float
        Outward unit normals: the tip's +z.
    heading_rad : float
        Direction of the tip's +x, from clamp to tip, seen from above [rad]: +x is its projection onto the
        surface.

    Raises
    ------
    ValueError
        If a normal points along the heading.
    """
    z = np.asarray(normal, float)
    heading = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
    x = heading - np.sum(z * heading, axis=-1, keepdims=True) * z
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    across = bool(np.all(length > 1e-6))
    require(across, "heading_rad", heading_rad, "a direction that is not along a normal")
    x = x / length
    frame = np.stack([x, np.cross(z, x), z], axis=-1)  # (..., 3, 3), columns are the axes
    quaternions = Rotation.from_matrix(frame.reshape(-1, 3, 3)).as_quat()
    return np.asarray(quaternions.reshape(*z.shape[:-1], 4))


def grid(
    center_m: npt.ArrayLike, size_m: npt.ArrayLike, spacing_m: npt.ArrayLike, order: str
) -> FloatArray:
    """(n, 2) positions of a rectangular grid about a centre [m].

    Parameters
    ----------
    center_m, size_m, spacing_m : (2,) float
        The outermost rows lie within `size_m`, as far out as whole spacings reach.
    order : str
        raster: every row in the direction of x; serpentine: every second one back.
    """
    center, size, spacing = (np.asarray(v, float) for v in (center_m, size_m, spacing_m))
    rows_of_each = np.floor(size / spacing + 1e-9) + 1
    _check_count(float(np.prod(rows_of_each)))
    counts = rows_of_each.astype(int)
    x, y = (center[k] + spacing[k] * (np.arange(counts[k]) - (counts[k] - 1) / 2) for k in range(2))
    rows = [np.stack([x, np.full(x.size, value)], axis=1) for value in y]
    if order == "serpentine":
        rows = [row[::-1] if i % 2 else row for i, row in enumerate(rows)]
    return np.concatenate(rows)


def grid_within(polygon_m: FloatArray, spacing_m: npt.ArrayLike, order: str) -> FloatArray:
    """(n, 2) positions of the `grid` over a polygon of (k, 2) corners that lie in it [m]."""
    low, high = polygon_m.min(axis=0), polygon_m.max(axis=0)
    whole = grid((low + high) / 2, high - low, spacing_m, order)
    return whole[inside_polygon(whole, polygon_m)]


def inside_polygon(xy_m: npt.ArrayLike, polygon_m: npt.ArrayLike) -> BoolArray:
    """(...) whether (..., 2) positions lie in a polygon of (k, 2) corners, or on its edge.

    Even-odd rule, so that an edge that crosses another leaves a hole.
    """
    p, corners = np.asarray(xy_m, float)[..., None, :], np.asarray(polygon_m, float)
    a, b = corners, np.roll(corners, -1, axis=0)  # (k, 2)
    crosses = (a[:, 1] > p[..., 1]) != (b[:, 1] > p[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (p[..., 1] - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    odd = np.sum(crosses & (p[..., 0] < at), axis=-1) % 2 == 1
    edge = b - a
    along = np.sum((p - a) * edge, axis=-1) / np.maximum(np.sum(edge**2, axis=-1), 1e-300)
    nearest = a + np.clip(along, 0, 1)[..., None] * edge
    close = 1e-9 * float(np.max(np.ptp(corners, axis=0)))
    on_edge = np.any(np.linalg.norm(p - nearest, axis=-1) <= close, axis=-1)
    return np.asarray(odd | on_edge)


def on_a_line(xy_m: FloatArray, near_m: float | None = None) -> bool:
    """Whether (n, 2) positions are on one line, or so near to it; None: up to rounding."""
    return bool(np.linalg.matrix_rank(xy_m - xy_m.mean(axis=0), tol=near_m) < 2)


def corners(polygon_m: FloatArray) -> FloatArray:
    """(k, 2) of a polygon as a scene gives it, (k, 3).

    Raises
    ------
    ValueError
        If they enclose nothing: fewer than three, or all on one line.
    """
    xy_m = polygon_m[:, :2]
    require(len(xy_m) >= 3, "polygon_m", len(xy_m), "three corners or more")
    require(not on_a_line(xy_m), "polygon_m", xy_m.tolist(), "corners that are not all on one line")
    return np.asarray(xy_m)


def read_positions(fields: Mapping[str, Any], where: str) -> FloatArray:
    """(n, 3) positions of a scene's section [m]; z is NaN where the surface decides it.

    Those of ``adaptive`` are of `scan.adaptive`.

    Raises
    ------
    ValueError
        If it is none of the known patterns, or a field of it is wrong.
    """
    require(len(fields) == 1, where, [*fields], f"exactly one of {', '.join((*_FORMS, 'adaptive'))}")
    form, pattern = one_of(_FORMS, fields, where)
    positions = pattern if form == "list" else build(pattern.positions, f"{where}.{form}")
    require_near(positions, where)
    return positions


def require_near(positions_m: FloatArray, where: str) -> None:
    """Raise ``ValueError`` that names the first of (n, 3) places beyond `FARTHEST_M`; NaN is no place."""
    (far,) = np.nonzero(np.any(np.abs(positions_m) > FARTHEST_M, axis=-1))
    if far.size:
        accepted = f"within {FARTHEST_M:g} m of the frame's origin"
        require(False, f"{where}[{far[0]}]", positions_m[far[0]].tolist(), accepted)


def read_list(value: object, where: str) -> FloatArray:
    """(n, 3) positions of a list of (x, y) or (x, y, z); NaN where no z is given."""
    good = isinstance(value, list) and len(value) > 0
    require(good, where, value, "a list of one position or more")
    assert isinstance(value, list)
    positions = np.full((len(value), 3), np.nan)
    for i, item in enumerate(value):
        read = numbers(item, f"{where}[{i}]")
        require(len(read) in (2, 3), f"{where}[{i}]", item, "2 or 3 coordinates")
        positions[i, : len(read)] = read
    return positions


def _read_spacing(value: object, where: str) -> Pair:
    """Along x and y; one number is both."""
    both = isinstance(value, (list, tuple))
    x, y = numbers(value, where, 2) if both else (number(value, where),) * 2
    require(min(x, y) > 0, where, value, "a number above 0, or two")
    return x, y


def flat(xy_m: FloatArray) -> FloatArray:
    """(n, 3) positions whose z the surface decides."""
    return np.concatenate([xy_m, np.full((len(xy_m), 1), np.nan)], axis=1)


def _check_count(count: float, where: str = "spacing_m") -> None:
    require(count <= MOST_POINTS, where, f"{count:.3g} points", f"at most {MOST_POINTS} points")


Spacing = Annotated[Pair, _read_spacing]
Places = Annotated[FloatArray, read_list]


@dataclass(frozen=True)
class _Grid:
    center_m: Pair
    size_m: Pair
    spacing_m: Spacing
    order: Order = "serpentine"

    def positions(self) -> FloatArray:
        require(min(self.size_m) >= 0, "size_m", self.size_m, "numbers of 0 or above")
        return flat(grid(self.center_m, self.size_m, self.spacing_m, self.order))


@dataclass(frozen=True)
class _Spiral(Checked):
    center_m: Pair
    radius_m: AboveZero
    spacing_m: Spacing

    def positions(self) -> FloatArray:
        """Of an Archimedean one, outwards: neighbours along it and from turn to turn about a spacing apart."""
        spacing_m = self.spacing_m[0]
        _check_count(np.pi * (self.radius_m / spacing_m) ** 2)
        pitch = spacing_m / (2 * np.pi)  # radius per angle
        # arc length of r = pitch angle, inverted on a fine table
        last = self.radius_m / pitch
        angle = np.linspace(0.0, last, 16 + int(40 * last))
        length = pitch / 2 * (angle * np.sqrt(1 + angle**2) + np.arcsinh(angle))
        steps = np.arange(0.0, length[-1] + 1e-9 * spacing_m, spacing_m)
        turned = np.interp(steps, length, angle)
        offset = pitch * turned[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
        return flat(self.center_m + offset)


@dataclass(frozen=True, eq=False)
class _Around:
    centres_m: Places
    offsets_m: Places

    def positions(self) -> FloatArray:
        _check_count(float(len(self.centres_m)) * len(self.offsets_m), "offsets_m")
        return (self.centres_m[:, None] + self.offsets_m).reshape(-1, 3)  # centre by centre


@dataclass(frozen=True, eq=False)
class _Region:
    polygon_m: Places
    spacing_m: Spacing
    order: Order = "serpentine"

    def positions(self) -> FloatArray:
        kept = grid_within(corners(self.polygon_m), self.spacing_m, self.order)
        require(len(kept) > 0, "spacing_m", self.spacing_m, "fine enough for a point")
        return flat(kept)


_FORMS = {"grid": _Grid, "spiral": _Spiral, "list": Places, "around": _Around, "region": _Region}
