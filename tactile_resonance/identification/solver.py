# SPDX-License-Identifier: Apache-2.0
"""Maximum likelihood fit of many points at once: Levenberg-Marquardt steps on normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.one_point import OnePoint, OneValue
from tactile_resonance.identification.problem import START_ITERATIONS, Problem

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
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
    residual : (batch, K) complex
        Weighted, of the last group.
    converged : (batch,) bool
    iterations : (batch,) int
    """

    theta: FloatArray
    normal: FloatArray
    cost: FloatArray
    group_cost: FloatArray
    residual: ComplexArray
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
    chunk = problem.chunk_of(batch)
    parts = []
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for first in range(0, max(batch, 1), chunk):
            rows = slice(first, first + chunk)
            part = [values.rows(rows) for values in data] if batch > chunk else list(data)
            points = problem.points(part)
            begin = points.start(START_ITERATIONS) if start is None else start[rows]
            parts.append(refine(points, np.atleast_2d(begin), None, max_iterations))
    if len(parts) == 1:
        return parts[0]
    fields = ("theta", "normal", "cost", "group_cost", "residual", "converged", "iterations")
    return Solution(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields))


def refine(
    points: Any,
    start: FloatArray,
    value: Any = None,
    max_iterations: int = MAX_ITERATIONS,
) -> Solution:
    """Minimise the cost of points that are computed together.

    Parameters
    ----------
    points : OnePoint, ManyPoints or SharedPoints
    start : (batch, n) or, of `SharedPoints`, (batch, M, n) float
    value : what `points.evaluate` returns, optional
        The model there, where it is known already.
    max_iterations : int
        Evaluations of the model after the first one.
    """
    if isinstance(points, OnePoint):
        assert value is None or isinstance(value, OneValue)
        return _refine_one(points, start[0], value, max_iterations)
    return _refine_many(points, start, value, max_iterations)


def _refine_one(
    point: OnePoint, theta: FloatArray, value: OneValue | None, max_iterations: int
) -> Solution:
    """As `_refine_many`, for a batch of one: no masks."""
    value = point.weight(point.evaluate(theta) if value is None else value)
    cost = value.cost
    limit, floor = STEP_TOLERANCE**2 / point.free, ROUNDING**2 * point.weighted_power
    gradient, normal = point.normals(value)
    damping = 0.0
    converged = False
    iterations = 0
    residual = None
    for _ in range(max_iterations):
        step, decrement = point.step(normal, gradient, damping)
        if damping == 0 and decrement <= max(limit * cost, floor):
            theta = theta - step
            cost -= decrement
            residual = point.residual_after(value, step)
            converged = True
            break
        if not np.isfinite(decrement) or damping > 1e10:
            break
        trial = point.weight(point.evaluate(theta - step))
        iterations += 1
        if trial.cost <= cost * (1 + 1e-12) + floor:
            theta, value, cost = theta - step, trial, trial.cost
            gradient, normal = point.normals(value)
            damping = 0.0 if damping < 1e-4 else damping / 10
        else:
            damping = max(10 * damping, 1e-3)
    if residual is None:
        residual = point.residual_after(value, np.zeros_like(theta))
    return Solution(
        theta[None],
        normal[None],
        np.array([cost]),
        value.group_cost[None],
        residual[None],
        np.array([converged]),
        np.array([iterations]),
    )


def _refine_many(points: Any, theta: FloatArray, value: Any, max_iterations: int) -> Solution:
    batch = theta.shape[0]
    value = points.weight(points.evaluate(theta) if value is None else value)
    limit, floor = STEP_TOLERANCE**2 / points.free, ROUNDING**2 * points.weighted_power
    cost, group_cost = value.cost, value.group_cost
    gradient, normal = points.normals(value)
    theta = theta.copy()
    damping = np.zeros(batch)
    converged = np.zeros(batch, bool)
    iterations = np.zeros(batch, np.int64)
    active = np.arange(batch)
    work = points
    for _ in range(max_iterations):
        now = slice(None) if active.size == batch else active
        step, decrement = points.step(normal[now], gradient[now], damping[now])
        done = (decrement <= np.maximum(limit * cost[now], floor[now])) & (damping[now] == 0)
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
            work = points.rows(active)
        trial = theta[active] - step
        found = work.weight(work.evaluate(trial))
        trial_gradient, trial_normal = work.normals(found)
        total = found.cost
        iterations[active] += 1
        # rounding of the cost itself must not count as an increase
        better = total <= cost[active] * (1 + 1e-12) + floor[active]
        good = active[better]
        theta[good], cost[good] = trial[better], total[better]
        group_cost[good] = found.group_cost[better]
        gradient[good], normal[good] = trial_gradient[better], trial_normal[better]
        damping[good] = np.where(damping[good] < 1e-4, 0.0, damping[good] / 10)
        worse = active[~better]
        damping[worse] = np.maximum(10 * damping[worse], 1e-3)
    residual = points.last_residual(theta)
    return Solution(theta, normal, cost, group_cost, residual, converged, iterations)
