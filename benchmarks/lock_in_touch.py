# SPDX-License-Identifier: Apache-2.0
"""First contact by a lock-in on one line near the resonance, to compare `PolesTouch` with.

Its complex amplitude, once in two periods of the line, against its scatter in air: Hotelling's test of one more
observation (Anderson, *An Introduction to Multivariate Statistical Analysis*, 2003, section 5.2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require

LEAST_REFERENCE = 20
"""Observations in air from which their scatter is known well enough."""


def lock_in(
    samples: ArrayLike, sample_rate_hz: float, line_hz: float, window_s: float
) -> FloatArray:
    """Return the amplitude of a line in each window, (windows, 2): in phase and in quadrature.

    Parameters
    ----------
    samples : (n,) array
        From time 0 of the line's phase; what does not fill a window at the end is left out.
    sample_rate_hz, line_hz : float
    window_s : float
        A whole number of samples and of periods of the line: other lines that fit in leave no trace.

    Raises
    ------
    ValueError
        If it is not.
    """
    y = np.asarray(samples, dtype=float)
    count, periods = window_s * sample_rate_hz, window_s * line_hz
    whole = all(abs(x - round(x)) < 1e-6 and round(x) >= 1 for x in (count, periods))
    require(whole, "window_s", window_s, "a whole number of samples and of periods of the line")
    length = round(count)
    windows = y.size // length
    turn = np.exp(-2j * np.pi * line_hz / sample_rate_hz * np.arange(length)) * (2 / length)
    phasor = y[: windows * length].reshape(windows, length) @ turn  # (windows,)
    return np.column_stack([phasor.real, phasor.imag])


class ScatterTouch:
    """Observations against the mean and scatter of those in air.

    Parameters
    ----------
    reference : (n, d) array
        In air; independent of each other.
    false_alarm_probability : float
        Of one observation.

    Attributes
    ----------
    threshold : float
        Of the statistic.
    """

    def __init__(self, reference: ArrayLike, false_alarm_probability: float) -> None:
        given = np.asarray(reference, dtype=float)
        good = given.ndim == 2 and len(given) >= LEAST_REFERENCE and np.isfinite(given).all()
        require(
            bool(good), "reference", given.shape, f"(n, d), finite, n at least {LEAST_REFERENCE}"
        )
        chosen = 0 < false_alarm_probability < 0.5
        accepted = "above 0, below 0.5"
        require(chosen, "false_alarm_probability", false_alarm_probability, accepted)
        n, d = given.shape
        self._mean = given.mean(axis=0)
        self._root = np.linalg.inv(np.linalg.cholesky(np.cov(given.T).reshape(d, d)))
        # (n - d) n / (d (n - 1) (n + 1)) T^2 is distributed as F(d, n - d)
        self._scale = (n - d) * n / (d * (n - 1) * (n + 1))
        self.threshold = float(special.fdtri(d, n - d, 1 - false_alarm_probability))

    def statistic(self, observation: ArrayLike) -> FloatArray:
        """Return the statistic of observations (..., d), shape (...); F-distributed in air."""
        off = (np.asarray(observation, dtype=float) - self._mean) @ self._root.T
        return np.asarray(self._scale * np.sum(off**2, axis=-1))

    def touched(self, observation: ArrayLike) -> bool:
        """Whether one observation (d,) is not one of air; False where it is not finite."""
        return bool(self.statistic(observation) > self.threshold)
