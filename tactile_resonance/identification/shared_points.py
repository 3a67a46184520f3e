# SPDX-License-Identifier: Apache-2.0
"""Points that are several records each: one system, a transient of its own in every record.

A point is M rows of `many_points.ManyPoints`; what couples them is that their coefficients of A and B
are the same, see `arrow`. The methods are those of `ManyPoints`, on coefficients (batch, M, n).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.arrow import solve_arrow
from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.dense import minimise_dense
from tactile_resonance.identification.many_points import ManyPoints, ManyValues
from tactile_resonance.identification.problem import START_ITERATIONS, Problem
from tactile_resonance.identification.solver import MAX_ITERATIONS, Solution, refine

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]


@dataclass(eq=False)
class SharedValues:
    """The model of a batch at some coefficients.

    Attributes
    ----------
    rows : ManyValues
        Of (batch M) records.
    group_cost : (batch, groups) float
        Of all records of a point; empty before `SharedPoints.weight`.
    """

    rows: ManyValues
    group_cost: FloatArray

    @property
    def cost(self) -> FloatArray:
        """(batch,) of all groups."""
        return np.asarray(self.group_cost.sum(axis=-1))

    def error_of(self, part: int) -> ComplexArray:
        """(batch M, K_g) error on the bins of a group."""
        return self.rows.error_of(part)


class SharedPoints:
    """Cost, gradients and normal matrices of a batch of M records each.

    Parameters
    ----------
    problem : Problem
    data : sequence of BinData
        Of each group, with (batch M) rows: the records of a point one after the other.
    records : int
        M.
    """

    def __init__(self, problem: Problem, data: Sequence[BinData], records: int) -> None:
        self._problem, self._records = problem, records
        self._rows: ManyPoints = problem.many_points(data)
        a, b, _ = problem.sizes
        self._shared = a + b

    def weigh(self, data: Sequence[BinData]) -> None:
        """Weights by the variances of `data`; y and u stay."""
        self._rows.weigh(data)

    def rows(self, which: IntArray) -> SharedPoints:
        """Some of the points."""
        chosen = SharedPoints.__new__(SharedPoints)
        chosen._problem, chosen._records, chosen._shared = (
            self._problem, self._records, self._shared,
        )  # fmt: skip
        chosen._rows = self._rows.rows(rows_of(which, self._records))
        return chosen

    @property
    def free(self) -> int:
        """Real equations beyond the coefficients."""
        bins = sum(group.size for group in self._problem.groups)
        own = self._problem.sizes[2]
        return int(max(self._records * (2 * bins - own) - self._shared, 1))

    @property
    def weighted_power(self) -> FloatArray:
        """(batch,) ``sum |y|^2 / s_Y^2``."""
        return self._of_points(self._rows.weighted_power).sum(axis=1)

    def evaluate(self, theta: FloatArray) -> SharedValues:
        """The model at theta (batch, M, n), unweighted: see `weight`."""
        return SharedValues(self._rows.evaluate(self._flat(theta)), np.empty(0))

    def weight(self, value: SharedValues) -> SharedValues:
        """The same with the cost of the weighted errors."""
        value.rows = self._rows.weight(value.rows)
        value.group_cost = self._of_points(value.rows.group_cost).sum(axis=1)
        return value

    def normals(self, value: SharedValues) -> tuple[FloatArray, FloatArray]:
        """Half the gradients (batch, M, n), normals (batch, M, groups, n, n), of a weighted value."""
        gradient, normal = self._rows.normals(value.rows)
        return self._of_points(gradient), self._of_points(normal)

    def step(
        self, normal: FloatArray, gradient: FloatArray, damping: FloatArray | float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Levenberg-Marquardt steps to be subtracted (batch, M, n), and what they lower the cost by."""
        return solve_arrow(normal.sum(axis=2), gradient, self._shared, damping)

    def last_residual(self, theta: FloatArray) -> ComplexArray:
        """(batch, M, K) weighted errors of the last group at theta."""
        return self._of_points(self._rows.last_residual(self._flat(theta)))

    def start(self, iterations: int, theta: FloatArray | None = None) -> FloatArray:
        """(batch, M, n) coefficients by Sanathanan-Koerner iterations, from weights 1 or those of theta."""
        for _ in range(iterations):
            flat = None if theta is None else self._flat(theta)
            gradient, normal = self._rows.start_equations(flat)
            parts = self._of_points(normal), self._of_points(gradient)
            theta = -solve_arrow(*parts, self._shared)[0]
        assert theta is not None
        return theta

    def _flat(self, theta: FloatArray) -> FloatArray:
        return theta.reshape(-1, theta.shape[-1])

    def _of_points(self, rows: npt.NDArray) -> npt.NDArray:
        return rows.reshape(-1, self._records, *rows.shape[1:])


def rows_of(points: IntArray, records: int) -> IntArray:
    """Rows of points (k,): M of each, one after the other."""
    return np.asarray((points[:, None] * records + np.arange(records)).ravel())


def start_shared(problem: Problem, data: Sequence[BinData], records: int) -> FloatArray:
    """(batch, M, n) start values; see `Problem.start`."""
    points = SharedPoints(problem, data, records)
    if problem.driven is problem:
        return points.start(START_ITERATIONS)
    first = SharedPoints(problem.driven, data[-1:], records).start(1)
    return points.start(START_ITERATIONS - 1, first)


def minimise_shared(
    problem: Problem,
    data: Sequence[BinData],
    records: int,
    start: FloatArray | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> Solution:
    """Minimise the cost of each point of a batch that is computed together; see `solver.minimise`.

    Returns
    -------
    Solution
        With theta (batch, M, n), normals (batch, M, groups, n, n), residuals (batch, M, K). Points
        that did not converge are fitted again by the dense solver.
    """
    begin = start_shared(problem, data, records) if start is None else start
    points = SharedPoints(problem, data, records)
    return refine_shared(problem, points, data, begin, None, max_iterations)


def refine_shared(
    problem: Problem,
    points: SharedPoints,
    data: Sequence[BinData],
    start: FloatArray,
    value: SharedValues | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> Solution:
    """From start values (batch, M, n); see `minimise_shared`."""
    records = start.shape[1]
    solution = refine(points, start, value, max_iterations)
    for k in np.flatnonzero(~solution.converged):
        row = [values.rows(rows_of(np.array([k]), records)) for values in data]
        _refit(problem, solution, int(k), row)
    return solution


def _refit(problem: Problem, solution: Solution, k: int, data: Sequence[BinData]) -> None:
    """Replace a point by what the dense solver finds with all transients side by side."""
    records = solution.theta.shape[1]
    stacked, parts = side_by_side(problem, data)
    dense = minimise_dense(stacked, parts)
    if not dense.converged:
        return
    a, b, own = problem.sizes
    shared = a + b
    edges = np.cumsum([0] + [group.size for group in stacked.groups])
    half = edges[-1]
    groups = len(problem.groups)
    solution.converged[k] = True
    solution.cost[k] = dense.group_cost.sum()
    solution.group_cost[k] = dense.group_cost.reshape(records, groups).sum(axis=0)
    solution.theta[k, :, :shared] = dense.theta[:shared]
    solution.theta[k, :, shared:] = dense.theta[shared:].reshape(records, own)
    for m in range(records):
        mine = shared + m * own
        columns = np.r_[:shared, mine : mine + own]
        for g in range(groups):
            first, last = edges[m * groups + g], edges[m * groups + g + 1]
            rows = np.r_[first:last, half + first : half + last]
            part = dense.jacobian[np.ix_(rows, columns)]
            solution.normal[k, m, g] = part.T @ part
        solution.residual[k, m] = dense.residual[first:last]


def side_by_side(problem: Problem, data: Sequence[BinData]) -> tuple[Problem, list[BinData]]:
    """One point as a problem of its own: groups of each record, transients in columns of their own."""
    records = data[0].y.shape[0]
    groups: list[BinGroup] = []
    parts: list[BinData] = []
    for m in range(records):
        for group, values in zip(problem.groups, data, strict=True):
            assert group.transient is not None
            own = group.transient.shape[1]
            transient = np.zeros((group.size, records * own), complex)
            transient[:, m * own : (m + 1) * own] = group.transient
            groups.append(replace(group, transient=transient))
            parts.append(values.rows(slice(m, m + 1)))
    return Problem(tuple(groups)), parts
