# SPDX-License-Identifier: Apache-2.0
"""The joint estimator of one mode for point after point, compiled by numba.

The steps are those of `many_points`, `joint_fit`, `joint_noise`, `solver` and `covariance`, written out. A
point that needs more than undamped steps, flat and independent noise and one stable pole in the band
is left unmarked: the plain path takes it. Only `joint_compiled` imports this, and only where it is
asked for.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numba import njit

from tactile_resonance.identification import (
    kernel_algebra,
    kernel_judgement,
    kernel_model,
    one_mode,
)
from tactile_resonance.identification.kernel_algebra import (
    OPTIONS,
    compiled,
    dot,
    factorise,
    real_dot,
    solve,
    spread_of_pieces,
)
from tactile_resonance.identification.kernel_judgement import level, pole_in_band
from tactile_resonance.identification.kernel_model import (
    ERROR,
    VALUES,
    WORK,
    evaluate,
    linearise_driven,
    linearise_others,
    power_of_error,
    start_group,
    weigh_driven,
)

TINY = float(np.finfo(float).tiny)


@compiled
def _gather(u, y, where, data, input_o):
    """Bins of a point by groups, real and imaginary parts; whether all are finite."""
    finite = 0.0
    for group in range(2):
        places, rows = where[group], data[group]
        source_re, source_im = (rows[2], rows[3]) if group == 1 else (input_o[0], input_o[1])
        for k in range(places.size):
            value, source = y[places[k]], u[places[k]]
            rows[0, k], rows[1, k] = value.real, value.imag
            source_re[k], source_im[k] = source.real, source.imag
            finite += value.real + value.imag + source.real + source.imag
    return np.isfinite(finite)


@compiled
def _step(memory, only_driven):
    """Undamped step in vectors[2] from the normal matrices; whether there is one."""
    _, _, _, normal, vectors, lower = memory
    n = vectors.shape[1]
    for i in range(n):
        for j in range(n):
            normal[2, i, j] = normal[1, i, j] if only_driven else normal[0, i, j] + normal[1, i, j]
    if not factorise(normal[2], vectors[3], lower, 1e-15):
        return False
    solve(lower, vectors[3], vectors[1], vectors[2])
    return True


@compiled
def _start(theta, groups, memory):
    """Start values in theta; see `Problem.start`. Whether there are any."""
    data, values, work, normal, vectors, _ = memory
    for iteration in range(2):
        vectors[1] = 0.0
        for g in range(1 - iteration, 2):
            start_group(
                groups[g], theta, iteration == 0, data[g], values[g], work[g], normal[g],
                vectors[1],
            )  # fmt: skip
        if not _step(memory, iteration == 0):
            return False
        theta[:] = vectors[2]
    return True


@compiled
def _linearise(groups, variances, memory):
    """Gradient in vectors[1], normals in normal[:2], of values that are weighed."""
    data, values, work, normal, vectors, _ = memory
    vectors[1] = 0.0
    linearise_others(
        groups[0], values[0], data[0], 1 / variances[0], work[0], normal[0], vectors[1]
    )
    linearise_driven(groups[1], values[1], data[1], variances[1], work[1], normal[1], vectors[1])


@compiled
def _powers(values, input_o):
    """Powers of the errors between harmonics and of U, and their squared correlation."""
    e_re, e_im = values[ERROR], values[ERROR + 1]
    u_re, u_im = input_o[0], input_o[1]
    power_y, power_u = power_of_error(values), dot(u_re, u_re) + dot(u_im, u_im)
    cross_re = dot(e_re, u_re) + dot(e_im, u_im)
    cross_im = real_dot(e_im, e_re, u_re, u_im)
    squared = (cross_re * cross_re + cross_im * cross_im) / max(power_y * power_u, TINY)
    return power_y, power_u, squared


@compiled
def _near(theta, groups, limits, input_o, memory):
    """One step on from start values; whether there is one."""
    data, values, _, _, vectors, _ = memory
    evaluate(groups[0], theta, data[0], values[0])
    evaluate(groups[1], theta, data[1], values[1])
    power_y, power_u, squared = _powers(values[0], input_o)
    size = data[0].shape[1]
    variance_y = power_y / size
    variances = (
        variance_y if variance_y > TINY else 1.0,
        0.0 if squared > limits[0] else power_u / size,
    )
    weigh_driven(values[1], variances[0], variances[1])
    _linearise(groups, variances, memory)
    if not _step(memory, False):
        return False
    theta -= vectors[2]
    return True


@compiled
def _noise(groups, theta, pieces, limits, input_o, memory):
    """Variances of a bin of Y and U, 0 where not flat and independent; the model in values[0]."""
    data, values, _, _, _, _ = memory
    nothing = (0.0, 0.0)
    evaluate(groups[0], theta, data[0], values[0])
    power_y, power_u, squared = _powers(values[0], input_o)
    if not squared <= limits[0]:
        return nothing
    error = values[0][ERROR : ERROR + 2]
    if limits[1] > 0 and not (
        spread_of_pieces(pieces[0], pieces[1], error[0], error[1]) <= limits[1]
        and spread_of_pieces(pieces[0], pieces[1], input_o[0], input_o[1]) <= limits[1]
    ):
        return nothing
    size = data[0].shape[1]
    variance_y = power_y / size * limits[2]
    return (variance_y, power_u / size) if variance_y > TINY else nothing


@compiled
def _refine(theta, groups, limits, variances, memory):
    """Costs of both groups at the last but one theta; negative where steps need damping.

    The model of the first group at theta is in values[0] already.
    """
    data, values, _, _, vectors, _ = memory
    power = 0.0
    for g in range(2):
        power += dot(data[g][0], data[g][0]) + dot(data[g][1], data[g][1])
    floor = limits[3] * power / variances[0]
    before = np.inf
    for iteration in range(int(limits[5])):
        if iteration > 0:
            evaluate(groups[0], theta, data[0], values[0])
        evaluate(groups[1], theta, data[1], values[1])
        others = power_of_error(values[0]) / variances[0]
        excited = weigh_driven(values[1], variances[0], variances[1])
        cost = others + excited
        if not cost <= before * (1 + 1e-12) + floor:
            break
        before = cost
        _linearise(groups, variances, memory)
        if not _step(memory, False):
            break
        decrement = dot(vectors[1], vectors[2])
        theta -= vectors[2]
        if decrement <= max(limits[4] * cost, floor):
            return others, excited
    return -1.0, -1.0


def _entry(sources: int) -> Any:
    """`fit_points` of these sources: its cache on disk watches its own file, and values like this."""

    @njit(cache=True, **OPTIONS)
    def fit_points(u, y, where, groups, pieces, bases, limits, out):
        """Fit of points.

        Parameters
        ----------
        u, y : (batch, K) complex
        where : two (K_g,) int arrays
            Of the bins between harmonics and of the excited ones.
        groups : two groups
            See `kernel_model`.
        pieces : two int arrays
            Starts and counts of the pieces of the noise.
        bases : two (m + 1, m) float
            Hessenberg matrices of denominator and numerator.
        limits : (11,) float
            See `CompiledJointPlan`.
        out : tuple of arrays
            ordinary (batch,) bool, theta (batch, n), covariance (batch, n, n), residual (batch, K_e)
            complex, figures (batch, FIGURES).
        """
        ordinary, theta, covariance, residual, figures = out
        if sources < 0:
            return
        n = theta.shape[1]
        bins = (where[0].size, where[1].size)
        data = (np.zeros((4, bins[0])), np.zeros((4, bins[1])))
        values = (np.empty((VALUES, bins[0])), np.empty((VALUES, bins[1])))
        work = (np.empty((WORK, bins[0])), np.empty((WORK, bins[1])))
        input_o = np.empty((2, bins[0]))
        normal = np.empty((3, n, n))
        vectors = np.empty((4, n))
        lower = np.empty((n, n))
        memory = (data, values, work, normal, vectors, lower)
        for point in range(y.shape[0]):
            at = theta[point]
            if not _gather(u[point], y[point], where, data, input_o):
                continue
            if not (_start(at, groups, memory) and _near(at, groups, limits, input_o, memory)):
                continue
            variances = _noise(groups, at, pieces, limits, input_o, memory)
            if not variances[0] > 0:
                continue
            costs = _refine(at, groups, limits, variances, memory)
            if not costs[0] >= 0:
                continue
            found = (covariance[point], residual[point], figures[point])
            if not level(groups[1], at, limits, variances, costs, memory, found):
                continue
            terms = bases[1].shape[0]
            band = (limits[8], limits[9], limits[10])
            ordinary[point] = pole_in_band(
                at[:2], at[2 : 2 + terms], covariance[point], bases, band, figures[point]
            )

    return fit_points


_MODULES = (kernel_algebra, kernel_model, kernel_judgement, one_mode)
fit_points = _entry(crc32(b"".join(Path(str(m.__file__)).read_bytes() for m in _MODULES)))
