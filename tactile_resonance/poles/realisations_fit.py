# SPDX-License-Identifier: Apache-2.0
"""The joint estimator on several realisations of the phases: one system, transients of their own.

Bins between harmonics tell the noise, what realisations differ by on excited lines tells noise and
stochastic nonlinear distortion together, and what they have in common tells whether the model holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.poles.bins import BinData
from tactile_resonance.poles.fit import Solution, minimise, refit_failed
from tactile_resonance.poles.joint_fit import ROUNDED, JointFit, mean_power
from tactile_resonance.poles.joint_layout import JointLayout
from tactile_resonance.poles.joint_model_error import systematic_of
from tactile_resonance.poles.joint_noise import JointNoise, NoiseBands
from tactile_resonance.poles.joint_weights import begin, noise_of, weighted
from tactile_resonance.poles.likelihood import moments
from tactile_resonance.poles.noise_level import KINDS, are_flat
from tactile_resonance.poles.realisations_level import Levels
from tactile_resonance.poles.realisations_spread import Spread
from tactile_resonance.poles.scatter import Pieces, smooth_variance
from tactile_resonance.poles.whiteness import are_smooth

BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]

# The scatter of realisations and the noise are taken anew from a fit that they weigh.
REWEIGHTINGS = 2


@dataclass(frozen=True, eq=False)
class _Round:
    """Data of a batch with the variances it was weighted with, and its fit.

    Attributes
    ----------
    plain : BinData
        Without variances.
    data : BinData
        With variances, and without what came through the input.
    solution : Solution
    noise : (batch, 2) float
        Mean variances of the noise on both channels that the weights stand for.
    kind : (batch,) int
        Index into `KINDS`.
    share : (batch, K_e) float or None
        Of the variance weighted with that is noise; None where all of it is.
    """

    plain: BinData
    data: BinData
    solution: Solution
    noise: FloatArray
    kind: IntArray
    share: FloatArray | None = None

    def rows(self, which: IntArray) -> _Round:
        """Some of the points."""
        return _Round(
            self.plain.rows(which),
            self.data.rows(which),
            self.solution.rows(which),
            self.noise[which],
            self.kind[which],
        )


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def fit_realisations(layout: JointLayout, u: ComplexArray, y: ComplexArray) -> JointFit:
    """Fit of a few points.

    Parameters
    ----------
    layout : JointLayout
    u, y : (batch, M, K) complex
        At its bins, of M >= 2 realisations.
    """
    records = u.shape[1]
    usable = np.asarray(np.isfinite(u.sum(axis=(1, 2)) + y.sum(axis=(1, 2))))
    if not usable.all():
        u, y = (np.where(usable[:, None, None], v, 0) for v in (u, y))
    pieces = Pieces.of(layout.excited_bins.size, records - 1)
    first = _from_noise(layout, u, y)
    levels = _levels(layout, first, pieces)
    changed = _weighted_wrongly(layout, first, levels, pieces)
    if not changed.any():
        return _judged(layout, first, first, pieces, usable)
    rest, rows = np.flatnonzero(~changed), np.flatnonzero(changed)
    second = before = first.rows(rows)
    for _ in range(REWEIGHTINGS):
        second = _from_scatter(layout, second, pieces)
    fit = _judged(layout, second, before, pieces, usable[rows])
    if not rest.size:
        return fit
    part = first.rows(rest)
    others = _judged(layout, part, part, pieces, usable[rest])
    order = np.argsort(np.concatenate([rows, rest]))
    return JointFit.joined([fit, others]).rows(order)


def _from_noise(layout: JointLayout, u: ComplexArray, y: ComplexArray) -> _Round:
    """Weighted with the noise between harmonics, or, without any, as the layout says."""
    problem, others = layout.problem, layout.other_bins.size
    one = np.ones((len(y), 1, 1))
    if others == 0:
        ratio = layout.input_noise_ratio or 0.0
        data = BinData.of(y, u, 0, one, ratio * one if ratio else None, order=layout.order)
        noise = np.tile([1.0, ratio], (len(y), 1))
        solution = refit_failed(problem, minimise(problem, data), data)
        return _Round(data, data, solution, noise, np.zeros(len(y), np.int64))
    plain = BinData.of(y, u, others, one, None, None, one, order=layout.order)
    bands = NoiseBands.of(layout.other_bins, layout.excited_bins, plain.records)
    theta, found = begin(layout, plain, bands)
    data = weighted(plain, found, bands)
    solution = refit_failed(problem, minimise(problem, data, theta), data)
    kind = np.array([KINDS.index(name) for name in found.kind])
    return _Round(plain, data, solution, found.mean_variances, kind)


def _with_noise(
    layout: JointLayout, plain: BinData, theta: FloatArray
) -> tuple[BinData, JointNoise]:
    """Data with the noise that errors between harmonics show, and that noise."""
    bands = NoiseBands.of(layout.other_bins, layout.excited_bins, plain.records)
    noise = noise_of(layout, plain, theta, bands)
    return weighted(plain, noise, bands), noise


def _levels(layout: JointLayout, fitted: _Round, pieces: Pieces) -> Levels:
    by_piece = (fitted.kind == 2) & (fitted.share is not None)
    variance = _residual_variance(layout, fitted)
    return Levels.of(layout, fitted.solution, fitted.data.u_driven, variance, pieces, by_piece)


def _weighted_wrongly(
    layout: JointLayout, fitted: _Round, levels: Levels, pieces: Pieces
) -> BoolArray:
    """(batch,) where realisations differ on excited lines by more than the variances weighted with say.

    By more than chance, on the whole or from line to line.
    """
    changed = levels.distorted()
    if pieces.starts.size > 1:
        changed = changed | ~are_flat(pieces.means(levels.line_variance), pieces.dof)
    if layout.other_bins.size == 0 and layout.input_noise_ratio is None:
        changed[:] = True  # nothing is known of the weights but what realisations differ by
    power = mean_power(fitted.data.y_driven).mean(axis=1)
    variance = _residual_variance(layout, fitted)
    return changed & (levels.excited * variance.min(axis=-1) > ROUNDED * power)


def _residual_variance(layout: JointLayout, fitted: _Round) -> FloatArray:
    """(batch, K_e) variance of the residuals of each realisation that is weighted with."""
    return _variance(fitted.data, _response(layout, fitted))


def _variance(data: BinData, g: ComplexArray) -> FloatArray:
    """(batch, K_e) variance of ``y - g u`` for a response g (batch, K_e): alike in all records."""
    return np.broadcast_to(data.residual_variance(g)[:, 0], g.shape)


def _response(layout: JointLayout, fitted: _Round) -> ComplexArray:
    """(batch, K_e)."""
    return layout.problem.response(fitted.solution.theta[:, 0])


def _from_scatter(layout: JointLayout, fitted: _Round, pieces: Pieces) -> _Round:
    """Excited lines weighted with what realisations differ by, and fitted again."""
    theta = fitted.solution.theta
    g = _response(layout, fitted)
    gain = g.real**2 + g.imag**2
    levels = _levels(layout, fitted, pieces)
    sample = levels.line_variance * _residual_variance(layout, fitted)
    total, kind = smooth_variance(sample, gain, pieces)
    if layout.other_bins.size:
        # of distorted lines with too large weights the transients were wrong, and so the noise
        data, found = _with_noise(layout, fitted.plain, theta)
        noise = found.mean_variances
        known = _variance(data, g)
        more = np.maximum(total - known, 0)
        data = replace(data, variance_y=data.variance_y + more[:, None])
        share = known / np.maximum(total, known)
    else:
        input_noise = levels.excited[:, None] * (layout.input_noise_ratio or 0.0)
        rest = np.maximum(total - input_noise * gain, 1e-3 * total)
        data = replace(
            fitted.plain,
            variance_y=rest[:, None],
            variance_u=input_noise[:, None] if layout.input_noise_ratio else None,
        )
        noise = np.stack([rest.mean(axis=-1), input_noise[:, 0]], axis=-1)
        share = np.ones_like(total)
    solution = refit_failed(layout.problem, minimise(layout.problem, data, theta), data)
    return _Round(fitted.plain, data, solution, noise, kind, share)


def _judged(
    layout: JointLayout, fitted: _Round, first: _Round, pieces: Pieces, usable: BoolArray
) -> JointFit:
    """What a round is worth, with what realisations differ by as systems; see `_each_by_itself`."""
    solution, data = fitted.solution, fitted.data
    batch, records, _ = solution.theta.shape
    a, b, _ = layout.problem.sizes
    levels = _levels(layout, fitted, pieces)
    common = levels.scatter.common / np.sqrt(levels.excited)[:, None]
    suspect = are_smooth(common, layout.structure.parameters)
    if suspect.any():  # what rounding leaves of exact data says nothing
        floor = ROUNDED * mean_power(data.y_driven).mean(axis=1)
        variance = levels.excited[:, None] * _residual_variance(layout, fitted)
        suspect &= variance.min(axis=-1) > floor
    suspect |= levels.cost > levels.limit
    covariance, total = _covariances(layout, fitted, levels, suspect)
    systematic = np.zeros((batch, layout.structure.order // 2, 2, 2))
    if suspect.any():
        rows = np.flatnonzero(suspect)
        systematic[rows] = systematic_of(layout, data.rows(rows), solution.theta[rows])
    theta = solution.theta
    fit = JointFit(
        theta=np.concatenate(
            [theta[:, 0, : a + b], theta[..., a + b :].reshape(batch, -1)], axis=1
        ),
        covariance=covariance,
        total=total,
        condition=levels.inverse.condition,
        converged=solution.converged,
        usable=usable,
        cost=levels.cost,
        expected=levels.expected,
        suspect=suspect,
        noise=fitted.noise * levels.noise_level(suspect)[:, None],
        kind=np.array(KINDS)[fitted.kind],
        residual=common,
        systematic=systematic,
        remark=np.full(batch, "", object),
        lacking=np.full((batch, 3), np.nan),
    )
    return _each_by_itself(layout, fit, first, pieces)


def _each_by_itself(layout: JointLayout, fit: JointFit, first: _Round, pieces: Pieces) -> JointFit:
    """With the scatter of the poles of each realisation in the total covariance.

    Where lines are distorted the resonator is not linear. Then its poles are the mean of those of all
    realisations, of the first round, weighted with the noise. Weighted with the distortion of each line
    a resonance that differs would count least, and the bins between harmonics most, where the ringing up
    of a resonator that is not linear tells of another system.
    """
    theta = first.solution.theta
    levels = _levels(layout, first, pieces)
    # gradients as independent lines make them, each with the variance that it shows itself
    inner = _normal_of_excited(layout, first, levels.line_variance)
    if layout.other_bins.size:
        inner = inner + levels.between[:, None, None, None] * first.solution.normal[:, :, 0]
    spread = Spread.of(layout, first.data, theta, inner, levels.excited_dof)
    distorted = levels.distorted() & spread.known
    weight = np.where(distorted, 1.0, spread.weight)
    of_first = _covariances(layout, first, levels, np.zeros(weight.size, bool))
    covariance, total = (
        np.where(distorted[:, None, None], one, other)
        for one, other in zip(of_first, (fit.covariance, fit.total), strict=True)
    )
    changed, systematic = fit.theta.copy(), fit.systematic.copy()
    shared = total.shape[1]
    changed[distorted, :shared] = (theta[:, 0, :shared] + spread.step)[distorted]
    more = spread.variance_of_mean(distorted) - spread.of_poles(total)
    for k in (0, 1):
        systematic[..., k, k] += weight[:, None] * np.maximum(np.nan_to_num(more[..., k]), 0.0)
    odd, remark = spread.remarks()
    differing = replace(
        fit,
        theta=changed,
        covariance=covariance,
        total=total,
        suspect=fit.suspect | odd,
        systematic=systematic,
        remark=remark,
    )
    rows = weight > 0
    return fit.replaced(rows, differing.rows(np.flatnonzero(rows)))


def _covariances(
    layout: JointLayout, fitted: _Round, levels: Levels, suspect: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Of the shared coefficients, from noise and in total; see `Levels.covariances`."""
    noise_alone = fitted.share is None or not layout.other_bins.size
    return levels.covariances(suspect, None if noise_alone else _noise_normal(layout, fitted))


def _noise_normal(layout: JointLayout, fitted: _Round) -> FloatArray:
    """(batch, M, n, n) covariance of the gradient on excited lines from their noise alone."""
    assert fitted.share is not None
    return _normal_of_excited(layout, fitted, fitted.share)


def _normal_of_excited(layout: JointLayout, fitted: _Round, part: FloatArray) -> FloatArray:
    """(batch, M, n, n) covariance of the gradient on excited lines.

    Parameters
    ----------
    part : (batch, K_e) float
        Their variance, of that weighted with.
    """
    variance = _residual_variance(layout, fitted) / part
    changed = replace(
        fitted.data, variance_y=variance[:, None], variance_u=None, covariance_yu=None
    )
    return moments(layout.problem.tables, changed.arrays, fitted.solution.theta)[2][:, :, 1]
