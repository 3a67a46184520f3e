# SPDX-License-Identifier: Apache-2.0
"""Every wrench that arrives is judged before it is used: number, overload, stuck, old."""

from __future__ import annotations

import math
from bisect import bisect
from collections import deque

from tactile_resonance.contact.result import Breach, Cause
from tactile_resonance.contact.samples import WrenchSample
from tactile_resonance.contact.vectors import ZERO, Vector

RATE_WINDOW_NS = 10_000_000
RECENT, LONGEST_GAP_NS = 64, 200_000_000
"""So many forces are kept for the rate, none from before a longer gap [ns]."""


class ForceWatch:
    """The last wrenches, less their bias.

    Parameters
    ----------
    stuck_samples : int
        So many equal forces along z in a row are a stuck sensor, or one at the end of its range.
    mean_s : float
        Over which the force is averaged [s].

    Attributes
    ----------
    force_n : tuple of 3 floats
        Newest force at the tip, less the bias [N].
    peak_n : float
        Largest force along +z since the bias was set [N]; 0 before.
    """

    def __init__(self, stuck_samples: int, mean_s: float) -> None:
        self._stuck_samples = stuck_samples
        self._equal = 1
        self._last: tuple[int, float] | None = None  # time and force along z of the newest
        self._times_ns: deque[int] = deque(maxlen=RECENT)
        self._forces_n: deque[float] = deque(maxlen=RECENT)  # along z, at these times
        self._mean = RunningMean(round(mean_s * 1e9))
        self._bias_n: Vector | None = None
        self.force_n: Vector = ZERO
        self.peak_n = 0.0

    @property
    def bias_n(self) -> Vector:
        """What is taken off [N]; zeros before the tare."""
        return ZERO if self._bias_n is None else self._bias_n

    def set_bias(self, bias_n: Vector) -> None:
        """Take what the sensor shows out of contact as 0; forget what came before."""
        self._bias_n = bias_n
        self._times_ns.clear()
        self._forces_n.clear()
        self._mean.clear()
        self.force_n = ZERO
        self.peak_n = 0.0

    def add(self, sample: WrenchSample, inertia_n: float = 0.0) -> Breach | None:
        """Take one wrench, oldest first; what is wrong with it is returned and it is not used.

        Parameters
        ----------
        sample : WrenchSample
        inertia_n : float
            Part of the force along z that is not of the contact [N].
        """
        time_ns, (x, y, z), _, overload = sample
        if overload:
            return Breach(Cause.FORCE_OVERLOAD, "the force sensor reports overload")
        if not math.isfinite(x + y + z):
            return Breach(Cause.FORCE_INVALID, f"force is not finite: {x}, {y}, {z} N")
        since_ns = 0
        if self._last is not None:
            last_ns, last_n = self._last
            since_ns = time_ns - last_ns
            if since_ns <= 0:
                text = f"time of forces does not ascend: {time_ns} after {last_ns} ns"
                return Breach(Cause.FORCE_INVALID, text)
            self._equal = self._equal + 1 if z == last_n else 1
            if self._equal >= self._stuck_samples:
                self._last = time_ns, z
                text = f"{self._equal} equal forces in a row: the sensor is stuck"
                return Breach(Cause.FORCE_STUCK, text)
        self._last = time_ns, z
        z -= inertia_n
        if self._bias_n is not None:
            bias_x, bias_y, bias_z = self._bias_n
            x, y, z = x - bias_x, y - bias_y, z - bias_z
            if z > self.peak_n:
                self.peak_n = z
        self.force_n = (x, y, z)
        if since_ns > LONGEST_GAP_NS:
            self._times_ns.clear()
            self._forces_n.clear()
        self._times_ns.append(time_ns)
        self._forces_n.append(z)
        self._mean.add(time_ns, z)
        return None

    def age_s(self, now_ns: int) -> float:
        """Age of the newest wrench [s]; infinite before the first."""
        return math.inf if self._last is None else (now_ns - self._last[0]) * 1e-9

    @property
    def mean_n(self) -> float | None:
        """Mean force along z over the last `mean_s` [N]; None where less than that is there."""
        return self._mean.value

    def rate_n_per_s(self) -> float | None:
        """Rise of the force along z over 10 ms [N/s], from means of three; None where too few."""
        times, forces = self._times_ns, self._forces_n
        if len(times) < 6:
            return None
        newest_ns = (times[-1] + times[-2] + times[-3]) / 3
        then = newest_ns - RATE_WINDOW_NS
        # the three samples nearest to 10 ms before, none of the newest: `first` is the oldest of them
        first = min(bisect(times, then), len(times) - 6)
        while first > 0 and abs(times[first - 1] - then) <= abs(times[first + 2] - then):
            first -= 1
        span = newest_ns - (times[first] + times[first + 1] + times[first + 2]) / 3
        if span < RATE_WINDOW_NS / 2:
            return None
        before = forces[first] + forces[first + 1] + forces[first + 2]
        return (forces[-1] + forces[-2] + forces[-3] - before) / 3 / (span * 1e-9)


class RunningMean:
    """Mean over the last time, of values that come one by one.

    Parameters
    ----------
    window_ns : int
    """

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._recent: deque[tuple[int, float]] = deque()
        self._sum, self._full = 0.0, False

    def clear(self) -> None:
        """Forget all values."""
        self._recent.clear()
        self._sum, self._full = 0.0, False

    def add(self, time_ns: int, value: float) -> None:
        """Take one more value, later than the others."""
        recent = self._recent
        recent.append((time_ns, value))
        self._sum += value
        since_ns = time_ns - self._window_ns
        while recent[0][0] <= since_ns:
            self._sum -= recent.popleft()[1]
            self._full = True

    @property
    def value(self) -> float | None:
        """The mean; None until values have come for longer than the window."""
        return self._sum / len(self._recent) if self._full else None
