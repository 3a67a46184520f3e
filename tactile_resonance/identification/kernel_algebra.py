# SPDX-License-Identifier: Apache-2.0
"""Small matrices of the compiled kernels: normal equations as `kernel_driven.add_up_driven` leaves them."""

from __future__ import annotations

import numpy as np

from tactile_resonance.identification.kernel_memory import compiled


@compiled
def eliminate(normal, work, step):
    """Solve normal equations; whether they have a solution.

    Without pivoting, see `normal_equations.solve_positive`.

    Parameters
    ----------
    normal : (n (n + 1) + 1,) float
        See `kernel_driven.add_up_driven`.
    work : same shape
        Overwritten.
    step : (n,) float
        Out.
    """
    n = step.size
    width = n + 1
    for k in range(n * width):
        work[k] = normal[k]
    for j in range(n):
        row = j * width
        pivot = work[row + j] * (1 + 1e-15)
        if not pivot > 0:
            return False
        inverse = 1 / pivot
        work[row + j] = inverse
        for i in range(j + 1, n):
            other = i * width
            factor = work[row + i] * inverse
            for k in range(i, width):
                work[other + k] -= factor * work[row + k]
    for j in range(n - 1, -1, -1):
        row = j * width
        total = work[row + n]
        for k in range(j + 1, n):
            total -= work[row + k] * step[k]
        step[j] = total * work[row + j]
    return True


@compiled
def invert(normal, work, inverse):
    """Inverse (n, n) of a flat normal matrix, by sweeps, and its condition number.

    Infinite where there is none; see `covariance.invert_normal`. `work` (n or more,) is overwritten: a
    row in an array of its own lets the compiler take several entries at once.
    """
    n = inverse.shape[0]
    for i in range(n):
        for j in range(i, n):
            value = normal[i * (n + 1) + j]
            inverse[i, j] = value
            inverse[j, i] = value
    for k in range(n):
        pivot = inverse[k, k]
        if not pivot > 0:
            return np.inf
        factor = 1 / pivot
        for j in range(n):
            work[j] = inverse[k, j]
        for i in range(n):
            if i != k:
                scale = work[i] * factor
                for j in range(n):
                    inverse[i, j] -= scale * work[j]
                inverse[i, k] = scale
        for j in range(n):
            inverse[k, j] *= factor
        inverse[k, k] = -factor
    for i in range(n):
        for j in range(i + 1):  # both halves: rounding made them differ
            value = -0.5 * (inverse[i, j] + inverse[j, i])
            inverse[i, j] = value
            inverse[j, i] = value
    for i in range(n):
        if not inverse[i, i] > 0:
            return np.inf
        work[i] = normal[i * (n + 2)]
    before, after = 0.0, 0.0
    for i in range(n):
        first = second = 0.0
        for j in range(i + 1, n):
            first += normal[i * (n + 1) + j] ** 2 / work[j]
            second += inverse[i, j] ** 2 * work[j]
        before += 1 + 2 * first / work[i]
        after += (inverse[i, i] * work[i]) ** 2 + 2 * second * work[i]
    return np.sqrt(np.sqrt(before * after))


@compiled
def f_quantile(normal, dof_1, dof_2):
    """As `noise_level.f_quantile`, from the normal quantile."""
    a, b = 2 / (9 * dof_1), 2 / (9 * dof_2)
    bottom = (1 - b) ** 2 - normal**2 * b
    if not bottom > 0:
        return np.inf
    under = (1 - a) ** 2 * b + (1 - b) ** 2 * a - normal**2 * a * b
    return (((1 - a) * (1 - b) + normal * np.sqrt(max(under, 0.0))) / bottom) ** 3
