# SPDX-License-Identifier: Apache-2.0
"""The joint estimator on the bins of a few points: weights, coefficients, levels, and what contradicts.

Bins between harmonics measure the noise. What realisations differ by on excited lines measures noise and
stochastic nonlinear distortion together, and what they have in common whether the model holds; of one
record the cost and the smoothness of the residuals show that, and a search for what the model lacks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.frf.estimate import disagreement
from tactile_resonance.poles.data import BinData, rules_between, with_noise
from tactile_resonance.poles.fit import SEVERAL_MODES, best_of_split, minimise, refit_failed
from tactile_resonance.poles.judgement import Judged
from tactile_resonance.poles.lacking import Lack, asks
from tactile_resonance.poles.levels import DISTORTION_PROBABILITY, Levels, Spread
from tactile_resonance.poles.likelihood import Solution, moments
from tactile_resonance.poles.noise_level import (
    BINS_PER_BAND,
    ROUNDED,
    TINY,
    Pieces,
    are_flat,
    level_of,
    line_pieces,
    noise_at_modes,
    smooth_variance,
    student_variance,
)
from tactile_resonance.poles.significance import are_smooth, systematic_of

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan


# How often the noise is taken anew, and the part by which its variance must turn out smaller for that.
MOST_RETURNS = 4
SAME_LEVEL = 0.1
# The scatter of realisations and the noise are taken anew from a fit that they weigh.
REWEIGHTINGS = 2


@dataclass(frozen=True, eq=False)
class _Round:
    """Data of points with the variances they were weighted with, and their fit.

    Attributes
    ----------
    plan : JointPlan
    plain : BinData
        As they came.
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

    plan: JointPlan
    plain: BinData
    data: BinData
    solution: Solution
    noise: FloatArray
    kind: IntArray
    share: FloatArray | None = None

    @classmethod
    def of(
        cls,
        plan: JointPlan,
        plain: BinData,
        data: BinData,
        start: FloatArray,
        noise: FloatArray,
        kind: IntArray,
        share: FloatArray | None = None,
    ) -> _Round:
        """The fit of weighted data from coefficients (batch, M, n) near the minimum."""
        solution = minimise(plan.problem, data, start)
        refit_failed(plan.problem, solution, data)
        return cls(plan, plain, data, solution, noise, kind, share)

    @classmethod
    def weighted_with_noise(cls, plan: JointPlan, plain: BinData, theta: FloatArray) -> _Round:
        """Weighted with the noise between harmonics that coefficients near the minimum show."""
        data, noise, kind = with_noise(plan, plain, theta)
        return cls.of(plan, plain, data, theta, noise, kind)

    def rows(self, which: IntArray) -> _Round:
        """Some of the points, of a round without `share`."""
        if which.size == self.kind.size:
            return self
        return replace(
            self,
            plain=self.plain.rows(which),
            data=self.data.rows(which),
            solution=self.solution.rows(which),
            noise=self.noise[which],
            kind=self.kind[which],
        )

    @property
    def lines(self) -> IntArray:
        """(batch,) excited lines; 0 of points of which a bin is not finite."""
        lines = np.full(self.kind.size, self.plan.excited_at.size)
        for k in (~np.isfinite(self.solution.cost)).nonzero()[0]:
            y, u = self.plain.y[k], self.plain.u[k]
            lines[k] *= bool(np.isfinite(y).all() and np.isfinite(u).all())
        return lines

    @property
    def anew(self) -> _Round:
        """Weighted with the noise that the fit shows."""
        return self.weighted_with_noise(self.plan, self.plain, self.solution.theta)

    @property
    def level(self) -> FloatArray:
        """(batch,) of the noise between harmonics, in units of that weighted with; NaN without such bins."""
        bins, (used, _) = self.data.records * self.data.undriven, self.solution.leverage.T
        return np.asarray(self.solution.part_cost[:, 0] / (bins - used / 2))

    @cached_property
    def response(self) -> ComplexArray:
        """(batch, K_e) on excited lines."""
        return self.plan.problem.response(self.solution.theta[:, 0])

    @property
    def responses(self) -> tuple[ComplexArray, ComplexArray]:
        """(batch, M, K_e) of each realisation on excited lines, with and without its transient; NaN: no input.

        Of a wrong fit the transients hold part of what realisations differ by; those of a right one hide some.
        """
        problem, data = self.plan.problem, self.data
        (alpha, _, gamma), (of_a, _, of_c) = problem.split(self.solution.theta), problem.driven_bases
        transient = (gamma @ of_c.T) / (alpha @ of_a.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            return data.y_driven / data.u_driven, (data.y_driven - transient) / data.u_driven

    @cached_property
    def variance(self) -> FloatArray:
        """(batch, K_e) of the residuals of each realisation that is weighted with."""
        return np.broadcast_to(self.data.residual_variance(self.response), self.response.shape)

    @cached_property
    def pieces(self) -> Pieces:
        """Of the excited lines, of M >= 2 realisations."""
        return line_pieces(self.data.driven, self.data.records - 1)

    @cached_property
    def levels(self) -> Levels:
        """Of M >= 2 realisations."""
        by_piece = (self.kind == 2) & (self.share is not None)
        u = self.data.u_driven
        return Levels.of(self.plan, self.solution, u, self.variance, self.pieces, by_piece)

    def more_than_rounding(self, level: FloatArray) -> BoolArray:
        """(batch,) whether a level of the residuals is more than rounding leaves of exact data."""
        return np.asarray(level * self.variance.min(axis=-1) > ROUNDED * _mean_power(self.data))

    def normal_of_excited(self, part: FloatArray) -> FloatArray:
        """(batch, M, n, n) covariance of the gradient on excited lines.

        Parameters
        ----------
        part : (batch, K_e) float
            Their variance, of that weighted with.
        """
        none = np.empty((len(part), 0))
        changed = self.data.weighted(
            variance_y=self.variance / part, variance_u=none, covariance_yu=none
        )
        return moments(self.plan.problem.tables, changed, self.solution.theta)[2][:, :, 1]

    def at_modes(self, scale: FloatArray) -> FloatArray:
        """(batch,) factor of the covariance from noise of this level; see `noise_level.noise_at_modes`."""
        factor = np.ones(scale.size)
        rows = ((self.kind > 0) & self.solution.converged).nonzero()[0]
        if rows.size and self.data.undriven:  # one level for all flat bins is known well enough
            part = 1.0 if self.share is None else self.share[rows]
            at = self.data.rows(rows), self.solution.rows(rows), scale[rows]
            factor[rows] = noise_at_modes(self.plan, *at, part)
        return factor

    def covariances(self, suspect: BoolArray) -> tuple[FloatArray, FloatArray]:
        """(batch, s, s) of the coefficients that realisations share, from noise and in total."""
        solution, levels, shared = self.solution, self.levels, sum(self.plan.problem.sizes[:2])
        level, dof = levels.residual_level(suspect)
        between, between_dof = levels.noise_level(suspect)
        nu = levels.piece_dof  # of what realisations differ by, else of the bins between harmonics
        nu = np.where(self.kind == 2, BINS_PER_BAND, 0) if self.share is None else nu
        pieces = np.where(nu > 2, nu / (nu - 2), 1.0)
        first, last = solution.normal[:, :, 0], solution.normal[:, :, 1]
        noise = solution.marginal[:, 0, :shared, :shared]
        if np.isnan(levels.between_dof).all():
            both = 0.5 * (level * student_variance(dof) * pieces)[:, None, None]
            return both * noise, both * noise
        if self.share is None:  # there is no less than the noise
            level = np.where(nu > 1, level * (nu - 1) / nu, level)  # over variances from so few bins it is more
            more = np.maximum(level / between, 1.0)
        else:
            between, between_dof = levels.between, levels.between_dof
            more = level / between
            noise = solution.sandwich(first + self.normal_of_excited(self.share), shared)
        total = solution.sandwich(first + last * more[:, None, None, None], shared)
        at_modes = self.at_modes(between)[:, None, None]
        total += (at_modes - 1) * noise
        noise = at_modes * noise
        scale = 0.5 * between * pieces
        total_dof = np.where(more == 1, between_dof, dof)
        return (
            noise * (scale * student_variance(between_dof))[:, None, None],
            total * (scale * student_variance(total_dof))[:, None, None],
        )


def fit_records(plan: JointPlan, u: ComplexArray, y: ComplexArray) -> Judged:
    """Fits of points.

    Parameters
    ----------
    plan : JointPlan
    u, y : (batch, M, K) complex
        At its bins, of M records each.
    """
    plain = BinData.of(y, _without_rounding(plan, u), plan.order, plan.others_at.size)
    if plain.undriven == 0:
        ratio = plan.input_noise_ratio or 0.0
        data = plain.weighted(variance_u=np.full((len(y), 1), ratio)) if ratio else plain
        solution = minimise(plan.problem, data)
        noise = np.tile([1.0, ratio], (len(y), 1))
    else:
        rules = rules_between(plain.undriven, plain.records)
        solution = minimise(plan.problem, plain, None, rules)
        noise = solution.noise
        variance_y = np.where(noise[:, :1] > TINY, noise[:, :1], 1.0)
        data = plain.weighted(rest=variance_y, variance_y=variance_y, variance_u=noise[:, 1:])
    refit_failed(plan.problem, solution, data)
    if plan.structure.order >= SEVERAL_MODES:
        solution = best_of_split(plan, data, solution)
    return _worth(_Round(plan, plain, data, solution, noise, np.zeros(len(y), np.int64)))


def _without_rounding(plan: JointPlan, u: ComplexArray) -> ComplexArray:
    """Inputs (batch, M, K) that are 0 between harmonics where there is no more than rounding.

    Of an exact input rounding is not flat, and would by chance be weighted like noise that is not.
    """
    if not plan.others_at.size:
        return u
    # one bin of either kind rules most records out
    other, line = (np.abs(u[:, 0, at[0]]) ** 2 for at in (plan.others_at, plan.excited_at))
    rows = (other <= ROUNDED**0.5 * line).nonzero()[0]
    if not rows.size:
        return u
    between, driven = (
        np.mean(np.abs(u[rows][..., at]) ** 2, axis=(1, 2)) for at in (plan.others_at, plan.excited_at)
    )
    exact = rows[between <= ROUNDED * driven]
    if exact.size:
        u = u.copy()
        u[np.ix_(exact, np.arange(u.shape[1]), plan.others_at)] = 0.0
    return u


def _worth(fitted: _Round, returns: int = MOST_RETURNS, changed: BoolArray | bool = True) -> Judged:
    """What a fit is worth; the noise is taken anew from it first where start values showed it badly.

    That is where it turns out smaller or, of one record, is not flat and has `changed` (batch,). Up to so many
    times.
    """
    judge, solution = _alone if fitted.plain.records == 1 else _several, fitted.solution
    badly = (fitted.level < 1 - SAME_LEVEL) | ((fitted.kind > 0) & changed & (judge is _alone))
    rows = ((badly & solution.converged) | ~solution.plain).nonzero()[0]
    if not (rows.size and returns):
        return judge(fitted)
    changed = (np.abs(fitted.level - 1) > SAME_LEVEL) | ~solution.plain
    anew = _worth(fitted.rows(rows).anew, returns - 1, changed[rows])
    if rows.size == badly.size:
        return anew
    solution.plain[rows] = solution.converged[rows] = False  # nothing more is asked of these
    judged = judge(fitted)
    judged.put(rows, anew)
    return judged


def _alone(fitted: _Round) -> Judged:
    """What a fit of one record is worth."""
    plan = fitted.plan
    solution, data = fitted.solution, fitted.data
    theta, inverse = solution.theta[:, 0], solution.marginal[:, 0]
    batch = len(theta)
    scale, cost, expected, suspect, noise, correction = level_of(
        plan, solution, fitted.noise, fitted.kind == 2
    )
    residual = solution.residual[:, 0] * (1 / np.sqrt(scale))[:, None]
    suspect = are_smooth(residual, plan.structure.parameters) | suspect
    asked = solution.converged
    if batch > 1:
        asked = asked & (suspect | asks(plan, cost, expected, residual))
    lack = Lack.of(plan, data, solution, asked)
    suspect = suspect | np.isfinite(lack.found[:, 0])
    doubted = suspect | (lack.chi_square > 0)
    if doubted.any():  # what rounding leaves of exact data says nothing
        rows = np.flatnonzero(doubted)
        of_noise = (scale * data.variance_y.min(axis=1))[rows]
        doubted[rows] = of_noise > ROUNDED * _mean_power(data.rows(rows))
        suspect &= doubted
        lack.found[~suspect] = np.nan
    lack = lack.only_where(doubted & ~suspect)
    wrong = suspect & solution.plain
    # real and imaginary part of a circular complex error have half its variance each
    covariance = inverse * (0.5 * scale * correction * fitted.at_modes(scale))[:, None, None]
    known = plan.level_known
    return Judged.of(
        plan,
        fitted.lines,
        theta=theta,
        condition_number=solution.condition,
        converged=solution.converged,
        residual=residual,
        cost=cost,
        expected_cost=expected,
        suspect=suspect,
        covariance=covariance if known else np.full_like(covariance, np.nan),
        total=None if known else covariance,
        kind=fitted.kind,
        level_known=np.full(batch, known),
        noise_variance=noise,
        systematic=systematic_of(plan, data, solution.theta, wrong),
        lacking=lack.found,
        doubt=lack.doubt,
        remark=lack.remarks,
    )


def _mean_power(data: BinData) -> FloatArray:
    """(batch,) mean square of Y on excited lines."""
    y = data.y_driven
    return np.asarray(np.mean(y.real**2 + y.imag**2, axis=(1, 2)))


def noise_of_moving_modes(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, theta: FloatArray
) -> float:
    """Factor of the covariance of a fit to one record, for noise at its modes that the fit does not count.

    Such noise passes for flat in few bins; a mode that moves makes it.

    Parameters
    ----------
    plan : JointPlan
        Of several periods.
    u, y : (K,) complex
    theta : (n,) float
        The fit.
    """
    plain = BinData.of(y[None, None], u[None, None], plan.order, plan.others_at.size)
    fitted = _Round.weighted_with_noise(plan, plain, theta[None, None])
    if fitted.kind[0] > 0 or not fitted.solution.converged[0]:
        return 1.0
    scale, *_ = level_of(plan, fitted.solution, fitted.noise, np.zeros(1, bool))
    return float(noise_at_modes(plan, fitted.data, fitted.solution, scale)[0])


def _several(first: _Round) -> Judged:
    """What a fit of M >= 2 realisations of the phases is worth: one system, transients of their own.

    Each counts by its own noise, where noise is all there is: of distortion nobody knows how much is in each.
    """
    judged, std, own = _together(first), _noise_of_each(first), first.plan.problem.sizes[2]
    rows = np.flatnonzero(first.solution.plain & np.any(std != 1, axis=1))
    if rows.size:
        by, theta = std[rows, :, None], first.solution.theta[rows]
        theta[..., -own:] /= by
        plain = first.plain.rows(rows)
        plain = plain._replace(y=plain.y / by, u=plain.u / by)
        alike = _Round.weighted_with_noise(first.plan, plain, theta)
        noise_alone = np.flatnonzero(~(alike.levels.distorted() | alike.levels.contradicts))
        rows, of_alike = rows[noise_alone], _together(alike.rows(noise_alone))
        of_alike.theta[:, -std.shape[1] * own :] *= std[rows].repeat(own, axis=1)
        judged.put(rows, of_alike)
    return judged


def _noise_of_each(fitted: _Round) -> FloatArray:
    """(batch, M) deviation of the noise of each realisation, of mean square 1; 1 where chance explains them.

    From logarithms of the powers of errors between harmonics, which differ from one realisation to another by
    those of their noise, whatever its spectrum, and have a variance of ``pi^2 / 6`` each.
    """
    plan, data, others = fitted.plan, fitted.plain, fitted.plan.others_at
    if not others.size:
        return np.ones(data.y.shape[:2])
    alpha, beta, gamma = plan.problem.split(fitted.solution.theta)
    error = (alpha @ plan.denominator_basis.values[others].T) * data.y[..., others]
    error = error - (beta @ plan.numerator_on_bins[others].T) * data.u[..., others]
    log_power = 2 * np.log(np.abs(error - gamma @ plan.transient_on_bins[others].T)).mean(axis=-1)
    variance = np.exp(log_power - log_power.mean(axis=1, keepdims=True))
    chi_square = others.size * np.sum(np.log(variance) ** 2, axis=1) / (np.pi**2 / 6)
    differ = chi_square > special.chdtri(data.records - 1, DISTORTION_PROBABILITY)
    return np.where(differ[:, None], np.sqrt(variance / variance.mean(axis=1, keepdims=True)), 1.0)


def _together(first: _Round) -> Judged:
    """What a fit of realisations that are equally noisy is worth."""
    rows = np.flatnonzero(first.solution.plain & _weighted_wrongly(first))
    if 0 < rows.size == first.kind.size:
        return _with_scatter(first)
    judged = _judged(first, first)
    if rows.size:
        judged.put(rows, _with_scatter(first.rows(rows)))
    return judged


def _with_scatter(first: _Round) -> Judged:
    """What a fit is worth whose lines are weighted with what realisations differ by."""
    second = first
    for _ in range(REWEIGHTINGS):
        second = _from_scatter(second)
    return _judged(second, first)


def _weighted_wrongly(fitted: _Round) -> BoolArray:
    """(batch,) where realisations differ on excited lines by more than the variances weighted with say.

    By more than chance, on the whole or from line to line.
    """
    plan, levels, pieces = fitted.plan, fitted.levels, fitted.pieces
    changed = levels.distorted()
    if pieces.starts.size > 1:
        changed = changed | ~are_flat(pieces.means(levels.line_variance), pieces.dof)
    if fitted.data.undriven == 0 and plan.input_noise_ratio is None:
        changed[:] = True  # nothing is known of the weights but what realisations differ by
    return changed & fitted.more_than_rounding(levels.excited)


def _from_scatter(fitted: _Round) -> _Round:
    """Excited lines weighted with what realisations differ by, and fitted again."""
    plan, levels, theta, g = fitted.plan, fitted.levels, fitted.solution.theta, fitted.response
    gain = g.real**2 + g.imag**2
    total, kind = smooth_variance(levels.line_variance * fitted.variance, gain, fitted.pieces)
    if fitted.data.undriven:
        # of distorted lines with too large weights the transients were wrong, and so the noise
        data, noise, of_noise = with_noise(plan, fitted.plain, theta)
        known = np.broadcast_to(data.residual_variance(g), g.shape)
        data = data.weighted(variance_y=data.variance_y + np.maximum(total - known, 0))
        share = known / np.maximum(total, known)
        kind = np.maximum(kind, of_noise)
    else:
        input_noise = levels.excited[:, None] * (plan.input_noise_ratio or 0.0)
        rest = np.maximum(total - input_noise * gain, 1e-3 * total)
        data = fitted.plain.weighted(variance_y=rest)
        if plan.input_noise_ratio:
            data = data.weighted(variance_u=input_noise)
        noise = np.stack([rest.mean(axis=-1), input_noise[:, 0]], axis=-1)
        share = np.ones_like(total)
    return _Round.of(plan, fitted.plain, data, theta, noise, kind, share)


def _judged(fitted: _Round, first: _Round) -> Judged:
    """What a round is worth, with what realisations differ by as systems; see `_each_by_itself`."""
    plan, solution, levels = fitted.plan, fitted.solution, fitted.levels
    batch, records, _ = solution.theta.shape
    a, b, own = plan.problem.sizes
    common = levels.common / np.sqrt(levels.excited)[:, None]
    # of exact data; what a wrong model leaves differs, too: each transient takes up another part of it
    noisy = fitted.more_than_rounding(levels.excited)
    suspect = (are_smooth(common, plan.structure.parameters) | levels.contradicts) & noisy
    asked = solution.converged & (suspect | (batch == 1)) & (fitted.kind < 2)
    lack = Lack.of(plan, fitted.data, solution, asked & noisy)
    suspect |= np.isfinite(lack.found[:, 0])
    covariance, total = fitted.covariances(suspect)
    theta = solution.theta
    judged = Judged.of(
        plan,
        fitted.lines,
        theta=np.concatenate(
            [theta[:, 0, : a + b], theta[..., a + b :].reshape(batch, records * own)], axis=1
        ),
        condition_number=solution.condition,
        converged=solution.converged,
        residual=common,
        cost=levels.cost,
        expected_cost=levels.expected,
        suspect=suspect,
        covariance=covariance,
        total=total,
        kind=fitted.kind,
        noise_variance=fitted.noise * levels.noise_level(suspect)[0][:, None],
        systematic=systematic_of(plan, fitted.data, theta, suspect),
        lacking=lack.found,
    )
    judged = _each_by_itself(judged, total, first)
    lack = lack.only_where(~judged.suspect)
    return replace(
        judged,
        doubt=lack.doubt,
        remark=np.where(judged.remark == "", lack.remarks, judged.remark),
    )


def _each_by_itself(fit: Judged, total: FloatArray, first: _Round) -> Judged:
    """With the scatter of the poles of each realisation in the total covariance.

    Where lines are distorted the resonator is not linear. Then its poles are the mean of those of all
    realisations, of the first round, weighted with the noise. Weighted with the distortion of each line
    a resonance that differs would count least, and the bins between harmonics most, where the ringing up
    of a resonator that is not linear points to another system.
    """
    theta, levels = first.solution.theta, first.levels
    # gradients as independent lines make them, each with the variance that it shows itself
    inner = first.normal_of_excited(levels.line_variance)
    if first.data.undriven:
        inner = inner + levels.between[:, None, None, None] * first.solution.normal[:, :, 0]
    spread = Spread.of(first.plan, first.data, theta, inner, levels.excited_dof)
    distorted = levels.distorted() & spread.known
    weight = np.where(distorted, 1.0, spread.weight)
    covariance = fit.covariance
    if distorted.any():
        of_first = first.covariances(np.zeros(weight.size, bool))
        covariance, total = (
            np.where(distorted[:, None, None], one, other)
            for one, other in zip(of_first, (covariance, total), strict=True)
        )
    changed, systematic = fit.theta.copy(), fit.systematic.copy()
    shared = total.shape[1]
    changed[distorted, :shared] = (theta[:, 0, :shared] + spread.step)[distorted]
    more = spread.variance_of_mean(distorted) - spread.of_poles(total)
    for k in (0, 1):
        systematic[..., k, k] += weight[:, None] * np.maximum(np.nan_to_num(more[..., k]), 0.0)
    odd, remark = spread.remarks()
    wrong = np.zeros(odd.size, bool)
    for response in first.responses:
        differ = levels.excited / levels.between
        remarks, of_no_system = disagreement(response, first.data.u_driven, differ)
        remark = np.where(remarks != "", remarks, remark)
        wrong |= remarks != ""
        unknown = of_no_system[:, None, None]
        if np.any(unknown):  # what is left of their mean is of no system
            covariance, total = (np.where(unknown, np.nan, one) for one in (covariance, total))
    return replace(
        fit,
        theta=changed,
        covariance=covariance,
        total=total,
        suspect=fit.suspect | odd | wrong,
        systematic=systematic,
        remark=remark,
    )
