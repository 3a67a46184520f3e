# SPDX-License-Identifier: Apache-2.0
"""What the force and the pose of the tip were over a past interval, and how much the force moved meanwhile.

Every wrench and every pose of the last seconds is kept. Between two wrenches the force is taken to run
linearly, so that each wrench counts for the time that it stands for, and an interval may begin and end
anywhere between two of them. An interval is summed when it is asked for, over its own wrenches alone and
relative to the first of them: no cumulative sum of earlier forces is there to cancel.

Tissue moves with breath and heartbeat, at up to a few hertz; a force sensor makes noise up to its own rate.
They are distinguished by time scale: what means over 10 ms differ by from one to the next is noise (mean square
successive difference; von Neumann, Ann. Math. Stat. 12 (1941) 367), what means over 20 ms differ by beyond
their share of it is the force.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from itertools import islice
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import Vector, quaternion_from_vector, vector
from tactile_resonance.fields import require
from tactile_resonance.record import Contact, ForceSpread

SHORT_S = 0.02
"""Of the short means [s]."""

LEAST_SHORT = 8
"""Fewer of them say nothing about a spread."""

SHORTEST_S = LEAST_SHORT * SHORT_S
"""Of an interval whose spread can be known [s]."""

LEAST_KNOWN = 0.8
"""Of the blocks of a measurement, in time, whose spread must be known."""


def spread_of(
    time_s: NDArray[np.floating], force_n: NDArray[np.floating], length_s: float
) -> ForceSpread:
    """Spread of the forces heard in an interval.

    Parameters
    ----------
    time_s : (n,) array
        Ascending, from the beginning of the interval.
    force_n : (n,) array
        NaN where there is none.
    length_s : float
        Of the interval.
    """
    parts = round(length_s / SHORT_S)
    heard = np.isfinite(force_n)
    if parts < LEAST_SHORT or heard.sum() < 2 * parts:
        return ForceSpread()
    halves = 2 * parts
    at = (time_s[heard] * (halves / length_s)).astype(int).clip(0, halves - 1)
    counts = np.bincount(at, minlength=halves)
    known = 2 * counts > np.median(counts)  # at the edge of a gap few are left
    reference_n = force_n[heard][0]
    sums = np.bincount(at, force_n[heard] - reference_n, halves)
    means = np.divide(sums, counts, out=np.full(halves, math.nan), where=known)  # over 10 ms
    here = means.reshape(parts, 2).mean(axis=1)  # over 20 ms
    here = here[np.isfinite(here)]
    if here.size < LEAST_SHORT:
        return ForceSpread()
    noise = float(np.nanmean(np.diff(means) ** 2)) / 2 / 2  # variance of a mean over 20 ms
    # an n-th of the noise went with the mean
    variance = float(here.var()) - (1 - 1 / here.size) * noise
    return ForceSpread(
        math.sqrt(max(variance, 0.0)),
        float(reference_n + here.min()),
        float(reference_n + here.max()),
    )


def joined_spread(blocks: Sequence[tuple[float, ForceSpread, float]]) -> ForceSpread:
    """Spread over all blocks of a measurement, that between their means included.

    Parameters
    ----------
    blocks : sequence of (mean force [N], its spread, length in any one unit)
        Not known where more than a fifth of their time is not.
    """
    known = [block for block in blocks if math.isfinite(block[0] + block[1].rms_n)]
    length_s = sum(block[2] for block in known)
    if not known or length_s < LEAST_KNOWN * sum(block[2] for block in blocks):
        return ForceSpread()
    mean_n = sum(force * seconds for force, _, seconds in known) / length_s
    variance = sum(
        seconds * (spread.rms_n**2 + (force - mean_n) ** 2) for force, spread, seconds in known
    )
    return ForceSpread(
        math.sqrt(variance / length_s),
        min(spread.min_n for _, spread, _ in known),
        max(spread.max_n for _, spread, _ in known),
    )


GAP_PERIODS = 3
"""Wrenches further apart than so many of their nominal periods say nothing of the time between them."""

POSE_GAP_NS = 100_000_000
"""The same of poses [ns]: a loop that has nothing to do looks seldom, and the tip moves slowly."""

LEAST_COVERAGE = 0.8
"""Of an interval that forces must cover for their mean to be its force."""

BATCHES, LEAST_WRENCHES = 8, 32
"""For the standard deviation of the mean."""

SPARE = 1.1
"""A source may be faster than it states by this factor without losing the oldest wrenches."""


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
        # rows of a time [ns] and a force, or the six numbers of a pose: tuples of plain numbers, which Python's
        # collection of garbage does not look at
        self._forces, self._poses = (
            deque[tuple[float, ...]](maxlen=math.ceil(SPARE * most) + 1)
            for most in (rate_hz * length_s, length_s / period_s)
        )
        self._force_gap_ns = GAP_PERIODS * 1e9 / rate_hz
        self._now_ns, self._zero_std_n = 0, 0.0
        self._lock = threading.Lock()
        self._came = threading.Condition(self._lock)

    def restart(self, zero_std_n: float = 0.0) -> None:
        """Forget all forces, as of a new tare: earlier ones are not less its zero.

        Parameters
        ----------
        zero_std_n : float
            Standard deviation of the new zero along the normal [N].
        """
        with self._lock:
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
        zero_n, forces, poses = bias_n[2], self._forces, self._poses
        with self._lock:
            self._now_ns = time_ns
            # a source may repeat its newest wrench: each counts once
            newest_ns = forces[-1][0] if forces else -math.inf
            for heard_ns, force_n, _, overload in wrenches:
                if heard_ns > newest_ns:
                    newest_ns = heard_ns
                    good = valid and not overload
                    forces.append((heard_ns, force_n[2] - zero_n if good else math.nan))
            if arm is not None and (not poses or arm.time_ns > poses[-1][0]):
                poses.append((arm.time_ns, *arm.position_m, *arm.rotation_rad))
            self._came.notify_all()

    def reaches(self, time_ns: int, within_s: float) -> bool:
        """Whether a period of that time or later has been taken, within so long from now."""
        with self._came:
            return self._came.wait_for(lambda: self._now_ns >= time_ns, within_s)

    def over(self, t0_ns: int, t1_ns: int) -> Contact:
        """Return what is known of the interval from `t0_ns` to `t1_ns`.

        The force is its time-weighted mean, the place that of the tip, in the base; the orientation is that
        nearest to the middle of the interval, whose time they have. The coverage is the share over which valid
        wrenches came without a gap.

        The deviation of the mean is that of the zero, and from the means of eight batches, so that correlated
        noise and a slow decay count as they should (method of batch means; Law, *Simulation Modeling and
        Analysis*, section 9.5.3). Noise that is alike over a batch or longer passes for motion of the force,
        which is no error of its mean. NaN for fewer than 32 wrenches, and where all are equal: how far they are
        off is then up to the step of the converter, which is not known here.

        Raises
        ------
        ValueError
            If it does not end after it begins.
        """
        require(t0_ns < t1_ns, "t1_ns", t1_ns, f"above t0_ns = {t0_ns}")
        with self._lock:
            now_ns, zero_std_n = self._now_ns, self._zero_std_n
            full = len(self._forces) == self._forces.maxlen
            oldest_ns = self._forces[0][0] if full else -math.inf
            heard, placed = (_cut(rows, t0_ns, t1_ns) for rows in (self._forces, self._poses))
        (times, rows), (pose_times, poses) = _columns(heard, 1), _columns(placed, 6)
        coverage, mean, batches_n = _averages(times, rows, t0_ns, t1_ns, self._force_gap_ns)
        known, place_m, _ = _averages(pose_times, poses[:, :3], t0_ns, t1_ns, POSE_GAP_NS)
        place: dict[str, Any] = {"coverage": coverage, "time_ns": (t0_ns + t1_ns) // 2}
        if known >= LEAST_COVERAGE:
            nearest = np.abs(pose_times - place["time_ns"]).argmin()
            place["position_m"] = vector(place_m)
            place["orientation_xyzw"] = quaternion_from_vector(vector(poses[nearest, 3:]))
        reason = self._missing(t0_ns, t1_ns, now_ns, oldest_ns, coverage)
        if reason:
            return Contact(**place, reason=reason)
        inside = (times >= t0_ns) & (times <= t1_ns)
        std_n, spread = math.nan, ForceSpread()
        forces_n = rows[inside & np.isfinite(rows[:, 0]), 0]
        if forces_n.size >= LEAST_WRENCHES:
            if np.ptp(forces_n) > 0:
                std_n = math.hypot(batches_n, zero_std_n)
            time_s = (times[inside] - t0_ns) * 1e-9
            spread = spread_of(time_s, rows[inside, 0], (t1_ns - t0_ns) * 1e-9)
        return Contact(float(mean[0]), std_n, **place, spread=spread)

    def _missing(
        self, t0_ns: int, t1_ns: int, now_ns: int, oldest_ns: float, coverage: float
    ) -> str:
        """Why the force of an interval is not known; empty where it is."""
        if t1_ns > now_ns:
            return f"the block ends {(t1_ns - now_ns) * 1e-6:.1f} ms in the future"
        kept_ns = now_ns - self._length_ns
        if t0_ns < max(kept_ns, oldest_ns):
            ago_s, length_s = (now_ns - t0_ns) * 1e-9, self._length_ns * 1e-9
            text = f"the block begins {ago_s:.1f} s ago, forces are kept for "
            if t0_ns >= kept_ns:
                length_s = (now_ns - oldest_ns) * 1e-9
                return f"{text}{length_s:.1f} s, since they come faster than the rate_hz of their source"
            return f"{text}{length_s:g} s"
        if coverage < LEAST_COVERAGE:
            accepted = f"at least {100 * LEAST_COVERAGE:g} % are accepted"
            return f"forces cover {100 * coverage:.3g} % of the block, {accepted}"
        return ""


def _averages(
    times_ns: IntArray, values: FloatArray, t0_ns: int, t1_ns: int, longest_ns: float
) -> tuple[float, FloatArray, float]:
    """Of the spans between successive samples that are not too far apart, within an interval.

    Parameters
    ----------
    times_ns : (n,) array
        Ascending.
    values : (n, k) array
        NaN in the first column where there is none.
    t0_ns, t1_ns : int
    longest_ns : float
        A longer span says nothing.

    Returns
    -------
    coverage : float
        Share of the interval that they cover.
    mean : (k,) array
        Weighted by time; NaN where nothing is covered.
    std_of_mean : float
        Standard deviation of the first column's mean, from batches of equal covered time.
    """
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
    reference = values[known.argmax()].copy() if known.any() else np.zeros(values.shape[1])
    values -= reference
    lengths, middles = np.diff(corners), (values[:-1] + values[1:]) / 2  # (n - 1,), (n - 1, k)
    unknown = ~(known[:-1] & known[1:] & (steps <= longest_ns))
    lengths[unknown], middles[unknown] = 0.0, 0.0
    # up to the end of each span: time that is covered, and integral of the values over it
    covered_ns = np.concatenate([[0.0], np.cumsum(lengths)])  # (n,)
    sums = np.cumsum(lengths[:, None] * middles, axis=0)
    sums = np.concatenate([np.zeros((1, values.shape[1])), sums])  # (n, k)
    whole_ns = covered_ns[-1]
    if whole_ns == 0:
        return 0.0, np.full(values.shape[1], math.nan), math.nan
    ends = np.interp(np.linspace(0.0, whole_ns, BATCHES + 1), covered_ns, sums[:, 0])
    means = np.diff(ends) / (whole_ns / BATCHES)
    std = float(means.std(ddof=1) / math.sqrt(BATCHES))
    return float(whole_ns / end), reference + sums[-1] / whole_ns, std


def _cut(rows: deque[tuple[float, ...]], t0_ns: int, t1_ns: int) -> list[tuple[float, ...]]:
    """Rows of an interval, and one more on either side; quick, for the control loop waits meanwhile."""
    first = max(0, bisect_right(rows, t0_ns, key=itemgetter(0)) - 1)
    return list(islice(rows, first, bisect_left(rows, t1_ns, key=itemgetter(0)) + 1))


def _columns(rows: list[tuple[float, ...]], width: int) -> tuple[IntArray, FloatArray]:
    """Times (n,) and values (n, width)."""
    values = np.array([row[1:] for row in rows], float).reshape(len(rows), width)
    return np.array([row[0] for row in rows], np.int64), values
