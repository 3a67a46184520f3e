# SPDX-License-Identifier: Apache-2.0
"""Regions of space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.vectors import Vector
from tactile_resonance.fields import check_above_zero, require

Point = tuple[float, ...]


class Shape(Protocol):
    """A region of space."""

    def contains(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell for positions (..., 2 or 3) [m] which lie inside, shape (...)."""
        ...


@dataclass(frozen=True)
class Disc:
    """A disc in x, y at any height: the surface of a round dish."""

    center_m: tuple[float, float]
    radius_m: float

    def __post_init__(self) -> None:
        check_above_zero(self, "radius_m")

    def contains(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which positions lie inside or on the edge."""
        distance = np.linalg.norm(position_m[..., :2] - np.asarray(self.center_m), axis=-1)
        return np.asarray(distance <= self.radius_m)


@dataclass(frozen=True)
class Box:
    """A box with edges along the axes; two coordinates per corner leave the height open."""

    low_m: Point
    high_m: Point

    def __post_init__(self) -> None:
        low, high = self.low_m, self.high_m
        require(len(low) in (2, 3), "low_m", low, "2 or 3 coordinates")
        above = len(high) == len(low) and all(a < b for a, b in zip(low, high, strict=True))
        require(above, "high_m", high, f"above low_m = {low} in every coordinate")

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

    def __post_init__(self) -> None:
        require(len(self.point_m) in (2, 3), "point_m", self.point_m, "2 or 3 coordinates")
        good = len(self.normal) == len(self.point_m) and any(self.normal)
        require(good, "normal", self.normal, "a vector other than 0, of as many coordinates")

    def contains(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which positions lie on the side the normal points away from."""
        position = _coordinates(position_m, len(self.normal))
        return np.asarray((position - np.asarray(self.point_m)) @ np.asarray(self.normal) <= 0)


@dataclass(frozen=True)
class Sphere:
    """A ball; positions without a height are taken at height 0."""

    center_m: Vector
    radius_m: float

    def __post_init__(self) -> None:
        check_above_zero(self, "radius_m")

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


@dataclass(frozen=True, kw_only=True)
class ShapeEntry:
    """Part of a file: one shape."""

    disc: Disc | None = None
    box: Box | None = None
    half_space: HalfSpace | None = None
    sphere: Sphere | None = None

    def shape(self) -> Shape:
        """Return the one that is given; ``ValueError`` if there is none, or more than one."""
        names = ("disc", "box", "half_space", "sphere")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        require(len(given) == 1, "shape", list(given), f"exactly one of {', '.join(names)}")
        (shape,) = given.values()
        return shape
