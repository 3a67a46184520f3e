# SPDX-License-Identifier: Apache-2.0
"""The joint estimator of one mode for point after point, compiled by numba.

The steps are those of `many_points`, `joint_fit`, `joint_noise`, `solver` and `covariance`, written
out. A point that needs more than undamped steps, flat and independent noise and one stable pole in
the band is left unmarked: the plain path takes it. Only `joint_compiled` imports this, and only where
it is asked for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from tactile_resonance.identification import (
    kernel_algebra,
    kernel_driven,
    kernel_judgement,
    kernel_memory,
    kernel_tables,
    kernel_undriven,
    one_mode,
)
from tactile_resonance.identification.kernel_algebra import eliminate
from tactile_resonance.identification.kernel_driven import (
    add_up_driven,
    linearise_driven,
    weigh_start,
)
from tactile_resonance.identification.kernel_judgement import level, pole_in_band
from tactile_resonance.identification.kernel_memory import (
    B_ROW,
    C_ROW,
    E_ROW,
    IM,
    MOST_BINS,
    OPTIONS,
    S_ROW,
    U_ROW,
    V_ROW,
    Y_ROW,
    U,
    Y,
    combine,
    fill,
    fingerprint,
    inlined,
    power,
    prepared,
)
from tactile_resonance.identification.kernel_undriven import (
    add_up_undriven,
    error_with_input,
    spread_of_pieces,
)

__all__ = ["MOST_BINS", "fit_points", "workspace"]

TINY = float(np.finfo(float).tiny)


def workspace(tables, n):
    """What `fit_points` computes in: memories of the groups, as rows and flat, and small arrays.

    One call after another: `fit_points` holds the interpreter's lock.
    """
    memory = [prepared(table) for table in tables]
    entries = n * (n + 1) + 1
    groups = tuple((rows, rows.reshape(-1)) for rows in memory)
    normals = (np.empty(entries), np.empty(entries), np.empty(entries), np.empty(n))
    return groups, normals, np.empty(n, complex)


@inlined
def _gather(u, y, where, flat):
    """Bins of a point, real and imaginary parts, in the memory of a group; whether all are finite."""
    sources, places = where
    finite = 0.0
    for k in range(sources.size):
        value, source, at = y[sources[k]], u[sources[k]], places[k]
        flat[Y + at], flat[Y + IM + at] = value.real, value.imag
        flat[U + at], flat[U + IM + at] = source.real, source.imag
        finite += value.real + value.imag + source.real + source.imag
    return np.isfinite(finite)


@inlined
def _add(total, part, factor):
    """Add ``factor part`` without a new array."""
    for k in range(total.size):
        total[k] += factor * part[k]


@inlined
def _start(theta, tables, groups, normals):
    """Start values in theta; see `Problem.start`. Whether there are any."""
    others, driven = tables
    total, of_others, work, step = normals
    fill(groups[1][0], V_ROW, 1.0, driven.products.shape[1])
    weigh_start(groups[1][1], 0.0, 0.0, True, driven.products.shape[1])
    add_up_driven(groups[1][0], driven, total)
    if not eliminate(total, work, theta):
        return False
    add_up_undriven(groups[0], others.transient, theta, True, of_others)
    weigh_start(groups[1][1], theta[0], theta[1], False, driven.products.shape[1])
    add_up_driven(groups[1][0], driven, total)
    _add(total, of_others, 1.0)
    if not eliminate(total, work, step):
        return False
    for i in range(theta.size):
        theta[i] = step[i]
    return True


@inlined
def _driven(theta, variances, table, group):
    """Cost of the bins with an input, with weights in the memory of the group."""
    combine(group[0], B_ROW, table.numerator, theta, 2)
    combine(group[0], C_ROW, table.transient, theta, theta.size - table.transient.shape[0] // 2)
    bins = table.products.shape[1]
    fill(group[0], S_ROW, variances[0], bins)
    return linearise_driven(group[1], theta[0], theta[1], variances[1], bins)


@inlined
def _near(theta, tables, groups, normals, power_u, limits):
    """One step on from start values; whether there is one."""
    total, of_others, work, step = normals
    size = tables[0].size
    power_y = add_up_undriven(groups[0], tables[0].transient, theta, False, of_others)
    squared = error_with_input(groups[0][1], size) / max(power_y * power_u, TINY)
    variance_y = power_y / size
    variances = (
        variance_y if variance_y > TINY else 1.0,
        0.0 if squared > limits[0] else power_u / size,
    )
    _driven(theta, variances, tables[1], groups[1])
    add_up_driven(groups[1][0], tables[1], total)
    _add(total, of_others, 1 / variances[0])
    if not eliminate(total, work, step):
        return False
    _add(theta, step, -1.0)
    return True


@inlined
def _noise(power_y, power_u, table, group, pieces, limits):
    """Variances of a bin of Y and U, 0 where not flat and independent, at the error in the memory."""
    nothing = (0.0, 0.0)
    flat, size = group[1], table.size
    if not error_with_input(flat, size) / max(power_y * power_u, TINY) <= limits[0]:
        return nothing
    if limits[1] > 0 and not (
        spread_of_pieces(group[0], E_ROW, pieces, power_y / size) <= limits[1]
        and spread_of_pieces(group[0], U_ROW, pieces, power_u / size) <= limits[1]
    ):
        return nothing
    variance_y = power_y / size * limits[2]
    return (variance_y, power_u / size) if variance_y > TINY else nothing


@inlined
def _refine(theta, tables, groups, normals, power_y, variances, limits):
    """Costs of both groups at the last but one theta; negative where steps need damping.

    The normal equations of the bins between harmonics are there already.
    """
    total, of_others, work, step = normals
    data_power = 0.0
    for g in range(2):
        data_power += power(groups[g][0], Y_ROW, tables[g].size)
    floor = limits[3] * data_power / variances[0]
    before = np.inf
    width = theta.size + 1
    for iteration in range(int(limits[5])):
        if iteration > 0:
            power_y = add_up_undriven(groups[0], tables[0].transient, theta, False, of_others)
        others = power_y / variances[0]
        excited = _driven(theta, variances, tables[1], groups[1])
        cost = others + excited
        if not cost <= before * (1 + 1e-12) + floor:
            break
        before = cost
        add_up_driven(groups[1][0], tables[1], total)
        _add(total, of_others, 1 / variances[0])
        if not eliminate(total, work, step):
            break
        decrement = 0.0
        for i in range(theta.size):
            decrement += total[i * width + theta.size] * step[i]
        _add(theta, step, -1.0)
        if decrement <= max(limits[4] * cost, floor):
            return others, excited
    return -1.0, -1.0


def _entry(sources: int) -> Any:
    """`fit_points` of these sources: its cache on disk watches its own file, and values like this."""

    @njit(cache=True, **OPTIONS)
    def fit_points(u, y, where, tables, pieces, bases, limits, space, out):
        """Fit of points.

        Parameters
        ----------
        u, y : (batch, K) complex
        where : two pairs of (K_g,) int arrays
            Of the bins between harmonics and of the excited ones: places in a record, and in `tables`.
        tables : two GroupTable
        pieces : (pieces,) int
            Bins in each piece of the noise.
        bases : two (m + 1, m) float
            Hessenberg matrices of denominator and numerator.
        limits : (11,) float
            See `CompiledJointPlan`.
        space : tuple of arrays
            See `workspace`.
        out : tuple of arrays
            ordinary (batch,) bool, theta (batch, n), covariance (batch, n, n), residual (batch, K_e)
            complex, figures (batch, FIGURES).
        """
        ordinary, theta, covariance, residual, figures = out
        if sources < 0:
            return
        groups, normals, values = space
        for point in range(y.shape[0]):
            at = theta[point]
            finite = _gather(u[point], y[point], where[0], groups[0][1])
            if not (_gather(u[point], y[point], where[1], groups[1][1]) and finite):
                continue
            if not _start(at, tables, groups, normals):
                continue
            power_u = power(groups[0][0], U_ROW, tables[0].size)
            if not _near(at, tables, groups, normals, power_u, limits):
                continue
            power_y = add_up_undriven(groups[0], tables[0].transient, at, False, normals[1])
            variances = _noise(power_y, power_u, tables[0], groups[0], pieces, limits)
            if not variances[0] > 0:
                continue
            costs = _refine(at, tables, groups, normals, power_y, variances, limits)
            if not costs[0] >= 0:
                continue
            _driven(at, variances, tables[1], groups[1])
            found = (covariance[point], residual[point], figures[point])
            sizes = (tables[0].size, tables[1].size)
            if not level(
                groups[1][1], sizes, normals[:3], variances, costs, limits, found
            ):  # fmt: skip
                continue
            terms = bases[1].shape[0]
            band = (limits[8], limits[9], limits[10])
            ordinary[point] = pole_in_band(
                at[:2], at[2 : 2 + terms], covariance[point], bases, band, values, figures[point]
            )

    return fit_points


fit_points = _entry(
    fingerprint(
        kernel_algebra,
        kernel_driven,
        kernel_judgement,
        kernel_memory,
        kernel_tables,
        kernel_undriven,
        one_mode,
    )
)
