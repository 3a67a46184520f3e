# SPDX-License-Identifier: Apache-2.0
"""What the force sensor shows out of contact: bias, noise, and whether they can be relied on."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.result import Breach, Cause

FloatArray = NDArray[np.float64]

LEAST_SAMPLES = 20
LEAST_NOISE_N = 2e-5
DRIFT_DEVIATIONS = 5.0


class Tare:
    """Mean and deviation of the forces of some time at rest, out of contact.

    Parameters
    ----------
    noise_limit_n : float
        Deviation of one force above which the tare is refused [N].
    """

    def __init__(self, noise_limit_n: float) -> None:
        self._noise_limit_n = noise_limit_n
        self._forces: list[FloatArray] = []

    def add(self, force_n: FloatArray) -> None:
        """Take one force (3,) [N]."""
        self._forces.append(force_n)

    def judge(self) -> Breach | None:
        """What is wrong with it: too few forces, noise, drift."""
        forces = np.array(self._forces)  # (n, 3)
        if len(forces) < LEAST_SAMPLES:
            text = f"{len(forces)} forces came during the tare, needed are {LEAST_SAMPLES}"
            return Breach(Cause.FORCE_STALE, text)
        noise = float(forces.std(axis=0, ddof=1).max())
        if noise > self._noise_limit_n:
            text = f"noise of {1e3 * noise:.2f} mN rms during the tare"
            return Breach(Cause.TARE_NOISY, f"{text}, limit {1e3 * self._noise_limit_n:g} mN")
        half = len(forces) // 2
        # of the halves' difference, white noise assumed
        std = self.noise_n * math.sqrt(4 / len(forces))
        drift = float(forces[half:, 2].mean() - forces[:half, 2].mean())
        if abs(drift) > DRIFT_DEVIATIONS * std:
            text = f"force drifted by {1e3 * drift:.2f} mN between the halves of the tare"
            return Breach(Cause.TARE_DRIFT, f"{text}, noise explains {1e3 * std:.2f} mN")
        return None

    @property
    def bias_n(self) -> FloatArray:
        """Mean force (3,) [N]."""
        return np.mean(self._forces, axis=0)

    @property
    def noise_n(self) -> float:
        """Standard deviation of one force along z [N]."""
        forces = np.array(self._forces)[:, 2]
        return max(LEAST_NOISE_N, float(forces.std(ddof=1)))

    @property
    def bias_std_n(self) -> float:
        """Standard deviation of the bias along z from noise [N]."""
        return self.noise_n / math.sqrt(len(self._forces))
