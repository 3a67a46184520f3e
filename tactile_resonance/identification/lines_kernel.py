# SPDX-License-Identifier: Apache-2.0
"""Fits of one mode to the lines of an FRF, point after point, compiled by numba.

The steps are those of `solver`, `many_points` and `covariance`, written out. A point that needs more
than undamped steps is left unmarked. Only `lines_compiled` imports this, and only where it is asked
for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from tactile_resonance.identification import (
    kernel_algebra,
    kernel_driven,
    kernel_memory,
    kernel_tables,
)
from tactile_resonance.identification.kernel_algebra import eliminate, invert
from tactile_resonance.identification.kernel_driven import (
    add_up_driven,
    linearise_driven,
    turned_residual,
    weigh_start,
)
from tactile_resonance.identification.kernel_memory import (
    B_ROW,
    IM,
    MOST_BINS,
    OPTIONS,
    U_ROW,
    S,
    V,
    Y,
    combine,
    fingerprint,
    inlined,
    prepared,
)

__all__ = ["MOST_BINS", "fit_points", "workspace"]


def workspace(table, n):
    """What `fit_points` computes in: the group's memory, as rows and flat, and three small arrays."""
    memory = prepared(table)
    memory[U_ROW, : table.size] = 1.0
    entries = n * (n + 1) + 1
    return memory, memory.reshape(-1), (np.empty(entries), np.empty(entries), np.empty(n))


@inlined
def _gather(response, variance, flat):
    """A point's lines with their weights in the memory; their weighted power, NaN where one is no number."""
    power = 0.0
    for k in range(response.size):
        value, weight = response[k], 1 / variance[k]
        flat[Y + k], flat[Y + IM + k] = value.real, value.imag
        flat[V + k], flat[S + k] = weight, variance[k]
        power += weight * (value.real * value.real + value.imag * value.imag)
    return power


@inlined
def _start(theta, table, memory, flat, normals):
    """Start values in theta; see `ManyPoints.start`. Whether there are any."""
    normal, work, _ = normals
    bins = table.products.shape[1]
    weigh_start(flat, 0.0, 0.0, True, bins)
    add_up_driven(memory, table, normal)
    if not eliminate(normal, work, theta):
        return False
    weigh_start(flat, theta[0], theta[1], False, bins)
    add_up_driven(memory, table, normal)
    return eliminate(normal, work, theta)


@inlined
def _cost(theta, table, memory, flat):
    """Cost at theta, with weights in the memory."""
    combine(memory, B_ROW, table.numerator, theta, 2)
    return linearise_driven(flat, theta[0], theta[1], 0.0, table.products.shape[1])


@inlined
def _refine(theta, table, memory, flat, normals, floor, limit, iterations):
    """Cost where the last step leads; negative where steps need damping.

    The normal equations of the last step stay in the first of `normals`.
    """
    normal, work, step = normals
    width = theta.size + 1
    before = np.inf
    for _ in range(iterations):
        cost = _cost(theta, table, memory, flat)
        if not cost <= before * (1 + 1e-12) + floor:
            break
        before = cost
        add_up_driven(memory, table, normal)
        if not eliminate(normal, work, step):
            break
        decrement = 0.0
        for i in range(theta.size):
            decrement += normal[i * width + theta.size] * step[i]
        for i in range(theta.size):
            theta[i] -= step[i]
        if decrement <= max(limit * cost, floor):
            return cost - decrement
    return -1.0


def _entry(sources: int) -> Any:
    """`fit_points` of these sources."""

    @njit(cache=True, **OPTIONS)
    def fit_points(response, variance, table, limits, space, out):
        """Fit of points.

        Parameters
        ----------
        response : (batch, F) complex
        variance : (batch, F) float
            Infinite on lines that are left out.
        table : GroupTable
        limits : (4,) float
            Of rounding and of a last step, squared and relative to the cost; iterations; condition
            number.
        space : tuple of arrays
            See `workspace`.
        out : tuple of arrays
            ordinary (batch,) bool, theta (batch, n), inverse (batch, n, n) of the normal matrices,
            condition number (batch,), cost (batch,), residual (batch, F) complex.
        """
        ordinary, theta, inverse, condition, cost, residual = out
        if sources < 0:
            return
        memory, flat, normals = space
        for point in range(response.shape[0]):
            at = theta[point]
            power = _gather(response[point], variance[point], flat)
            if not (np.isfinite(power) and _start(at, table, memory, flat, normals)):
                continue
            floor, iterations = limits[0] * power, int(limits[2])
            cost[point] = _refine(at, table, memory, flat, normals, floor, limits[1], iterations)
            if not cost[point] >= 0:
                continue
            condition[point] = invert(normals[0], normals[1], inverse[point])
            if not condition[point] < limits[3]:
                continue
            _cost(at, table, memory, flat)
            turned_residual(flat, 1.0, residual[point])
            ordinary[point] = True

    return fit_points


fit_points = _entry(fingerprint(kernel_algebra, kernel_driven, kernel_memory, kernel_tables))
