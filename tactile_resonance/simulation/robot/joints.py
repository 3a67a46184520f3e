# SPDX-License-Identifier: Apache-2.0
"""How the joints follow their targets: dead time, a first-order lag, a small wander."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.target import CYCLE_S

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class JointTracking:
    """Tracking of targets by the joints.

    Attributes
    ----------
    dead_time_s : float
        Between a target and the first motion; rounded to whole cycles.
    lag_s : float
        Time constant of the approach.
    jitter_rad : float
        Standard deviation of the wander of one joint; 4 microrad are about 3 micrometres at a tip half
        a metre from the axes.
    jitter_time_s : float
        Its correlation time (Ornstein-Uhlenbeck).
    """

    dead_time_s: float = 0.004
    lag_s: float = 0.010
    jitter_rad: float = 4e-6
    jitter_time_s: float = 0.05


class Joints:
    """Actual angles and speeds of the joints.

    Attributes
    ----------
    q, qd : (6,) arrays
        Actual angles [rad] and speeds [rad/s].
    """

    def __init__(self, q: FloatArray, tracking: JointTracking, rng: np.random.Generator) -> None:
        self._rng = rng
        self._tracking = tracking
        self._keep = float(np.exp(-CYCLE_S / tracking.lag_s)) if tracking.lag_s > 0 else 0.0
        self._jitter_keep = float(np.exp(-CYCLE_S / tracking.jitter_time_s))
        self._kick = tracking.jitter_rad * float(np.sqrt(1 - self._jitter_keep**2))
        self._jitter = tracking.jitter_rad * rng.standard_normal(6)
        delay = round(tracking.dead_time_s / CYCLE_S)
        self._pending = deque([np.array(q, dtype=float)] * delay)
        self._followed = np.array(q, dtype=float)
        self.q = self._followed + self._jitter
        self.qd = np.zeros(6)

    def step(self, target_q: FloatArray, powered: bool) -> None:
        """Follow for one cycle; without power the brakes hold the joints where they are."""
        if not powered:
            self.qd = np.zeros(6)
            return
        self._pending.append(target_q)
        delayed = self._pending.popleft()
        self._followed = delayed + (self._followed - delayed) * self._keep
        noise = self._rng.standard_normal(6)
        self._jitter = self._jitter * self._jitter_keep + self._kick * noise
        before = self.q
        self.q = self._followed + self._jitter
        self.qd = (self.q - before) / CYCLE_S

    def hold(self) -> FloatArray:
        """Forget what is pending and return the angles (6,) at which the brakes caught the joints."""
        self._pending = deque([self.q.copy()] * len(self._pending))
        self._followed = self.q - self._jitter
        return self._followed.copy()
