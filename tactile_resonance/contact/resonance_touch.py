# SPDX-License-Identifier: Apache-2.0
"""First contact detected by the resonance itself: a change against free air that noise does not explain.

Poles with their covariance come once a block: f0 and damping ratio against those in air. How far blocks in air
lie apart, in units of their covariances, is what one more block is judged by (Fisher's F, Student's t), so that
the probability of a false alarm is the chosen one however few they are.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy import special  # scipy.stats takes a node most of a second to import

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require


class PolesTouch:
    """Poles with known covariance against those of the first blocks, in air.

    Parameters
    ----------
    false_alarm_probability : float
        Of one block, at most, where the scatter in air is that of the covariances, or larger, in both
        quantities or in one, and Gaussian.
    blocks : int
        That make the reference, 2 or more to see how they scatter: of one its covariance is relied on. The
        fewer, the larger a change must be to be no false alarm, for 1e-6 and a scatter as stated: 70
        deviations after 5 blocks, 22 after 8, 14 after 12, 5.3 were it known.
    """

    def __init__(self, false_alarm_probability: float = 1e-6, blocks: int = 8) -> None:
        chosen = 0 < false_alarm_probability < 0.5
        accepted = "above 0, below 0.5"
        require(chosen, "false_alarm_probability", false_alarm_probability, accepted)
        require(blocks >= 1, "blocks", blocks, "1 or above")
        # of the chi-square distribution with two degrees of freedom
        self._least = -2 * math.log(false_alarm_probability)
        self._per_scatter = _per_scatter(false_alarm_probability, blocks)
        self._blocks = blocks
        self._air: list[tuple[FloatArray, FloatArray]] = []
        self._mean: FloatArray = np.zeros(2)
        self._covariance: FloatArray = np.zeros((2, 2))
        self._scatter = 0.0

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
        self._scatter = sum(
            float((p - self._mean) @ w @ (p - self._mean))
            for w, (p, _) in zip(weights, self._air, strict=True)
        )

    def statistic(self, pole: ArrayLike, covariance: ArrayLike) -> float:
        """Squared change in stated deviations; chi-squared with 2 degrees of freedom in air, if these hold.

        Parameters
        ----------
        pole : (2,) array
            f0 [Hz] and damping ratio.
        covariance : (2, 2) array
        """
        require(self.ready, "reference", len(self._air), f"{self._blocks} blocks in air first")
        p, c = _checked(pole, covariance)
        off = p - self._mean
        return float(off @ np.linalg.solve(c + self._covariance, off))

    def touched(self, pole: ArrayLike, covariance: ArrayLike) -> bool:
        """Whether a block is not one of air."""
        threshold = max(self._least, self._per_scatter * self._scatter)
        return self.statistic(pole, covariance) > threshold


def _per_scatter(probability: float, blocks: int) -> float:
    """Ratio that the statistic of one more block has to the scatter of the blocks with this probability.

    Scatter: their summed squares about their mean. Where it is that of the covariances times a factor, the
    ratio follows F, with 2 and 2 (n - 1) degrees of freedom; where it is all in one direction, with 1 and
    n - 1. Of any other scatter the ratio is beyond the larger of both more rarely.
    """
    spare = blocks - 1
    if not spare:
        return 0.0
    alike = probability ** (-1 / spare) - 1  # F with 2 degrees of freedom has a closed form
    alone = float(special.stdtrit(spare, probability / 2)) ** 2 / spare
    return max(alike, alone)


def _checked(pole: ArrayLike, covariance: ArrayLike) -> tuple[FloatArray, FloatArray]:
    p, c = np.asarray(pole, dtype=float), np.asarray(covariance, dtype=float)
    good = p.shape == (2,) and c.shape == (2, 2) and np.isfinite(p).all() and np.isfinite(c).all()
    require(bool(good), "pole", (p.tolist(), c.tolist()), "f0, damping ratio and their covariance")
    require(
        bool(np.linalg.eigvalsh(c).min() > 0), "covariance", c.tolist(), "a positive definite one"
    )
    return p, c
