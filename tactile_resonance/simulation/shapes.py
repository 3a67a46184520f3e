# SPDX-License-Identifier: Apache-2.0
"""Regions of space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.fields import known_keys, number, numbers, require, section

Point = tuple[float, ...]
SHAPES = ("disc", "box", "half_space", "sphere")


class Shape(Protocol):
    """A region of space."""

    def contains(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell for positions (..., 2 or 3) [m] which lie inside, shape (...)."""
        ...


@dataclass(frozen=True)
class Disc:
    """A disc in x, y at any height: the surface of a round dish."""

    center_m: Point
    radius_m: float

    def contains(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which positions lie inside or on the edge."""
        distance = np.linalg.norm(position_m[..., :2] - np.asarray(self.center_m), axis=-1)
        return np.asarray(distance <= self.radius_m)


@dataclass(frozen=True)
class Box:
    """A box with edges along the axes; two coordinates per corner leave the height open."""

    low_m: Point
    high_m: Point

    def contains(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which positions lie inside or on the faces."""
        position = _coordinates(position_m, len(self.low_m))
        inside = (position >= np.asarray(self.low_m)) & (position <= np.asarray(self.high_m))
        return np.asarray(inside.all(axis=-1))


@dataclass(frozen=True)
class HalfSpace:
    """All positions with ``normal . (position - point) <= 0``."""

    point_m: Point
    normal: Point

    def contains(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which positions lie on the side the normal points away from."""
        position = _coordinates(position_m, len(self.normal))
        return np.asarray((position - np.asarray(self.point_m)) @ np.asarray(self.normal) <= 0)


@dataclass(frozen=True)
class Sphere:
    """A ball; positions without a height are taken at height 0."""

    center_m: Point
    radius_m: float

    def contains(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which positions lie inside or on the surface."""
        position = _coordinates(position_m, 3)
        way = position - np.asarray(self.center_m)
        return np.asarray(np.einsum("...i,...i", way, way) <= self.radius_m**2)


def _coordinates(position_m: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Cut off the height, or add height 0, so that the last axis has `count` coordinates."""
    missing = count - position_m.shape[-1]
    if missing <= 0:
        return position_m[..., :count]
    return np.concatenate([position_m, np.zeros((*position_m.shape[:-1], missing))], axis=-1)


def read_shape(entry: Mapping[str, Any], where: str) -> Shape:
    """Read the one shape among the fields of `entry`.

    Raises
    ------
    ValueError
        If there is none, or more than one, or a field of it is wrong.
    """
    forms = [key for key in entry if key in SHAPES]
    require(len(forms) == 1, where, forms, f"exactly one of {sorted(SHAPES)}")
    form = forms[0]
    return _read(form, section(entry, form, where), f"{where}.{form}")


def _read(form: str, fields: Mapping[str, Any], where: str) -> Shape:
    def point(key: str, *counts: int) -> Point:
        value = numbers(fields.get(key), f"{where}.{key}")
        accepted = " or ".join(str(count) for count in counts)
        require(len(value) in counts, f"{where}.{key}", value, f"{accepted} coordinates")
        return value

    def radius() -> float:
        value = number(fields.get("radius_m"), f"{where}.radius_m")
        require(value > 0, f"{where}.radius_m", value, "a number above 0")
        return value

    if form == "disc":
        known_keys(fields, {"center_m", "radius_m"}, where)
        return Disc(point("center_m", 2), radius())
    if form == "sphere":
        known_keys(fields, {"center_m", "radius_m"}, where)
        return Sphere(point("center_m", 3), radius())
    if form == "box":
        known_keys(fields, {"low_m", "high_m"}, where)
        low = point("low_m", 2, 3)
        high = point("high_m", len(low))
        ordered = all(a < b for a, b in zip(low, high, strict=True))
        require(ordered, f"{where}.high_m", high, f"above low_m = {low} in every coordinate")
        return Box(low, high)
    known_keys(fields, {"point_m", "normal"}, where)
    origin = point("point_m", 2, 3)
    normal = point("normal", len(origin))
    require(any(normal), f"{where}.normal", normal, "a vector other than 0")
    return HalfSpace(origin, normal)
