# SPDX-License-Identifier: Apache-2.0
"""Seeded random numbers for what is stepped a thousand times a second."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_resonance._typing import FloatArray

Seed = int | Sequence[int] | np.random.SeedSequence | np.random.Generator
"""What ``numpy.random.default_rng`` takes; a generator is drawn from as it is."""

ROWS = 64
"""Drawn at once: one call costs as much as some hundred numbers, and must not hold up a step."""


class NormalRows:
    """Rows of independent normal numbers, without end.

    They are drawn in blocks: a generator that is handed in is ahead of what has been taken.

    Parameters
    ----------
    seed : Seed
    rms : sequence of float
        Standard deviation of each number of a row.
    """

    def __init__(self, seed: Seed, rms: Sequence[float]) -> None:
        self._random = np.random.default_rng(seed)
        self._rms = np.array(rms)  # (width,)
        self._left: list[FloatArray] = []  # the next row last

    def take(self) -> FloatArray:
        """Return the next row, (width,)."""
        if not self._left:
            numbers = self._rms * self._random.standard_normal((ROWS, self._rms.size))
            self._left = [*reversed(numbers)]
        return self._left.pop()
