# SPDX-License-Identifier: Apache-2.0
"""Which variance to weight lines with: pooled over the band where the data allow it.

A sample variance from few periods is a poor weight: with nu degrees of freedom the estimate loses a
factor (nu - 1)/(nu - 2) in variance and has none for nu <= 2. Where the variance is the same on all
lines, or changes slowly, one smooth curve over the band is far better known.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import special

from tactile_resonance._typing import BoolArray, FloatArray, IntArray

# Bartlett's test rejects a flat variance wrongly in one of ten thousand bands.
FALSE_ALARM = 1e-4
REWEIGHTINGS = 3
# Of the mean over the band: below it a fitted variance is taken for an accident.
LEAST_VARIANCE = 1e-3
KINDS = ("flat", "sloped", "per line")


@dataclass(frozen=True, eq=False)
class VarianceModel:
    """Variance to weight with, for a batch of points.

    Attributes
    ----------
    variance : (batch, F) float
        Infinite on lines that are left out.
    lines : (batch,) int
        Lines that are not.
    dof : int
        Complex degrees of freedom of the variance of each line.
    kind : (batch,) int
        Index into `KINDS`.
    independent_dof : float or None
        Degrees of freedom that a line adds to the pool; `dof` where absent. Fewer where lines share
        the bins between them that their variances are from.
    """

    variance: FloatArray
    lines: IntArray
    dof: int
    kind: IntArray
    independent_dof: float | None = None

    @property
    def pooled_dof(self) -> FloatArray:
        """(batch,) of the whole curve; equals `dof` for ``per line``."""
        each = self.dof if self.independent_dof is None else self.independent_dof
        return np.where(self.kind == 2, float(self.dof), self.lines * float(each))

    @property
    def information_correction(self) -> FloatArray:
        """(batch,) factor by which the plain covariance ``(2 Re J^H J / s^2)^-1`` is too small.

        With weights 1/s^2 of nu complex degrees of freedom each, ``E[1/s^2] = nu / (nu - 1) /
        sigma^2`` and ``E[1/s^4] = nu^2 / ((nu - 1)(nu - 2)) / sigma^4``; the plain covariance
        becomes (nu - 1)/nu of the bound and the estimate's own (nu - 1)/(nu - 2), together nu / (nu
        - 2). NaN for nu <= 2, where the weights have no second moment.

        A level pooled to nu degrees of freedom makes errors over their stated deviation Student
        distributed: with 2 nu real degrees of freedom their variance is ``nu / (nu - 1)``.
        """
        per_line = self.dof / (self.dof - 2) if self.dof > 2 else np.nan
        return np.where(self.kind == 2, per_line, student_variance(self.pooled_dof))

    def expected_cost(self, parameters: int) -> FloatArray:
        """(batch,) expectation of ``sum |e|^2 / s^2`` with noise alone; NaN where it has none."""
        return (self.lines - parameters / 2) * student_variance(self.pooled_dof)

    def contradicts(self, cost: FloatArray, parameters: int, probability: float) -> BoolArray:
        """(batch,) whether noise alone exceeds a cost more rarely; False where that cannot be determined."""
        free = np.maximum(self.lines - parameters / 2, 0.5)
        chance = special.fdtrc(2 * free, 2 * self.pooled_dof, cost / free)
        if self.dof > 2:
            # moments of F(2, 2 nu)
            nu = self.dof
            mean = nu / (nu - 1)
            std = mean * np.sqrt(nu / (nu - 2))
            per_line = special.ndtr((free * mean - cost) / (np.sqrt(free) * std))
        else:
            per_line = np.ones(free.shape)
        return np.asarray(np.where(self.kind == 2, per_line, chance) < probability)


@np.errstate(divide="ignore", invalid="ignore")
def student_variance(dof: FloatArray) -> FloatArray:
    """Variance of Student's distribution for a level of `dof` complex degrees of freedom; NaN up to 1."""
    return np.where(dof > 1, dof / (dof - 1), np.nan)


def model_variance(variance: FloatArray, dof: int, gain: FloatArray | None = None) -> VarianceModel:
    """Flat where a test lets it pass, else sloped, else line by line.

    Parameters
    ----------
    variance : (batch, F) float
        Sample variance per line; lines where it is not positive and finite are left out.
    dof : int
        Complex degrees of freedom of each.
    gain : (batch, F) float, optional
        ``|G|^2``: flat then means flat noise on both channels, which makes the variance of a response
        ``a + b |G|^2``. At a resonance that matters where a test of few degrees of freedom sees no
        difference, for there is the information on the pole.

    References
    ----------
    Bartlett, *Properties of sufficiency and statistical tests*, Proc. R. Soc. A 160 (1937) 268-282.
    """
    usable = (variance > 0) & np.isfinite(variance)
    lines = usable.sum(axis=-1)
    count = np.maximum(lines, 1)
    whole = bool(usable.all())
    known = variance if whole else np.where(usable, variance, 0.0)
    mean = known.sum(axis=-1, keepdims=True) / count[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.log(variance if whole else np.where(usable, variance, 1.0))
        log_mean = log.sum(axis=-1) / count
        kind = np.zeros(variance.shape[0], np.int64)
        if gain is None:
            model = np.broadcast_to(mean, variance.shape)
            spread = np.log(mean[:, 0]) - log_mean
        else:
            model = two_channels(known, gain, usable)
            ratio = known / model  # 0 where a line is left out
            log_model = np.log(model) if whole else np.where(usable, np.log(model), 0.0)
            spread = np.log(ratio.sum(axis=-1) / count) - log_mean + log_model.sum(axis=-1) / count
        unequal = spread > _bartlett_limit(lines, dof, 1 if gain is None else 2)
    if unequal.any():
        model = model.copy()
        rest = np.flatnonzero(unequal)
        curve = log_linear(known[rest], usable[rest])
        ratio = np.where(usable[rest], known[rest] / curve, 1.0)
        with np.errstate(divide="ignore"):
            spread = (
                np.log((ratio * usable[rest]).sum(axis=-1) / count[rest])
                - np.sum(np.log(ratio), axis=-1) / count[rest]
            )
        each = spread > _bartlett_limit(lines[rest], dof, 2)
        model[rest] = np.where(each[:, None], variance[rest], curve)
        kind[rest] = np.where(each, 2, 1)
    if not whole:
        model = np.where(usable, model, np.inf)
    return VarianceModel(model, lines, dof, kind)


def are_flat(variance: FloatArray, dof: int) -> BoolArray:
    """(...) whether the test of `model_variance` finds variances (..., F) flat."""
    lines = variance.shape[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.log(variance.sum(axis=-1) / lines) - np.log(variance).sum(axis=-1) / lines
    limit = flat_limit(lines, dof)
    return np.asarray(spread <= limit)  # NaN, where a variance is not positive, is not flat


@lru_cache(maxsize=256)
def flat_limit(lines: int, dof: int) -> float:
    """Largest ``log mean - mean log`` that `are_flat` lets pass."""
    return float(_bartlett_limit(np.array(lines), dof, 1))


def _bartlett_limit(lines: IntArray, dof: int, parameters: int) -> FloatArray:
    """Largest ``log mean - mean log`` of variance ratios that passes the test."""
    real_dof = 2 * dof
    count = np.maximum(lines, parameters + 1).astype(float)
    correction = 1 + (count + 1) / (3 * count * real_dof)
    quantile = special.chdtri(count - parameters, FALSE_ALARM)
    return quantile * correction / (real_dof * count)


def two_channels(variance: FloatArray, gain: FloatArray, usable: BoolArray) -> FloatArray:
    """(batch, F) fit of ``a + b gain``, neither negative, to gamma distributed variances.

    Iteratively reweighted least squares is maximum likelihood here: the variance of a gamma
    variable is proportional to its squared mean.
    """
    lines = np.maximum(usable.sum(axis=-1), 1)
    whole = bool(usable.all())
    scale = variance.sum(axis=-1, keepdims=True) / lines[:, None]
    level = gain if whole else np.where(usable, gain, 0.0)
    mean = level.sum(axis=-1, keepdims=True) / lines[:, None]
    level = level / np.maximum(mean, np.finfo(float).tiny)
    sample = variance / scale
    weight = usable.astype(float)
    for _ in range(REWEIGHTINGS):
        by_level = weight * level
        s0, s1 = weight.sum(axis=-1), by_level.sum(axis=-1)
        s2, t0, t1 = (
            np.einsum("bf,bf->b", first, second)
            for first, second in ((by_level, level), (weight, sample), (by_level, sample))
        )
        determinant = s0 * s2 - s1**2
        b = np.where(determinant > 1e-9 * s0 * s2, (s0 * t1 - s1 * t0) / determinant, 0.0)
        a = (t0 - b * s1) / s0
        b = np.where(b < 0, 0.0, np.where(a < 0, t1 / s2, b))
        a = np.maximum((t0 - b * s1) / s0, 0.0)
        model = np.maximum(a[:, None] + b[:, None] * level, LEAST_VARIANCE)
        weight = 1 / model**2
        if not whole:
            weight[~usable] = 0.0
    return model * scale


def log_linear(variance: FloatArray, usable: BoolArray) -> FloatArray:
    """(batch, F) maximum likelihood fit of ``exp(c_0 + c_1 x)`` to gamma distributed variances.

    By Fisher scoring, over the usable lines.
    """
    x = np.linspace(-1, 1, variance.shape[-1])
    design = np.column_stack([np.ones_like(x), x])  # (F, 2)
    count = np.maximum(usable.sum(axis=-1), 1)
    coefficients = np.stack(
        [np.log(variance.sum(axis=-1) / count), np.zeros(variance.shape[0])], axis=-1
    )
    information = np.einsum("bf,fi,fj->bij", usable.astype(float), design, design)
    for _ in range(50):
        ratio = variance * np.exp(-coefficients @ design.T)
        score = np.where(usable, ratio - 1, 0.0) @ design
        step = np.linalg.solve(information, score[..., None])[..., 0]
        # some decades at most: the score is far from linear where the ratio is large
        coefficients = coefficients + np.clip(step, -2.0, 2.0)
        if np.max(np.abs(step)) < 1e-10:
            break
    return np.exp(coefficients @ design.T)
