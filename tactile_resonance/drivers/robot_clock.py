# SPDX-License-Identifier: Apache-2.0
"""A robot's clock related to this machine's, from time stamps that arrive late by a varying delay."""

from __future__ import annotations

from collections import deque

import numpy as np

SLOT_S = 1.0
SLOTS = 30
# A delay larger than the least by this, of all stamps over `JUMP_STAMPS`, is a clock that was set.
JUMP_S = 0.050
JUMP_STAMPS = 100
# Two crystals differ by less than this, so few slots are not regressed to more.
MOST_DRIFT = 200e-6


class RobotClock:
    """Least delay of each second, and a straight line through the last thirty of them.

    A stamp is never early: the least delay is nearest to the truth, and what all stamps share cannot be
    seen in one direction. Half of the round trip is taken for it; the whole round trip and the robot's
    cycle bound the error.

    Parameters
    ----------
    round_trip_s : float
        Least round trip of the network [s].
    cycle_s : float
        Control period of the robot [s]: how long a state may wait in it before it is sent.
    """

    def __init__(self, round_trip_s: float = 0.0, cycle_s: float = 0.002) -> None:
        self._round_trip_s = round_trip_s
        self._cycle_s = cycle_s
        self._restart()

    def _restart(self) -> None:
        self._slots: deque[tuple[float, float]] = deque(maxlen=SLOTS)
        self._first: tuple[float, float] | None = (
            None  # robot time, local time: keeps numbers small
        )
        self._slot_start_s = 0.0
        self._line = (0.0, 0.0)  # delay at the first stamp, and its slope
        self._residual_s = 0.0
        self._newest_s = -np.inf
        self._late = 0

    @property
    def uncertainty_s(self) -> float:
        """Standard deviation of `local_s` [s]; NaN before the first stamp.

        Half of the round trip and the robot's cycle taken as uniform, and the scatter of the least
        delays about their line.
        """
        if self._first is None:
            return float("nan")
        unseen = (self._round_trip_s**2 + self._cycle_s**2) / 12
        return float(np.sqrt(unseen + self._residual_s**2))

    def add(self, robot_s: float, local_s: float) -> None:
        """Take a stamp of the robot and the local time at which it arrived [s].

        A robot's clock that went back, or stays late by more than 50 ms for 100 stamps, was set anew.
        """
        if self._first is None or robot_s < self._newest_s:
            self._restart()
            self._first = (robot_s, local_s)
            self._slot_start_s = robot_s
            self._slots.append((0.0, 0.0))
        assert self._first is not None
        self._newest_s = robot_s
        x = robot_s - self._first[0]
        delay = (local_s - self._first[1]) - x
        excess = delay - self._predicted(x)
        self._late = self._late + 1 if excess > JUMP_S else 0
        if self._late >= JUMP_STAMPS:
            self._restart()
            self.add(robot_s, local_s)
            return
        if robot_s - self._slot_start_s >= SLOT_S:
            self._slot_start_s = robot_s
            self._slots.append((x, delay))
            self._fit()
        elif delay < self._slots[-1][1]:
            self._slots[-1] = (x, delay)
        if excess < 0:  # earlier than thought possible: the line is too high
            self._line = (self._line[0] + excess, self._line[1])

    def local_s(self, robot_s: float) -> float:
        """Local time of a robot time [s]; NaN before the first stamp."""
        if self._first is None:
            return float("nan")
        x = robot_s - self._first[0]
        return self._first[1] + x + self._predicted(x) - self._round_trip_s / 2

    def _predicted(self, x: float) -> float:
        return self._line[0] + self._line[1] * x

    def _fit(self) -> None:
        # the newest slot has only begun
        done = np.array(list(self._slots)[:-1])  # (slots, 2)
        x, delay = done[:, 0], done[:, 1]
        if len(done) < 5:
            self._line = (float(delay.min()), 0.0)
            self._residual_s = float(np.std(delay))
            return
        slope, start = np.polyfit(x, delay, 1)
        slope = float(np.clip(slope, -MOST_DRIFT, MOST_DRIFT))
        start = float(np.mean(delay - slope * x))
        residual = delay - (start + slope * x)
        # a second in which every stamp was late pulls the line up: lay it under the lower half
        low = residual <= np.median(residual)
        self._line = (start + float(np.mean(residual[low])), slope)
        self._residual_s = float(np.std(residual[low]))
