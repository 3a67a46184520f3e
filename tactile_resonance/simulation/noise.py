# SPDX-License-Identifier: Apache-2.0
"""Seeded noise for what is stepped a thousand times a second: independent numbers, and vibration."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import float64, njit

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.vectors import Vector

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
        self._left = np.empty((0, self._rms.size))

    def take(self, count: int) -> FloatArray:
        """Return the next rows, (count, width)."""
        while len(self._left) < count:
            drawn = self._rms * self._random.standard_normal((ROWS, self._rms.size))
            self._left = np.concatenate([self._left, drawn])
        rows, self._left = self._left[:count], self._left[count:]
        return rows


class Jitter:
    """Stationary vibration of three axes: white noise through two equal real poles, seeded.

    Its autocorrelation is ``s^2 (1 + w |t|) exp(-w |t|)``; the step is exact for any period.

    Parameters
    ----------
    rms_m : float
        s, of each axis [m].
    corner_rad_s : float
        w, the rate of the poles [rad/s].
    period_s : float
    seed : Seed
    """

    def __init__(self, rms_m: float, corner_rad_s: float, period_s: float, seed: Seed) -> None:
        w, t = corner_rad_s, period_s
        fall = math.exp(-w * t)
        transition = fall * np.array([[1 + w * t, t], [-(w**2) * t, 1 - w * t]])
        stationary = rms_m**2 * np.diag([1.0, w**2])
        driven = stationary - transition @ stationary @ transition.T
        # tiny negative eigenvalues are rounding
        values, vectors = np.linalg.eigh(driven)
        drive = vectors * np.sqrt(np.maximum(values, 0))
        self._rms = np.array([rms_m, rms_m * w])  # of place and speed
        self._by = np.ascontiguousarray(np.hstack([transition, drive]))
        self.reseed(seed)

    def reseed(self, seed: Seed) -> None:
        """Let vibration follow from a seed, from the next step on, beginning in a state drawn anew."""
        self._random = np.random.default_rng(seed)
        self._state = self._rms[:, None] * self._random.standard_normal((2, 3))  # places and speeds
        self._left: list[Vector] = []  # places, the next last

    def step(self) -> Vector:
        """Advance one period; return the displacement [m]."""
        if not self._left:
            places = np.empty((ROWS, 3))  # written there: a kernel that returns arrays cannot be interrupted
            _tremble(self._state, self._by, self._random.standard_normal((ROWS, 6)), places)
            self._left = [*map(tuple, places[::-1].tolist())]
        return self._left.pop()


@njit((float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1]), cache=True)
def _tremble(state, by, noise, places):
    """Advance place and speed of three axes, once for each row of noise; write the places (rows, 3)."""
    for row in range(len(noise)):
        for k in range(3):
            place, speed, first, second = state[0, k], state[1, k], noise[row, k], noise[row, 3 + k]
            for n in range(2):
                a, b, c, d = by[n, 0], by[n, 1], by[n, 2], by[n, 3]
                state[n, k] = a * place + b * speed + c * first + d * second
            places[row, k] = state[0, k]
