# SPDX-License-Identifier: Apache-2.0
"""What tissue did under a held tip, from the way of the tip that kept the force: how far, how often."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

EVERY_NS, NEWEST = 20_000_000, 1000
"""Of the tip's heights one is kept in so long [ns]; so many, the newest."""

ANEW_NS = 500_000_000
"""A motion is described anew after so long [ns]."""

LEAST_S, LEAST_TURNS = 0.4, 2.5
"""A motion is described from so long [s] on; its rate where it has turned so often."""

INNER = (2.5, 97.5)
"""Percentiles of the heights between which a motion goes."""

PADDED = 8
"""By which the spectrum is finer than the heights' own."""


class HeldMotion:
    """Heights of a tip that holds a force on tissue that moves."""

    def __init__(self) -> None:
        self._times_ns: deque[int] = deque(maxlen=NEWEST)
        self._heights_m: deque[float] = deque(maxlen=NEWEST)
        self._described = 0, ""  # when, and what

    def add(self, time_ns: int, height_m: float) -> None:
        """Take the height of the tip along the normal, with its time."""
        times = self._times_ns
        if not times or time_ns - times[-1] >= EVERY_NS:
            times.append(time_ns)
            self._heights_m.append(height_m)

    def describe(self) -> str:
        """Say how far and how often it moves, as `moving tissue: 200 um at 1.2 Hz`; empty before it is known.

        The distance is half of the whole way, creep taken off where the motion has turned often enough.
        """
        if self._times_ns and self._times_ns[-1] - self._described[0] >= ANEW_NS:
            self._described = self._times_ns[-1], self._sentence()
        return self._described[1]

    def _sentence(self) -> str:
        if len(self._times_ns) < LEAST_S * 1e9 / EVERY_NS:
            return ""
        t_s = (np.array(self._times_ns) - self._times_ns[0]) * 1e-9  # (n,)
        heights = np.array(self._heights_m)
        crept = heights - np.polyval(np.polyfit(t_s, heights, 1), t_s)
        # on a grid of even steps: a loop that was late leaves gaps
        even = np.arange(0.0, t_s[-1], EVERY_NS * 1e-9)
        power = np.abs(np.fft.rfft(np.interp(even, t_s, crept), PADDED * even.size)) ** 2
        rate_hz = np.argmax(power) / (PADDED * even.size * EVERY_NS * 1e-9)
        if rate_hz * t_s[-1] < LEAST_TURNS:
            return f"moving tissue: {_half_way_um(heights):.0f} um in {t_s[-1]:.1f} s"
        return f"moving tissue: {_half_way_um(crept):.0f} um at {rate_hz:.1f} Hz"


def _half_way_um(heights_m: FloatArray) -> float:
    low, high = np.percentile(heights_m, INNER)
    return 0.5e6 * float(high - low)
