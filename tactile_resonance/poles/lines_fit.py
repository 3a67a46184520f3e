# SPDX-License-Identifier: Apache-2.0
"""Fit of a rational model to lines: of an FRF (input 1), or of input and output spectra.

Sample maximum likelihood: the cost weighs with sample variances (Pintelon & Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. (2012), chapter 12).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.poles import likelihood
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import (
    DenseSolution,
    Linearised,
    least_squares,
    linear_step,
    minimise,
)
from tactile_resonance.poles.likelihood import Rules, Solution
from tactile_resonance.poles.model import RationalModel
from tactile_resonance.poles.plan import FitPlan
from tactile_resonance.poles.starts import (
    SEVERAL_MODES,
    best_of_split,
    dispensable,
    exchanged,
    moved_to,
)
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.poles.tables import Problem

# Beyond this condition number normal equations are not trusted and the Jacobian itself is
# factorised.
NORMAL_EQUATIONS_LIMIT = 1e5
# Models of more poles than this go to the dense solver at once.
LARGEST_BATCHED_ORDER = 6
REBASE_ITERATIONS = 40
ONLY_START = Rules(iterations=0)
# Bases follow the denominator until it changes by less than this from one iteration to the next.
REBASE_TOLERANCE = 1e-2


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
        """The model of coefficients (batch, n)."""
        if not self.structure.delay:
            return super().model_of(theta)
        return replace(super().model_of(theta[:, :-1]), delay_s=theta[:, -1] * self.delay_unit_s)

    def fit(self, data: BinData) -> tuple[LinesPlan, Solution]:
        """Fit of all points of a batch, and the plan of its coefficients, which may have other bases."""
        if self.structure.order > LARGEST_BATCHED_ORDER:
            return self.settled(data)._fit_dense(data)
        if self.structure.delay:
            return self._fit_dense(data)
        solution = minimise(self.problem, data)
        if self.structure.order >= SEVERAL_MODES:
            solution = best_of_split(self, data, solution)
        converged, condition = solution.converged, solution.condition
        doubtful = np.flatnonzero(~converged | ~(condition < NORMAL_EQUATIONS_LIMIT))
        if len(data.y) == 1 and doubtful.size:
            return self.rebased(data)._fit_dense(data)
        for k in doubtful:
            dense = least_squares(self.problem, data.rows(slice(k, k + 1)))
            if dense.cost <= solution.cost[k] * (1 + 1e-9) or not converged[k]:
                solution.put(np.array([k]), dense.solution(self.problem, *dense.covariance()))
        return self, solution

    def compared(self, data: BinData, start: FloatArray | None = None) -> ComplexArray:
        """As `FitPlan.compared`, from start values; of what the batched solver cannot do a whole fit."""
        if self.structure.order <= LARGEST_BATCHED_ORDER and not self.structure.delay:
            return super().compared(data)
        plan, solution = self.fit(data)
        return plan.poles_in_band(solution.theta[:, 0])

    def with_covariance(self, data: BinData) -> tuple[ComplexArray, FloatArray]:
        """Poles of a fit, in the band or not, and their covariance as its residuals show it."""
        plan, solution = self.fit(data)
        return plan.poles_and_covariance(data, solution)[:2]

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
        return exchanged(plan, row, found)[0] if np.isfinite(found.cost) else plan

    def dispensable(self, data: BinData, solution: Solution) -> BoolArray:
        """(batch, places) modes in the band without which the fit is as good, where many are fitted."""
        out = np.zeros((len(data.y), self.structure.order // 2), bool)
        if self.structure.delay or self.structure.order <= LARGEST_BATCHED_ORDER:
            return out
        modes = self.poles_in_band(solution.theta[:, 0])
        for k in np.flatnonzero(solution.converged):
            row, theta = data.rows(slice(k, k + 1)), solution.theta[k, 0]
            poles = dispensable(self, row, theta, float(solution.cost[k]))
            out[k] = np.isclose(modes[k][:, None], poles, 1e-6, 0).any(axis=-1)
        return out

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
        finite = np.isfinite(data.variance_y)
        inverse = solution.marginal[:, 0]
        if self.structure.delay or self.weights is not None:  # fitted point by point
            normal = np.empty_like(inverse)
            for k, used in enumerate(finite):
                row = data.rows(slice(k, k + 1))
                at = Linearised.of(self.problem, row, solution.theta[k, 0], self._delay_phase)
                ratio = noise[k, used] / data.variance_y[k, used]
                jacobian = at.jacobian[0, used]  # (F, 2, n)
                normal[k] = np.einsum("fpi,f,fpj->ij", jacobian, ratio, jacobian)
        else:
            more = np.where(finite, data.variance_y**2 / noise, np.inf)
            weighted = data.weighted(variance_y=more)
            normal = likelihood.moments(self.problem.tables, weighted, solution.theta)[2][:, 0, 1]
        return 0.5 * inverse @ normal @ inverse

    def _fit_dense(self, data: BinData) -> tuple[LinesPlan, Solution]:
        """Point by point."""
        each = []
        for k in range(len(data.y)):
            found = self._best_of_starts(data.rows(slice(k, k + 1)))
            each.append(found.solution(self.problem, *found.covariance()))
        return self, Solution.joined(each)

    def _best_of_starts(self, row: BinData) -> DenseSolution:
        """Of several starts the one with the least cost."""
        phase, starts = self._delay_phase, list[FloatArray | None]([None])
        if phase is not None:
            starts = delay_starts(self.problem, row, phase)
        solutions = [
            least_squares(self.problem, row, start, phase, self.start_size) for start in starts
        ]
        finite = [s for s in solutions if np.isfinite(s.cost)]
        best = min(finite or solutions, key=lambda s: s.cost)
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
    """Starts with the delay removed beforehand, on a grid of a radian over the band.

    The cost has many minima in the delay, about half a turn of phase over the band apart.
    """
    step = 1.0 / max(float(np.ptp(phase)), 1e-12)
    candidates = []
    for delay in step * np.arange(-2, 13):
        turned = row._replace(y=row.y * np.exp(1j * phase * delay))
        begun = minimise(problem, turned, None, ONLY_START)
        if np.isfinite(begun.theta).all():
            candidates.append((float(begun.cost[0]), np.append(begun.theta[0, 0], delay)))
    candidates.sort(key=lambda c: c[0])
    return [theta for _, theta in candidates[:3]] or [None]
