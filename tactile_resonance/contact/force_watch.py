# SPDX-License-Identifier: Apache-2.0
"""Every wrench that arrives is judged before it is used: number, overload, stuck, old."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.result import Breach, Cause
from tactile_resonance.contact.samples import WrenchSample

RATE_WINDOW_NS = 10_000_000
KEEP_NS = 200_000_000


class ForceWatch:
    """The last wrenches, less their bias.

    Parameters
    ----------
    stuck_samples : int
        So many equal forces along z in a row are a stuck sensor, or one at the end of its range.

    Attributes
    ----------
    force_n : (3,) array
        Newest force at the tip, less the bias [N].
    peak_n : float
        Largest force along +z since the bias was set [N]; 0 before.
    """

    def __init__(self, stuck_samples: int) -> None:
        self._stuck_samples = stuck_samples
        self._equal = 1
        self._last: WrenchSample | None = None
        self._recent: deque[tuple[int, float]] = deque()  # time, force along z
        self._bias_n: NDArray[np.float64] | None = None
        self.force_n: NDArray[np.float64] = np.zeros(3)
        self.peak_n = 0.0

    @property
    def bias_n(self) -> NDArray[np.float64]:
        """What is taken off (3,) [N]; zeros before the tare."""
        return np.zeros(3) if self._bias_n is None else self._bias_n

    def set_bias(self, bias_n: NDArray[np.float64]) -> None:
        """Take what the sensor shows out of contact (3,) as 0; forget what came before."""
        self._bias_n = bias_n
        self._recent.clear()
        self.force_n = np.zeros(3)
        self.peak_n = 0.0

    def add(self, sample: WrenchSample, inertia_n: float = 0.0) -> Breach | None:
        """Take one wrench, oldest first; what is wrong with it is returned and it is not used.

        Parameters
        ----------
        sample : WrenchSample
        inertia_n : float
            Part of the force along z that is not of the contact [N].
        """
        if sample.overload:
            return Breach(Cause.FORCE_OVERLOAD, "the force sensor reports overload")
        x, y, z = (float(value) for value in sample.force_n)
        if not math.isfinite(x + y + z):
            return Breach(Cause.FORCE_INVALID, f"force is no number: {x}, {y}, {z} N")
        last = self._last
        if last is not None and sample.time_ns <= last.time_ns:
            text = f"time of forces does not ascend: {sample.time_ns} after {last.time_ns} ns"
            return Breach(Cause.FORCE_INVALID, text)
        same = last is not None and z == float(last.force_n[2])
        self._equal = self._equal + 1 if same else 1
        self._last = sample
        if self._equal >= self._stuck_samples:
            text = f"{self._equal} equal forces in a row: the sensor is stuck"
            return Breach(Cause.FORCE_STUCK, text)
        self.force_n = sample.force_n - [0.0, 0.0, inertia_n]
        if self._bias_n is not None:
            self.force_n -= self._bias_n
            self.peak_n = max(self.peak_n, float(self.force_n[2]))
        z = float(self.force_n[2])
        self._recent.append((sample.time_ns, z))
        while self._recent[0][0] < sample.time_ns - KEEP_NS:
            self._recent.popleft()
        return None

    def age_s(self, now_ns: int) -> float:
        """Age of the newest wrench [s]; infinite before the first."""
        return math.inf if self._last is None else (now_ns - self._last.time_ns) * 1e-9

    def mean_n(self, window_s: float) -> float | None:
        """Mean force along z over the last time [N]; None where less than that is there."""
        if not self._recent:
            return None
        newest = self._recent[-1][0]
        since = newest - round(window_s * 1e9)
        if self._recent[0][0] > since:
            return None
        values = [force for time, force in self._recent if time > since]
        return sum(values) / len(values)

    def rate_n_per_s(self) -> float | None:
        """Rise of the force along z over 10 ms [N/s], from means of three; None where too few."""
        if len(self._recent) < 6:
            return None
        recent = list(self._recent)[-64:]
        newest = recent[-3:]
        then = sum(time for time, _ in newest) / 3 - RATE_WINDOW_NS
        # the three samples nearest to 10 ms before
        before = sorted(recent[:-3], key=lambda item: abs(item[0] - then))[:3]
        span = (sum(t for t, _ in newest) - sum(t for t, _ in before)) / 3
        rise = (sum(f for _, f in newest) - sum(f for _, f in before)) / 3
        return rise / (span * 1e-9) if span >= RATE_WINDOW_NS / 2 else None
