# SPDX-License-Identifier: Apache-2.0
"""First contact detected by the resonance itself: a change against free air that noise does not explain.

Poles with their covariance come once a block: f0 and damping ratio against those in air, by Hotelling's test
of one more observation (Anderson, *An Introduction to Multivariate Statistical Analysis*, 2003, section 5.2),
whose probability of a false alarm is chosen.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require


class PolesTouch:
    """Poles with known covariance against those of the first blocks, in air.

    Parameters
    ----------
    false_alarm_probability : float
        Of one block, where the covariances are those of the scatter.
    blocks : int
        That make the reference; where they scatter more than their covariances explain, as when the
        sensor warms up, the threshold rises with it. That much is known from few blocks only: false alarms
        are then more frequent, of three blocks up to ``(1 - ln(p) / 2)^-2``, 1.6 % for p = 1e-6.
    """

    def __init__(self, false_alarm_probability: float = 1e-6, blocks: int = 3) -> None:
        chosen = 0 < false_alarm_probability < 0.5
        accepted = "above 0, below 0.5"
        require(chosen, "false_alarm_probability", false_alarm_probability, accepted)
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
