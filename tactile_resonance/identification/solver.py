# SPDX-License-Identifier: Apache-2.0
"""Maximum likelihood fit of many points at once: Levenberg-Marquardt steps on normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.normal_equations import solve_scaled, step_and_decrement
from tactile_resonance.identification.one_point import OnePoint
from tactile_resonance.identification.problem import Problem

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MAX_ITERATIONS = 60
# A step below this many standard deviations, as the residuals show them, is the last one taken.
STEP_TOLERANCE = 1e-2
# Rounding of a residual relative to the data it is the residual of.
ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class Solution:
    """Coefficients of a batch.

    Attributes
    ----------
    theta : (batch, n) float
        Coefficients [A without its last, B, C].
    normal : (batch, groups, n, n) float
        ``Re J^H J`` of each group at the solution.
    cost : (batch,) float
    group_cost : (batch, groups) float
    converged : (batch,) bool
    iterations : (batch,) int
    """

    theta: FloatArray
    normal: FloatArray
    cost: FloatArray
    group_cost: FloatArray
    converged: BoolArray
    iterations: npt.NDArray[np.int64]


def minimise(
    problem: Problem,
    data: Sequence[BinData],
    start: FloatArray | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> Solution:
    """Minimise the cost of each point of a batch.

    Parameters
    ----------
    problem : Problem
    data : sequence of BinData
        One for each group, with the same batch.
    start : (batch, n) float, optional
        Sanathanan-Koerner iterations when absent.
    max_iterations : int
        Evaluations of the model after the first one.
    """
    batch = data[0].y.shape[0]
    chunk = problem.chunk
    parts = []
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for first in range(0, max(batch, 1), chunk):
            rows = slice(first, first + chunk)
            part = [values.rows(rows) for values in data] if batch > chunk else list(data)
            begin = problem.first(part) if start is None else start[rows]
            solver = _minimise_one if batch == 1 else _minimise_chunk
            parts.append(solver(problem, part, begin, max_iterations))
    if len(parts) == 1:
        return parts[0]
    fields = ("theta", "normal", "cost", "group_cost", "converged", "iterations")
    return Solution(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields))


def _minimise_one(
    problem: Problem, data: list[BinData], start: FloatArray, max_iterations: int
) -> Solution:
    """As `_minimise_chunk`, for a batch of one: no masks."""
    point = OnePoint(problem.stacked, data)
    theta = start[0]
    free = max(2 * sum(group.size for group in problem.groups) - theta.size, 1)
    floor = ROUNDING**2 * point.weighted_power
    group_cost, gradient, normal = point.linearise(theta)
    cost = float(group_cost.sum())
    damping = 0.0
    converged = False
    iterations = 0
    for _ in range(max_iterations):
        step, decrement = step_and_decrement(normal.sum(axis=0), gradient, damping)
        if damping == 0 and decrement <= max(STEP_TOLERANCE**2 * cost / free, floor):
            theta = theta - step
            cost -= decrement
            converged = True
            break
        if not np.isfinite(decrement) or damping > 1e10:
            break
        trial = theta - step
        trial_cost, trial_gradient, trial_normal = point.linearise(trial)
        total = float(trial_cost.sum())
        iterations += 1
        if total <= cost * (1 + 1e-12) + floor:
            theta, cost, group_cost = trial, total, trial_cost
            gradient, normal = trial_gradient, trial_normal
            damping = 0.0 if damping < 1e-4 else damping / 10
        else:
            damping = max(10 * damping, 1e-3)
    return Solution(
        theta[None],
        normal[None],
        np.array([cost]),
        group_cost[None],
        np.array([converged]),
        np.array([iterations]),
    )


def _minimise_chunk(
    problem: Problem, data: list[BinData], theta: FloatArray, max_iterations: int
) -> Solution:
    batch = theta.shape[0]
    bins = sum(group.size for group in problem.groups)
    free = max(2 * bins - theta.shape[1], 1)
    floor = ROUNDING**2 * sum(
        np.sum((v.y.real**2 + v.y.imag**2) / v.variance_y, axis=-1) for v in data
    )
    group_cost, gradient, normal = problem.linearise(data, theta)
    theta = theta.copy()
    cost = group_cost.sum(axis=-1)
    damping = np.zeros(batch)
    converged = np.zeros(batch, bool)
    iterations = np.zeros(batch, np.int64)
    active = np.arange(batch)
    work = data
    for _ in range(max_iterations):
        whole = active.size == batch
        now = slice(None) if whole else active
        step, decrement = solve_scaled(normal[now].sum(axis=1), gradient[now], damping[now])
        tolerance = np.maximum(STEP_TOLERANCE**2 * cost[now] / free, floor[now])
        done = (decrement <= tolerance) & (damping[now] == 0)
        theta[active[done]] -= step[done]
        cost[active[done]] -= decrement[done]
        converged[active[done]] = True
        # a point without any finite step has nowhere to go
        lost = ~np.isfinite(decrement) | (damping[now] > 1e10)
        keep = ~(done | lost)
        if not keep.any():
            break
        if not keep.all():
            active, step = active[keep], step[keep]
            work = [values.rows(active) for values in data]
        trial = theta[active] - step
        trial_cost, trial_gradient, trial_normal = problem.linearise(work, trial)
        total = trial_cost.sum(axis=-1)
        iterations[active] += 1
        # rounding of the cost itself must not count as an increase
        better = total <= cost[active] * (1 + 1e-12) + floor[active]
        if better.all() and active.size == batch:
            theta, cost, group_cost = trial, total, trial_cost
            gradient, normal = trial_gradient, trial_normal
            damping[:] = np.where(damping < 1e-4, 0.0, damping / 10)
            continue
        good = active[better]
        theta[good], cost[good], group_cost[good] = trial[better], total[better], trial_cost[better]
        gradient[good], normal[good] = trial_gradient[better], trial_normal[better]
        damping[good] = np.where(damping[good] < 1e-4, 0.0, damping[good] / 10)
        worse = active[~better]
        damping[worse] = np.maximum(10 * damping[worse], 1e-3)
    return Solution(theta, normal, cost, group_cost, converged, iterations)
