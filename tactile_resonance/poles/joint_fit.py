# SPDX-License-Identifier: Apache-2.0
"""The joint estimator on the bins of a few points: coefficients, noise level, and what contradicts."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance.poles.bins import BinData
from tactile_resonance.poles.fit import Solution, minimise, refit_failed
from tactile_resonance.poles.joint_layout import JointLayout
from tactile_resonance.poles.joint_model_error import systematic_of
from tactile_resonance.poles.joint_noise import BINS_PER_BAND, JointNoise
from tactile_resonance.poles.joint_weights import begin, noise_of, weighted
from tactile_resonance.poles.lacking import asks, lacking_terms
from tactile_resonance.poles.likelihood import invert
from tactile_resonance.poles.model_error import MODEL_ERROR_PROBABILITY
from tactile_resonance.poles.noise_level import KINDS, f_quantile
from tactile_resonance.poles.whiteness import are_smooth

BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

# Points that are fitted together: enough for what a call costs, few enough for the cache.
CHUNK = 1000
# Of the power of the data: residuals below are rounding.
ROUNDED = 1e-22
# How often the noise is taken anew, and the change of its variance below which it is the same.
MOST_RETURNS = 4
SAME_LEVEL = 0.1


@dataclass(frozen=True, eq=False)
class JointFit:
    """Fits of a batch.

    Attributes
    ----------
    theta : (batch, n) float
        Coefficients [A without its last, B, C]; of several records the C of each.
    covariance : (batch, n, n) float
        Of them, from noise; NaN where noise cannot be told from all else. Of several realisations
        of the coefficients that they share.
    total : same shape
        From noise and distortion; NaN where nothing but noise is known.
    condition : (batch,) float
    converged, usable : (batch,) bool
        Usable are points whose bins are all finite.
    cost, expected : (batch,) float
        Of the excited bins; NaN where the level is from the residuals themselves.
    suspect : (batch,) bool
        Whether cost or whiteness contradict the model.
    noise : (batch, 2) float
        Variance of a bin of Y and of U.
    kind : (batch,) str
        What the variance was taken for.
    residual : (batch, K_e) complex
        Weighted, on the excited bins, turned by the phase of the input.
    systematic : (batch, places, 2, 2) float
        What a model error moves (f0_hz, damping_ratio) by, as an outer product; 0 where there is no
        suspicion.
    remark : (batch,) object
        What else is to be told to people; empty: nothing.
    lacking : (batch, 3) float
        See `lacking.lacking_terms`; NaN where it was not asked, as for several realisations.
    """

    theta: FloatArray
    covariance: FloatArray
    total: FloatArray
    condition: FloatArray
    converged: BoolArray
    usable: BoolArray
    cost: FloatArray
    expected: FloatArray
    suspect: BoolArray
    noise: FloatArray
    kind: npt.NDArray[np.str_]
    residual: ComplexArray
    systematic: FloatArray
    remark: npt.NDArray[np.object_]
    lacking: FloatArray

    def rows(self, which: npt.NDArray[np.int64]) -> JointFit:
        """Some of the points."""
        return JointFit(*(getattr(self, f.name)[which] for f in fields(JointFit)))

    @classmethod
    def joined(cls, parts: list[JointFit]) -> JointFit:
        """The batch of several."""
        if len(parts) == 1:
            return parts[0]
        names = [f.name for f in fields(cls)]
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))

    def replaced(self, rows: BoolArray, fit: JointFit) -> JointFit:
        """With some points of another batch."""
        arrays = {}
        for name in (f.name for f in fields(self)):
            arrays[name] = getattr(self, name).copy()
            arrays[name][rows] = getattr(fit, name)
        return JointFit(**arrays)


@dataclass(frozen=True, eq=False)
class _Level:
    """Noise level of a batch, in units of the variances weighted with; see `JointFit`."""

    scale: FloatArray
    cost: FloatArray
    expected: FloatArray
    suspect: BoolArray
    noise: FloatArray
    correction: FloatArray


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def fit_bins(layout: JointLayout, u: ComplexArray, y: ComplexArray) -> JointFit:
    """Fits of points.

    Parameters
    ----------
    layout : JointLayout
    u, y : (batch, K) complex
        At its bins.

    Notes
    -----
    One step from start values the residuals are all but noise, unless the input's noise is far above
    the output's or the same in both. Where the noise then looks other than flat, or the model wrong,
    its level is taken once more, from where the fit ended.
    """
    fit = _in_chunks(layout, u, y)
    doubtful = np.full(u.shape[0], layout.other_bins.size > 0)
    for _ in range(MOST_RETURNS):
        doubtful &= (fit.suspect | (fit.kind != KINDS[0])) & _may_return(fit)
        if not doubtful.any():
            break
        before = fit.noise[:, 0]
        again = _in_chunks(layout, u[doubtful], y[doubtful], fit.theta[doubtful])
        fit = fit.replaced(doubtful, again)
        doubtful &= np.abs(fit.noise[:, 0] - before) > SAME_LEVEL * before
    return fit


def _in_chunks(
    layout: JointLayout, u: ComplexArray, y: ComplexArray, start: FloatArray | None = None
) -> JointFit:
    """`_fit` of all points, some at a time."""
    parts = [slice(k, k + CHUNK) for k in range(0, max(len(u), 1), CHUNK)]
    return JointFit.joined(
        [_fit(layout, u[part], y[part], None if start is None else start[part]) for part in parts]
    )


def _may_return(fit: JointFit | Solution) -> BoolArray:
    """(batch,) whether a fit ended where another one may begin."""
    finite = np.isfinite(fit.theta).all(axis=tuple(range(1, fit.theta.ndim)))
    return np.asarray(fit.converged & finite)


def _fit(
    layout: JointLayout, u: ComplexArray, y: ComplexArray, start: FloatArray | None = None
) -> JointFit:
    """The fit of a few points from coefficients (batch, n) that are near it, or from start values."""
    batch = u.shape[0]
    # finite as a whole only where every bin is
    usable = np.asarray(np.isfinite(u.sum(axis=-1) + y.sum(axis=-1)))
    if not usable.all():
        u, y = (np.where(usable[:, None], v, 0) for v in (u, y))
    undriven, problem = layout.other_bins.size, layout.problem
    u, y = u[:, None], y[:, None]  # of one record
    one = np.ones((batch, 1, 1))
    if undriven == 0:
        kind = np.full(batch, "flat", "U8")
        ratio = layout.input_noise_ratio or 0.0
        data = BinData.of(y, u, 0, one, ratio * one if ratio else None, order=layout.order)
        solution = minimise(problem, data)
    else:
        data = BinData.of(y, u, undriven, one, None, None, one, order=layout.order)
        if start is None:
            theta, noise = begin(layout, data, layout.noise_bands)
        else:
            theta = start[:, None]
            noise = noise_of(layout, data, theta, layout.noise_bands)
        kind, data = noise.kind, weighted(data, noise, layout.noise_bands)
        solution = minimise(problem, data, theta)
    solution = refit_failed(problem, solution, data)
    theta = solution.theta[:, 0]
    inverse, condition = invert(solution.normal[:, 0].sum(axis=1))
    if undriven == 0:
        level = _level_from_residuals(layout, solution)
    else:
        level = _level_from_others(layout, solution, inverse, noise)
    residual = solution.residual[:, 0] / np.sqrt(level.scale)[:, None]
    suspect = are_smooth(residual, layout.structure.parameters) | level.suspect
    lacking = np.full((batch, 3), np.nan)
    asked = suspect | (batch == 1) | asks(layout, level.cost, level.expected, residual)
    asked = np.flatnonzero(asked & _may_return(solution))
    if asked.size:
        part = data if asked.size == batch else data.rows(asked)
        lacking[asked] = lacking_terms(
            layout, part, theta[asked], inverse[asked], solution.cost[asked]
        )
        suspect = suspect | np.isfinite(lacking[:, 0])
    if suspect.any():  # what rounding leaves of exact data says nothing
        rows = np.flatnonzero(suspect)
        of_noise = (level.scale * data.variance_y.min(axis=(1, 2)))[rows]
        suspect[rows] = of_noise > ROUNDED * mean_power(data.rows(rows).y_driven[:, 0])
        lacking[~suspect] = np.nan
    systematic = np.zeros((batch, layout.structure.order // 2, 2, 2))
    wrong = suspect
    if start is None and layout.other_bins.size > 0:  # others are fitted once more
        wrong = suspect & ~_may_return(solution)
    if wrong.any():
        systematic[wrong] = systematic_of(layout, data.rows(wrong), solution.theta[wrong])
    # real and imaginary part of a circular complex error have half its variance each
    covariance = inverse * (0.5 * level.scale * level.correction)[:, None, None]
    unknown = np.full_like(covariance, np.nan)
    known = layout.level_known
    return JointFit(
        theta=theta,
        covariance=covariance if known else unknown,
        total=unknown if known else covariance,
        condition=condition,
        converged=solution.converged,
        usable=usable,
        cost=level.cost,
        expected=level.expected,
        suspect=suspect,
        noise=level.noise,
        kind=kind,
        residual=residual,
        systematic=systematic,
        remark=np.full(batch, "", object),
        lacking=lacking,
    )


def _level_from_residuals(layout: JointLayout, solution: Solution) -> _Level:
    """One period: a model error hides in the level, unless the residuals are smooth."""
    batch = solution.cost.size
    dof = max(layout.excited_bins.size - sum(layout.problem.sizes) / 2, 0.5)
    level = solution.cost / dof
    ratio = layout.input_noise_ratio or 0.0
    nothing = np.full(batch, np.nan)
    return _Level(
        level,
        nothing,
        nothing,
        np.zeros(batch, bool),
        np.stack([level, ratio * level], axis=-1),
        np.full(batch, student_variance(dof)),
    )


def _level_from_others(
    layout: JointLayout,
    solution: Solution,
    inverse: FloatArray,
    noise: JointNoise,
) -> _Level:
    """The bins between harmonics tell the level, the excited ones whether the model holds."""
    n = inverse.shape[-1]
    # leverage of the others
    used = np.einsum("bij,bji->b", inverse, solution.normal[:, 0, 0])
    dof_o = layout.other_bins.size - used / 2
    dof_e = layout.excited_bins.size - (n - used) / 2
    level = solution.part_cost[:, 0] / dof_o
    cost = solution.part_cost[:, 1] / level
    expected = dof_e * dof_o / (dof_o - 1)
    limit = dof_e * f_quantile(1 - MODEL_ERROR_PROBABILITY, 2 * dof_e, 2 * dof_o)
    pieces = noise.kind == "per line"
    if pieces.any():
        # weights from few bins: moments of F(2, 2 nu), as in `VarianceModel.cost_quantile`
        mean = BINS_PER_BAND / (BINS_PER_BAND - 1)
        std = mean * np.sqrt(BINS_PER_BAND / (BINS_PER_BAND - 2))
        quantile = special.ndtri(1 - MODEL_ERROR_PROBABILITY)
        expected = np.where(pieces, expected * mean, expected)
        limit = np.where(pieces, dof_e * mean + np.sqrt(dof_e) * std * quantile, limit)
    suspect = cost > limit
    dof = dof_e + dof_o
    correction = student_variance(dof)
    if pieces.any():  # as `VarianceModel.information_correction` line by line
        correction = np.where(pieces, BINS_PER_BAND / (BINS_PER_BAND - 2), correction)
    pooled = solution.part_cost.sum(axis=-1) / dof
    return _Level(
        np.where(suspect, level, pooled),
        cost,
        expected,
        suspect,
        noise.mean_variances * level[:, None],
        correction,
    )


def student_variance(dof):
    """Variance of Student's distribution for a level of `dof` complex degrees of freedom."""
    dof = np.asarray(dof, float)  # Python's own floats raise where the division is by 0
    return np.divide(dof, dof - 1, out=np.full(dof.shape, np.nan), where=dof > 1)


def mean_power(values: ComplexArray) -> FloatArray:
    """(batch,) mean square."""
    return np.asarray(np.mean(values.real**2 + values.imag**2, axis=-1))
