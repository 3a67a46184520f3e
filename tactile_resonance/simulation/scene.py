# SPDX-License-Identifier: Apache-2.0
"""Phantoms on the table: regions of space and the tissue in each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_resonance.configuration import share_path
from tactile_resonance.simulation.fields import (
    known_keys,
    number,
    numbers,
    read_yaml,
    require,
    section,
)
from tactile_resonance.simulation.library import TissueLibrary
from tactile_resonance.simulation.tissue import Tissue

Point = tuple[float, ...]


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
        distance = np.linalg.norm(position - np.asarray(self.center_m), axis=-1)
        return np.asarray(distance <= self.radius_m)


def _coordinates(position_m: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Cut off the height, or add height 0, so that the last axis has `count` coordinates."""
    missing = count - position_m.shape[-1]
    if missing <= 0:
        return position_m[..., :count]
    return np.concatenate([position_m, np.zeros((*position_m.shape[:-1], missing))], axis=-1)


@dataclass(frozen=True)
class Region:
    """A shape filled with one tissue."""

    name: str
    shape: Shape
    tissue: Tissue


@dataclass(frozen=True)
class PhantomScene:
    """What lies on the table. Where regions overlap, the later one is there.

    Attributes
    ----------
    name : str
    force_n : float
        Contact force asked for [N].
    regions : tuple of Region
    scan_points_m : tuple of (x, y) or (x, y, z)
        Where to measure [m]; empty where the scene gives them in another form.
    """

    name: str
    force_n: float
    regions: tuple[Region, ...]
    scan_points_m: tuple[Point, ...]

    def region_index(self, position_m: ArrayLike) -> NDArray[np.int64]:
        """Return the index of the region at positions (..., 2 or 3) [m], -1 where there is none."""
        position = np.asarray(position_m, dtype=float)
        good = position.ndim >= 1 and position.shape[-1] in (2, 3)
        require(good, "position_m", position.shape, "shape (..., 2) or (..., 3)")
        index = np.full(position.shape[:-1], -1, dtype=np.int64)
        for i, region in enumerate(self.regions):
            index = np.where(region.shape.contains(position), i, index)
        return index

    def region_at(self, position_m: ArrayLike) -> Region | None:
        """Return the region at one position (2 or 3 coordinates) [m], or None."""
        index = int(self.region_index(position_m))
        return None if index < 0 else self.regions[index]

    def tissue_at(self, position_m: ArrayLike) -> Tissue | None:
        """Return the tissue at one position (2 or 3 coordinates) [m], or None."""
        region = self.region_at(position_m)
        return None if region is None else region.tissue


def read_scene(library: TissueLibrary, path: Path | None = None) -> PhantomScene:
    """Read the phantoms of a scene file; by default ``config/scenes/gelatine_phantoms.yaml``.

    Only the fields ``name``, ``force_n``, ``regions`` and, where there, ``scan_points`` are read here.

    Raises
    ------
    ValueError
        If the file cannot be read, or one of these fields is missing or wrong.
    """
    path = share_path("config/scenes/gelatine_phantoms.yaml") if path is None else Path(path)
    content, where = read_yaml(path), path.name
    entries = content.get("regions")
    good = isinstance(entries, list) and len(entries) > 0
    require(good, f"{where}: regions", entries, "a list of one region or more")
    assert isinstance(entries, list)
    force = number(content.get("force_n"), f"{where}: force_n")
    require(force > 0, f"{where}: force_n", force, "a number above 0")
    return PhantomScene(
        name=str(content.get("name", path.stem)),
        force_n=force,
        regions=tuple(
            _read_region(entry, library, f"{where}: regions[{i}]")
            for i, entry in enumerate(entries)
        ),
        scan_points_m=(
            _read_points(section(content, "scan_points", where), where)
            if "scan_points" in content
            else ()
        ),
    )


def _read_region(entry: object, library: TissueLibrary, where: str) -> Region:
    require(isinstance(entry, Mapping), where, entry, "a mapping")
    assert isinstance(entry, Mapping)
    shapes = {"disc", "box", "half_space", "sphere"}
    known_keys(entry, {"name", "tissue", "gelatine_percent"} | shapes, where)
    materials = [key for key in ("tissue", "gelatine_percent") if key in entry]
    require(len(materials) == 1, where, materials, "exactly one of tissue, gelatine_percent")
    forms = [key for key in entry if key in shapes]
    require(len(forms) == 1, where, forms, f"exactly one of {sorted(shapes)}")
    try:
        if materials == ["tissue"]:
            tissue = library[str(entry["tissue"])]
        else:
            tissue = library.gelatine(number(entry["gelatine_percent"], "gelatine_percent"))
    except ValueError as error:
        raise ValueError(f"{where}.{error}") from error
    form = forms[0]
    shape = _read_shape(form, section(entry, form, where), f"{where}.{form}")
    return Region(str(entry.get("name", tissue.name)), shape, tissue)


def _read_shape(form: str, fields: Mapping[str, Any], where: str) -> Shape:
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


def _read_points(fields: Mapping[str, Any], where: str) -> tuple[Point, ...]:
    """Read ``centres_m`` x ``offsets_m``: every offset about every centre, centre by centre."""
    where = f"{where}: scan_points"
    known_keys(fields, {"centres_m", "offsets_m"}, where)

    def points(key: str) -> list[Point]:
        value = fields.get(key)
        good = isinstance(value, list) and len(value) > 0
        require(good, f"{where}.{key}", value, "a list of one position or more")
        assert isinstance(value, list)
        read = [numbers(item, f"{where}.{key}[{i}]") for i, item in enumerate(value)]
        same = len({len(item) for item in read}) == 1 and len(read[0]) in (2, 3)
        require(same, f"{where}.{key}", value, "positions of 2, or all of 3, coordinates")
        return read

    centres, offsets = points("centres_m"), points("offsets_m")
    same = len(centres[0]) == len(offsets[0])
    require(same, f"{where}.offsets_m", offsets[0], f"{len(centres[0])} coordinates")
    pairs = [(centre, offset) for centre in centres for offset in offsets]
    return tuple(tuple(a + b for a, b in zip(*pair, strict=True)) for pair in pairs)
