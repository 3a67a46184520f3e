# SPDX-License-Identifier: Apache-2.0
"""First contact detected by the resonance itself: a change against free air that noise does not explain.

Two streams can tell it. Poles with their covariance come once a block: f0 and damping ratio against
those in air. A lock-in on one line near the resonance comes once in two periods of that line: its complex
amplitude against its scatter in air. Both are Hotelling's test of one more observation (Anderson, *An
Introduction to Multivariate Statistical Analysis*, 2003, section 5.2), whose probability of a false alarm
is chosen.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_resonance.fields import require

FloatArray = NDArray[np.float64]

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
        _check_probability(false_alarm_probability)
        # contact_node needs no scipy, and starts in two thirds of the time
        from scipy import special

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


class PolesTouch:
    """Poles with known covariance against those of the first blocks, in air.

    Parameters
    ----------
    false_alarm_probability : float
        Of one block.
    blocks : int
        That make the reference; where they scatter more than their covariances explain, as when the
        sensor warms up, the threshold rises with it.
    """

    def __init__(self, false_alarm_probability: float = 1e-6, blocks: int = 3) -> None:
        _check_probability(false_alarm_probability)
        require(blocks >= 1, "blocks", blocks, "1 or above")
        # of the chi-square distribution with two degrees of freedom
        self._threshold = -2 * math.log(false_alarm_probability)
        self._blocks = blocks
        self._air: list[tuple[FloatArray, FloatArray]] = []
        self._mean: FloatArray = np.zeros(2)
        self._covariance: FloatArray = np.zeros((2, 2))
        self._excess = 1.0

    @property
    def ready(self) -> bool:
        """Whether the reference is there."""
        return len(self._air) == self._blocks

    def reset(self) -> None:
        """Forget the reference."""
        self._air.clear()

    def add_air(self, pole: ArrayLike, covariance: ArrayLike) -> None:
        """Take a block of which is known that the tip was in air; more than needed replace the oldest."""
        p, c = _checked(pole, covariance)
        self._air = [*self._air, (p, c)][-self._blocks :]
        weights = [np.linalg.inv(c) for _, c in self._air]
        self._covariance = np.linalg.inv(sum(weights))
        self._mean = self._covariance @ sum(
            w @ p for w, (p, _) in zip(weights, self._air, strict=True)
        )
        spare = 2 * (len(self._air) - 1)
        cost = sum(
            float((p - self._mean) @ w @ (p - self._mean))
            for w, (p, _) in zip(weights, self._air, strict=True)
        )
        self._excess = max(1.0, cost / spare) if spare else 1.0

    def statistic(self, pole: ArrayLike, covariance: ArrayLike) -> float:
        """Squared change in deviations; chi-squared with 2 degrees of freedom in air.

        Parameters
        ----------
        pole : (2,) array
            f0 [Hz] and damping ratio.
        covariance : (2, 2) array
        """
        require(self.ready, "reference", len(self._air), f"{self._blocks} blocks in air first")
        p, c = _checked(pole, covariance)
        off = p - self._mean
        return float(off @ np.linalg.solve(self._excess * (c + self._covariance), off))

    def touched(self, pole: ArrayLike, covariance: ArrayLike) -> bool:
        """Whether a block is not one of air."""
        return self.statistic(pole, covariance) > self._threshold


def _checked(pole: ArrayLike, covariance: ArrayLike) -> tuple[FloatArray, FloatArray]:
    p, c = np.asarray(pole, dtype=float), np.asarray(covariance, dtype=float)
    good = p.shape == (2,) and c.shape == (2, 2) and np.isfinite(p).all() and np.isfinite(c).all()
    require(bool(good), "pole", (p.tolist(), c.tolist()), "f0, damping ratio and their covariance")
    require(
        bool(np.linalg.eigvalsh(c).min() > 0), "covariance", c.tolist(), "a positive definite one"
    )
    return p, c


def _check_probability(value: float) -> None:
    require(0 < value < 0.5, "false_alarm_probability", value, "above 0, below 0.5")
