# SPDX-License-Identifier: Apache-2.0
"""Where to touch, seen from above: grid, spiral, list, the same about several centres, region of interest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance.fields import known_keys, number, numbers, require, section

FloatArray = npt.NDArray[np.float64]
FORMS = ("grid", "spiral", "list", "around", "region")
ORDERS = ("serpentine", "raster")
MOST_POINTS = 100_000
FARTHEST_M = 10.0
"""From the origin of its frame: out of the reach of any arm that carries the sensor."""


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
    counts = np.floor(size / spacing + 1e-9).astype(int) + 1
    _check_count(float(counts[0]) * float(counts[1]))
    x, y = (center[k] + spacing[k] * (np.arange(counts[k]) - (counts[k] - 1) / 2) for k in range(2))
    rows = [np.stack([x, np.full(x.size, value)], axis=1) for value in y]
    if order == "serpentine":
        rows = [row[::-1] if i % 2 else row for i, row in enumerate(rows)]
    return np.concatenate(rows)


def spiral(center_m: npt.ArrayLike, radius_m: float, spacing_m: float) -> FloatArray:
    """(n, 2) positions of an Archimedean spiral from its centre outwards [m].

    Neighbours along the spiral and from turn to turn lie about `spacing_m` apart.
    """
    _check_count(np.pi * (radius_m / spacing_m) ** 2)
    pitch = spacing_m / (2 * np.pi)  # radius per angle
    # arc length of r = pitch angle, inverted on a fine table
    last = radius_m / pitch
    angle = np.linspace(0.0, last, 16 + int(40 * last))
    length = pitch / 2 * (angle * np.sqrt(1 + angle**2) + np.arcsinh(angle))
    steps = np.arange(0.0, length[-1] + 1e-9 * spacing_m, spacing_m)
    turned = np.interp(steps, length, angle)
    offset = pitch * turned[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    return np.asarray(np.asarray(center_m, float) + offset)


def inside_polygon(xy_m: npt.ArrayLike, polygon_m: npt.ArrayLike) -> npt.NDArray[np.bool_]:
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


def read_positions(fields: Mapping[str, Any], where: str) -> FloatArray:
    """(n, 3) positions of a scene's section [m]; z is NaN where the surface decides it.

    Raises
    ------
    ValueError
        If it is none of the known patterns, or a field of it is wrong.
    """
    known_keys(fields, set(FORMS), where)
    require(len(fields) == 1, where, sorted(fields), f"exactly one of {', '.join(FORMS)}")
    positions = _read_form(fields, where)
    require_near(positions, where)
    return positions


def require_near(positions_m: FloatArray, where: str) -> None:
    """Raise ``ValueError`` that names the first of (n, 3) places beyond `FARTHEST_M`; NaN is no place."""
    (far,) = np.nonzero(np.any(np.abs(positions_m) > FARTHEST_M, axis=-1))
    if far.size:
        accepted = f"within {FARTHEST_M:g} m of the frame's origin"
        require(False, f"{where}[{far[0]}]", positions_m[far[0]].tolist(), accepted)


def _read_form(fields: Mapping[str, Any], where: str) -> FloatArray:
    form = next(iter(fields))
    if form == "list":
        return read_list(fields["list"], f"{where}.list")
    content, where = section(fields, form, where), f"{where}.{form}"
    if form == "around":
        known_keys(content, {"centres_m", "offsets_m"}, where)
        centres, offsets = (
            read_list(content.get(key), f"{where}.{key}") for key in ("centres_m", "offsets_m")
        )
        _check_count(float(len(centres)) * len(offsets), f"{where}.offsets_m")
        return (centres[:, None] + offsets).reshape(-1, 3)  # centre by centre
    if form == "spiral":
        known_keys(content, {"center_m", "radius_m", "spacing_m"}, where)
        center = numbers(content.get("center_m"), f"{where}.center_m", 2)
        return _flat(
            spiral(center, _positive(content, "radius_m", where), _spacing(content, where)[0])
        )
    order = content.get("order", ORDERS[0])
    require(order in ORDERS, f"{where}.order", order, f"one of {', '.join(ORDERS)}")
    if form == "grid":
        known_keys(content, {"center_m", "size_m", "spacing_m", "order"}, where)
        center = numbers(content.get("center_m"), f"{where}.center_m", 2)
        size = numbers(content.get("size_m"), f"{where}.size_m", 2)
        require(min(size) >= 0, f"{where}.size_m", size, "numbers of 0 or above")
        return _flat(grid(center, size, _spacing(content, where), order))
    known_keys(content, {"polygon_m", "spacing_m", "order"}, where)
    polygon = read_list(content.get("polygon_m"), f"{where}.polygon_m")[:, :2]
    require(len(polygon) >= 3, f"{where}.polygon_m", len(polygon), "three corners or more")
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    whole = grid((low + high) / 2, high - low, _spacing(content, where), order)
    kept = whole[inside_polygon(whole, polygon)]
    require(
        len(kept) > 0, f"{where}.spacing_m", content.get("spacing_m"), "fine enough for a point"
    )
    return _flat(kept)


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


def _flat(xy_m: FloatArray) -> FloatArray:
    return np.concatenate([xy_m, np.full((len(xy_m), 1), np.nan)], axis=1)


def _positive(content: Mapping[str, Any], key: str, where: str) -> float:
    value = number(content.get(key), f"{where}.{key}")
    require(value > 0, f"{where}.{key}", value, "a number above 0")
    return value


def _spacing(content: Mapping[str, Any], where: str) -> tuple[float, float]:
    value = content.get("spacing_m")
    if isinstance(value, list):
        pair = numbers(value, f"{where}.spacing_m", 2)
        require(min(pair) > 0, f"{where}.spacing_m", value, "numbers above 0")
        return pair[0], pair[1]
    spacing = _positive(content, "spacing_m", where)
    return spacing, spacing


def _check_count(count: float, where: str = "spacing_m") -> None:
    require(count <= MOST_POINTS, where, f"{count:.3g} points", f"at most {MOST_POINTS} points")
