# SPDX-License-Identifier: Apache-2.0
"""Covariance, level and pole of a point fitted by `joint_kernel`, and whether nothing contradicts."""

from __future__ import annotations

import numpy as np

from tactile_resonance.identification.kernel_algebra import compiled, f_quantile, solve
from tactile_resonance.identification.kernel_model import ERROR, WEIGHT, evaluate, weigh_driven

# Columns of `figures`.
COST, EXPECTED, CONDITION, NOISE_Y, NOISE_U, F0_HZ, DAMPING, POLE, RESIDUE = (
    *(0, 1, 2, 3, 4, 5, 6),
    *(7, 9),
)
POLE_COVARIANCE, COVARIANCE, FIGURES = 11, 15, 19


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


@compiled
def pole_in_band(theta, covariance, bases, limits, figures):
    """The pole, its residue and covariances; whether it is one stable pair near the band."""
    h, h_b = bases
    scale = limits[8]
    last_0, last_1 = h[2, 1] * theta[0], h[2, 1] * theta[1]
    first, second = h[0, 0], h[1, 1] - last_1
    under = ((first - second) / 2) ** 2 + (h[0, 1] - last_0) * h[1, 0]
    if not under < 0:
        return False
    x = complex((first + second) / 2, np.sqrt(-under))
    pole = x * scale
    size = abs(pole)
    f0_hz = size / (2 * np.pi)
    if not (pole.real < 0 and limits[9] <= f0_hz <= limits[10]):
        return False
    # A and its slope
    p_1 = (x - h[0, 0]) / h[1, 0]
    slope_1 = 1 / h[1, 0]
    slope_2 = (p_1 + (x - h[1, 1]) * slope_1) / h[2, 1]
    ratio = scale / (theta[1] * slope_1 + slope_2)
    terms = h_b.shape[0]
    values = np.empty(terms, np.complex128)
    values[0] = 1.0
    b = complex(theta[2], 0.0)
    for k in range(terms - 1):
        total = x * values[k]
        for j in range(k + 1):
            total -= h_b[j, k] * values[j]
        values[k + 1] = total / h_b[k + 1, k]
        b += theta[3 + k] * values[k + 1]
    residue = b * ratio
    s_0, s_1 = -ratio, -p_1 * ratio
    c_00, c_01, c_11 = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    # (Re, Im) of the pole
    rr = s_0.real**2 * c_00 + 2 * s_0.real * s_1.real * c_01 + s_1.real**2 * c_11
    ii = s_0.imag**2 * c_00 + 2 * s_0.imag * s_1.imag * c_01 + s_1.imag**2 * c_11
    ri = s_0.real * s_0.imag * c_00 + s_1.real * s_1.imag * c_11
    ri += (s_0.real * s_1.imag + s_0.imag * s_1.real) * c_01
    re, im = pole.real, pole.imag
    f_r, f_i = re / (2 * np.pi * size), im / (2 * np.pi * size)
    d_r, d_i = -(im**2) / size**3, re * im / size**3
    cross = f_r * d_r * rr + (f_r * d_i + f_i * d_r) * ri + f_i * d_i * ii
    figures[F0_HZ], figures[DAMPING] = f0_hz, -re / size
    figures[POLE], figures[POLE + 1] = re, im
    figures[RESIDUE], figures[RESIDUE + 1] = residue.real, residue.imag
    figures[POLE_COVARIANCE], figures[POLE_COVARIANCE + 3] = rr, ii
    figures[POLE_COVARIANCE + 1] = figures[POLE_COVARIANCE + 2] = ri
    figures[COVARIANCE] = f_r**2 * rr + 2 * f_r * f_i * ri + f_i**2 * ii
    figures[COVARIANCE + 1] = figures[COVARIANCE + 2] = cross
    figures[COVARIANCE + 3] = d_r**2 * rr + 2 * d_r * d_i * ri + d_i**2 * ii
    return True
