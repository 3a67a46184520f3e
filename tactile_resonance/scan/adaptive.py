# SPDX-License-Identifier: Apache-2.0
"""Scans that choose their touches: until a boundary, a tissue or the map is known as well as it is wanted.

The first touches are spread over the region; each of the others is where the loss that is left (expected area
on the wrong side of the boundary, or variance of the map above what is wanted) is expected to fall most per
second of way and touch (Bect et al., Statistics and Computing 22, 2012). The choice is a function of what was
found so far, among places that are known beforehand, and of places whose gains differ by less than a thousandth
the first is taken: equal results, equal touches.

Few points do not determine length and size of the process, and where all of them are alike they would make it
constant. What is known beforehand bounds both: a length at which something as narrow as `smallest_m` may lie
between points, and a size such that a level is not more than one standard deviation from the mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from scipy.spatial.distance import cdist

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.fields import (
    AboveZero,
    Checked,
    Range,
    build,
    one_of,
    read_dataclass,
    require,
)
from tactile_resonance.scan.kriging import LEAST_POINTS, KrigedSurface, krige
from tactile_resonance.scan.level_set import Boundary, LevelSet, Raster, boundary_of
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.points import Pair, Places, corners, grid_within, on_a_line
from tactile_resonance.tissue.classify import TissueClass

MOST_PLACES = 2500
"""The time to choose one grows with their square."""
MOST_TOUCHES = 500
CELLS = 80
"""Along the longer side of the region, where areas are summed."""
_ALIKE = 1e-3  # gains that differ by less of the largest count as equal
_SHORTLIST = 100  # places of greatest doubt, of which the gain is reckoned
_OPEN = 1e-2  # of the largest loss: elsewhere a touch takes nothing away
_LENGTH = 0.6  # of a process, over the width at half height of a bump of gelatine felt over a ball
_STEPS = 50  # in which the first touches are spread


@dataclass(frozen=True)
class WantedMap(Checked):
    """Wanted: f0 everywhere with this standard deviation; the loss is the variance above it."""

    f0_std_hz: AboveZero

    def loss(self, f0_hz: FloatArray, std_hz: FloatArray) -> FloatArray:
        """(...) per area."""
        return np.maximum(std_hz**2 - self.f0_std_hz**2, 0)

    def loss_after(self, f0_hz: FloatArray, std_hz: FloatArray, after: FloatArray) -> FloatArray:
        """(...) after a touch that leaves another standard deviation."""
        return self.loss(f0_hz, after)

    def doubt(self, f0_hz: FloatArray, std_hz: FloatArray) -> FloatArray:
        """(...) how little is known of places."""
        return std_hz

    def least_std(self, values: FloatArray) -> float:
        """Nothing is known beforehand."""
        return 0.0


@dataclass(frozen=True, eq=False)
class Adaptive(Checked):
    """Which touches a scan may choose, and what for.

    Attributes
    ----------
    polygon_m : (k, 2) float
        Corners of the region.
    wanted : LevelSet or WantedMap
        Where f0 lies between two levels, or all of it.
    most, start : int
        All touches, and the first ones.
    smallest_m : float
        Width of the smallest thing that is looked for.
    spacing_m : float
        Of the grid of places that may be touched.
    most_loss : float
        Expected area on the wrong side that may be left [m^2]; of a map nothing is.
    """

    polygon_m: FloatArray
    wanted: LevelSet | WantedMap
    most: Annotated[int, Range(LEAST_POINTS, MOST_TOUCHES)]
    smallest_m: AboveZero
    start: int = 9
    spacing_m: AboveZero = 0.001
    most_loss: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        good = LEAST_POINTS <= self.start <= self.most
        require(good, "start", self.start, f"{LEAST_POINTS} to {self.most}")

    @cached_property
    def raster(self) -> Raster:
        """Of the region, fine enough for areas."""
        return self._raster(CELLS)

    def _raster(self, cells: int) -> Raster:
        longest_m = float(np.max(np.ptp(self.polygon_m, axis=0)))
        return Raster.over(self.polygon_m, longest_m / cells)

    def places_m(self) -> FloatArray:
        """(p, 2) places that may be touched, row by row.

        Raises
        ------
        ValueError
            If there are too few or too many.
        """
        kept = grid_within(self.polygon_m, (self.spacing_m,) * 2, "raster")
        good = LEAST_POINTS <= len(kept) <= MOST_PLACES
        accepted = f"a spacing with {LEAST_POINTS} to {MOST_PLACES} places in the region"
        require(good, "spacing_m", f"{self.spacing_m:g}, {len(kept)} places", accepted)
        wide = not on_a_line(kept, self.spacing_m / 2)
        accepted = "a region and a spacing with places that are not all on one line"
        require(wide, "spacing_m", f"{self.spacing_m:g}, {len(kept)} places on a line", accepted)
        return kept

    def first(self, places_m: FloatArray) -> list[int]:
        """Indices of the first touches among places (p, 2): middles of equal parts of the region, in order."""
        return _nearest_first(places_m, _spread(places_m, min(self.start, len(places_m))))

    def krige(self, known: tuple[FloatArray, FloatArray, FloatArray]) -> KrigedSurface | None:
        """What `known_points` lead to; None where they are too few or on one line."""
        xy_m, f0_hz, std_hz = known
        if len(xy_m) < LEAST_POINTS or on_a_line(xy_m, self.spacing_m / 2):
            return None
        return krige(xy_m, f0_hz, std_hz, _LENGTH * self.smallest_m, self.wanted.least_std(f0_hz))

    def loss(self, surface: KrigedSurface) -> float:
        """What is left over the region: m^2, or Hz^2 m^2."""
        raster = self.raster
        left = self.wanted.loss(*surface.predict(raster.xy_m[raster.within]))
        return float(np.sum(left)) * raster.cell_m2

    def boundary(self, results: Iterable[PointResult]) -> Boundary | None:
        """Boundary that the points of a scan lead to; None where none is wanted, or they are too few."""
        if not isinstance(self.wanted, LevelSet):
            return None
        surface = self.krige(known_points(results))
        return None if surface is None else boundary_of(surface, self.wanted, self.raster)

    def next(
        self,
        places_m: FloatArray,
        touched: Sequence[int],
        known: tuple[FloatArray, FloatArray, FloatArray],
        seconds: FloatArray,
    ) -> int | None:
        """Index of the next touch among places (p, 2); None where what is wanted is known, or nothing is left.

        Parameters
        ----------
        places_m : (p, 2) float
        touched : sequence of int
            Indices of places that are not touched again, whatever became of them; one at least.
        known : tuple
            Of `known_points`.
        seconds : (p,) float
            That way and touch would take.
        """
        free = np.setdiff1d(np.arange(len(places_m)), touched)
        if not free.size or len(touched) >= self.most:
            return None
        surface = self.krige(known)
        if surface is None:  # points failed: the place farthest from all of them
            gain = cdist(places_m[free], places_m[list(touched)]).min(axis=1)
        elif self.loss(surface) <= self.most_loss:
            return None
        else:
            doubt = np.round(self.wanted.doubt(*surface.predict(places_m[free])), 9)
            free = np.sort(free[np.argsort(-doubt, kind="stable")[:_SHORTLIST]])
            gain = self._gain(surface, places_m, free, float(np.median(known[2]))) / seconds[free]
        return int(free[np.argmax(gain > (1 - _ALIKE) * gain.max())])

    def _gain(
        self,
        surface: KrigedSurface,
        places_m: FloatArray,
        free: IntArray,
        noise_hz: float,
    ) -> FloatArray:
        """(f,) loss that a touch at each free place is expected to take away, summed over the region.

        By the likeliest process alone: to choose, that does, and costs a tenth.
        """
        process = surface.likeliest
        coarse = self._raster(CELLS // 2)
        at = coarse.xy_m[coarse.within]
        f0_hz, variance = process.moments(process.before(process.xy_m, at))
        std_hz = np.sqrt(variance)
        before = self.wanted.loss(f0_hz, std_hz)
        open_ = before > _OPEN * before.max()
        f0, std = f0_hz[open_, None], std_hz[open_, None]
        _, there = process.moments(process.before(process.xy_m, places_m[free]))
        shared = process.covariance(at[open_], places_m[free])  # (o, f)
        known = shared**2 / (there + noise_hz**2)
        after = np.sqrt(np.maximum(std**2 - known, 0))
        return np.asarray(
            np.sum(before[open_, None] - self.wanted.loss_after(f0, std, after), axis=0)
        )


def known_points(results: Iterable[PointResult]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n, 2) places [m], (n,) f0 and its standard deviation [Hz] of the points that have them.

    At the nominal contact where that is known of any: classes refer to it.
    """
    done = [result for result in results if result.outcome is PointOutcome.DONE]
    prefix = "nominal_" if any(np.isfinite(r.nominal_f0_std_hz) for r in done) else ""
    names = ("x_m", "y_m", f"{prefix}f0_hz", f"{prefix}f0_std_hz")
    rows = [[getattr(result, name) for name in names] for result in done]
    table = np.array(rows, float).reshape(-1, 4)
    table = table[np.all(np.isfinite(table), axis=1)]
    return table[:, :2], table[:, 2], table[:, 3]


def read_adaptive(value: Mapping[str, Any], classes: Sequence[TissueClass], where: str) -> Adaptive:
    """Read the section ``adaptive`` of a scene's positions.

    Parameters
    ----------
    value : mapping
    classes : sequence of TissueClass
        Of the scene.
    where : str

    Raises
    ------
    ValueError
        That names the field, its value and what is accepted.
    """
    own = {field.name for field in fields(Adaptive)} - {"polygon_m", "wanted", "most_loss"}
    beside = {*own, *(field.name for field in fields(_Within))}
    value = {key: item for key, item in value.items() if item is not None}
    _, wanted = one_of(_WANTED, value, where, frozenset(beside))
    most_loss = 0.0
    if not isinstance(wanted, WantedMap):
        means = {each.name: float(each.mean[0]) for each in classes}
        wanted, most_loss = build(wanted.level_set, where, means), wanted.area_m2
    region, rest = ({k: v for k, v in value.items() if k in keys} for keys in (beside - own, own))
    polygon_m = build(read_dataclass(_Within, region, where).polygon, where)
    given = {"polygon_m": polygon_m, "wanted": wanted, "most_loss": most_loss}
    made = read_dataclass(Adaptive, rest, where, **given)
    build(made.places_m, where)
    return made


@dataclass(frozen=True)
class _Boundary(Checked):
    area_m2: AboveZero
    f0_hz: AboveZero | None = None
    between: tuple[str, str] | None = None

    def level_set(self, classes: Mapping[str, float]) -> LevelSet:
        one = (self.f0_hz is None) != (self.between is None)
        require(one, "boundary", None, "exactly one of f0_hz, between")
        if self.between is None:
            return LevelSet(low=float(self.f0_hz or 0.0))
        good = len({*self.between} & {*classes}) == 2
        accepted = f"two out of tissue_classes: {sorted(classes)}"
        require(good, "boundary.between", self.between, accepted)
        first, second = (classes[name] for name in self.between)
        require(first != second, "boundary.between", self.between, "classes of different f0_hz")
        return LevelSet(low=(first + second) / 2)


@dataclass(frozen=True)
class _Tissue(Checked):
    name: str
    area_m2: AboveZero

    def level_set(self, classes: Mapping[str, float]) -> LevelSet:
        accepted = f"one out of two or more tissue_classes: {sorted(classes)}"
        require(self.name in classes and len(classes) > 1, "tissue.name", self.name, accepted)
        own = classes[self.name]
        middles = [(own + other) / 2 for other in classes.values() if other != own]
        below, above = [m for m in middles if m < own], [m for m in middles if m > own]
        require(bool(middles), "tissue.name", self.name, "a class whose f0_hz differs from others")
        return LevelSet(max(below, default=-np.inf), min(above, default=np.inf))


_WANTED = {"boundary": _Boundary, "tissue": _Tissue, "map": WantedMap}


@dataclass(frozen=True, eq=False)
class _Within:
    center_m: Pair | None = None
    size_m: Pair | None = None
    polygon_m: Places | None = None

    def polygon(self) -> FloatArray:
        given = (self.center_m, self.size_m, self.polygon_m)
        there = [each is not None for each in given]
        alone = there in ([True, True, False], [False, False, True])
        require(alone, "center_m, size_m, polygon_m", given, "center_m and size_m, or polygon_m")
        if self.polygon_m is not None:
            return corners(self.polygon_m)
        center, size = np.array(self.center_m), np.array(self.size_m)
        require(bool(size.min() > 0), "size_m", self.size_m, "numbers above 0")
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return np.asarray(center + signs * size / 2)


def _spread(places_m: FloatArray, count: int) -> list[int]:
    """Indices of the places nearest to the middles of as many equal parts of the region."""
    middle = places_m.mean(axis=0)
    chosen = [_first_of(-np.linalg.norm(places_m - middle, axis=1))]
    while len(chosen) < count:
        chosen.append(_first_of(cdist(places_m, places_m[chosen]).min(axis=1)))
    middles = places_m[chosen]
    for _ in range(_STEPS):
        own = np.argmin(np.round(cdist(places_m, middles), 9), axis=1)
        middles = np.array([places_m[own == k].mean(axis=0) for k in range(count)])
    return list(dict.fromkeys(_first_of(-np.linalg.norm(places_m - m, axis=1)) for m in middles))


def _first_of(values: FloatArray) -> int:
    """Index of the largest, the first of those that differ by rounding only."""
    return int(np.argmax(np.round(values, 9)))


def _nearest_first(places_m: FloatArray, chosen: list[int]) -> list[int]:
    """In the order from each to the nearest that is left, from the lowest index on."""
    left = sorted(chosen)
    order = [left.pop(0)]
    while left:
        order.append(left.pop(_first_of(-cdist(places_m[left], places_m[order[-1:]])[:, 0])))
    return order
