# SPDX-License-Identifier: Apache-2.0
"""Covariance, level and pole of a point fitted by `joint_kernel`, and whether nothing contradicts."""

from __future__ import annotations

import numpy as np

from tactile_resonance.identification import one_mode
from tactile_resonance.identification.kernel_algebra import compiled, f_quantile, solve
from tactile_resonance.identification.kernel_model import ERROR, WEIGHT, evaluate, weigh_driven
from tactile_resonance.identification.one_mode import (
    CONDITION,
    COST,
    EXPECTED,
    NOISE_U,
    NOISE_Y,
)

pole_in_band = compiled(one_mode.pole_in_band)


@compiled
def invert_factored(total, lower, unit, vectors, covariance):
    """Inverse of a factorised normal matrix, and its condition number; see `invert_normal`."""
    n = unit.size
    column, out = vectors[0], vectors[2]
    before, after = 0.0, 0.0
    for i in range(n):
        for j in range(n):
            before += (total[i, j] * unit[i] * unit[j]) ** 2
    for j in range(n):
        column[:] = 0.0
        column[j] = 1.0
        solve(lower, unit, column, out)
        for i in range(n):
            covariance[i, j] = out[i]
            after += (out[i] / (unit[i] * unit[j])) ** 2
    return (before * after) ** 0.25


@compiled
def level(group, theta, limits, variances, costs, memory, out):
    """Covariance, residual, cost and its expectation; whether they are those of noise."""
    data, values, _, normal, vectors, lower = memory
    covariance, residual, figures = out
    n = theta.size
    # the factor is that of the step just taken
    condition = invert_factored(normal[2], lower, vectors[3], vectors, covariance)
    used = 0.0
    for i in range(n):
        for j in range(n):
            used += covariance[i, j] * normal[0, j, i]
    bins_o, bins_e = data[0].shape[1], data[1].shape[1]
    dof_o, dof_e = bins_o - used / 2, bins_e - (n - used) / 2
    dof = dof_o + dof_e
    scale = costs[0] / dof_o
    cost = costs[1] / scale
    if not (cost <= dof_e * f_quantile(limits[6], 2 * dof_e, 2 * dof_o) and dof > 1):
        return False
    pooled = (costs[0] + costs[1]) / dof
    ratio = 0.5 * pooled * dof / (dof - 1)
    for i in range(n):
        for j in range(n):
            covariance[i, j] *= ratio
    figures[COST], figures[EXPECTED] = cost, dof_e * dof_o / (dof_o - 1)
    figures[CONDITION] = condition
    figures[NOISE_Y], figures[NOISE_U] = variances[0] * scale, variances[1] * scale
    excited, at = data[1], values[1]
    evaluate(group, theta, excited, at)
    weigh_driven(at, variances[0], variances[1])
    for k in range(bins_e):
        u = complex(excited[2, k], excited[3, k])
        error = complex(at[ERROR, k], at[ERROR + 1, k]) * np.sqrt(at[WEIGHT, k] / pooled)
        size = abs(u)
        if size > 0:
            error *= u.conjugate() / size
        residual[k] = error
    return condition < limits[7]
