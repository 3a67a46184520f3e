# SPDX-License-Identifier: Apache-2.0
"""Motion of the arm along one axis that commands under way will still cause."""

from __future__ import annotations

import math
from collections import deque


class ArmModel:
    """Acceleration limit, dead time and lag of the arm along the normal, one period at a time.

    The law needs from it the way that is still to come; the estimator the acceleration, whose
    force on a tool-mounted cell is not one of contact.

    Attributes
    ----------
    set_speed_m_s : float
        Commanded to the arm, after the acceleration limit.
    speed_m_s, acceleration_m_s2 : float
        Of the tip, as far as the model knows.
    """

    def __init__(self, *, dead_time_s: float, lag_s: float, period_s: float) -> None:
        self._period_s, self._lag_s = period_s, lag_s
        self._line: deque[float] = deque([0.0] * max(1, round(dead_time_s / period_s)))
        self._keep = math.exp(-period_s / lag_s) if lag_s > 0 else 0.0
        self.set_speed_m_s = 0.0
        self.speed_m_s = 0.0
        self.acceleration_m_s2 = 0.0

    def step(self, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Advance one period, commanded to a speed under an acceleration limit."""
        most = acceleration_m_s2 * self._period_s
        self.set_speed_m_s += min(most, max(-most, speed_m_s - self.set_speed_m_s))
        self._line.append(self.set_speed_m_s)
        delayed = self._line.popleft()
        before = self.speed_m_s
        self.speed_m_s = delayed + self._keep * (before - delayed)
        self.acceleration_m_s2 = (self.speed_m_s - before) / self._period_s

    @property
    def pending_m(self) -> float:
        """Way that the arm goes on if its set speed became zero now [m]."""
        return sum(self._line) * self._period_s + self.speed_m_s * self._lag_s
