# SPDX-License-Identifier: Apache-2.0
"""Lines of an FRF (input 1), or of input and output spectra: what they are weighted with, and their fit.

Sample maximum likelihood: the cost weighs with sample variances (Pintelon & Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. (2012), chapter 12).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles import likelihood
from tactile_resonance.poles.compiled import entry, inner
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import (
    Linearised,
    exchanged,
    least_squares,
    linear_step,
    minimise,
    moved_to,
)
from tactile_resonance.poles.likelihood import Rules, Solution
from tactile_resonance.poles.model import RationalModel, real_rows
from tactile_resonance.poles.noise_level import FALSE_ALARM, VarianceModel, at_modes, model_variance
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.poles.tables import FitPlan, Problem

# Degrees of freedom that stand for a covariance known exactly.
EXACT = 10**6
# Of the input's noise seen at the output.
LEAST_OUTPUT_NOISE = 1e-12
# Beyond this condition number normal equations are not trusted and the Jacobian itself is
# factorised.
NORMAL_EQUATIONS_LIMIT = 1e5
# Models of more poles than this go to the dense solver at once.
LARGEST_BATCHED_ORDER = 6
REBASE_ITERATIONS = 40
ONLY_START = Rules(iterations=0)
# Starts for a delay within a radian over the band.
FINEST_DELAY = 50
# Bases follow the denominator until it changes by less than this from one iteration to the next.
REBASE_TOLERANCE = 1e-2


@dataclass(frozen=True, eq=False)
class WeightedLines:
    """Lines of a batch of points.

    Attributes
    ----------
    data : BinData
        With variances that are infinite on lines left out.
    known : VarianceModel
        What is known of these variances; says nothing of points without any.
    level_known : (batch,) bool
        Whether there is a variance above 0 at all; points without are weighted alike on all lines.
    total_known : bool
        Whether the variance is of noise and distortion.
    noise : (batch, F) float or None
        Variance from noise alone, where it is known as well then.
    sample : BinData
        As `data`, with the variances of each line as they were given.
    """

    data: BinData
    known: VarianceModel
    level_known: BoolArray
    sample: BinData
    total_known: bool = False
    noise: FloatArray | None = None

    def noise_at_modes(self, plan: LinesPlan, solution: Solution) -> FloatArray:
        """(batch,) factor of the covariance of a fit; see `noise_level.at_modes`."""
        known = self.known
        if not (known.kind < 2).any():
            return np.ones(len(self.data.y))
        theta, problem = solution.theta[:, 0], plan.problem
        poles = plan.poles_in_band(theta)
        sensitivity = plan.model_of(theta).residues_and_sensitivity(poles)[1]  # (batch, places, a)
        taken = real_rows(sensitivity) @ solution.marginal[:, :, : sensitivity.shape[-1]]
        phase = np.empty(0) if plan._delay_phase is None else plan._delay_phase
        bases = (np.stack([of.real.T, of.imag.T]) for of in problem.driven_bases[:2])
        ratio, squares = np.empty((2, *taken.shape[:-1]))
        ratio_at_modes(taken, theta, *bases, phase, self.data, self.sample, ratio, squares)
        each = known.dof if known.independent_dof is None else known.independent_dof
        return np.where(known.kind < 2, at_modes(ratio, each / squares), 1.0)


@inner
def _add_series(coefficients, basis, sums):
    """Add the series of real coefficients over the first rows of a basis (2, terms, K) to sums (2, K)."""
    for part in range(2):
        for i in range(coefficients.size):
            for k in range(sums.shape[1]):
                sums[part, k] += coefficients[i] * basis[part, i, k]


@entry
def ratio_at_modes(taken, theta, basis_a, basis_b, phase, data, sample, ratios, squares):
    """Of the lines that poles are known from, the mean ratio of a sample's variance to that of the data.

    And the sum of the squares of their shares in the variance, into the last two (points, places, 2), for the
    real and the imaginary part. `taken` (points, places, 2, n) are the derivatives of these by the gradient of
    the cost, of coefficients theta (points, n) over the bases (2, terms, K), real and imaginary part; `phase`
    (K,) is that of a unit of delay, if there is one.
    """
    points, places, _, n = taken.shape
    bins, a, b = basis_a.shape[2], basis_a.shape[1] - 1, basis_b.shape[1]
    variance, ratio, weight, g = np.empty(bins), np.empty(bins), np.empty(bins), np.empty((2, bins))
    of_a, of_b, by_a, by_b = np.empty((2, bins)), np.empty((2, bins)), np.empty((2, bins)), np.empty((2, bins))
    for point in range(points):
        of_a[:], of_b[:] = basis_a[:, a], 0.0
        _add_series(theta[point, :a], basis_a, of_a)
        _add_series(theta[point, a : a + b], basis_b, of_b)
        same = min(point, data.u.shape[0] - 1)
        for k in range(bins):
            inverse = 1 / (of_a[0, k] * of_a[0, k] + of_a[1, k] * of_a[1, k])
            g[0, k] = (of_b[0, k] * of_a[0, k] + of_b[1, k] * of_a[1, k]) * inverse
            g[1, k] = (of_b[1, k] * of_a[0, k] - of_b[0, k] * of_a[1, k]) * inverse
            u = data.u[same, 0, k]
            weight[k] = (u.real * u.real + u.imag * u.imag) * inverse
        for k in range(bins):
            variance[k], ratio[k] = data.variance_y[point, k], sample.variance_y[point, k]
        if data.variance_u.shape[1] > 0:
            for k in range(bins):
                power = g[0, k] * g[0, k] + g[1, k] * g[1, k]
                variance[k] += data.variance_u[point, k] * power
                ratio[k] += sample.variance_u[point, k] * power
        if data.covariance_yu.shape[1] > 0:
            for k in range(bins):
                turned = complex(g[0, k], -g[1, k])
                if phase.size:
                    turned *= np.exp(1j * phase[k] * theta[point, n - 1])
                variance[k] -= 2 * (data.covariance_yu[point, k] * turned).real
                ratio[k] -= 2 * (sample.covariance_yu[point, k] * turned).real
        for k in range(bins):  # 0 where it is infinite
            inverse = 1 / variance[k]
            ratio[k] *= inverse
            weight[k] *= inverse
        for place in range(places):
            for part in range(2):
                by = taken[point, place, part]
                by_a[:], by_b[:] = 0.0, 0.0
                _add_series(by[:a], basis_a, by_a)
                _add_series(by[a : a + b], basis_b, by_b)
                if phase.size:
                    for k in range(bins):
                        by_b[0, k] += by[n - 1] * phase[k] * of_b[1, k]
                        by_b[1, k] -= by[n - 1] * phase[k] * of_b[0, k]
                total = mean = square = 0.0
                for k in range(bins):
                    re = by_b[0, k] - g[0, k] * by_a[0, k] + g[1, k] * by_a[1, k]
                    im = by_b[1, k] - g[0, k] * by_a[1, k] - g[1, k] * by_a[0, k]
                    share = weight[k] * (re * re + im * im)
                    total += share
                    mean += share * ratio[k]
                    square += share * share
                ratios[point, place, part], squares[point, place, part] = mean / total, square / (total * total)


def lines_of_frf(frf: FRF) -> WeightedLines:
    """Of an FRF with (..., F) arrays as `identify` checks it; its lines are those of the band."""
    flat_shape = math.prod(frf.g.shape[:-1]), frf.frequency_hz.size
    g = frf.g.reshape(flat_shape)
    usable = np.isfinite(g)
    level_known = np.full(flat_shape[0], frf.variance is not None and frf.dof > 0)
    variance, noise = np.ones(flat_shape), None
    if frf.variance_noise is not None and frf.variance_total is not None:
        noise = frf.variance_noise.reshape(flat_shape)
    if frf.variance is not None and frf.dof > 0:
        variance = frf.variance.reshape(flat_shape)
        weighted = usable & (variance > 0) & (variance < np.inf)
        if noise is not None:
            of_noise = (noise > 0) & (noise < np.inf)
            weighted &= of_noise | ~of_noise.any(axis=-1, keepdims=True)
        if not weighted.all():
            level_known = np.asarray((usable & (variance > 0)).any(axis=-1))
            variance = np.where(level_known[:, None], variance, 1.0)
            usable = np.where(level_known[:, None], weighted, usable)
    if not usable.all():
        g = np.where(usable, g, 0.0)
        variance = np.where(usable, variance, np.nan)
    known = model_variance(variance, max(frf.dof, 1), g.real**2 + g.imag**2)
    weights = known.variance
    if not level_known.all():
        power = np.where(usable, _power(g, usable), np.inf)
        weights = np.where(level_known[:, None], weights, power)
    if frf.variance_total is None and frf.periods > 1:
        # noise is from bins between lines: neighbours share them where periods are few
        bins = (frf.periods - 1) * frf.realisations
        known = replace(known, independent_dof=min(frf.dof, bins))
    data = BinData.of(g[:, None], np.ones((1, 1, g.shape[1])), variance_y=weights)
    return WeightedLines(
        data,
        known,
        level_known,
        data.weighted(variance_y=np.where(usable, variance, 1.0)),
        frf.variance_total is not None,
        noise,
    )


def lines_of_spectra(
    spectra: ComplexArray, covariance: ComplexArray, dof: int, pooled: bool
) -> WeightedLines:
    """Of spectra (..., 2, F) with covariance (..., 2, 2, F); see `identify.identify_spectra`."""
    points, lines = math.prod(spectra.shape[:-2]), spectra.shape[-1]
    z = spectra.reshape(points, 2, lines)
    c = covariance.reshape(points, 2, 2, lines)
    usable = np.isfinite(z).all(axis=-2) & np.isfinite(c).all(axis=(-3, -2))
    noise_y, noise_u = (usable & (c[:, k, k].real > 0) for k in (0, 1))
    level_known = np.asarray((noise_y | noise_u).any(axis=-1))
    # where other lines of a channel have a variance, it is unknown on a line without one
    usable &= noise_y | ~noise_y.any(axis=-1, keepdims=True)
    usable &= noise_u | ~noise_u.any(axis=-1, keepdims=True)
    z = np.where(usable[:, None], z, 0.0)
    c_yy, c_uu = (np.where(usable, c[:, k, k].real, 0.0) for k in (0, 1))
    c_yu = np.where(usable, c[:, 0, 1], 0.0)
    model_y, model_u = (_channel(x, usable, dof, pooled) for x in (c_yy, c_uu))
    known = replace(
        model_y,
        lines=usable.sum(axis=-1),
        dof=dof if dof > 0 else EXACT,
        kind=np.maximum(model_y.kind, model_u.kind),
    )
    smooth_y, smooth_u = (np.where(usable, m.variance, 0.0) for m in (model_y, model_u))
    both = np.sqrt(smooth_y * smooth_u)
    of_line = np.asarray(c_yu / _or_one(both), complex)
    correlation = of_line.sum(axis=-1, keepdims=True)
    varies = _varies(of_line, correlation, usable, dof)
    known = replace(known, kind=np.where(varies, 2, known.kind))
    together = known.kind[:, None] < 2
    correlation /= np.maximum(known.lines[:, None], np.abs(correlation))  # 1 at most
    sample = {"variance_y": c_yy, "variance_u": c_uu, "covariance_yu": c_yu}
    c_yu = np.where(together, correlation * both, c_yu)
    c_yy, c_uu = (np.where(together, *pair) for pair in ((smooth_y, c_yy), (smooth_u, c_uu)))
    power_y, power_u = (_power(x, usable) for x in (z[:, 0], z[:, 1]))
    # all the noise may be in the input, but weights of start values are from the output's
    c_yy = np.maximum(c_yy, LEAST_OUTPUT_NOISE * c_uu * power_y / power_u)
    c_yy = np.where(level_known[:, None], c_yy, power_y)
    data = BinData.of(
        z[:, :1],
        z[:, 1:],
        variance_y=np.where(usable, c_yy, np.inf),
        variance_u=c_uu,
        covariance_yu=c_yu,
    )
    return WeightedLines(data, known, level_known, data.weighted(**sample))


def _channel(variance: FloatArray, usable: BoolArray, dof: int, pooled: bool) -> VarianceModel:
    """Of one channel: pooled over the band where a test allows it; exact ones line by line."""
    lines = usable.sum(axis=-1)
    if dof <= 0 or not pooled:
        return VarianceModel(variance, lines, max(dof, 1), np.full(lines.shape, 2))
    model = model_variance(np.where(usable, variance, np.nan), dof)
    # a channel without noise is as flat as any
    noisy = np.asarray((variance > 0).any(axis=-1))[:, None]
    return replace(model, variance=np.where(noisy, model.variance, 0.0))


def _varies(of_line: ComplexArray, total: ComplexArray, usable: BoolArray, dof: int) -> BoolArray:
    """(batch,) whether sample correlations (batch, F) scatter about their mean by more than chance allows.

    `total` (batch, 1) is their sum. Of `dof` degrees of freedom they scatter by 1 / dof each, whatever the
    correlation; the square of that has a relative variance of 2 + 6 / dof at most, where the channels are one.
    """
    lines = usable.sum(axis=-1)
    if dof <= 0:
        return np.zeros(lines.shape, bool)
    apart = np.where(usable, of_line - total / np.maximum(lines, 1)[:, None], 0.0)
    scatter = dof * np.sum(apart.real**2 + apart.imag**2, axis=-1) / np.maximum(lines - 1, 1)
    shape = np.maximum(lines - 1, 1) / (2 + 6 / dof)
    return np.asarray(scatter > special.gammainccinv(shape, FALSE_ALARM) / shape)


def _power(values: ComplexArray, usable: BoolArray) -> FloatArray:
    """(batch, 1) mean square of the usable lines; 1 where there is none above 0."""
    power = np.where(usable, values.real**2 + values.imag**2, 0.0).sum(axis=-1, keepdims=True)
    return _or_one(power / np.maximum(usable.sum(axis=-1, keepdims=True), 1))


def _or_one(values: FloatArray) -> FloatArray:
    return np.where(values > 0, values, 1.0)


@dataclass(frozen=True, eq=False)
class LinesPlan(FitPlan):
    """What a fit on given lines needs whatever the data.

    Coefficients (batch, n) are [A without its last, B], and a delay over `delay_unit_s` if asked for.

    Attributes
    ----------
    lines_hz : (F,) float
    structure : ModelStructure
    band_hz : (low, high)
    start_size : (F,) float or None
        ``|A|`` that start values begin from, in a rebased plan.
    weights : pair of (F,) float or None
        In which the bases of A and of B are orthonormal there.
    """

    lines_hz: FloatArray
    structure: ModelStructure
    band_hz: tuple[float, float]
    start_size: FloatArray | None = None
    weights: tuple[FloatArray, FloatArray] | None = None

    @classmethod
    def on_lines(
        cls, frequency_hz: FloatArray, structure: ModelStructure, band_hz: tuple[float, float]
    ) -> LinesPlan:
        """Plan with bases orthonormal on the lines; the latest ones are kept."""
        return _plan(np.ascontiguousarray(frequency_hz, float).tobytes(), structure, band_hz)

    def with_structure(self, structure: ModelStructure) -> LinesPlan:
        """The plan of another structure."""
        return LinesPlan.on_lines(self.frequency_hz, structure, self.band_hz)

    @property
    def frequency_hz(self) -> FloatArray:
        """(F,) the lines."""
        return self.lines_hz

    @cached_property
    def problem(self) -> Problem:
        """Driven bins without a transient."""
        none = np.empty((self.frequency_hz.size, 0), complex)
        return Problem(self.denominator_basis.values, self.numerator_basis.values, none)

    @cached_property
    def delay_unit_s(self) -> float:
        """A radian at the highest line."""
        return 1 / (2 * np.pi * float(self.frequency_hz.max()))

    @cached_property
    def _delay_phase(self) -> FloatArray | None:
        """(F,) phase by a unit of delay; None where none is asked for."""
        if not self.structure.delay:
            return None
        return np.asarray(2 * np.pi * self.frequency_hz * self.delay_unit_s)

    def model_of(self, theta: FloatArray) -> RationalModel:
        """The model of coefficients (..., n)."""
        if not self.structure.delay:
            return super().model_of(theta)
        unit_s = self.delay_unit_s
        return replace(super().model_of(theta[..., :-1]), delay_s=theta[..., -1] * unit_s, delay_unit_s=unit_s)

    @property
    def _one_by_one(self) -> bool:
        """Whether the compiled fit does not have the model."""
        return self.structure.delay or self.structure.order > LARGEST_BATCHED_ORDER

    def batched(self, data: BinData) -> tuple[LinesPlan, Solution]:
        """As `FitPlan.batched`; at full precision models that the compiled fit does not have."""
        if not self._one_by_one:
            return super().batched(data)
        return (self if self.structure.delay else self.settled(data))._fit_dense(data)

    def fit(self, data: BinData) -> tuple[LinesPlan, Solution]:
        """As `batched`; at full precision what does not converge or is ill-conditioned, too."""
        plan, solution = self.batched(data)
        if self._one_by_one:
            return plan, solution
        converged, condition = solution.converged, solution.condition
        doubtful = np.flatnonzero(~converged | ~(condition < NORMAL_EQUATIONS_LIMIT))
        if len(data.y) == 1 and doubtful.size:
            return self.rebased(data)._fit_dense(data)
        for k in doubtful:
            dense = least_squares(self.problem, data.rows(slice(k, k + 1)))
            if dense.cost[0] <= solution.cost[k] * (1 + 1e-9) or not converged[k]:
                solution.put(np.array([k]), dense)
        return self, solution

    def compared(self, data: BinData, start: FloatArray | None = None) -> ComplexArray:
        """As `FitPlan.compared`, from start values; of what the batched solver cannot do a whole fit."""
        if not self._one_by_one:
            return super().compared(data)
        plan, solution = self.batched(data)
        return plan.poles_in_band(solution.theta[:, 0])

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def rebased(self, data: BinData) -> LinesPlan:
        """Plan with bases orthonormal in the weights of the fit itself.

        Polynomials orthonormal on the lines still make ill-conditioned rational functions where |A|
        spans many decades: many poles, wide bands. Sanathanan-Koerner iterations that
        orthonormalise anew in ``1 / |A|^2`` bring the condition number to a few units (Bultheel,
        Van Barel, Rolain, Pintelon, *Numerically robust transfer function modeling from noisy
        frequency domain data*, IEEE Trans. Autom. Control 50 (2005) 1835-1839). The first point
        with finite weights stands for all.
        """
        row, plan = _first_usable(data), self
        size = np.ones(self.frequency_hz.size)
        for _ in range(REBASE_ITERATIONS):
            of_size = plan.of_size(row, size)
            if of_size is None:
                break
            plan = of_size
            theta = linear_step(plan.problem, row, np.sqrt(size))
            alpha = np.append(theta[: self.structure.order], 1.0)
            last, size = size, np.abs(plan.problem.denominator @ alpha) ** 2
            if not (np.isfinite(size).all() and (size > 0).all()):
                return replace(plan, start_size=None)
            if np.ptp(np.log(size / last)) < REBASE_TOLERANCE:
                break
        return plan if plan is self else replace(plan, start_size=np.sqrt(size))

    def settled(self, data: BinData) -> LinesPlan:
        """Plan with bases that suit the deepest minimum of the first point with finite weights."""
        plan = self.rebased(data)
        if self.structure.delay:
            return plan
        row = _first_usable(data)
        found = least_squares(plan.problem, row, None, None, plan.start_size)
        return exchanged(plan, row, found)[0] if np.isfinite(found.cost[0]) else plan

    def of_size(self, row: BinData, size: FloatArray) -> LinesPlan | None:
        """Plan with bases orthonormal in the weights of a point where ``|A|^2`` is `size` (F,).

        None where weights are not finite.
        """
        y, u = row.y[0, 0], row.u[0, 0]
        weight = 1 / (row.variance[0] * size)
        weight_y, weight_u = weight * np.abs(y) ** 2, weight * np.abs(u) ** 2
        mean_y, mean_u = weight_y.mean(), weight_u.mean()
        if not (np.isfinite([mean_y, mean_u]).all() and mean_y > 0 and mean_u > 0):
            return None
        weights = weight_y / mean_y, weight_u / mean_u
        plan = replace(self, start_size=np.sqrt(size), weights=weights)
        bases = plan.denominator_basis, plan.numerator_basis
        return plan if np.isfinite([basis.hessenberg.sum() for basis in bases]).all() else None

    @np.errstate(divide="ignore", invalid="ignore")
    def propagated(self, solution: Solution, data: BinData, noise: FloatArray) -> FloatArray:
        """Covariance (batch, n, n) of a solution where the variance (batch, F) is not that of `data`."""
        finite, by_one = np.isfinite(data.variance_y), self.structure.delay or self.weights is not None
        alone = by_one | ~(solution.condition < NORMAL_EQUATIONS_LIMIT)
        inverse = solution.marginal[:, 0]
        covariance = np.full_like(inverse, np.nan)
        if not alone.all():
            more = data.weighted(variance_y=np.where(finite, data.variance_y**2 / noise, np.inf))
            normal = likelihood.moments(self.problem.tables, more, solution.theta)[2][:, 0, 1]
            covariance[~alone] = (0.5 * inverse @ normal @ inverse)[~alone]
        for k in np.flatnonzero(alone):
            row, used = data.rows(slice(k, k + 1)), finite[k]
            at = Linearised.of(self.problem, row, solution.theta[k, 0], self._delay_phase)
            jacobian = at.jacobian[0, used].reshape(-1, covariance.shape[-1])  # (2 F, n)
            column = np.linalg.norm(jacobian, axis=0)
            if np.isfinite(column).all() and (column > 0).all():
                ratio = np.repeat(noise[k, used] / data.variance_y[k, used], 2)
                of_lines = np.linalg.pinv(jacobian / column) / column[:, None]
                covariance[k] = 0.5 * (of_lines * ratio) @ of_lines.T
        return covariance

    def _fit_dense(self, data: BinData) -> tuple[LinesPlan, Solution]:
        """Point by point."""
        each = [self._best_of_starts(data.rows(slice(k, k + 1))) for k in range(len(data.y))]
        return self, Solution(*map(np.concatenate, zip(*each, strict=True)))

    def _best_of_starts(self, row: BinData) -> Solution:
        """Of several starts the one with the least cost."""
        phase, starts = self._delay_phase, list[FloatArray | None]([None])
        if phase is not None:
            starts = delay_starts(self.problem, row, phase)
        solutions = [
            least_squares(self.problem, row, start, phase, self.start_size) for start in starts
        ]
        finite = [s for s in solutions if np.isfinite(s.cost[0])]
        best = min(finite or solutions, key=lambda s: float(s.cost[0]))
        if phase is None and finite and self.structure.order > LARGEST_BATCHED_ORDER:
            best = moved_to(self, row, *exchanged(self, row, best))
        return best


@lru_cache(maxsize=16)
def _plan(
    frequency_hz: bytes, structure: ModelStructure, band_hz: tuple[float, float]
) -> LinesPlan:
    return LinesPlan(np.frombuffer(frequency_hz), structure, band_hz)


def _first_usable(data: BinData) -> BinData:
    """The first point with finite weights."""
    k = int(np.argmax(np.isfinite(data.variance_y).any(axis=-1)))
    return data.rows(slice(k, k + 1))


def delay_starts(problem: Problem, row: BinData, phase: FloatArray) -> list[FloatArray | None]:
    """Starts with the delay removed beforehand, from minus two to twelve radians over the band.

    The cost has many minima in the delay, half a turn of phase apart: over the band or, where B has too few
    terms to turn the response, at the lines. The grid is of a quarter of a radian there; its three best minima
    begin.
    """
    over_band = 1.0 / max(float(np.ptp(phase)), 1e-12)
    step = max(0.25, over_band / FINEST_DELAY)
    delays = step * np.arange(math.ceil(-2 * over_band / step), 12 * over_band / step)
    all_of_row = row.rows(np.zeros(delays.size, np.int64))
    turned = all_of_row._replace(y=row.y * np.exp(1j * delays[:, None, None] * phase))
    begun = minimise(problem, turned, None, ONLY_START)
    cost = np.where(np.isfinite(begun.theta).all(axis=(1, 2)), begun.cost, np.inf)
    beside = np.minimum(np.append(np.inf, cost[:-1]), np.append(cost[1:], np.inf))
    least = np.flatnonzero(np.isfinite(cost) & (cost <= beside))
    best = least[np.argsort(cost[least], kind="stable")[:3]]
    return [np.append(begun.theta[k, 0], delays[k]) for k in best] or [None]
