# SPDX-License-Identifier: Apache-2.0
"""The force over the time in which a block was taken, with its uncertainty."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

BATCHES = 8
LEAST_SAMPLES = 4 * BATCHES
# Sources that stream do so at 100 Hz or more; one that tells changes only may tell each a few times over.
STREAM_SAMPLES, STREAM_SPAN_NS = 200, 4_000_000_000


class ForceHistory:
    """Normal forces of the last seconds; one thread may add while another asks.

    Parameters
    ----------
    length_s : float
        How far back it reaches [s].
    """

    def __init__(self, length_s: float = 60.0) -> None:
        self._length_ns = round(length_s * 1e9)
        self._samples: deque[tuple[int, float]] = deque()
        self._changed = threading.Condition(threading.RLock())

    def add(self, time_ns: int, force_n: float) -> None:
        """Take one force [N]; one older than the newest is of a clock set back: all before is forgotten."""
        with self._changed:
            if self._samples and time_ns < self._samples[-1][0]:
                self._samples.clear()
            self._samples.append((time_ns, force_n))
            while self._samples[0][0] < time_ns - self._length_ns:
                self._samples.popleft()
            self._changed.notify_all()

    def mean(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Mean force from `start_ns` to `end_ns` [N] and its standard deviation.

        The standard deviation is that of the mean, found from the means of eight batches, so that
        correlated noise and a slow decay count as they should (method of batch means); an offset of the
        sensor is not in it.

        Returns
        -------
        force_n, force_std_n : float
            NaN, NaN where nothing was heard in that time; a standard deviation of NaN where fewer than
            32 samples were.
        """
        with self._changed:
            forces = np.array([f for t, f in self._samples if start_ns <= t <= end_ns])
        if forces.size == 0:
            return float("nan"), float("nan")
        if forces.size < LEAST_SAMPLES:
            return float(forces.mean()), float("nan")
        means = np.array([batch.mean() for batch in np.array_split(forces, BATCHES)])
        return float(forces.mean()), float(means.std(ddof=1) / np.sqrt(BATCHES))

    def wait(self, start_ns: int, end_ns: int, timeout_s: float) -> None:
        """Until a source that streams is heard up to `end_ns`, where nothing since `start_ns` was yet."""
        with self._changed:
            if self.streams and self.newest()[0] < start_ns:
                self._changed.wait_for(lambda: self.newest()[0] >= end_ns, timeout_s)

    @property
    def streams(self) -> bool:
        """Whether forces come again and again: then one that is not there is late, not unchanged."""
        with self._changed:
            if len(self._samples) < STREAM_SAMPLES:
                return False
            return self._samples[-1][0] - self._samples[-STREAM_SAMPLES][0] < STREAM_SPAN_NS

    def newest(self) -> tuple[int, float]:
        """Time [ns] and force [N] heard last; 0 and NaN before the first."""
        with self._changed:
            return self._samples[-1] if self._samples else (0, float("nan"))
