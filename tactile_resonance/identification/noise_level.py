# SPDX-License-Identifier: Apache-2.0
"""Which variance to weight lines with: pooled over the band where the data allow it.

A sample variance from few periods is a poor weight: with nu degrees of freedom the estimate loses a
factor (nu - 1)/(nu - 2) in variance and has none for nu <= 2. Where the variance is the same on all
lines, or changes slowly, one smooth curve over the band is far better known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

FloatArray = npt.NDArray[np.float64]

# Bartlett's test rejects a flat variance wrongly in one of a thousand bands.
FALSE_ALARM = 1e-3


@dataclass(frozen=True)
class VarianceModel:
    """Variance to weight with.

    Attributes
    ----------
    variance : (F,) float
    dof : int
        Complex degrees of freedom of the variance of each line.
    pooled_dof : int
        Of the whole curve; equals `dof` for ``per line``.
    kind : {"flat", "sloped", "per line"}
    """

    variance: FloatArray
    dof: int
    pooled_dof: int
    kind: str

    @property
    def information_correction(self) -> float:
        """Factor by which the plain covariance ``(2 Re J^H J / s^2)^-1`` is too small.

        With weights 1/s^2 of nu complex degrees of freedom each, ``E[1/s^2] = nu/(nu-1)/sigma^2``
        and ``E[1/s^4] = nu^2/((nu-1)(nu-2))/sigma^4``; the plain covariance becomes (nu-1)/nu of
        the bound and the estimate's own (nu-1)/(nu-2), together nu/(nu-2). NaN for nu <= 2, where
        the weights have no second moment. 1 where the variance is pooled.
        """
        if self.kind != "per line":
            return 1.0
        return self.dof / (self.dof - 2) if self.dof > 2 else float("nan")

    def expected_cost(self, lines: int, parameters: int) -> float:
        """Expectation of ``sum |e|^2 / s^2`` with noise alone; NaN where it has none.

        ``|e|^2 / s^2`` is F-distributed with 2 and 2 nu degrees of freedom.
        """
        nu = self.pooled_dof
        return (lines - parameters / 2) * nu / (nu - 1) if nu > 1 else float("nan")

    def cost_quantile(self, lines: int, parameters: int, probability: float) -> float:
        """Quantile of the cost with noise alone; NaN where its distribution is too wide to tell."""
        free = lines - parameters / 2
        if self.kind != "per line":
            return free * float(stats.f.ppf(probability, 2 * free, 2 * self.pooled_dof))
        if self.dof <= 2:
            return float("nan")
        one = stats.f(2, 2 * self.dof)
        return free * one.mean() + np.sqrt(free) * one.std() * float(stats.norm.ppf(probability))


def model_variance(variance: FloatArray, dof: int) -> VarianceModel:
    """Flat where a test lets it pass, else sloped, else line by line.

    Parameters
    ----------
    variance : (F,) float
        Sample variance per line, positive.
    dof : int
        Complex degrees of freedom of each.

    Returns
    -------
    VarianceModel

    References
    ----------
    Bartlett, *Properties of sufficiency and statistical tests*, Proc. R. Soc. A 160 (1937) 268-282.
    """
    lines = variance.size
    flat = np.full(lines, variance.mean())
    if _bartlett(variance, flat, dof, 1) > FALSE_ALARM:
        return VarianceModel(flat, dof, lines * dof, "flat")
    sloped = _log_linear(variance)
    if _bartlett(variance, sloped, dof, 2) > FALSE_ALARM:
        return VarianceModel(sloped, dof, lines * dof, "sloped")
    return VarianceModel(variance, dof, dof, "per line")


def _bartlett(variance: FloatArray, model: FloatArray, dof: int, parameters: int) -> float:
    """Probability of a spread of ``variance / model`` at least this large if the model holds."""
    lines = variance.size
    if lines <= parameters:
        return 1.0
    ratio = variance / model
    real_dof = 2 * dof
    statistic = real_dof * lines * (np.log(ratio.mean()) - np.mean(np.log(ratio)))
    correction = 1 + (lines + 1) / (3 * lines * real_dof)
    return float(stats.chi2.sf(statistic / correction, lines - parameters))


def _log_linear(variance: FloatArray) -> FloatArray:
    """Maximum likelihood fit of ``exp(c_0 + c_1 x)`` to gamma distributed variances.

    By Fisher scoring.
    """
    x = np.linspace(-1, 1, variance.size)
    design = np.column_stack([np.ones_like(x), x])  # (F, 2)
    coefficients = np.array([np.log(variance.mean()), 0.0])
    for _ in range(50):
        ratio = variance * np.exp(-design @ coefficients)
        step = np.linalg.solve(design.T @ design, design.T @ (ratio - 1))
        # limited: the score is far from linear where the ratio is large
        coefficients = coefficients + np.clip(step, -2.0, 2.0)
        if np.max(np.abs(step)) < 1e-10:
            break
    return np.exp(design @ coefficients)
