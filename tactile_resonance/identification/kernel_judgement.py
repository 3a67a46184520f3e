# SPDX-License-Identifier: Apache-2.0
"""Covariance, level and pole of a point fitted by `joint_kernel`, and whether nothing contradicts."""

from __future__ import annotations

import numpy as np

from tactile_resonance.identification import one_mode
from tactile_resonance.identification.kernel_algebra import f_quantile, invert
from tactile_resonance.identification.kernel_driven import turned_residual
from tactile_resonance.identification.kernel_memory import compiled
from tactile_resonance.identification.one_mode import (
    CONDITION,
    COST,
    EXPECTED,
    NOISE_U,
    NOISE_Y,
)

pole_in_band = compiled(one_mode.pole_in_band)


@compiled
def level(flat, sizes, normals, variances, costs, limits, out):
    """Covariance, residual, cost and its expectation; whether they are those of noise.

    `normals` are flat, of all bins and of those between harmonics, the latter without their
    variance, and one to be overwritten; the residual is that of the memory of the excited bins.
    """
    covariance, residual, figures = out
    total, of_others, work = normals
    n = covariance.shape[0]
    condition = invert(total, work, covariance)
    if not condition < limits[7]:
        return False
    used = 0.0
    for i in range(n):
        used += covariance[i, i] * of_others[i * (n + 2)]
        for j in range(i + 1, n):
            used += 2 * covariance[i, j] * of_others[i * (n + 1) + j]
    used /= variances[0]
    dof_o, dof_e = sizes[0] - used / 2, sizes[1] - (n - used) / 2
    dof = dof_o + dof_e
    scale = costs[0] / dof_o
    cost = costs[1] / scale
    if not (cost <= dof_e * f_quantile(limits[6], 2 * dof_e, 2 * dof_o) and dof > 1):
        return False
    pooled = (costs[0] + costs[1]) / dof
    scaling = 0.5 * pooled * dof / (dof - 1)
    for i in range(n):
        for j in range(n):
            covariance[i, j] *= scaling
    figures[COST], figures[EXPECTED] = cost, dof_e * dof_o / (dof_o - 1)
    figures[CONDITION] = condition
    figures[NOISE_Y], figures[NOISE_U] = variances[0] * scale, variances[1] * scale
    turned_residual(flat, 1 / np.sqrt(pooled), residual)
    return True
