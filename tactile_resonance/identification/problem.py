# SPDX-License-Identifier: Apache-2.0
"""Groups of bins that share the coefficients of ``Y = (B U + C) / A``, and points on them.

Start values by Sanathanan-Koerner iterations (IEEE Trans. Autom. Control 8 (1963) 56-58); the cost is

    sum_k |Y - (B U + C) / A|^2 / (s_Y^2 + s_U^2 |B/A|^2 - 2 Re(s_YU conj(B/A)))

(Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012), sections
8.3, 9.11 and 12.3). The gradient is exact; the normal matrix leaves the derivative of the denominator
out, which is smaller by the signal-to-noise ratio of the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.many_points import ManyPoints
from tactile_resonance.identification.one_point import OnePoint, StackedBasis

FloatArray = npt.NDArray[np.float64]

START_ITERATIONS = 2
# Values in a chunk's arrays: few enough for the cache, enough to make little of the calls.
CHUNK_VALUES = 65536
# Up to so many points are faster one by one: `OnePoint` makes fewer calls than a batch needs.
FEW = 4


@dataclass(frozen=True, eq=False)
class Problem:
    """Groups of bins that share coefficients; only the last one has an input.

    Attributes
    ----------
    groups : tuple of BinGroup
    """

    groups: tuple[BinGroup, ...]

    @cached_property
    def places(self) -> list[npt.NDArray[np.int64]]:
        """Of each group, where its distinct normal entries stand."""
        return [group.places(self.sizes) for group in self.groups]

    @cached_property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of free coefficients of A, B and C."""
        terms = [0, 0, 0]
        for group in self.groups:
            terms[0] = group.denominator.shape[1] - 1
            if group.numerator is not None:
                terms[1] = group.numerator.shape[1]
            if group.transient is not None:
                terms[2] = group.transient.shape[1]
        return terms[0], terms[1], terms[2]

    @cached_property
    def driven(self) -> Problem:
        """The group with an input by itself, where it holds equations enough for start values.

        Of a record of many periods it is a small part of all bins, and the one that tells most.
        """
        last = self.groups[-1]
        enough = len(self.groups) > 1 and last.size >= sum(self.sizes)
        return Problem((last,)) if enough else self

    @cached_property
    def _stacked(self) -> StackedBasis:
        return StackedBasis.of(self.groups)

    @property
    def chunk(self) -> int:
        """Most points that are computed together."""
        return max(1, CHUNK_VALUES // max(1, sum(group.size for group in self.groups)))

    def chunk_of(self, batch: int) -> int:
        """Points of a batch that are computed together."""
        return 1 if batch <= FEW else self.chunk

    def points(self, data: Sequence[BinData]) -> Any:
        """`OnePoint` or `ManyPoints` of these data: the same methods, on coefficients (n,) or (batch, n)."""
        return self.one_point(data) if data[0].y.shape[0] == 1 else self.many_points(data)

    def one_point(self, data: Sequence[BinData]) -> OnePoint:
        """A point with these data of each group, in a batch of 1."""
        return OnePoint(self._stacked, data)

    def many_points(self, data: Sequence[BinData]) -> ManyPoints:
        """Points with these data of each group."""
        return ManyPoints(self.groups, self.places, self.sizes, data)

    def start(self, points: Any, data: Sequence[BinData]) -> FloatArray:
        """(n,) or (batch, n) start values of points with these data.

        The first iteration only brings weights for the second one: bins with an input are enough.
        """
        if self.driven is self:
            return np.asarray(points.start(START_ITERATIONS))
        first = self.driven.points(data[-1:]).start(1)
        return np.asarray(points.start(START_ITERATIONS - 1, first))

    def split(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of A (with its last), B and C, each (batch, terms)."""
        a, b, _ = self.sizes
        one = np.ones((theta.shape[0], 1))
        return (
            np.concatenate([theta[:, :a], one], axis=1),
            np.ascontiguousarray(theta[:, a : a + b]),
            np.ascontiguousarray(theta[:, a + b :]),
        )
