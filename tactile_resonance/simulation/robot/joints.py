# SPDX-License-Identifier: Apache-2.0
"""How the joints follow their targets, and how the tip trembles beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.target import CYCLE_S
from tactile_resonance.simulation.tracking import Jitter, Lag, TrackingParameters

FloatArray = NDArray[np.float64]


class Joints:
    """Actual angles and speeds of the joints: dead time and lag behind the target.

    Attributes
    ----------
    q, qd, qdd : (6,) arrays
        What the encoders say: angles [rad], speeds [rad/s], accelerations [rad/s^2].
    tremble_m : (3,) array
        Vibration of the tool in the base, which the encoders do not see.
    """

    def __init__(self, q: FloatArray, tracking: TrackingParameters, seed: int) -> None:
        self._tracking = tracking
        self._jitter = Jitter(tracking, CYCLE_S, seed) if tracking.jitter_rms_m > 0 else None
        self._lag = Lag(tracking, q, CYCLE_S)
        self.q = self._lag.value
        self.qd = np.zeros(6)
        self.qdd = np.zeros(6)
        self.tremble_m = np.zeros(3)

    def step(self, target_q: FloatArray, powered: bool) -> None:
        """Follow for one cycle; without power the brakes hold the joints where they are."""
        if not powered:
            self.qd = self.qdd = np.zeros(6)
            return
        before, slower = self.q, self.qd
        self.q = self._lag.step(target_q)
        self.qd = (self.q - before) / CYCLE_S
        self.qdd = (self.qd - slower) / CYCLE_S
        if self._jitter is not None:
            self.tremble_m = self._jitter.step()

    def hold(self) -> FloatArray:
        """Forget what is pending and return the angles (6,) at which the brakes caught the joints."""
        self._lag = Lag(self._tracking, self.q, CYCLE_S)
        self.qd = self.qdd = np.zeros(6)
        return self.q
