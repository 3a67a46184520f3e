# SPDX-License-Identifier: Apache-2.0
"""The same fit for one point at full precision: orthogonal factorisations of the Jacobian.

Normal equations square the condition number. For the models that need it (many poles, a pure delay,
exact data) this solver factorises the Jacobian itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.problem import Problem
from tactile_resonance.identification.solver import ROUNDING, Solution

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

START_ITERATIONS = 20
MAX_ITERATIONS = 200
STEP_TOLERANCE = 1e-5


@dataclass(frozen=True, eq=False)
class DenseSolution:
    """Coefficients of one point; arrays as in `solver.Solution` without the batch axis.

    Attributes
    ----------
    theta : (n,) float
        [A without its last, B, C, delay / unit if asked for].
    jacobian : (2 K, n) float
        Of the weighted residuals.
    residual : (K,) complex
        Weighted, of the groups one after the other.
    group_cost : (groups,) float
    converged : bool
    iterations : int
    """

    theta: FloatArray
    jacobian: FloatArray
    residual: ComplexArray
    group_cost: FloatArray
    converged: bool
    iterations: int


def minimise_dense(
    problem: Problem,
    data: Sequence[BinData],
    start: FloatArray | None = None,
    delay_phase: FloatArray | None = None,
    previous: Sequence[FloatArray] | None = None,
) -> DenseSolution:
    """Minimise the cost of one point.

    Parameters
    ----------
    problem : Problem
    data : sequence of BinData
        With a batch of 1.
    start : (n,) float, optional
        Sanathanan-Koerner iterations when absent.
    delay_phase : (K,) float, optional
        Phase [rad] per unit of delay on the bins of the only group; the delay is then the last
        entry of theta.
    previous : sequence of (K,) float, optional
        ``|A|`` on the bins of each group that the start values begin from; 1 when absent.
    """
    if start is None:
        start = _start(problem, data, previous)
        if delay_phase is not None:
            start = np.append(start, 0.0)
    theta = start.astype(float)
    size = sum(np.sum(np.abs(v.y) ** 2 / v.variance_y) for v in data)
    floor = ROUNDING**2 * float(size)
    with np.errstate(all="ignore"):
        residual, jacobian = _linearise(problem, data, theta, delay_phase)
        cost = _cost(residual)
        damping, converged, iterations = 0.0, False, 0
        free = max(2 * residual.size - theta.size, 1)
        for iterations in range(1, MAX_ITERATIONS + 1):  # noqa: B007
            if not np.isfinite(jacobian).all():
                break
            stacked = _stack(residual)
            step, decrement = _step(jacobian, stacked, damping)
            trial = theta - step
            trial_residual, trial_jacobian = _linearise(problem, data, trial, delay_phase)
            trial_cost = _cost(trial_residual)
            if trial_cost <= cost * (1 + 1e-12) + floor:
                small = decrement <= max(STEP_TOLERANCE**2 * cost / free, floor)
                # exact data: on until the cost no longer falls, or only by rounding
                small &= trial_cost > 0.5 * cost or cost <= floor
                theta, residual, jacobian, cost = trial, trial_residual, trial_jacobian, trial_cost
                if small and damping == 0:
                    converged = True
                    break
                damping = 0.0 if damping < 1e-6 else damping / 10
            else:
                damping = max(10 * damping, 1e-6)
                if damping > 1e12:
                    break
    edges = np.cumsum([0] + [group.size for group in problem.groups])
    group_cost = np.array(
        [_cost(residual[a:b]) for a, b in zip(edges[:-1], edges[1:], strict=False)]
    )
    return DenseSolution(theta, jacobian, residual, group_cost, converged, iterations)


def refit_failed(problem: Problem, solution: Solution, data: Sequence[BinData]) -> Solution:
    """The points that did not converge again, by the dense solver."""
    failed = np.flatnonzero(~solution.converged)
    if not failed.size:
        return solution
    theta, normal = solution.theta.copy(), solution.normal.copy()
    cost, group_cost = solution.cost.copy(), solution.group_cost.copy()
    converged, residual = solution.converged.copy(), solution.residual.copy()
    edges = np.cumsum([0] + [group.size for group in problem.groups])
    for k in failed:
        row = [values.rows(slice(k, k + 1)) for values in data]
        dense = minimise_dense(problem, row)
        if not dense.converged:
            continue
        converged[k], theta[k] = True, dense.theta
        group_cost[k], cost[k] = dense.group_cost, dense.group_cost.sum()
        residual[k] = dense.residual[edges[-2] :]
        half = dense.jacobian.shape[0] // 2
        for j, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=False)):
            part = np.concatenate(
                [dense.jacobian[first:last], dense.jacobian[half + first : half + last]]
            )
            normal[k, j] = part.T @ part
    return Solution(theta, normal, cost, group_cost, residual, converged, solution.iterations)


def jacobian_covariance(jacobian: FloatArray) -> tuple[FloatArray, float]:
    """``(J^T J)^-1`` (n, n) through singular values, and the condition number with unit columns."""
    column = np.linalg.norm(jacobian, axis=0)
    n = column.size
    if not (np.isfinite(column).all() and (column > 0).all()):
        return np.full((n, n), np.nan), float("inf")
    _, singular, vh = np.linalg.svd(jacobian / column, full_matrices=False)
    if singular[-1] <= 0 or singular.size < n:
        return np.full((n, n), np.nan), float("inf")
    half = vh.T / singular
    return half @ half.T / np.outer(column, column), float(singular[0] / singular[-1])


def _linearise(
    problem: Problem, data: Sequence[BinData], theta: FloatArray, delay_phase: FloatArray | None
) -> tuple[ComplexArray, FloatArray]:
    """Weighted residuals (K,) and their Jacobian (2 K, n)."""
    delayed = delay_phase is not None
    phase = np.zeros(1) if delay_phase is None else delay_phase
    residuals, rows = [], []
    alpha, beta, gamma = (c[0] for c in problem.split((theta[:-1] if delayed else theta)[None]))
    a_terms, b_terms, _ = problem.sizes
    for group, values in zip(problem.groups, data, strict=False):
        u = 1.0 if values.u is None else values.u[0]
        if delayed:
            u = u * np.exp(-1j * phase * theta[-1])
        inverse_a = 1 / (group.denominator @ alpha)
        columns = np.zeros((group.size, theta.size), complex)
        by_g = np.zeros_like(columns)
        g = np.zeros(group.size, complex)
        transient = np.zeros(group.size, complex)
        if group.numerator is not None:
            g = (group.numerator @ beta) * inverse_a
            by_g[:, :a_terms] = -(g * inverse_a)[:, None] * group.denominator[:, :-1]
            by_g[:, a_terms : a_terms + b_terms] = inverse_a[:, None] * group.numerator
        columns += by_g * np.broadcast_to(u, g.shape)[:, None]
        if group.transient is not None:
            transient = (group.transient @ gamma) * inverse_a
            columns[:, :a_terms] -= (transient * inverse_a)[:, None] * group.denominator[:, :-1]
            end = a_terms + b_terms + group.transient.shape[1]
            columns[:, a_terms + b_terms : end] = inverse_a[:, None] * group.transient
        if delayed:
            columns[:, -1] = -1j * phase * g * u
        error = values.y[0] - g * u - transient
        variance = np.broadcast_to(values.variance_y[0], error.shape)
        change: FloatArray | float = 0.0
        if values.variance_u is not None and group.numerator is not None:
            turn = np.exp(-1j * phase * theta[-1]) if delayed else np.ones(1)
            gt = g * turn
            slope = values.variance_u[0] * np.conj(gt)
            variance = variance + values.variance_u[0] * np.abs(g) ** 2
            if values.covariance_yu is not None:
                slope = slope - np.conj(values.covariance_yu[0])
                variance = variance - 2 * np.real(values.covariance_yu[0] * np.conj(gt))
            by_gt = by_g * turn[:, None]
            if delayed:
                by_gt[:, -1] = -1j * phase * gt
            change = np.real(slope[:, None] * by_gt)
        weight = 1 / np.sqrt(variance)
        residual = error * weight
        rows.append(-columns * weight[:, None] - residual[:, None] * change / variance[:, None])
        residuals.append(residual)
    return np.concatenate(residuals), _stack(np.concatenate(rows))


def _start(
    problem: Problem, data: Sequence[BinData], previous: Sequence[FloatArray] | None
) -> FloatArray:
    """Sanathanan-Koerner iterations by orthogonal factorisation; the best of all."""
    n = sum(problem.sizes)
    if previous is None:
        previous = [np.ones(group.size) for group in problem.groups]
    best, best_cost = np.zeros(n), np.inf
    for _ in range(START_ITERATIONS):
        theta = linear_step(problem, data, previous)
        with np.errstate(all="ignore"):
            cost = _cost(_linearise(problem, data, theta, None)[0])
        alpha = problem.split(theta[None])[0][0]
        previous = [np.abs(group.denominator @ alpha) for group in problem.groups]
        if not cost < best_cost * (1 - 1e-3):
            if cost < best_cost:
                best = theta
            break
        best, best_cost = theta, cost
    return best


def linear_step(
    problem: Problem, data: Sequence[BinData], previous: Sequence[FloatArray]
) -> FloatArray:
    """(n,) least squares of ``(A Y - B U - C) / |A_previous|``: one Sanathanan-Koerner iteration.

    Parameters
    ----------
    previous : sequence of (K,) float
        ``|A_previous|`` on the bins of each group.
    """
    n = sum(problem.sizes)
    a_terms, b_terms, _ = problem.sizes
    rows, right = [], []
    for group, values, a in zip(problem.groups, data, previous, strict=False):
        scale = (1 / (np.sqrt(np.broadcast_to(values.variance_y[0], a.shape)) * a))[:, None]
        u = 1.0 if values.u is None else values.u[0][:, None]
        block = np.zeros((group.size, n), complex)
        block[:, :a_terms] = values.y[0][:, None] * group.denominator[:, :-1]
        if group.numerator is not None:
            block[:, a_terms : a_terms + b_terms] = -u * group.numerator
        if group.transient is not None:
            block[:, a_terms + b_terms :] = -group.transient
        rows.append(block * scale)
        right.append(-values.y[0] * group.denominator[:, -1] * scale[:, 0])
    design, target = _stack(np.concatenate(rows)), _stack(np.concatenate(right))
    column = np.linalg.norm(design, axis=0)
    column[~(column > 0)] = 1.0
    if not np.isfinite(design).all() or not np.isfinite(target).all():
        return np.full(n, np.nan)
    return np.linalg.lstsq(design / column, target, rcond=None)[0] / column


def _step(jacobian: FloatArray, residual: FloatArray, damping: float) -> tuple[FloatArray, float]:
    """Levenberg-Marquardt step, and the decrease of the cost that the linear model predicts."""
    column = np.linalg.norm(jacobian, axis=0)
    column[column == 0] = 1.0
    scaled = jacobian / column
    if damping > 0:
        n = column.size
        scaled = np.concatenate([scaled, np.sqrt(damping) * np.eye(n)])
        residual = np.concatenate([residual, np.zeros(n)])
    step = np.linalg.lstsq(scaled, residual, rcond=None)[0]
    predicted = scaled @ step
    return step / column, float(predicted @ predicted)


def _cost(residual: ComplexArray) -> float:
    return float(np.sum(residual.real**2 + residual.imag**2))


def _stack(values: ComplexArray) -> FloatArray:
    """Real part over imaginary part."""
    return np.concatenate([values.real, values.imag])
