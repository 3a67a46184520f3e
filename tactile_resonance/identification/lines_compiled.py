# SPDX-License-Identifier: Apache-2.0
"""Fits of one mode to lines through compiled code: the same answers in less time.

See `joint_compiled` on numba, which is an optional dependency.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.compiled import kernel
from tactile_resonance.identification.kernel_tables import GroupTable
from tactile_resonance.identification.lines_fit import NORMAL_EQUATIONS_LIMIT, LinesFit, LinesPlan
from tactile_resonance.identification.solver import MAX_ITERATIONS, ROUNDING, STEP_TOLERANCE


def fit_compiled(plan: LinesPlan, data: BinData) -> LinesFit:
    """As `LinesPlan.fit`, for one mode in the s-domain and responses without noise of an input.

    Points whose steps need damping, or whose normal equations are not to be trusted, are fitted by
    `LinesPlan.fit`.

    Raises
    ------
    ImportError
        Without numba.
    ValueError
        For other structures, and more lines than fit the kernel's memory.
    """
    code = kernel("lines_kernel")
    structure = plan.structure
    if structure.order != 2 or structure.domain != "s" or structure.delay:
        raise ValueError(f"structure: {structure}, compiled is order 2 in s without delay")
    if plan.frequency_hz.size > code.MOST_BINS:
        raise ValueError(
            f"band_hz: {plan.frequency_hz.size} lines, compiled takes up to {code.MOST_BINS}"
        )
    response = np.ascontiguousarray(data.y, complex)
    variance = np.ascontiguousarray(np.broadcast_to(data.variance_y, response.shape), float)
    batch, lines = response.shape
    n = sum(plan.problem.sizes)
    ordinary = np.zeros(batch, bool)
    theta, inverse = np.empty((batch, n)), np.empty((batch, n, n))
    condition, cost = np.empty(batch), np.empty(batch)
    residual = np.zeros((batch, lines), complex)
    limits = np.array(
        [
            ROUNDING**2,
            STEP_TOLERANCE**2 / max(2 * lines - n, 1),
            MAX_ITERATIONS,
            NORMAL_EQUATIONS_LIMIT,
        ]
    )
    out = (ordinary, theta, inverse, condition, cost, residual)
    table = _table(plan)
    code.fit_points(response, variance, table, limits, code.workspace(table, n), out)
    inverse *= 0.5
    fit = LinesFit(plan.model_of(theta), cost, inverse, condition, np.ones(batch, bool), residual)
    return fit if ordinary.all() else _replaced(fit, ~ordinary, plan.fit(data.rows(~ordinary)))


def _replaced(fit: LinesFit, rows: np.ndarray, other: LinesFit) -> LinesFit:
    """With other fits in some rows."""
    for name in ("cost", "covariance", "condition_number", "converged", "residual"):
        getattr(fit, name)[rows] = getattr(other, name)
    for name in ("denominator", "numerator"):
        getattr(fit.model, name)[rows] = getattr(other.model, name)
    return fit


@lru_cache(maxsize=16)
def _table(plan: LinesPlan) -> GroupTable:
    return GroupTable.of(plan.problem.groups[0], plan.problem.sizes)
