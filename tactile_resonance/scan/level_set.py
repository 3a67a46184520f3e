# SPDX-License-Identifier: Apache-2.0
"""Where a kriged quantity lies between two levels: its boundary, how sure that is, and what a touch would add.

A place is taken to lie on the side of its kriged value. With the posterior N(m, s^2) there and its distance d
to the level, of one alone, this is wrong with probability Phi(-d/s). After one more touch, which leaves the
standard deviation s' of s, it is expected to be wrong with probability 2 T(d/s, s' / sqrt(s^2 - s'^2)), T of
Owen: the probability that the quantity and its kriged value after the touch, which are jointly Gaussian with
correlation sqrt(1 - s'^2/s^2), lie on two sides of the level (Owen, Ann. Math. Stat. 27, 1956; Chevalier et
al., Technometrics 56, 2014, section 2). Between two levels those of both add; outside that of the far one is
taken off, which is exact of a touch that shows nothing or all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from contourpy import LineType, contour_generator  # comes with matplotlib
from scipy.special import ndtr, ndtri, owens_t

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.fields import known, require
from tactile_resonance.scan.kriging import KrigedSurface
from tactile_resonance.scan.points import inside_polygon

Lines = tuple[FloatArray, ...]
PROBABILITY = 0.95
"""With which the boundary of a place lies in its band."""


@dataclass(frozen=True)
class LevelSet:
    """What lies between two levels, one of which may be infinite."""

    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        good = self.low < self.high and bool(self.levels)
        require(
            good, "low, high", (self.low, self.high), "two levels, ascending, one of them finite"
        )

    @property
    def levels(self) -> tuple[float, ...]:
        """Those that are finite."""
        return tuple(level for level in (self.low, self.high) if math.isfinite(level))

    @property
    def side(self) -> str:
        """Where it lies of its levels, for people."""
        return "between them" if len(self.levels) == 2 else "above it" if self.high == math.inf else "below it"

    def depth(self, value: FloatArray) -> FloatArray:
        """(...) by how much values lie within; negative outside."""
        return np.minimum(value - self.low, self.high - value)

    def inside(self, value: FloatArray, std: FloatArray) -> FloatArray:
        """(...) probability to lie within."""
        std = np.maximum(std, np.finfo(float).tiny)
        return np.asarray(ndtr((self.high - value) / std) - ndtr((self.low - value) / std))

    def loss(self, value: FloatArray, std: FloatArray) -> FloatArray:
        """(...) probability that a place is taken to lie on the wrong side."""
        inside = self.inside(value, std)
        return np.where(self.depth(value) > 0, 1 - inside, inside)

    def loss_after(self, value: FloatArray, std: FloatArray, after: FloatArray) -> FloatArray:
        """(...) as it is expected after a touch that leaves the standard deviation `after`."""
        with np.errstate(divide="ignore"):
            ratio = after / np.sqrt(np.maximum(std**2 - after**2, 0))
        low, high = np.abs(value - self.low), np.abs(self.high - value)
        wrong = owens_t(np.minimum(low, high) / std, ratio)
        if len(self.levels) == 2:
            # what crosses both levels is on the wrong side from between them, and not from beside them
            sign = np.where(self.depth(value) > 0, 1, -1)
            wrong = wrong + sign * owens_t(np.maximum(low, high) / std, ratio)
        return np.asarray(2 * wrong)

    def doubt(self, value: FloatArray, std: FloatArray) -> FloatArray:
        """(...) how little is known of places: the straddle heuristic (Bryan et al., NIPS 18, 2005)."""
        return 1.96 * std - np.abs(self.depth(value))

    def least_std(self, values: FloatArray) -> float:
        """Of the process: the mean is at most one of them from a level."""
        return float(np.min(np.abs(np.array(self.levels) - values.mean())))


@dataclass(frozen=True, eq=False)
class Raster:
    """Middles of the cells of a region.

    Attributes
    ----------
    x_m : (c,) float
    y_m : (r,) float
    within : (r, c) bool
        Which middles lie in the region.
    """

    x_m: FloatArray
    y_m: FloatArray
    within: BoolArray

    @classmethod
    def over(cls, polygon_m: FloatArray, cell_m: float) -> Raster:
        """Cells of about this size over a polygon of (k, 2) corners."""
        low, high = polygon_m.min(axis=0), polygon_m.max(axis=0)
        counts = np.maximum(np.ceil((high - low) / cell_m - 1e-9), 2).astype(int)
        x, y = (
            low[k] + (high[k] - low[k]) * (np.arange(counts[k]) + 0.5) / counts[k] for k in (0, 1)
        )
        within = inside_polygon(np.stack(np.meshgrid(x, y), axis=-1), polygon_m)
        return cls(x, y, within)

    @property
    def xy_m(self) -> FloatArray:
        """(r, c, 2) all middles."""
        return np.stack(np.meshgrid(self.x_m, self.y_m), axis=-1)

    @property
    def cell_m2(self) -> float:
        """Area of a cell."""
        return float((self.x_m[1] - self.x_m[0]) * (self.y_m[1] - self.y_m[0]))

    def lines(self, values: FloatArray) -> Lines:
        """Lines (k, 2) along which values (r, c) are 0; one that is closed ends where it begins."""
        masked = np.ma.masked_array(values, ~self.within)
        found = contour_generator(self.x_m, self.y_m, masked, line_type=LineType.Separate).lines(
            0.0
        )
        return tuple(np.asarray(line) for line in found)


@dataclass(frozen=True, eq=False)
class Boundary:
    """The boundary of a level set within a region.

    Attributes
    ----------
    level_set : LevelSet
    outline_m : lines (k, 2)
        Along which the kriged value is that of a level.
    inner_m, outer_m : lines (k, 2)
        What lies within the one and without the other lies within and without the level set with more than
        (1 + `PROBABILITY`) / 2.
    area_m2, area_std_m2 : float
        Expected within, and a bound on its standard deviation: places are taken to err all at once.
    wrong_area_m2 : float
        Expected to be on the wrong side of the outline.
    """

    level_set: LevelSet
    outline_m: Lines
    inner_m: Lines
    outer_m: Lines
    area_m2: float
    area_std_m2: float
    wrong_area_m2: float

    def as_json(self) -> Mapping[str, Any]:
        """Plain values; a level that is infinite is null."""
        low, high = known(self.level_set.low), known(self.level_set.high)
        return {
            "f0_hz": [low, high],
            "probability": PROBABILITY,
            "area_m2": self.area_m2,
            "area_std_m2": self.area_std_m2,
            "wrong_area_m2": self.wrong_area_m2,
            **{
                name: [line.tolist() for line in getattr(self, name)]
                for name in ("outline_m", "inner_m", "outer_m")
            },
        }


def difference_m2(
    surface: KrigedSurface, level_set: LevelSet, raster: Raster, truth: FloatArray
) -> float:
    """Area on which a kriged quantity and its true values (r, c) lie on two sides of a level."""
    value, _ = surface.predict(raster.xy_m)
    wrong = (level_set.depth(value) > 0) != (level_set.depth(truth) > 0)
    return float(np.sum(wrong & raster.within)) * raster.cell_m2


def boundary_of(surface: KrigedSurface, level_set: LevelSet, raster: Raster) -> Boundary:
    """Boundary of what lies between two levels of a kriged quantity."""
    value, std = surface.predict(raster.xy_m)
    depth, reach = level_set.depth(value), float(ndtri((1 + PROBABILITY) / 2)) * std
    inside = level_set.inside(value, std)[raster.within]
    cell_m2 = raster.cell_m2
    return Boundary(
        level_set,
        raster.lines(depth),
        raster.lines(depth - reach),
        raster.lines(depth + reach),
        float(np.sum(inside)) * cell_m2,
        float(np.sum(np.sqrt(inside * (1 - inside)))) * cell_m2,
        float(np.sum(level_set.loss(value, std)[raster.within])) * cell_m2,
    )
