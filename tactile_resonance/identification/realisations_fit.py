# SPDX-License-Identifier: Apache-2.0
"""The joint estimator on several realisations of the phases: one system, transients of their own.

Bins between harmonics tell the noise, what realisations differ by on excited lines tells noise and
stochastic nonlinear distortion together, and what they have in common tells whether the model holds.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.joint_fit import ROUNDED, JointFit, mean_power
from tactile_resonance.identification.joint_layout import JointLayout
from tactile_resonance.identification.joint_model_error import systematic_of
from tactile_resonance.identification.joint_noise import JointNoise, NoiseBands
from tactile_resonance.identification.joint_weights import noise_of, step_near, weighted
from tactile_resonance.identification.noise_level import KINDS, are_flat
from tactile_resonance.identification.realisations_level import Levels
from tactile_resonance.identification.realisations_spread import Spread
from tactile_resonance.identification.scatter import Pieces, smooth_variance
from tactile_resonance.identification.shared_points import (
    SharedPoints,
    minimise_shared,
    refine_shared,
    rows_of,
    start_shared,
)
from tactile_resonance.identification.solver import Solution
from tactile_resonance.identification.whiteness import are_smooth

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
    plain : list of BinData
        Of (batch M) rows, without variances.
    u_others : (batch M, K_o) complex
        Input between harmonics.
    data : list of BinData
        With variances, and without what came through the input.
    solution : Solution
    noise : (batch, 2) float
        Mean variances of the noise on both channels that the weights stand for.
    kind : (batch,) int
        Index into `KINDS`.
    share : (batch M, K_e) float or None
        Of the variance weighted with that is noise; None where all of it is.
    """

    plain: list[BinData]
    u_others: ComplexArray
    data: list[BinData]
    solution: Solution
    noise: FloatArray
    kind: IntArray
    share: FloatArray | None = None

    def rows(self, which: IntArray) -> _Round:
        """Some of the points."""
        records = self.solution.theta.shape[1]
        rows = rows_of(which, records)
        solution = Solution(*(getattr(self.solution, f.name)[which] for f in fields(Solution)))
        return _Round(
            [values.rows(rows) for values in self.plain],
            self.u_others[rows],
            [values.rows(rows) for values in self.data],
            solution,
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
    batch, records, size = u.shape
    usable = np.asarray(np.isfinite(u.sum(axis=(1, 2)) + y.sum(axis=(1, 2))))
    if not usable.all():
        u, y = (np.where(usable[:, None, None], v, 0) for v in (u, y))
    u, y = (v.reshape(batch * records, size) for v in (u, y))
    pieces = Pieces.of(layout.excited_bins.size, records - 1)
    first = _from_noise(layout, u, y, records)
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


def _from_noise(layout: JointLayout, u: ComplexArray, y: ComplexArray, records: int) -> _Round:
    """Weighted with the noise between harmonics, or, without any, as the layout says."""
    u_e, y_e = u.take(layout.excited_at, axis=1), y.take(layout.excited_at, axis=1)
    u_o, y_o = u.take(layout.others_at, axis=1), y.take(layout.others_at, axis=1)
    problem, rows = layout.problem, u.shape[0]
    one = np.ones((rows, 1))
    if layout.other_bins.size == 0:
        ratio = layout.input_noise_ratio or 0.0
        data = [BinData(y_e, u_e, one, ratio * one if ratio else None)]
        noise = np.tile([1.0, ratio], (rows // records, 1))
        solution = minimise_shared(problem, data, records)
        return _Round(data, u_o, data, solution, noise, np.zeros(noise.shape[0], np.int64))
    plain = [BinData(y_o, None, one), BinData(y_e, u_e, one)]
    points = SharedPoints(problem, plain, records)
    theta = step_near(points, start_shared(problem, plain, records), plain, u_o, records)
    value = points.evaluate(theta)
    data, found = _with_noise(layout, plain, u_o, value.error_of(0), theta)
    if found.through_input is None:
        points.weigh(data)
        solution = refine_shared(problem, points, data, theta, value)
    else:
        solution = minimise_shared(problem, data, records, theta)
    kind = np.array([KINDS.index(name) for name in found.kind])
    return _Round(plain, u_o, data, solution, found.mean_variances, kind)


def _with_noise(
    layout: JointLayout,
    plain: list[BinData],
    u_others: ComplexArray,
    error: ComplexArray,
    theta: FloatArray,
) -> tuple[list[BinData], JointNoise]:
    """Data with the noise that errors (batch M, K_o) between harmonics show, and that noise."""
    records = theta.shape[1]
    bands = NoiseBands.of(layout.other_bins, layout.excited_bins, records)
    noise = noise_of(layout, error, theta[:, 0], u_others, bands, records)
    return weighted(plain, noise, bands, records), noise


def _levels(layout: JointLayout, fitted: _Round, pieces: Pieces) -> Levels:
    by_piece = (fitted.kind == 2) & (fitted.share is not None)
    variance = _residual_variance(layout, fitted)
    u = fitted.data[-1].u
    assert u is not None
    return Levels.of(layout, fitted.solution, u, variance, pieces, by_piece)


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
    power = mean_power(fitted.data[-1].y).reshape(changed.size, -1).mean(axis=1)
    variance = _residual_variance(layout, fitted)
    return changed & (levels.excited * variance.min(axis=-1) > ROUNDED * power)


def _residual_variance(layout: JointLayout, fitted: _Round) -> FloatArray:
    """(batch, K_e) variance of the residuals of each realisation that is weighted with."""
    records = fitted.solution.theta.shape[1]
    return _variance(fitted.data[-1], _response(layout, fitted), records)


def _variance(excited: BinData, g: ComplexArray, records: int) -> FloatArray:
    """(batch, K_e) variance of ``y - g u`` for a response g (batch, K_e): alike in all M rows."""
    variance = excited.rows(slice(None, None, records)).residual_variance(g)
    return np.broadcast_to(variance, g.shape)


def _response(layout: JointLayout, fitted: _Round) -> ComplexArray:
    """(batch, K_e)."""
    alpha, beta, _ = layout.problem.split(fitted.solution.theta[:, 0])
    group = layout.problem.groups[-1]
    return np.asarray(group.evaluate(1, beta) / group.evaluate(0, alpha))


def _from_scatter(layout: JointLayout, fitted: _Round, pieces: Pieces) -> _Round:
    """Excited lines weighted with what realisations differ by, and fitted again."""
    theta = fitted.solution.theta
    records = theta.shape[1]
    g = _response(layout, fitted)
    gain = g.real**2 + g.imag**2
    levels = _levels(layout, fitted, pieces)
    sample = levels.line_variance * _residual_variance(layout, fitted)
    total, kind = smooth_variance(sample, gain, pieces)
    if len(fitted.plain) > 1:
        # of distorted lines with too large weights the transients were wrong, and so the noise
        points = SharedPoints(layout.problem, fitted.plain, records)
        error = points.evaluate(theta).error_of(0)
        data, found = _with_noise(layout, fitted.plain, fitted.u_others, error, theta)
        excited, noise = data[-1], found.mean_variances
        known = _variance(excited, g, records)
        more = np.maximum(total - known, 0).repeat(records, axis=0)
        excited = replace(excited, variance_y=excited.variance_y + more)
        share = known / np.maximum(total, known)
    else:
        data, excited = [], fitted.plain[-1]
        input_noise = levels.excited[:, None] * (layout.input_noise_ratio or 0.0)
        rest = np.maximum(total - input_noise * gain, 1e-3 * total)
        excited = BinData(
            excited.y,
            excited.u,
            rest.repeat(records, axis=0),
            input_noise.repeat(records, axis=0) if layout.input_noise_ratio else None,
        )
        noise = np.stack([rest.mean(axis=-1), input_noise[:, 0]], axis=-1)
        share = np.ones_like(total)
    data = [*data[:-1], excited]
    points = SharedPoints(layout.problem, data, records)
    solution = refine_shared(layout.problem, points, data, theta)
    share = share.repeat(records, axis=0)
    return _Round(fitted.plain, fitted.u_others, data, solution, noise, kind, share)


def _judged(
    layout: JointLayout, fitted: _Round, first: _Round, pieces: Pieces, usable: BoolArray
) -> JointFit:
    """What a round is worth, with what realisations differ by as systems; see `_each_by_itself`."""
    solution, data = fitted.solution, fitted.data
    excited = data[-1]
    batch, records, _ = solution.theta.shape
    a, b, _ = layout.problem.sizes
    levels = _levels(layout, fitted, pieces)
    common = levels.scatter.common / np.sqrt(levels.excited)[:, None]
    suspect = are_smooth(common, layout.structure.parameters)
    if suspect.any():  # what rounding leaves of exact data says nothing
        floor = ROUNDED * mean_power(excited.y).reshape(batch, records).mean(axis=1)
        variance = levels.excited[:, None] * _residual_variance(layout, fitted)
        suspect &= variance.min(axis=-1) > floor
    suspect |= levels.cost > levels.limit
    covariance, total = _covariances(layout, fitted, levels, suspect)
    systematic = np.zeros((batch, layout.structure.order // 2, 2, 2))
    if suspect.any():
        rows = np.flatnonzero(suspect)
        part = [values.rows(rows_of(rows, records)) for values in data]
        systematic[rows] = systematic_of(layout, part, solution.theta[rows])
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
    records = theta.shape[1]
    levels = _levels(layout, first, pieces)
    # gradients as independent lines make them, each with the variance that it shows itself
    line = levels.line_variance.repeat(records, axis=0)
    inner = _normal_of_excited(layout, first, line)
    if len(first.data) > 1:
        inner = inner + levels.between[:, None, None, None] * first.solution.normal[:, :, 0]
    points = SharedPoints(layout.problem, first.data, records)
    spread = Spread.of(layout, points, theta, inner, levels.excited_dof)
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
    noise_alone = fitted.share is None or len(fitted.data) == 1
    return levels.covariances(suspect, None if noise_alone else _noise_normal(layout, fitted))


def _noise_normal(layout: JointLayout, fitted: _Round) -> FloatArray:
    """(batch, M, n, n) covariance of the gradient on excited lines from their noise alone."""
    assert fitted.share is not None
    return _normal_of_excited(layout, fitted, fitted.share)


def _normal_of_excited(layout: JointLayout, fitted: _Round, part: FloatArray) -> FloatArray:
    """(batch, M, n, n) covariance of the gradient on excited lines.

    Parameters
    ----------
    part : (batch M, K_e) float
        Their variance, of that weighted with.
    """
    records = fitted.solution.theta.shape[1]
    variance = _residual_variance(layout, fitted).repeat(records, axis=0)
    excited = fitted.data[-1]
    changed = BinData(excited.y, excited.u, variance / part)
    points = SharedPoints(layout.problem, [*fitted.data[:-1], changed], records)
    return points.normals(points.weight(points.evaluate(fitted.solution.theta)))[1][:, :, -1]
