# SPDX-License-Identifier: Apache-2.0
"""Seeded random numbers for what is stepped a thousand times a second."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Seed = int | Sequence[int] | np.random.SeedSequence | np.random.Generator
"""What ``numpy.random.default_rng`` takes; a generator is drawn from as it is."""

ROWS = 64
"""Drawn at once: one call costs as much as some hundred numbers, and must not hold up a step."""


class NormalRows:
    """Rows of independent standard normal numbers, without end.

    They are drawn in blocks: a generator that is handed in is ahead of what has been taken.

    Parameters
    ----------
    seed : Seed
    width : int
        Numbers in a row.
    """

    def __init__(self, seed: Seed, width: int) -> None:
        self._random = np.random.default_rng(seed)
        self._width = width
        self._left: list[list[float]] = []  # the next row last

    def take(self) -> list[float]:
        """Return the next row."""
        if not self._left:
            self._left = self._random.standard_normal((ROWS, self._width)).tolist()
            self._left.reverse()
        return self._left.pop()
