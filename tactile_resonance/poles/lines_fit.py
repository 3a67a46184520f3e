# SPDX-License-Identifier: Apache-2.0
"""Fit of a rational model to lines: of an FRF (input 1), or of input and output spectra.

Sample maximum likelihood: the cost weighs with sample variances (Pintelon & Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. (2012), chapter 12).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.poles import likelihood
from tactile_resonance.poles.basis import PolynomialBasis
from tactile_resonance.poles.covariance import modes_in_band
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import (
    RULES,
    DenseSolution,
    Linearised,
    least_squares,
    linear_step,
    minimise,
)
from tactile_resonance.poles.model import RationalModel, Variable
from tactile_resonance.poles.model_error import COMPARISON, poles_and_covariance, poorer, richer
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
ONLY_START = RULES._replace(iterations=0)
# Bases follow the denominator until it changes by less than this from one iteration to the next.
REBASE_TOLERANCE = 1e-2


@dataclass(frozen=True, eq=False)
class LinesFit:
    """Fits of a batch of points on the same lines.

    Attributes
    ----------
    theta : (batch, n) float
        Coefficients [A without its last, B].
    model : RationalModel
        Of these, and of a delay.
    cost : (batch,) float
    covariance : (batch, n, n) float
        Of the coefficients, where the variance of each line is the one it was weighted with.
    condition_number : (batch,) float
    converged : (batch,) bool
    residual : (batch, F) complex
        Weighted residuals; 0 on lines that were left out.
    jacobian : (batch, F, 2, n) float or None
        Of real and imaginary parts of the weighted residuals, where each point was fitted alone.
    dispensable : (batch, places) bool or None
        Modes in the band without which the fit is as good, where any was looked for; see `starts`.
    """

    theta: FloatArray
    model: RationalModel
    cost: FloatArray
    covariance: FloatArray
    condition_number: FloatArray
    converged: BoolArray
    residual: ComplexArray
    jacobian: FloatArray | None = None
    dispensable: BoolArray | None = None


@dataclass(frozen=True, eq=False)
class LinesPlan:
    """What a fit on given lines needs whatever the data.

    Attributes
    ----------
    frequency_hz : (F,) float
    structure : ModelStructure
    band_hz : (low, high)
    start_size : (F,) float or None
        ``|A|`` that start values begin from, in a rebased plan.
    """

    frequency_hz: FloatArray
    structure: ModelStructure
    band_hz: tuple[float, float]
    problem: Problem
    variable: Variable
    denominator_basis: PolynomialBasis
    numerator_basis: PolynomialBasis
    start_size: FloatArray | None = None

    @classmethod
    def on_lines(
        cls, frequency_hz: FloatArray, structure: ModelStructure, band_hz: tuple[float, float]
    ) -> LinesPlan:
        """Plan with bases orthonormal on the lines; the latest ones are kept."""
        return _plan(np.ascontiguousarray(frequency_hz, float).tobytes(), structure, band_hz)

    @property
    def richer(self) -> LinesPlan:
        """With one mode more."""
        return LinesPlan.on_lines(self.frequency_hz, richer(self.structure), self.band_hz)

    @property
    def poorer(self) -> LinesPlan | None:
        """With one mode less; None where the model has none to spare."""
        less = poorer(self.structure)
        return None if less is None else LinesPlan.on_lines(self.frequency_hz, less, self.band_hz)

    def fit(self, data: BinData) -> LinesFit:
        """Fit of all points of a batch."""
        batch = len(data.y)
        if self.structure.order > LARGEST_BATCHED_ORDER:
            return self.settled(data)._fit_dense(data)
        if self.structure.delay:
            return self._fit_dense(data)
        solution = minimise(self.problem, data)
        if self.structure.order >= SEVERAL_MODES:
            solution = best_of_split(
                self.problem, data, self.model_of(solution.theta[:, 0]), solution
            )
        theta, cost, converged = solution.theta[:, 0], solution.cost, solution.converged
        residual, parameters = solution.residual[:, 0], 0.5 * solution.marginal[:, 0]
        condition = solution.condition
        doubtful = np.flatnonzero(~converged | ~(condition < NORMAL_EQUATIONS_LIMIT))
        if batch == 1 and doubtful.size:
            return self.rebased(data)._fit_dense(data)
        for k in doubtful:
            dense = least_squares(self.problem, data.rows(slice(k, k + 1)))
            if dense.cost <= cost[k] * (1 + 1e-9) or not converged[k]:
                theta[k], cost[k], converged[k] = dense.theta, dense.cost, dense.converged
                residual[k] = dense.turned[0]
                half, condition[k] = dense.covariance()
                parameters[k] = 0.5 * half
        return LinesFit(
            theta, self.model_of(theta), cost, parameters, condition, converged, residual
        )

    @np.errstate(over="ignore", invalid="ignore")
    def compared(self, data: BinData, _: FloatArray | None = None) -> ComplexArray:
        """Poles (batch, places) in the band of a fit that others are compared with; see `JointPlan`.

        Of the batched solver alone where it is that of `fit`, and of few iterations.
        """
        if self.structure.order > LARGEST_BATCHED_ORDER or self.structure.delay:
            model = self.fit(data).model
        else:
            theta = minimise(self.problem, data, None, COMPARISON).theta
            model = self.model_of(theta[:, 0])
        return modes_in_band(model.poles_rad_s(), self.band_hz)

    def with_covariance(self, data: BinData) -> tuple[ComplexArray, FloatArray]:
        """Poles of a fit and their covariance; see `model_error.poles_and_covariance`."""
        fit = self.fit(data)
        dof = data.driven - self.structure.parameters / 2
        inverse = 2 * fit.covariance
        return poles_and_covariance(fit.model, inverse, fit.cost, dof)[:2]

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
        usable = np.isfinite(data.variance_y).any(axis=-1)
        row = data.rows(slice(int(np.argmax(usable)), int(np.argmax(usable)) + 1))
        order = self.structure.order
        plan = self
        size = np.ones(self.frequency_hz.size)
        for _ in range(REBASE_ITERATIONS):
            of_size = plan.of_size(row, size)
            if of_size is None:
                break
            plan = replace(of_size, start_size=None)
            theta = linear_step(plan.problem, row, np.sqrt(size))
            last, size = size, np.abs(plan.problem.denominator @ np.append(theta[:order], 1.0)) ** 2
            if not (np.isfinite(size).all() and (size > 0).all()):
                break
            plan = replace(plan, start_size=np.sqrt(size))
            if np.ptp(np.log(size / last)) < REBASE_TOLERANCE:
                break
        return plan

    def settled(self, data: BinData) -> LinesPlan:
        """Plan with bases that suit the deepest minimum of the first point with finite weights."""
        plan = self.rebased(data)
        if self.structure.delay:
            return plan
        usable = np.isfinite(data.variance_y).any(axis=-1)
        row = data.rows(slice(int(np.argmax(usable)), int(np.argmax(usable)) + 1))
        found = least_squares(plan.problem, row, None, None, plan.start_size)
        return exchanged(plan, row, found)[0] if np.isfinite(found.cost) else plan

    def _dispensable(self, solutions: list[DenseSolution], data: BinData, modes: ComplexArray) -> BoolArray:
        """(batch, places) for which of the modes (batch, places) in the band the others would do."""
        out = np.zeros(modes.shape, bool)
        if self.structure.delay or self.structure.order <= LARGEST_BATCHED_ORDER:
            return out
        for k, solution in enumerate(solutions):
            if solution.converged:
                poles = dispensable(self, data.rows(slice(k, k + 1)), solution)
                out[k] = np.isclose(modes[k][:, None], poles, 1e-6, 0).any(axis=-1)
        return out

    def of_size(self, row: BinData, size: FloatArray) -> LinesPlan | None:
        """Plan with bases orthonormal in the weights of a point where ``|A|^2`` is `size` (F,).

        None where weights are not finite.
        """
        y, u = row.y[0, 0], row.u[0, 0]
        weight = 1 / (np.broadcast_to(row.variance_y[0], y.shape) * size)
        weight_y, weight_u = weight * np.abs(y) ** 2, weight * np.abs(u) ** 2
        mean_y, mean_u = weight_y.mean(), weight_u.mean()
        if not (np.isfinite([mean_y, mean_u]).all() and mean_y > 0 and mean_u > 0):
            return None
        x, structure = self.variable.of_frequency(self.frequency_hz), self.structure
        denominator = PolynomialBasis.on_lines(x, structure.order, weight_y / mean_y)
        numerator = PolynomialBasis.on_lines(x, structure.numerator_order, weight_u / mean_u)
        if not np.isfinite([denominator.hessenberg.sum(), numerator.hessenberg.sum()]).all():
            return None
        problem = Problem.of_lines(denominator.values, numerator.values)
        return replace(
            self,
            problem=problem,
            denominator_basis=denominator,
            numerator_basis=numerator,
            start_size=np.sqrt(size),
        )

    def propagated(self, fit: LinesFit, data: BinData, noise: FloatArray) -> FloatArray:
        """Covariance (batch, n, n) of a fit where the variance (batch, F) is not that of `data`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            finite = np.isfinite(data.variance_y)
            if fit.jacobian is None:
                weighted = data.weighted(
                    variance_y=np.where(finite, data.variance_y**2 / noise, np.inf)
                )
                theta = fit.theta[:, None]
                normal = likelihood.moments(self.problem.tables, weighted, theta)[2][:, 0, 1]
            else:
                ratio = np.where(finite, noise / data.variance_y, 0.0)  # (batch, F)
                normal = np.einsum("bfpi,bf,bfpj->bij", fit.jacobian, ratio, fit.jacobian)
        inverse = 2 * fit.covariance
        return 0.5 * inverse @ normal @ inverse

    def model_of(self, theta: FloatArray, delay_s: FloatArray | float = 0.0) -> RationalModel:
        """The model with coefficients (batch, n), those of A first."""
        a, b, _ = self.problem.sizes
        return RationalModel(
            denominator=np.concatenate([theta[:, :a], np.ones((theta.shape[0], 1))], axis=1),
            numerator=np.ascontiguousarray(theta[:, a : a + b]),
            variable=self.variable,
            denominator_basis=self.denominator_basis,
            numerator_basis=self.numerator_basis,
            delay_s=delay_s,
        )

    def _fit_dense(self, data: BinData) -> LinesFit:
        """Point by point, for structures beyond the batched solver."""
        phase = None
        unit_s = 1.0
        if self.structure.delay:
            unit_s = 1 / (2 * np.pi * float(self.frequency_hz.max()))
            phase = 2 * np.pi * self.frequency_hz * unit_s
        solutions = []
        for k in range(len(data.y)):
            row = data.rows(slice(k, k + 1))
            solutions.append(self._best_of_starts(row, phase))
        theta = np.stack([s.theta for s in solutions])
        covariances, conditions = zip(*(s.covariance() for s in solutions), strict=True)
        delay_s = theta[:, -1] * unit_s if phase is not None else 0.0
        a, b, _ = self.problem.sizes
        model = self.model_of(theta, delay_s)
        modes = modes_in_band(model.poles_rad_s(), self.band_hz)
        return LinesFit(
            theta[:, : a + b],
            model,
            np.array([s.cost for s in solutions]),
            0.5 * np.stack(covariances),
            np.array(conditions),
            np.array([s.converged for s in solutions]),
            np.stack([s.turned[0] for s in solutions]),
            np.stack([s.jacobian[0] for s in solutions]),
            self._dispensable(solutions, data, modes),
        )

    def _best_of_starts(self, row: BinData, phase: FloatArray | None) -> DenseSolution:
        """Of several starts the one with the least cost."""
        solutions = []
        for start in self._starts(row, phase):
            solutions.append(least_squares(self.problem, row, start, phase, self.start_size))
        finite = [s for s in solutions if np.isfinite(s.cost)]
        best = min(finite or solutions, key=lambda s: s.cost)
        if phase is None and finite and self.structure.order > LARGEST_BATCHED_ORDER:
            best = moved_to(self, row, *exchanged(self, row, best))
        return best

    def _starts(self, row: BinData, phase: FloatArray | None) -> list[FloatArray | None]:
        if phase is None:
            return [None]
        return delay_starts(self.problem, row, phase)


@lru_cache(maxsize=16)
def _plan(
    frequency_hz: bytes, structure: ModelStructure, band_hz: tuple[float, float]
) -> LinesPlan:
    lines_hz = np.frombuffer(frequency_hz)
    variable = Variable.for_lines(lines_hz, structure)
    x = variable.of_frequency(lines_hz)
    denominator = PolynomialBasis.on_lines(x, structure.order)
    numerator = PolynomialBasis.on_lines(x, structure.numerator_order)
    problem = Problem.of_lines(denominator.values, numerator.values)
    return LinesPlan(lines_hz, structure, band_hz, problem, variable, denominator, numerator)


def delay_starts(problem: Problem, row: BinData, phase: FloatArray) -> list[FloatArray | None]:
    """Starts with the delay removed beforehand, on a grid of a radian over the band.

    The cost has many minima in the delay, about half a turn of phase over the band apart.
    """
    step = 1.0 / max(float(np.ptp(phase)), 1e-12)
    candidates = []
    for delay in step * np.arange(-2, 13):
        turned = row._replace(y=row.y * np.exp(1j * phase * delay))
        theta = minimise(problem, turned, None, ONLY_START).theta[0, 0]
        if not np.isfinite(theta).all():
            continue
        residual = Linearised.of(problem, turned, theta).residual
        cost = float(np.sum(residual.real**2 + residual.imag**2))
        candidates.append((cost, np.append(theta, delay)))
    candidates.sort(key=lambda c: c[0])
    return [theta for _, theta in candidates[:3]] or [None]
