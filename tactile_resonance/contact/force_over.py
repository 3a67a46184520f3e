# SPDX-License-Identifier: Apache-2.0
"""What the force and the pose of the tip were over a past interval: a block of a measurement.

Every wrench and every pose of the last seconds is kept. Between two wrenches the force is taken to run
linearly, so that each wrench counts for the time that it stands for, and an interval may begin and end
anywhere between two of them. An interval is summed when it is asked for, over its own wrenches alone and
relative to the first of them: no cumulative sum of earlier forces is there to cancel.
"""

from __future__ import annotations

import math
import struct
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.contact.force_spread import ForceSpread, spread_of
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import Vector, vector
from tactile_resonance.fields import require

GAP_PERIODS = 3
"""Wrenches further apart than so many of their nominal periods say nothing of the time between them."""

POSE_GAP_NS = 100_000_000
"""The same of poses [ns]: a loop that has nothing to do looks seldom, and the tip moves slowly."""

LEAST_COVERAGE = 0.8
"""Of an interval that forces must cover for their mean to be its force."""

BATCHES, LEAST_WRENCHES = 8, 32
"""For the standard deviation of the mean."""

PERIODS = 20
"""What so many periods of the loop brought is stored at once: that takes a third of the time."""

SPARE = 1.1
"""A source may be faster than it states by this factor without losing the oldest wrenches."""


@dataclass(frozen=True)
class ForceOver:
    """Force and pose over an interval; NaN where not known.

    Attributes
    ----------
    force_n : float
        Time-weighted mean of the force along the normal [N].
    force_std_n : float
        Standard deviation of that mean [N]: that of the zero, and from the means of eight batches, so that
        correlated noise and a slow decay count as they should (method of batch means; Law, *Simulation
        Modeling and Analysis*, section 9.5.3). NaN for fewer than 32 wrenches.
    spread : ForceSpread
        How the force moved meanwhile.
    coverage : float
        Share of the interval over which valid wrenches came without a gap.
    position_m : tuple of 3 floats
        Mean place of the tip in the base [m].
    rotation_rad : tuple of 3 floats
        Its rotation vector nearest to the middle of the interval [rad].
    reason : str
        Why `force_n` is NaN; empty where it is not.
    """

    force_n: float
    force_std_n: float
    spread: ForceSpread
    coverage: float
    position_m: Vector
    rotation_rad: Vector
    reason: str


class ForceRecord:
    """Forces and poses of the last seconds; one thread may add while another asks.

    Parameters
    ----------
    rate_hz : float
        Nominal rate of the wrenches.
    period_s : float
        Of the control loop [s].
    length_s : float
        How far back it reaches [s].
    """

    def __init__(self, rate_hz: float, period_s: float, length_s: float = 30.0) -> None:
        for name, value in (("rate_hz", rate_hz), ("period_s", period_s), ("length_s", length_s)):
            require(0 < value < math.inf, name, value, "a number above 0")
        self._length_ns = round(1e9 * length_s)
        self._forces = _Ring(1, math.ceil(SPARE * rate_hz * length_s) + 1)
        self._force_gap_ns = GAP_PERIODS * 1e9 / rate_hz
        self._poses = _Ring(6, math.ceil(SPARE * length_s / period_s) + 1)
        self._now_ns, self._zero_std_n = 0, 0.0
        # of the last periods: wrenches, zero that counts for them (None: they are no forces), state of the arm
        self._new: list[tuple[Sequence[WrenchSample], float | None, ArmSample | None]] = []
        self._lock = threading.Lock()

    def restart(self, zero_std_n: float = 0.0) -> None:
        """Forget all forces, as of a new tare: earlier ones are not less its zero.

        Parameters
        ----------
        zero_std_n : float
            Standard deviation of the new zero along the normal [N].
        """
        with self._lock:
            self._store()
            self._forces.clear()
            self._zero_std_n = zero_std_n

    def add(
        self,
        time_ns: int,
        wrenches: Sequence[WrenchSample],
        bias_n: Vector,
        arm: ArmSample | None,
        *,
        valid: bool,
    ) -> None:
        """Take what came in one period of the control loop.

        Parameters
        ----------
        time_ns : int
            Of the period [ns].
        wrenches : sequence of WrenchSample
            Oldest first, at the tip.
        bias_n : tuple of 3 floats
            Force of the tare, taken off here [N].
        arm : ArmSample or None
        valid : bool
            Whether these wrenches are forces of a contact: after a tare and without a fault. Others
            count as not heard.
        """
        with self._lock:
            self._now_ns = time_ns
            self._new.append((wrenches, bias_n[2] if valid else None, arm))
            if len(self._new) >= PERIODS:
                self._store()

    def over(self, t0_ns: int, t1_ns: int) -> ForceOver:
        """Return what is known of the interval from `t0_ns` to `t1_ns`.

        Raises
        ------
        ValueError
            If it does not end after it begins.
        """
        require(t0_ns < t1_ns, "t1_ns", t1_ns, f"above t0_ns = {t0_ns}")
        with self._lock:
            self._store()
            now_ns, oldest_ns = self._now_ns, self._forces.kept_since_ns
            zero_std_n = self._zero_std_n
            times, rows = self._forces.around(t0_ns, t1_ns)
            pose_times, poses = self._poses.around(t0_ns, t1_ns)
        spans = _Spans(times, rows, t0_ns, t1_ns, self._force_gap_ns)
        places = _Spans(pose_times, poses[:, :3], t0_ns, t1_ns, POSE_GAP_NS)
        position_m = rotation_rad = (math.nan, math.nan, math.nan)
        if places.coverage >= LEAST_COVERAGE:
            position_m = vector(places.mean())
            rotation_rad = vector(poses[np.abs(pose_times - (t0_ns + t1_ns) // 2).argmin(), 3:])
        reason = self._missing(t0_ns, t1_ns, now_ns, oldest_ns, spans.coverage)
        if reason:
            nan = math.nan
            return ForceOver(
                nan, nan, ForceSpread(), spans.coverage, position_m, rotation_rad, reason
            )
        inside = (times >= t0_ns) & (times <= t1_ns)
        std_n, spread = math.nan, ForceSpread()
        if np.count_nonzero(inside & np.isfinite(rows[:, 0])) >= LEAST_WRENCHES:
            std_n = math.hypot(spans.std_of_mean(), zero_std_n)
            time_s = (times[inside] - t0_ns) * 1e-9
            spread = spread_of(time_s, rows[inside, 0], (t1_ns - t0_ns) * 1e-9)
        force_n = float(spans.mean()[0])
        return ForceOver(force_n, std_n, spread, spans.coverage, position_m, rotation_rad, "")

    def _store(self) -> None:
        """Put what has come into the rings."""
        forces, poses = self._forces.append, self._poses.append
        for wrenches, zero_n, arm in self._new:
            for time_ns, force_n, _, overload in wrenches:
                forces(time_ns, math.nan if zero_n is None or overload else force_n[2] - zero_n)
            if arm is not None:
                poses(arm.time_ns, *arm.position_m, *arm.rotation_rad)
        self._new.clear()

    def _missing(
        self, t0_ns: int, t1_ns: int, now_ns: int, oldest_ns: int | None, coverage: float
    ) -> str:
        """Why the force of an interval is not known; empty where it is."""
        if t1_ns > now_ns:
            return f"the block ends {(t1_ns - now_ns) * 1e-6:.1f} ms in the future"
        if t0_ns < now_ns - self._length_ns or (oldest_ns is not None and t0_ns < oldest_ns):
            ago_s, length_s = (now_ns - t0_ns) * 1e-9, self._length_ns * 1e-9
            return f"the block begins {ago_s:.1f} s ago, forces are kept for {length_s:g} s"
        if coverage < LEAST_COVERAGE:
            accepted = f"at least {100 * LEAST_COVERAGE:g} % are accepted"
            return f"forces cover {100 * coverage:.3g} % of the block, {accepted}"
        return ""


class _Spans:
    """The spans between successive samples that are not too far apart, within an interval.

    Parameters
    ----------
    times_ns : (n,) array
        Ascending.
    values : (n, k) array
        NaN in the first column where there is none.
    t0_ns, t1_ns : int
    longest_ns : float
        A longer span says nothing.

    Attributes
    ----------
    coverage : float
        Share of the interval that they cover.
    """

    def __init__(
        self, times_ns: IntArray, values: FloatArray, t0_ns: int, t1_ns: int, longest_ns: float
    ) -> None:
        # from the beginning of the interval: as floats, times of the clock would lose their last digits
        t, end = (times_ns - t0_ns).astype(float), float(t1_ns - t0_ns)
        corners, steps = np.clip(t, 0.0, end), np.diff(t)
        values = values.copy()
        if len(steps):  # at the ends of the interval the value is that between two samples
            first = (corners[0] - t[0]) / steps[0] * (values[1] - values[0])
            last = (corners[-1] - t[-1]) / steps[-1] * (values[-1] - values[-2])
            values[0] += first
            values[-1] += last
        known = np.isfinite(values[:, 0])
        self._reference = (
            values[known.argmax()].copy() if known.any() else np.zeros(values.shape[1])
        )
        values -= self._reference
        lengths, middles = np.diff(corners), (values[:-1] + values[1:]) / 2  # (n - 1,), (n - 1, k)
        unknown = ~(known[:-1] & known[1:] & (steps <= longest_ns))
        lengths[unknown], middles[unknown] = 0.0, 0.0
        # up to the end of each span: time that is covered, and integral of the values over it
        self._covered_ns = np.concatenate([[0.0], np.cumsum(lengths)])  # (n,)
        sums = np.cumsum(lengths[:, None] * middles, axis=0)
        self._sums = np.concatenate([np.zeros((1, values.shape[1])), sums])  # (n, k)
        self.coverage = float(self._covered_ns[-1] / end)

    def mean(self) -> FloatArray:
        """Time-weighted mean (k,)."""
        return self._reference + self._sums[-1] / self._covered_ns[-1]

    def std_of_mean(self) -> float:
        """Standard deviation of the first column's mean, from batches of equal covered time."""
        covered, sums = self._covered_ns, self._sums[:, 0]
        ends = np.linspace(0.0, covered[-1], BATCHES + 1)
        means = np.diff(np.interp(ends, covered, sums)) / (covered[-1] / BATCHES)
        return float(means.std(ddof=1) / math.sqrt(BATCHES))


class _Ring:
    """The newest rows of a time [ns] and some floats, in one block of memory.

    Attributes
    ----------
    newest_ns : int
        Time of the newest row; 0 before the first.
    """

    def __init__(self, width: int, capacity: int) -> None:
        self._row = struct.Struct(f"=q{width}d")
        self._memory = bytearray(self._row.size * capacity)
        self._words = np.frombuffer(self._memory).reshape(capacity, 1 + width)
        self._times = self._words.view(np.int64)[:, 0]
        self._capacity, self._count = capacity, 0
        self.newest_ns = 0

    def clear(self) -> None:
        """Forget all rows."""
        self._count = self.newest_ns = 0

    def append(self, time_ns: int, *values: float) -> None:
        """Take a row; one that is not newer than the newest is left out."""
        if time_ns <= self.newest_ns and self._count:
            return
        at = self._count % self._capacity * self._row.size
        self._row.pack_into(self._memory, at, time_ns, *values)
        self.newest_ns = time_ns
        self._count += 1

    @property
    def kept_since_ns(self) -> int | None:
        """Time of the oldest row; None where none has been lost."""
        if self._count <= self._capacity:
            return None
        return int(self._times[self._count % self._capacity])

    def around(self, t0_ns: int, t1_ns: int) -> tuple[IntArray, FloatArray]:
        """Times (n,) and values (n, width) of an interval, and one row more on either side."""
        kept = range(max(0, self._count - self._capacity), self._count)
        first = max(0, bisect_right(kept, t0_ns, key=self._time_of) - 1)
        asked = kept[first : bisect_left(kept, t1_ns, key=self._time_of) + 1]
        begin = asked.start % self._capacity
        rows = self._words[begin : begin + len(asked)].copy()
        if len(rows) < len(asked):
            rows = np.concatenate([rows, self._words[: len(asked) - len(rows)]])
        return rows.view(np.int64)[:, 0], rows[:, 1:]

    def _time_of(self, number: int) -> int:
        return int(self._times[number % self._capacity])
