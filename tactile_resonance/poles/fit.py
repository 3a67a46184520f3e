# SPDX-License-Identifier: Apache-2.0
"""Maximum likelihood fits of points: start values, steps, what is left to full precision, further starts.

Start values by Sanathanan-Koerner iterations (IEEE Trans. Autom. Control 8 (1963) 56-58), then
Levenberg-Marquardt steps on the normal equations of `likelihood`. These square the condition number: what
does not converge, has many poles or a pure delay is fitted by scipy's least squares on the Jacobian.

Two modes nearer than their widths look like one. A fit that begins with one of its modes elsewhere stays
there: the cost has a minimum with a single mode for both, and the other one fits noise. So the highest peak
of a model of several modes is split.

In models of many modes Sanathanan-Koerner iterations place some poles on noise, for noise enters their
equations with the model's own denominator. From there a fit ends in a minimum in which a true mode is not
fitted at all. The score test of `lacking` shows where one is missing; the fit begins anew with a mode there in
place of the one that is missed least, and so on while the cost falls.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy  # its parts are loaded where they are used first: scipy.optimize takes a node 0.15 s

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles import likelihood
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.lacking import most_missed, poles_tried
from tactile_resonance.poles.likelihood import ROUNDING, STEP_TOLERANCE, Rules, Solution

if TYPE_CHECKING:
    from tactile_resonance.poles.lines import LinesPlan
    from tactile_resonance.poles.tables import FitPlan, Problem

ORDINARY = Rules()
# Of a fit at full precision.
LEAST_SQUARES_STARTS = 20
LEAST_SQUARES_EVALUATIONS = 200
LEAST_SQUARES_TOLERANCE = 1e-10

SEVERAL_MODES = 4
"""Order from which on a model has more than one mode."""

LEAST_FALL = 4.0
"""Of the cost, in units of the noise, that a start must bring: less is another mode on noise, not one more."""

APART = 0.7
"""Natural frequencies of the two, from that of the one, over its half width."""

# A mode is moved to where noise makes as much less often than this: a start that is no use costs time alone.
CHANCE = 0.3
# Starts that are tried before a minimum is taken for the deepest, those of the least cost first.
STARTS = 3
# Points that start anew in one pass: of many lines more take gigabytes.
AT_ONCE = 128


def minimise(
    problem: Problem,
    data: BinData,
    start: FloatArray | None = None,
    rules: Rules = ORDINARY,
) -> Solution:
    """Minimise the cost of each point, from a start (points, M, n) or from Sanathanan-Koerner iterations."""
    begin = np.empty((0, data.records, sum(problem.sizes))) if start is None else start
    found = Solution.empty(len(data.y), data.records, begin.shape[2], data.driven)
    likelihood.minimise(problem.tables, data, begin, rules, found)
    return found


def refit_failed(problem: Problem, solution: Solution, data: BinData) -> None:
    """Fit the points that did not converge again, at full precision, in place."""
    for k in (~solution.converged & solution.plain).nonzero()[0]:
        found = least_squares(problem, data.rows(slice(k, k + 1)))
        if found.converged[0]:
            solution.put(np.array([k]), found)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Errors of one point and their derivatives.

    Attributes
    ----------
    error : (M, K) complex
        Of Y.
    variance : (K,) float
    slope : (M, K, n) complex
        Of the model by each coefficient.
    variance_slope : (K, n) float
    """

    error: ComplexArray
    variance: FloatArray
    slope: ComplexArray
    variance_slope: FloatArray

    @classmethod
    def of(
        cls,
        problem: Problem,
        data: BinData,
        theta: FloatArray,
        delay_phase: FloatArray | None = None,
    ) -> Linearised:
        """At theta (s + M c,), with the delay last if its phase (K_driven,) is given; of data of one point."""
        a, b, _ = problem.sizes
        last, driven = a + b + data.records * problem.sizes[2], slice(problem.undriven, None)
        inverse = 1 / (problem.denominator[:, :a] @ theta[:a] + problem.denominator[:, a])  # (K,)
        by_g = np.zeros((data.driven, theta.size), complex)
        by_g[:, a : a + b] = inverse[driven, None] * problem.numerator
        slope = np.zeros((data.records, inverse.size, theta.size), complex)
        slope[..., a:last] = inverse[:, None] * numerator_columns(problem, data)[0]
        if delay_phase is not None:
            turn = np.exp(-1j * delay_phase * theta[last])[:, None]
            by_g[:, a : a + b] *= turn
            slope[:, driven, a : a + b] *= turn
        g = np.sum(by_g[:, a : a + b] * theta[a : a + b], axis=1)
        model = slope[..., a:last] @ theta[a:last]  # (M, K)
        by_g[:, :a] = -(g * inverse[driven])[:, None] * problem.denominator[driven, :a]
        slope[..., :a] = -(model * inverse)[..., None] * problem.denominator[:, :a]
        if delay_phase is not None:
            by_g[:, last] = -1j * delay_phase * g
            slope[:, driven, last] = by_g[:, last] * data.u_driven[0]
        variance = data.variance[0]  # (K,)
        variance[driven] = data.residual_variance(g[None])[0]
        variance_slope = np.zeros((variance.size, theta.size))
        if data.variance_u.size:
            half = data.variance_u[0] * np.conj(g)
            if data.covariance_yu.size:
                half = half - np.conj(data.covariance_yu[0])
            variance_slope[driven] = 2 * np.real(half[..., None] * by_g)
        return cls(data.y[0][:, data.order] - model, variance, slope, variance_slope)

    @property
    def residual(self) -> ComplexArray:
        """(M, K) weighted errors."""
        return np.ascontiguousarray(self.error / np.sqrt(self.variance))

    @property
    def jacobian(self) -> FloatArray:
        """(M, K, 2, n) derivatives of the real and imaginary parts of the weighted errors."""
        root = 1 / np.sqrt(self.variance)[..., None]
        of_variance = 0.5 * (self.error[..., None] * root) * self.variance_slope * root**2
        both = -self.slope * root - of_variance
        return np.stack([both.real, both.imag], axis=-2)


def least_squares(
    problem: Problem,
    data: BinData,
    start: FloatArray | None = None,
    delay_phase: FloatArray | None = None,
    first_size: FloatArray | None = None,
) -> Solution:
    """Minimise the cost of one point at full precision, by orthogonal factorisations of the Jacobian.

    A delay is the last entry of theta then.

    Parameters
    ----------
    problem : Problem
    data : BinData
        Of one point.
    start : (s + M c,) float, optional
        Sanathanan-Koerner iterations when absent.
    delay_phase : (K,) float, optional
        Phase [rad] per unit of delay.
    first_size : (K,) float, optional
        ``|A|`` that start values begin from; 1 when absent.
    """

    @lru_cache(maxsize=1)  # a Jacobian is asked for where the residuals were asked for last
    def kept(theta: bytes) -> Linearised:
        return Linearised.of(problem, data, np.frombuffer(theta), delay_phase)

    def at(theta: FloatArray) -> Linearised:
        return kept(theta.tobytes())

    with np.errstate(all="ignore"):
        if start is None:
            start = _best_start(problem, data, first_size)
            if delay_phase is not None:
                start = np.append(start, 0.0)
        converged, theta = False, start
        begin = at(start).residual.view(float)
        if np.isfinite(begin).all() and begin.size >= start.size:
            try:
                found = scipy.optimize.least_squares(
                    lambda theta: np.nan_to_num(at(theta).residual.view(float).ravel(), nan=1e150),
                    start,
                    lambda theta: np.nan_to_num(at(theta).jacobian.reshape(-1, theta.size)),
                    method="lm",
                    x_scale="jac",
                    ftol=LEAST_SQUARES_TOLERANCE,
                    xtol=LEAST_SQUARES_TOLERANCE,
                    gtol=LEAST_SQUARES_TOLERANCE,
                    max_nfev=LEAST_SQUARES_EVALUATIONS,
                )
                converged, theta = bool(found.status > 0), found.x
            except (ValueError, np.linalg.LinAlgError):  # nothing finite on the way
                pass
        last = at(theta)
        return _solution(problem, data, theta, last, converged)


def _solution(
    problem: Problem, data: BinData, theta: FloatArray, at: Linearised, converged: bool
) -> Solution:
    """That of a batch of one, (s + M c,) coefficients at which the errors are linearised.

    Converged is what was found as such where one step more would lower the cost by as little as the last one of
    `minimise`.
    """
    records, undriven, (a, b, own) = data.records, problem.undriven, problem.sizes
    shared, n = a + b, theta.size - (records - 1) * own
    residual, jacobian = at.residual, np.where(np.isfinite(at.variance)[:, None, None], at.jacobian, 0.0)
    rows, errors = jacobian.reshape(-1, theta.size), np.nan_to_num(residual)
    column = np.linalg.norm(rows, axis=0)
    inverse, condition, fall = np.full((theta.size, theta.size), np.nan), np.inf, np.inf
    if np.isfinite(rows).all():
        scale = np.where(column > 0, column, 1.0)
        directions, singular, vh = np.linalg.svd(rows / scale, full_matrices=False)
        there = singular > np.finfo(float).eps * len(rows) * singular[0]
        fall = float(np.sum((errors.view(float).ravel() @ directions[:, there]) ** 2))
        determined = singular.size == theta.size and singular[-1] > 0
        if determined and np.isfinite(column).all() and (column > 0).all():
            half = vh.T / singular
            inverse = half @ half.T / np.outer(scale, scale)
            # see `Solution.condition`
            condition = float((np.sum(singular**4) * np.sum(singular**-4.0)) ** 0.25)
    free = max(len(rows) - theta.size, 1)
    whole = ROUNDING**2 * float(np.sum(np.abs(data.y[0][:, data.order]) ** 2 / data.variance[0]))
    converged &= fall <= max(STEP_TOLERANCE**2 * float(np.sum(np.abs(errors) ** 2)) / free, whole)
    each, normal = np.empty((1, records, n)), np.empty((1, records, 2, n, n))
    marginal = np.empty((1, records, n, n))
    for m in range(records):
        of_record = np.arange(shared + m * own, shared + (m + 1) * own)
        columns = np.r_[:shared, of_record, shared + records * own : theta.size]
        each[0, m], marginal[0, m] = theta[columns], inverse[np.ix_(columns, columns)]
        for part, here in enumerate((slice(undriven), slice(undriven, None))):
            of_part = jacobian[m, here][..., columns].reshape(-1, n)
            normal[0, m, part] = of_part.T @ of_part
    u, power = data.u_driven[0], np.sum(residual.real**2 + residual.imag**2, axis=0)
    turn = np.where(np.abs(u) > 0, u.conj() / np.abs(u), 1.0)
    part_cost = np.array([[power[:undriven].sum(), power[undriven:].sum()]])
    return Solution(
        each,
        part_cost.sum(axis=1),
        part_cost,
        (errors[:, undriven:] * turn)[None],
        np.array([converged]),
        normal if records > 1 else normal[:0],
        marginal,
        np.array([condition]),
        np.sum(marginal[:, :, None] * normal, axis=(1, 3, 4)),
        np.full((1, 2), np.nan),
        np.ones(1, bool),
    )


def linear_step(problem: Problem, data: BinData, size: FloatArray) -> FloatArray:
    """(s + M c,) least squares of ``(A Y - B U - C) / |A|`` for sizes ``|A|`` (K,): of data of one point."""
    a = problem.sizes[0]
    y = data.y[0][:, data.order, None]
    columns = numerator_columns(problem, data)[0]
    design = np.concatenate([-y * problem.denominator[:, :a], columns], axis=-1)
    scale = 1 / (np.sqrt(data.variance[0]) * size)
    design *= scale[:, None]
    target = y[..., 0] * problem.denominator[:, a] * scale
    return real_solution(design.reshape(-1, design.shape[-1]), target.ravel())


def numerator_columns(problem: Problem, data: BinData) -> ComplexArray:
    """(points, M, K, b + M c) of ``B U + C`` by each coefficient of B and of the C of each record."""
    _, b, own = problem.sizes
    u, records = data.u_driven, data.records
    columns = np.zeros((len(u), records, data.order.size, b + records * own), complex)
    columns[:, :, problem.undriven :, :b] = u[..., None] * problem.numerator
    for m in range(records):
        columns[:, m, :, b + m * own : b + (m + 1) * own] = problem.transient
    return columns


def real_solution(matrix: ComplexArray, right: ComplexArray) -> FloatArray:
    """Real least squares solution of complex equations, whatever the scales of its unknowns.

    Parameters
    ----------
    matrix : (..., K, n) complex
    right : (..., K) complex

    Returns
    -------
    (..., n) float
        NaN where not all equations are finite.
    """
    rows = np.concatenate([matrix.real, matrix.imag], axis=-2)
    right = np.concatenate([right.real, right.imag], axis=-1)[..., None]
    finite = np.isfinite(rows).all(axis=(-2, -1)) & np.isfinite(right).all(axis=(-2, -1))
    rows = np.where(finite[..., None, None], rows, 0.0)
    column = np.linalg.norm(rows, axis=-2)
    column[~(column > 0)] = 1.0
    q, r = np.linalg.qr(rows / column[..., None, :])
    right = q.swapaxes(-1, -2) @ right
    solution = (np.linalg.pinv(r, np.finfo(float).eps * rows.shape[-2]) @ right)[..., 0] / column
    return np.where(finite[..., None], solution, np.nan)


def _best_start(problem: Problem, data: BinData, size: FloatArray | None) -> FloatArray:
    """The best of Sanathanan-Koerner iterations by orthogonal factorisation."""
    a, b, own = problem.sizes
    size = np.ones(problem.denominator.shape[0]) if size is None else size
    best, best_cost = np.zeros(a + b + data.records * own), np.inf
    for _ in range(LEAST_SQUARES_STARTS):
        theta = linear_step(problem, data, size)
        residual = Linearised.of(problem, data, theta).residual
        cost = float(np.sum(residual.real**2 + residual.imag**2))
        size = np.abs(problem.denominator @ np.append(theta[:a], 1.0))
        better = cost < best_cost * (1 - 1e-3)
        if cost < best_cost:
            best, best_cost = theta, cost
        if not better:
            break
    return best


@np.errstate(all="ignore")
def best_of_split(plan: FitPlan, data: BinData, solution: Solution) -> Solution:
    """The solution, of order 4 or more, or that from a start with its highest peak split.

    If that costs less by more than noise.
    """
    poles, split = _highest_split(plan, solution.theta[:, 0])
    parts = [split[k : k + AT_ONCE] for k in range(0, split.size, AT_ONCE)]
    if not parts:
        return solution
    found = np.concatenate([_coefficients(plan, data.rows(part), poles[part]) for part in parts])
    finite = np.isfinite(found).all(axis=1)
    rows, found = split[finite], found[finite]
    shared = sum(plan.problem.sizes[:2])
    of_record = np.arange(shared, found.shape[1]).reshape(data.records, -1)
    start = np.stack([found[:, np.append(np.arange(shared), own)] for own in of_record], axis=1)
    again = minimise(plan.problem, data.rows(rows), start)
    dof = data.records * data.order.size - sum(plan.problem.sizes) / 2
    fall = LEAST_FALL / max(dof, LEAST_FALL)
    better = again.converged & (
        ~solution.converged[rows] | (again.cost < solution.cost[rows] * (1 - fall))
    )
    solution.put(rows[better], again.rows(better))
    return solution


def _highest_split(plan: FitPlan, theta: FloatArray) -> tuple[ComplexArray, IntArray]:
    """Poles (points, a) [rad/s] of theta (points, n), the pair of the least peak at that of the highest.

    And the points that have two pairs.
    """
    model = plan.model_of(theta)
    poles = model.poles_rad_s()
    heights = np.abs(model.residues_and_sensitivity(poles)[0]) / np.abs(poles.real)
    above, each = poles.imag > 0, np.arange(len(poles))
    highest = poles[each, np.where(above, heights, -np.inf).argmax(axis=-1), None]
    least = poles[each, np.where(above, heights, np.inf).argmin(axis=-1), None]
    two = np.concatenate([highest, highest.conj(), least, least.conj()], axis=-1)
    moved = (poles[..., None] == two[:, None]).any(axis=-1)
    usable = (np.isfinite(heights) | ~above).all(axis=-1) & (above.sum(axis=-1) > 1)
    split = np.flatnonzero(usable & (moved.sum(axis=-1) == 4))
    pair = (highest + np.array([1j, -1j]) * APART * np.abs(highest.real))[split]
    at = split.repeat(4), moved[split].nonzero()[1]
    poles[at] = np.concatenate([pair, pair.conj()], axis=-1).ravel()
    return poles, split


def _coefficients(plan: FitPlan, data: BinData, poles: ComplexArray) -> FloatArray:
    """(points, a + b + M c) of A with given poles (points, a) [rad/s], and of the B and C that fit best."""
    roots, hessenberg = plan.variable.of_s(poles), plan.denominator_basis.hessenberg
    a, basis = plan.problem.sizes[0], plan.problem.denominator
    x = hessenberg[0, 0] + hessenberg[1, 0] * basis[:, 1]  # (K,) of the bins: x p_0 of the basis
    # many factors over decades overflow
    logarithm = np.sum(np.log(x[:, None] - roots[:, None]), axis=-1)
    phase = np.exp(1j * logarithm.imag)  # (points, K) A / |A|
    size = logarithm.real
    weight = np.exp(np.mean(size, axis=-1, keepdims=True) - size)
    denominator = real_solution(weight[..., None] * basis, phase)
    alpha = denominator / denominator[:, -1:]
    target = data.y[..., data.order] / np.sqrt(data.variance)[:, None]  # (points, M, K)
    scale = 1 / (np.sqrt(data.variance) * (alpha @ basis.T))  # (points, K)
    columns = scale[:, None, :, None] * numerator_columns(plan.problem, data)
    points, records, bins = target.shape
    own = real_solution(
        columns.reshape(points, records * bins, columns.shape[-1]), target.reshape(points, records * bins)
    )
    return np.concatenate([alpha[:, :a], own], axis=-1)


@np.errstate(all="ignore")
def exchanged(
    plan: LinesPlan, row: BinData, found: Solution
) -> tuple[LinesPlan, Solution]:
    """The deepest minimum that is found by moving modes of a solution of one point; bases that suit it."""
    tried = poles_tried(plan.frequency_hz)
    for _ in range(2 * plan.structure.order):
        missing, chance = most_missed(plan, row, found, tried)
        if not chance < np.log(CHANCE):
            break
        more = np.array([missing, np.conj(missing)])
        starts = [np.append(rest, more) for rest in _one_less(_poles(plan, found))]
        starts.sort(key=lambda poles: _cost_from(plan, row, poles))
        for start in starts[:STARTS]:
            again = _minimum_from(plan, row, start)
            if again is not None and again[1].cost[0] < found.cost[0] * (1 - 1e-9):
                plan, found = again
                break
        else:
            break
    return plan, found


@np.errstate(all="ignore")
def moved_to(
    plan: LinesPlan, row: BinData, there: LinesPlan, found: Solution
) -> Solution:
    """A solution of one plan as that of another one."""
    if there is plan:
        return found
    start = _coefficients(plan, row, _poles(there, found)[None])[0]
    return least_squares(plan.problem, row, start, None, plan.start_size)


def _poles(plan: LinesPlan, solution: Solution) -> ComplexArray:
    return plan.model_of(solution.theta[:, 0]).poles_rad_s()[0]


def _minimum_from(
    plan: LinesPlan, row: BinData, poles: ComplexArray
) -> tuple[LinesPlan, Solution] | None:
    """Fit that begins with these poles, of a plan with bases that suit them; None where there is none."""
    logarithm = 2 * np.sum(np.log(np.abs(plan.x[:, None] - plan.variable.of_s(poles))), axis=-1)
    there = plan.of_size(row, np.exp(logarithm - logarithm.mean()))
    start = None if there is None else _coefficients(there, row, poles[None])[0]
    if there is None or start is None or not np.isfinite(start).all():
        return None
    solution = least_squares(there.problem, row, start, None, there.start_size)
    return (there, solution) if np.isfinite(solution.cost[0]) else None


def _one_less(poles: ComplexArray) -> list[ComplexArray]:
    """All but each complex pair, and all but two real poles next to each other."""
    above, below, real = poles[poles.imag > 0], poles[poles.imag < 0], poles[poles.imag == 0]
    real = np.sort_complex(real)
    mirrored = [np.argmin(np.abs(below - pole.conj())) for pole in above]
    return [
        *(np.concatenate([np.delete(above, k), np.delete(below, m), real]) for k, m in enumerate(mirrored)),
        *(np.concatenate([above, below, np.delete(real, [k, k + 1])]) for k in range(0, real.size - 1, 2)),
    ]


def _cost_from(plan: LinesPlan, row: BinData, poles: ComplexArray) -> float:
    """Cost with given poles [rad/s] and the numerator that fits best."""
    error = Linearised.of(plan.problem, row, _coefficients(plan, row, poles[None])[0]).residual
    cost = float(np.sum(error.real**2 + error.imag**2))
    return cost if np.isfinite(cost) else np.inf
