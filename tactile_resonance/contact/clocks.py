# SPDX-License-Identifier: Apache-2.0
"""A device's clock against this machine's, from the stamps of what the device sends.

A message that left at remote time r arrives at local time l = r (1 + drift) + offset + delay. Delays are
never below the shortest one, so the true relation runs along the lower edge of the points (r, l - r), here
that edge of their convex hull which spans the middle of the window: the line below all points with the
smallest mean distance to them (Moon, Skelly, Towsley, Estimation and removal of clock skew from network
delay measurements, INFOCOM 1999). Late messages, however many and however late, do not move it.

The shortest delay itself cannot be distinguished from an offset by listening only: the caller states it, with
its uncertainty.
"""

from __future__ import annotations

import math
import statistics
from collections import deque

import numpy as np

from tactile_resonance.fields import require

BLOCK_S = 0.25
"""Of all messages within a block the one that was quickest counts."""
WINDOW_BLOCKS = 120
STEP_S = 0.005
"""A message that is earlier than the relation allows by more means that a clock was set."""
STEP_BLOCKS = 4
"""So many blocks on end that are later by as much do, too."""
YOUNG_BLOCKS = 8
"""Below this many blocks no drift is estimated."""
FIRST_STD_S = 1e-3
"""Stated until the first block is complete."""
USUAL_DRIFT = 2e-4
"""Of quartz clocks, taken as the uncertainty until a drift is estimated."""
LARGEST_DRIFT = 1e-3


class ClockTracker:
    """Follows a remote clock, message by message.

    Parameters
    ----------
    shortest_delay_s, delay_std_s : float
        Of a message on its way [s], and how well that is known (one standard deviation).
    """

    def __init__(self, shortest_delay_s: float = 0.0, delay_std_s: float = 0.0) -> None:
        for name, value in (("shortest_delay_s", shortest_delay_s), ("delay_std_s", delay_std_s)):
            require(0 <= value < math.inf, name, value, "a number, 0 or above")
        self._delay_s, self._delay_std_s = shortest_delay_s, delay_std_s
        self._clear()

    def _clear(self) -> None:
        self._origin: tuple[float, int] | None = None
        self._blocks: deque[tuple[float, float]] = deque(maxlen=WINDOW_BLOCKS)
        self._block: tuple[float, float] | None = None  # quickest of the block under way
        self._block_end_s = 0.0
        self._last_s = -math.inf
        # offset at the origin and drift of the lower edge, and how far points are above it
        self._line = (0.0, 0.0)
        self._scatter_s = FIRST_STD_S

    def add(self, remote_s: float, local_ns: int) -> None:
        """Take the stamp [s] of a message and when it arrived [ns].

        Raises
        ------
        ValueError
            If the stamp is not finite.
        """
        if not math.isfinite(remote_s):
            raise ValueError(f"remote_s: {remote_s!r}, expected a finite time")
        x = y = 0.0
        if self._origin is not None:
            # remote time, and local minus remote time, both since the first message
            origin_s, origin_ns = self._origin
            x = remote_s - origin_s
            y = (local_ns - origin_ns) * 1e-9 - x
            offset_s, drift = self._line
            if remote_s < self._last_s or (self._blocks and offset_s + drift * x - y > STEP_S):
                self._clear()
        if self._origin is None:
            self._origin = (remote_s, local_ns)
            self._block_end_s = BLOCK_S
            x = y = 0.0
        self._last_s = remote_s
        if x >= self._block_end_s and self._block is not None:
            self._blocks.append(self._block)
            self._block = None
            self._block_end_s = x + BLOCK_S
            self._drop_before_a_pause()
            self._fit()
        if self._block is None or y < self._block[1]:
            self._block = (x, y)
            if not self._blocks:
                self._line = (y, 0.0)

    @property
    def uncertainty_s(self) -> float:
        """Standard deviation of a converted time near the newest message [s]; NaN before the first."""
        if self._origin is None:
            return math.nan
        return math.hypot(self._scatter_s, self._delay_std_s)

    def to_local_ns(self, remote_s: float) -> int:
        """Local time [ns] of a remote time [s] near the newest message, by the relation as of now.

        Raises
        ------
        ValueError
            If no message has come yet.
        """
        if self._origin is None:
            raise ValueError("clock relation: no message has come yet")
        origin_s, origin_ns = self._origin
        x, (offset_s, drift) = self._last_s - origin_s, self._line
        newest_ns = origin_ns + round((x + (offset_s + drift * x - self._delay_s)) * 1e9)
        if remote_s == self._last_s:
            return newest_ns
        return newest_ns + round((remote_s - self._last_s) * (1 + drift) * 1e9)

    def _drop_before_a_pause(self) -> None:
        """When the sender stood still, its clock is behind from then on."""
        recent = list(self._blocks)[-STEP_BLOCKS:]
        late = [y - self._line[0] - self._line[1] * x for x, y in recent]
        if len(self._blocks) > STEP_BLOCKS and min(late) > STEP_S:
            self._blocks = deque(recent, maxlen=WINDOW_BLOCKS)

    def _fit(self) -> None:
        points = list(self._blocks)
        if len(points) < YOUNG_BLOCKS:
            lowest = min(y for _, y in points)
            self._line = (lowest, 0.0)
            unknown_s = USUAL_DRIFT * self._block_end_s
        else:
            self._line = _lower_edge(points)
            unknown_s = 0.0
        above = [y - self._line[0] - self._line[1] * x for x, y in points]
        # the newest block shows at once when something has changed
        self._scatter_s = max(2.0 * statistics.median(above), above[-1], unknown_s)


def _lower_edge(points: list[tuple[float, float]]) -> tuple[float, float]:
    """Offset and slope of the edge of the lower convex hull that spans the mean of x."""
    x, y = np.array(points).T
    left, right = x < x.mean(), x >= x.mean()
    # Of all lines from a point before the mean to one after it the hull's edge is lowest between the two next
    # to the mean. At a point that lies on the mean itself, as where blocks come evenly, all lines to it are as
    # low.
    between = (x[left].max() + x[right].min()) / 2
    slopes = (y[right] - y[left, None]) / (x[right] - x[left, None])
    heights = y[left, None] + slopes * (between - x[left, None])
    slope = float(np.clip(slopes.flat[heights.argmin()], -LARGEST_DRIFT, LARGEST_DRIFT))
    return float((y - slope * x).min()), slope
