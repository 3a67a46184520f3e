# SPDX-License-Identifier: Apache-2.0
"""The cost of ``Y = (B U + C) / A`` on bins, for (points, records, bins), compiled by numba.

A record has undriven bins, on which there is only a transient C and noise, and then driven ones:

    cost = sum_undriven |Y - C/A|^2 / s_rest^2
         + sum_driven |Y - (B U + C)/A|^2 / (s_Y^2 + s_U^2 |B/A|^2 - 2 Re(s_YU conj(B/A)))

(Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012), sections
8.3, 9.11 and 12.3). The records of a point share A and B; each has a C of its own. An FRF is one record
of driven bins with U = 1 and without C.

Derivatives of the error are basis functions times one complex factor for A, one for B, one for C. So the
normal matrix ``Re J^H J`` and the gradient are sums over bins of products of two basis functions, which
are computed once (`tables.Tables`), times weights that all coefficients of a kind share (`_weigh_driven`
and its neighbours). The gradient is exact; the normal matrix leaves out the derivative of the variance,
which is smaller by the signal-to-noise ratio of the input.

numba keeps the machine code beside this file, or in its own cache directory (NUMBA_CACHE_DIR). It looks
at the date of this file alone: whatever is compiled for the fit is in here.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from tactile_resonance._typing import FloatArray

OPTIONS: dict[str, Any] = {
    "cache": True,
    # Sums may be reordered, else no loop that adds up uses vector instructions; NaN and infinity keep
    # their meaning.
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
    # A division by zero is infinite, as in numpy, and not an exception that every loop would test for.
    "error_model": "numpy",
}

KERNELS: list[Any] = []
"""Those that Python calls."""


def _entry(kernel: Callable) -> Callable:
    """What Python calls: one kind of arrays, whatever it is given, so that a kernel is compiled once."""
    KERNELS.append(kernel)

    @wraps(kernel)
    def call(*arguments):
        return kernel(*[_plain(x) if type(x) is np.ndarray else x for x in arguments])

    return call


def _plain(array: npt.NDArray) -> npt.NDArray:
    """The same, contiguous and writable; `numpy.require` takes a microsecond to see that it is."""
    flags = array.flags
    return array if flags.c_contiguous and flags.writeable else np.array(array, order="C")


BLOCK = 48
"""Bins taken together: a multiple of the vectors of all processors, and few enough for the cache."""

# Rows of a block in the memory of a kernel: real parts of A, B, C, the error E, and behind each the
# imaginary ones; one over the variance of E; the variances of Y and U, their covariance.
ROW_A, ROW_B, ROW_C, ROW_E, ROW_V, ROW_VY, ROW_VU, ROW_COV = 0, 2, 4, 6, 8, 9, 10, 11
# Then weights, in the order of their rows, complex ones real part first. With X = Y - E and w = 1 / (|A|^2
# v): w |X|^2, -w conj(X), w; the gradient by A, and minus that by C. With an input: -w conj(X) U, w |U|^2,
# w conj(U); minus the gradient by B.
ROW_AA, ROW_AC, ROW_CC, ROW_OF_A, ROW_OF_C, ROW_AB, ROW_BB, ROW_BC, ROW_OF_B = (
    13,
    14,
    16,
    17,
    19,
    21,
    23,
    24,
    26,
)
ROWS = 28

# What is linearised: the error, or ``A Y - B U - C`` over |A| or over 1 (Sanathanan-Koerner iterations).
EXACT, LINEAR, LINEAR_UNWEIGHTED = 0, 1, 2

TINY = float(np.finfo(float).tiny)
# Part of a direction's power that a fit must leave for it to be tried.
LEAST_LEFT = 1e-8
MOST_DAMPING = 1e10
LEAST_DAMPING = 1e-3


class Arrays(NamedTuple):
    """Data of a batch, in blocks.

    Attributes
    ----------
    y, u : (points, M, blocks, 2, BLOCK) float
        Real and imaginary parts; on undriven bins u is what is seen of noise.
    rest, variance_y, variance_u : (points, M or 1, blocks or 1, 1, BLOCK or 1) float
        Of Y on undriven bins, and of Y and U on driven ones; infinite where a bin is to be left out. The
        third axis of `variance_u` is 0 long where U is exact.
    covariance_yu : (points, M or 1, blocks or 1 or 0, 2, BLOCK or 1) float
    """

    y: FloatArray
    u: FloatArray
    rest: FloatArray
    variance_y: FloatArray
    variance_u: FloatArray
    covariance_yu: FloatArray


@_entry
@njit(**OPTIONS)
def planes(values, order, undriven):
    """Complex values (points, M, K) in blocks (points, M, blocks, 2, BLOCK).

    In `order` (bins,), the undriven ones first and in blocks of their own.
    """
    points, records, _ = values.shape
    before = -(-undriven // BLOCK)
    out = np.zeros((points, records, before + -(-(order.size - undriven) // BLOCK), 2, BLOCK))
    for point in range(points):
        for m in range(records):
            source = values[point, m]
            for block in range(out.shape[2]):
                driven = block >= before
                first = undriven + BLOCK * (block - before) if driven else BLOCK * block
                here = out[point, m, block]
                for k in range(min(BLOCK, (order.size if driven else undriven) - first)):
                    value = source[order[first + k]]
                    here[0, k], here[1, k] = value.real, value.imag
    return out


@njit(**OPTIONS)
def _set(row, value, rows):
    for k in range(BLOCK):
        rows[row, k] = value


@njit(**OPTIONS)
def _fill(values, block, row, count, rows):
    """Rows from values (blocks, count, BLOCK), or (1, count, 1) for all bins, or 0 from none.

    What is the same for all bins stays from the first block on.
    """
    if block > 0 and (values.shape[0] == 0 or values.shape[2] == 1):
        return
    for i in range(count):
        if values.shape[0] == 0:
            _set(row + i, 0.0, rows)
        elif values.shape[2] == 1:
            _set(row + i, values[0, i, 0], rows)
        else:
            for k in range(BLOCK):
                rows[row + i, k] = values[block, i, k]


@njit(**OPTIONS)
def _combine(basis, row, place, block, coefficients, linear, rows):
    """A, B and C of a block; of a linear kind A alone."""
    for i in range(row.size):
        to = row[i]
        f, g = coefficients[place[i, 0]], coefficients[place[i, 1]]
        if to >= 0:
            if not (linear and to >= ROW_B):
                for k in range(BLOCK):
                    rows[to, k] += f * basis[block, i, 0, k] + g * basis[block, i, 1, k]
        else:
            to = -1 - to
            if not (linear and to >= ROW_B):
                for k in range(BLOCK):
                    rows[to, k] = f * basis[block, i, 0, k] + g * basis[block, i, 1, k]


@njit(**OPTIONS)
def _weigh_linear(y, u, point, m, at, last, block, weighted, flat):
    """Weights of ``A Y - B U - C`` over ``|A|``, or over 1, with the derivatives at 0."""
    for k in range(BLOCK):
        re, im = flat[ROW_A * BLOCK + k], flat[(ROW_A + 1) * BLOCK + k]
        w = 1 / flat[ROW_VY * BLOCK + k]
        if weighted:
            w /= re * re + im * im
        l_re, l_im = last[block, 0, k], -last[block, 1, k]
        y_re, y_im = y[point, m, at, 0, k], y[point, m, at, 1, k]
        u_re, u_im = u[point, m, at, 0, k], u[point, m, at, 1, k]
        squared, x_re, x_im = w * (y_re * y_re + y_im * y_im), -w * y_re, w * y_im
        z_re, z_im = x_re * l_re - x_im * l_im, x_re * l_im + x_im * l_re
        flat[ROW_AA * BLOCK + k] = squared
        flat[ROW_AC * BLOCK + k], flat[(ROW_AC + 1) * BLOCK + k] = x_re, x_im
        flat[ROW_CC * BLOCK + k] = w
        flat[ROW_OF_A * BLOCK + k], flat[(ROW_OF_A + 1) * BLOCK + k] = (
            squared * l_re,
            squared * l_im,
        )
        flat[ROW_OF_C * BLOCK + k], flat[(ROW_OF_C + 1) * BLOCK + k] = z_re, z_im
        flat[ROW_AB * BLOCK + k] = x_re * u_re - x_im * u_im
        flat[(ROW_AB + 1) * BLOCK + k] = x_re * u_im + x_im * u_re
        flat[ROW_BB * BLOCK + k] = w * (u_re * u_re + u_im * u_im)
        flat[ROW_BC * BLOCK + k], flat[(ROW_BC + 1) * BLOCK + k] = w * u_re, -w * u_im
        flat[ROW_OF_B * BLOCK + k] = z_re * u_re - z_im * u_im
        flat[(ROW_OF_B + 1) * BLOCK + k] = z_re * u_im + z_im * u_re


@njit(**OPTIONS)
def _weigh_undriven(y, point, m, at, flat):
    """Errors and weights of a block of undriven bins; its cost."""
    cost = 0.0
    for k in range(BLOCK):
        re, im = flat[ROW_A * BLOCK + k], flat[(ROW_A + 1) * BLOCK + k]
        v = 1 / flat[ROW_VY * BLOCK + k]
        squared = 1 / (re * re + im * im)
        i_re, i_im = re * squared, -im * squared
        c_re, c_im = flat[ROW_C * BLOCK + k], flat[(ROW_C + 1) * BLOCK + k]
        m_re, m_im = c_re * i_re - c_im * i_im, c_re * i_im + c_im * i_re
        e_re, e_im = y[point, m, at, 0, k] - m_re, y[point, m, at, 1, k] - m_im
        w = v * squared
        z_re, z_im = v * (e_re * i_re + e_im * i_im), v * (e_re * i_im - e_im * i_re)
        cost += v * (e_re * e_re + e_im * e_im)
        flat[ROW_E * BLOCK + k], flat[(ROW_E + 1) * BLOCK + k] = e_re, e_im
        flat[ROW_AA * BLOCK + k] = w * (m_re * m_re + m_im * m_im)
        flat[ROW_AC * BLOCK + k], flat[(ROW_AC + 1) * BLOCK + k] = -w * m_re, w * m_im
        flat[ROW_CC * BLOCK + k] = w
        flat[ROW_OF_A * BLOCK + k] = z_re * m_re - z_im * m_im
        flat[(ROW_OF_A + 1) * BLOCK + k] = z_re * m_im + z_im * m_re
        flat[ROW_OF_C * BLOCK + k], flat[(ROW_OF_C + 1) * BLOCK + k] = -z_re, -z_im
    return cost


@njit(**OPTIONS)
def _weigh_driven(y, u, point, m, at, flat):
    """Errors and weights of a block of driven bins; its cost.

    The variance of the error depends on the response: the gradient has its derivative too.
    """
    cost = 0.0
    for k in range(BLOCK):
        re, im = flat[ROW_A * BLOCK + k], flat[(ROW_A + 1) * BLOCK + k]
        squared = 1 / (re * re + im * im)
        i_re, i_im = re * squared, -im * squared
        b_re, b_im = flat[ROW_B * BLOCK + k], flat[(ROW_B + 1) * BLOCK + k]
        g_re, g_im = b_re * i_re - b_im * i_im, b_re * i_im + b_im * i_re
        u_re, u_im = u[point, m, at, 0, k], u[point, m, at, 1, k]
        c_re, c_im = flat[ROW_C * BLOCK + k], flat[(ROW_C + 1) * BLOCK + k]
        m_re = c_re * i_re - c_im * i_im + g_re * u_re - g_im * u_im
        m_im = c_re * i_im + c_im * i_re + g_re * u_im + g_im * u_re
        e_re, e_im = y[point, m, at, 0, k] - m_re, y[point, m, at, 1, k] - m_im
        s_re, s_im = flat[ROW_COV * BLOCK + k], flat[(ROW_COV + 1) * BLOCK + k]
        # half the derivative of the variance by g
        d_re = flat[ROW_VU * BLOCK + k] * g_re - s_re
        d_im = s_im - flat[ROW_VU * BLOCK + k] * g_im
        v = 1 / (flat[ROW_VY * BLOCK + k] + (d_re - s_re) * g_re - (d_im + s_im) * g_im)
        power = v * (e_re * e_re + e_im * e_im)
        cost += power
        w = v * squared
        z_re, z_im = v * (e_re * i_re + e_im * i_im), v * (e_re * i_im - e_im * i_re)
        h = v * power
        h_re, h_im = h * (d_re * i_re - d_im * i_im), h * (d_re * i_im + d_im * i_re)
        x_re, x_im = -w * m_re, w * m_im
        flat[ROW_E * BLOCK + k], flat[(ROW_E + 1) * BLOCK + k], flat[ROW_V * BLOCK + k] = (
            e_re,
            e_im,
            v,
        )
        flat[ROW_AA * BLOCK + k] = w * (m_re * m_re + m_im * m_im)
        flat[ROW_AC * BLOCK + k], flat[(ROW_AC + 1) * BLOCK + k] = x_re, x_im
        flat[ROW_CC * BLOCK + k] = w
        flat[ROW_OF_A * BLOCK + k] = z_re * m_re - z_im * m_im + h_re * g_re - h_im * g_im
        flat[(ROW_OF_A + 1) * BLOCK + k] = z_re * m_im + z_im * m_re + h_re * g_im + h_im * g_re
        flat[ROW_OF_C * BLOCK + k], flat[(ROW_OF_C + 1) * BLOCK + k] = -z_re, -z_im
        flat[ROW_AB * BLOCK + k] = x_re * u_re - x_im * u_im
        flat[(ROW_AB + 1) * BLOCK + k] = x_re * u_im + x_im * u_re
        flat[ROW_BB * BLOCK + k] = w * (u_re * u_re + u_im * u_im)
        flat[ROW_BC * BLOCK + k], flat[(ROW_BC + 1) * BLOCK + k] = w * u_re, -w * u_im
        flat[ROW_OF_B * BLOCK + k] = -(z_re * u_re - z_im * u_im + h_re)
        flat[(ROW_OF_B + 1) * BLOCK + k] = -(z_re * u_im + z_im * u_re + h_im)
    return cost


@njit(**OPTIONS)
def _add_up(products, weight, target, block, rows, gram):
    """Add the normal matrix and half the gradient of a block."""
    for pair in range(weight.size):
        row = weight[pair]
        first = second = 0.0
        for k in range(BLOCK):
            w = rows[row, k]
            first += products[block, pair, 0, k] * w
            second += products[block, pair, 1, k] * w
        gram[target[pair, 0]] += first
        gram[target[pair, 1]] += second


@njit(**OPTIONS)
def _turn(u, point, m, at, flat):
    """Weighted errors, turned by the phase of the input, in place of the weights of A with C."""
    for k in range(BLOCK):
        re, im = u[point, m, at, 0, k], u[point, m, at, 1, k]
        e_re, e_im = flat[ROW_E * BLOCK + k], flat[(ROW_E + 1) * BLOCK + k]
        squared = re * re + im * im
        nothing = not squared > 0
        re, squared = (1.0 if nothing else re), (1.0 if nothing else squared)
        scale = np.sqrt(flat[ROW_V * BLOCK + k] / squared)
        flat[ROW_AC * BLOCK + k] = scale * (e_re * re + e_im * im)
        flat[(ROW_AC + 1) * BLOCK + k] = scale * (e_im * re - e_re * im)


@njit(**OPTIONS)
def _of_part(part, driven, data, point, m, coefficients, kind, memory, gram, errors, powers):
    """Sums over the undriven or driven bins of a record; the cost.

    Written are, where they are not empty, the normal matrix with half the gradient as a flat (n, n + 1)
    matrix; errors (K,), of undriven bins as they are, of driven ones weighted and turned by the phase of the
    input; and added to are `powers`, see `_add_power`.
    """
    bins, last, basis, row, place, products, weight, target = part
    y, u, rest, variance_y, variance_u, covariance_yu = data
    flat, rows = memory
    of_bins = variance_y if driven else rest
    variance = of_bins[point, min(m, of_bins.shape[1] - 1)]
    of_input = variance_u[point, min(m, variance_u.shape[1] - 1)]
    covariance = covariance_yu[point, min(m, covariance_yu.shape[1] - 1)]
    for i in range(gram.size):
        gram[i] = 0.0
    cost = 0.0
    before = y.shape[2] - last.shape[0] if driven else 0
    for block in range(last.shape[0]):
        at = before + block
        _fill(variance, block, ROW_VY, 1, rows)
        if kind != LINEAR_UNWEIGHTED:
            _combine(basis, row, place, block, coefficients, kind == LINEAR, rows)
        if kind != EXACT:
            _weigh_linear(y, u, point, m, at, last, block, kind == LINEAR, flat)
        elif driven:
            _fill(of_input, block, ROW_VU, 1, rows)
            _fill(covariance, block, ROW_COV, 2, rows)
            cost += _weigh_driven(y, u, point, m, at, flat)
        else:
            cost += _weigh_undriven(y, point, m, at, flat)
        if gram.size > 0:
            _add_up(products, weight, target, block, rows, gram)
        if powers.size > 0:
            _add_power(u, point, m, block, rows, powers)
        if errors.size > 0:
            out, first = ROW_E, BLOCK * block
            if driven:
                _turn(u, point, m, at, flat)
                out = ROW_AC
            for k in range(min(BLOCK, bins - first)):
                errors[first + k] = complex(rows[out, k], rows[out + 1, k])
    return cost


@njit(**OPTIONS)
def _gram(tables, data, point, theta, kind, memory, gram, cost):
    """Normal matrices and half the gradients of undriven and driven bins, (M, 2, n (n + 1) + 1).

    Theta (M, n + 1) and these in the order C, A, B: what records do not share comes first; theta ends with
    1. Costs (2,) of the point are written too.
    """
    cost[0] = cost[1] = 0.0
    undriven, driven, none, sums = tables.undriven, tables.driven, memory[2], memory[3]
    block = memory[:2]
    for m in range(theta.shape[0]):
        at = theta[m]
        if undriven.bins > 0:
            cost[0] += _of_part(
                undriven, False, data, point, m, at, kind, block, gram[m, 0], none, sums
            )
        cost[1] += _of_part(driven, True, data, point, m, at, kind, block, gram[m, 1], none, sums)
    return cost[0] + cost[1]


@njit(**OPTIONS)
def _solve(gram, c, n, damping, work, total, step):
    """Solve the normal equations of all records; the step's decrement of the cost, NaN without a step.

    Own coefficients of each record are eliminated first: the cost of a step grows as M, not as its cube
    (Golub & Van Loan, *Matrix Computations*, 4th ed. (2013), section 3.2.11). Without pivoting, whose
    rounding is that of Cholesky's method whatever the scales of the unknowns.

    Parameters
    ----------
    work : (M, n, n + 1) float
        Overwritten.
    total : (n - c, n - c + 1) float
        Overwritten.
    step : (M, n) float
        Out.
    """
    records, shared, width = gram.shape[0], n - c, n + 1
    for i in range(shared):
        for j in range(shared + 1):
            total[i, j] = 0.0
    more = 1 + 1e-15 + damping
    for m in range(records):
        matrix, first, second = work[m], gram[m, 0], gram[m, 1]
        for i in range(n):
            for j in range(i, width):
                matrix[i, j] = first[i * width + j] + second[i * width + j]
            matrix[i, i] *= more
        for i in range(c):
            if not matrix[i, i] > 0:
                return np.nan
            inverse = 1 / matrix[i, i]
            for j in range(i + 1, n):
                factor = matrix[i, j] * inverse
                for k in range(j, width):
                    matrix[j, k] -= factor * matrix[i, k]
        for i in range(shared):
            for j in range(i, shared + 1):
                total[i, j] += matrix[c + i, c + j]
    for i in range(shared):
        if not total[i, i] > 0:
            return np.nan
        inverse = 1 / total[i, i]
        for j in range(i + 1, shared):
            factor = total[i, j] * inverse
            for k in range(j, shared + 1):
                total[j, k] -= factor * total[i, k]
    for i in range(shared - 1, -1, -1):
        value = total[i, shared]
        for j in range(i + 1, shared):
            value -= total[i, j] * step[0, c + j]
        step[0, c + i] = value / total[i, i]
    decrement = 0.0
    for m in range(records):
        matrix = work[m]
        for i in range(c, n):
            step[m, i] = step[0, i]
        for i in range(c - 1, -1, -1):
            value = matrix[i, n]
            for j in range(i + 1, n):
                value -= matrix[i, j] * step[m, j]
            step[m, i] = value / matrix[i, i]
        for i in range(n):
            at = i * width + n
            decrement += step[m, i] * (gram[m, 0, at] + gram[m, 1, at])
    return decrement


@njit(**OPTIONS)
def _inside(theta, c, out):
    """Coefficients (M, n + 1) in the order C, A, B and 1 from [A, B, C]."""
    n = theta.shape[1]
    for m in range(theta.shape[0]):
        for i in range(n):
            out[m, i] = theta[m, i + n - c if i < c else i - c]


@njit(**OPTIONS)
def _outside(coefficients, c, out):
    """Coefficients (M, n) in the order [A, B, C] from C, A, B."""
    n = out.shape[1]
    for m in range(out.shape[0]):
        for i in range(n):
            out[m, i + n - c if i < c else i - c] = coefficients[m, i]


@njit(**OPTIONS)
def _unpacked(gram, c, gradient, normal):
    """Gradient (M, n) and normal matrices (M, 2, n, n) in the order of theta."""
    n = gradient.shape[1]
    for m in range(gram.shape[0]):
        for i in range(n):
            at = i + n - c if i < c else i - c
            gradient[m, at] = gram[m, 0, i * (n + 1) + n] + gram[m, 1, i * (n + 1) + n]
            for j in range(i, n):
                to = j + n - c if j < c else j - c
                for part in range(2):
                    value = gram[m, part, i * (n + 1) + j]
                    normal[m, part, at, to] = value
                    normal[m, part, to, at] = value


@njit(**OPTIONS)
def _memory(records, c, n):
    """Memory of a block, a gram, what `_solve` computes in, coefficients, a step, costs."""
    rows = np.zeros((ROWS, BLOCK))
    return (
        (rows.reshape(-1), rows, np.empty(0, np.complex128), np.empty((4, 0, BLOCK))),
        np.zeros((records, 2, n * (n + 1) + 1)),
        np.empty((records, n, n + 1)),
        np.empty((n - c, n - c + 1)),
        np.ones((records, n + 1)),
        np.empty((records, n)),
        np.empty(2),
    )


@_entry
@njit(**OPTIONS)
def moments(tables, data, theta):
    """Cost, gradient and normal matrices of a batch.

    Parameters
    ----------
    tables : Tables
    data : Arrays
    theta : (points, M, n) float
        Coefficients [A without its last, B, C] of each record, A and B alike in all.

    Returns
    -------
    cost : (points, 2) float
        Of undriven and of driven bins.
    gradient : (points, M, n) float
        Half of it.
    normal : (points, M, 2, n, n) float
    """
    points, records, n = theta.shape
    memory, gram, _, _, at, _, _ = _memory(records, tables.c, n)
    cost, gradient = np.empty((points, 2)), np.empty((points, records, n))
    normal = np.empty((points, records, 2, n, n))
    for point in range(points):
        _inside(theta[point], tables.c, at)
        _gram(tables, data, point, at, EXACT, memory, gram, cost[point])
        _unpacked(gram, tables.c, gradient[point], normal[point])
    return cost, gradient, normal


@_entry
@njit(**OPTIONS)
def linear_fit(tables, data, theta, kind):
    """Theta (points, M, n) of a Sanathanan-Koerner iteration, NaN where there is none.

    `kind` is LINEAR, weighted over ``|A|`` at theta, or LINEAR_UNWEIGHTED; other parameters as of `moments`.
    """
    points, records, n = theta.shape
    c = tables.c
    memory, gram, systems, total, at, step, cost = _memory(records, c, n)
    out = np.full_like(theta, np.nan)
    for point in range(points):
        _inside(theta[point], c, at)
        _gram(tables, data, point, at, kind, memory, gram, cost)
        if np.isfinite(_solve(gram, c, n, 0.0, systems, total, step)):
            _outside(-step, c, out[point])
    return out


@njit(**OPTIONS)
def _add_power(u, point, m, block, rows, powers):
    """Add to powers (4, blocks, BLOCK) of bins those of a block of undriven ones; see `undriven_powers`.

    One loop for each: more than one that is written to would not use vector instructions.
    """
    for k in range(BLOCK):
        e_re, e_im = rows[ROW_E, k], rows[ROW_E + 1, k]
        powers[0, block, k] += e_re * e_re + e_im * e_im
    for k in range(BLOCK):
        re, im = u[point, m, block, 0, k], u[point, m, block, 1, k]
        powers[1, block, k] += re * re + im * im
    for k in range(BLOCK):
        re, im = u[point, m, block, 0, k], u[point, m, block, 1, k]
        powers[2, block, k] += rows[ROW_E, k] * re + rows[ROW_E + 1, k] * im
    for k in range(BLOCK):
        re, im = u[point, m, block, 0, k], u[point, m, block, 1, k]
        powers[3, block, k] += rows[ROW_E + 1, k] * re - rows[ROW_E, k] * im


@njit(**OPTIONS)
def _in_pieces(powers, bins, size, out):
    """Powers (4, blocks, BLOCK) of bins as sums (4, pieces) over `size` of them, the last piece longer."""
    pieces = out.shape[1]
    for i in range(4):
        of_bins = powers[i].reshape(-1)
        for piece in range(pieces):
            end = bins if piece == pieces - 1 else (piece + 1) * size
            its, total = of_bins[piece * size : end], 0.0
            for k in range(its.size):
                total += its[k]
            out[i, piece] = total


@_entry
@njit(**OPTIONS)
def undriven_powers(tables, data, theta, size, pieces):
    """What errors and inputs of undriven bins add up to, over all records, in pieces of the band.

    Parameters
    ----------
    tables, data, theta
        As of `moments`.
    size, pieces : int
        Bins of a piece, the last one is longer; how many pieces.

    Returns
    -------
    (points, 4, pieces) float
        Squared moduli of errors, of inputs, real and imaginary parts of ``error conj(u)``.
    """
    points, records, n = theta.shape
    memory, _, _, _, at, _, _ = _memory(records, tables.c, n)
    part, none = tables.undriven, np.empty(0)
    out, powers = np.empty((points, 4, pieces)), np.empty((4, part.last.shape[0], BLOCK))
    for point in range(points):
        _inside(theta[point], tables.c, at)
        powers[:] = 0.0
        for m in range(records):
            now, block = at[m], memory[:2]
            _of_part(part, False, data, point, m, now, EXACT, block, none, memory[2], powers)
        _in_pieces(powers, part.bins, size, out[point])
    return out


@_entry
@njit(**OPTIONS)
def begin(tables, of_driven, data, chance, size, pieces):
    """Coefficients near the minimum, and the noise that undriven bins show there.

    Two Sanathanan-Koerner iterations, then one undamped step with flat weights as the errors show them:
    residuals are then all but noise.

    Parameters
    ----------
    tables : Tables
    of_driven : bool
        Whether driven bins hold equations enough for start values.
    data : Arrays
        With variances of 1.
    chance : float
        Squared correlation of errors and inputs on undriven bins beyond which the input is taken for exact:
        what is seen there has come through the system then.
    size, pieces : int
        See `undriven_powers`.

    Returns
    -------
    theta : (points, M, n) float
        NaN where there are no start values.
    powers : (points, 4, pieces) float
        Of `undriven_powers`.
    """
    points, records = data.y.shape[:2]
    a, b, c = tables.a, tables.b, tables.c
    n = a + b + c
    memory, gram, systems, total, at, step, cost = _memory(records, c, n)
    block, none, nothing = memory[:2], memory[2], memory[3]
    y, u, rest, _, _, covariance = data
    variance_y, variance_u = np.ones((points, 1, 1, 1, 1)), np.zeros((points, 1, 1, 1, 1))
    weighted = Arrays(y, u, rest, variance_y, variance_u, covariance)
    theta, powers = np.full((points, records, n), np.nan), np.zeros((points, 4, pieces))
    no_gram, whole = np.empty(0), np.empty((4, 1))
    part, of_bins = tables.undriven, np.empty((4, tables.undriven.last.shape[0], BLOCK))
    for point in range(points):
        found = True
        for kind in (LINEAR_UNWEIGHTED, LINEAR):
            for m in range(records):
                here, now = gram[m, 0], at[m]
                if of_driven:
                    here[:] = 0.0
                else:
                    _of_part(part, False, data, point, m, now, kind, block, here, none, nothing)
                here = gram[m, 1]
                _of_part(tables.driven, True, data, point, m, now, kind, block, here, none, nothing)
            found = found and np.isfinite(_solve(gram, c, n, 0.0, systems, total, step))
            for m in range(records):
                for i in range(n):
                    at[m, i] = -step[m, i]
        if not found:
            continue
        of_bins[:] = 0.0
        for m in range(records):
            here, now = gram[m, 0], at[m]
            _of_part(part, False, data, point, m, now, EXACT, block, here, none, of_bins)
        _in_pieces(of_bins, part.bins, part.bins, whole)
        of_error, of_u = whole[0, 0], whole[1, 0]
        cross = whole[2, 0] ** 2 + whole[3, 0] ** 2
        if of_error > TINY:
            variance_y[point] = of_error / (records * part.bins)
        if not cross > chance * of_error * of_u:
            variance_u[point] = of_u / (records * part.bins)
        for m in range(records):
            here, now, factor = gram[m, 0], at[m], 1 / variance_y[point, 0, 0, 0, 0]
            for i in range(here.size):
                here[i] *= factor
            here = gram[m, 1]
            _of_part(
                tables.driven, True, weighted, point, m, now, EXACT, block, here, none, nothing
            )
        if np.isfinite(_solve(gram, c, n, 0.0, systems, total, step)):
            for m in range(records):
                for i in range(n):
                    at[m, i] -= step[m, i]
        of_bins[:] = 0.0
        for m in range(records):
            _of_part(part, False, data, point, m, at[m], EXACT, block, no_gram, none, of_bins)
        _in_pieces(of_bins, part.bins, size, powers[point])
        _outside(at, c, theta[point])
    return theta, powers


@_entry
@njit(**OPTIONS)
def undriven_errors(tables, data, theta):
    """(points, M, K_undriven) Y less that of the model on undriven bins; parameters as of `moments`."""
    points, records, n = theta.shape
    memory, _, _, _, at, _, _ = _memory(records, tables.c, n)
    part, none = tables.undriven, np.empty(0)
    out = np.empty((points, records, part.bins), np.complex128)
    for point in range(points):
        _inside(theta[point], tables.c, at)
        for m in range(records):
            here = out[point, m]
            _of_part(part, False, data, point, m, at[m], EXACT, memory[:2], none, here, memory[3])
    return out


@_entry
@njit(**OPTIONS)
def minimise(tables, data, start, iterations, tolerance, rounding):
    """Minimise the cost of each point: Levenberg-Marquardt steps.

    Parameters
    ----------
    tables : Tables
    data : Arrays
    start : (points, M, n) float
    iterations : int
        Most steps tried.
    tolerance : float
        A step below this many standard deviations, as the residuals show them, is the last one taken.
    rounding : float
        Of a residual relative to the data it is the residual of.

    Returns
    -------
    theta : (points, M, n) float
    normal : (points, M, 2, n, n) float
        Where the last step began.
    cost : (points,) float
    part_cost : (points, 2) float
        Of undriven and driven bins, where the last step began.
    residual : (points, M, K_driven) complex
        Weighted errors, turned by the phase of the input: errors of a response are smooth over lines,
        those of Y only after this, for the phases of the excitation are random.
    converged : (points,) bool
    """
    points, records, n = start.shape
    c = tables.c
    memory, here, systems, total, at, step, part_now = _memory(records, c, n)
    there, trial, gradient = np.zeros_like(here), np.ones_like(at), np.empty_like(step)
    part_then, none, driven = np.empty(2), np.empty(0), tables.driven
    theta, normal = np.empty_like(start), np.empty((points, records, 2, n, n))
    cost, part_cost = np.empty(points), np.empty((points, 2))
    residual = np.empty((points, records, tables.driven.bins), np.complex128)
    converged = np.zeros(points, np.bool_)
    bins = tables.undriven.bins + tables.driven.bins
    tolerance = tolerance**2 / max(records * (2 * bins - c) - (n - c), 1)
    for point in range(points):
        _inside(start[point], c, at)
        floor = rounding**2 * _weighted_power(data, point, tables.undriven.last.shape[0])
        now = _gram(tables, data, point, at, EXACT, memory, here, part_now)
        damping = 0.0
        for _ in range(iterations):
            if not np.isfinite(now) or damping > MOST_DAMPING:
                break
            decrement = _solve(here, c, n, damping, systems, total, step)
            if np.isfinite(decrement):
                for m in range(records):
                    for i in range(n):
                        trial[m, i] = at[m, i] - step[m, i]
                if damping == 0 and decrement <= max(tolerance * now, floor):
                    at[:] = trial
                    now -= decrement
                    converged[point] = True
                    break
                then = _gram(tables, data, point, trial, EXACT, memory, there, part_then)
                # rounding of the cost itself must not count as an increase
                if then <= now * (1 + 1e-12) + floor:
                    at[:] = trial
                    now = then
                    here, there = there, here
                    part_now, part_then = part_then, part_now
                    damping = 0.0 if damping < 0.1 * LEAST_DAMPING else damping / 10
                    continue
            damping = max(10 * damping, LEAST_DAMPING)
        cost[point] = now
        part_cost[point] = part_now
        for m in range(records):
            errors, block = residual[point, m], memory[:2]
            _of_part(driven, True, data, point, m, at[m], EXACT, block, none, errors, memory[3])
        _unpacked(here, c, gradient, normal[point])
        _outside(at, c, theta[point])
    return theta, normal, cost, part_cost, residual, converged


@njit(**OPTIONS)
def _weighted_power(data, point, undriven_blocks):
    """``sum |Y|^2 / s_Y^2`` of a point."""
    y, _, rest, variance_y, _, _ = data
    power = 0.0
    for m in range(y.shape[1]):
        for block in range(y.shape[2]):
            driven = block >= undriven_blocks
            variances = variance_y if driven else rest
            at = block - undriven_blocks if driven else block
            its = variances[
                point, min(m, variances.shape[1] - 1), min(at, variances.shape[2] - 1), 0
            ]
            if its.size == 1:
                total = 0.0
                for k in range(BLOCK):
                    re, im = y[point, m, block, 0, k], y[point, m, block, 1, k]
                    total += re * re + im * im
                power += total / its[0]
            else:
                for k in range(BLOCK):
                    re, im = y[point, m, block, 0, k], y[point, m, block, 1, k]
                    power += (re * re + im * im) / its[k]
    return power


@_entry
@njit(**OPTIONS)
def invert(matrices):
    """Inverses (batch, n, n) of positive definite matrices, and condition numbers of their roots.

    Returns
    -------
    inverse : (batch, n, n) float
        NaN where a matrix is singular or not finite.
    condition : (batch,) float
        Root of the Frobenius condition number with unit diagonal: that of a Jacobian with unit columns,
        within a factor n. Infinite where there is no inverse.
    """
    batch, n = matrices.shape[0], matrices.shape[1]
    inverses, conditions = np.empty((batch, n, n)), np.empty(batch)
    scale, row = np.empty(n), np.empty(n)
    for point in range(batch):
        matrix, inverse = matrices[point], inverses[point]
        before, good = 0.0, True
        for i in range(n):
            scale[i] = 1 / np.sqrt(matrix[i, i])
        for i in range(n):
            for j in range(n):
                value = matrix[i, j] * scale[i] * scale[j]
                inverse[i, j] = value
                before += value * value
        good = np.isfinite(before)
        for k in range(n):  # sweeps
            if not good:
                break
            pivot = inverse[k, k]
            if not pivot > 0:
                good = False
                break
            factor = 1 / pivot
            for j in range(n):
                row[j] = inverse[k, j]
            for i in range(n):
                if i != k:
                    times = row[i] * factor
                    for j in range(n):
                        inverse[i, j] -= times * row[j]
                    inverse[i, k] = times
            for j in range(n):
                inverse[k, j] *= factor
            inverse[k, k] = -factor
        after = 0.0
        for i in range(n):
            for j in range(i + 1):  # both halves: rounding made them differ
                value = -0.5 * (inverse[i, j] + inverse[j, i])
                after += value * value * (1.0 if i == j else 2.0)
                value *= scale[i] * scale[j]
                inverse[i, j], inverse[j, i] = value, value
            good = good and inverse[i, i] > 0
        conditions[point] = np.sqrt(np.sqrt(before * after)) if good else np.inf
        if not good:
            inverse[:] = np.nan
    return inverses, conditions


@njit(**OPTIONS)
def _fall(pair, own, slope, power, inverse, score, crossed):
    """What the cost falls by along a pair of directions; see `best_fall`."""
    n, bins = own.shape[0], power.size
    p_00 = p_01 = p_11 = 0.0
    for k in range(bins):
        re_0, im_0, re_1, im_1 = pair[0, 0, k], pair[0, 1, k], pair[1, 0, k], pair[1, 1, k]
        p_00 += power[k] * (re_0 * re_0 + im_0 * im_0)
        p_01 += power[k] * (re_0 * re_1 + im_0 * im_1)
        p_11 += power[k] * (re_1 * re_1 + im_1 * im_1)
    for r in range(2):
        total = 0.0
        for k in range(bins):
            total += slope[0, k] * pair[r, 0, k] - slope[1, k] * pair[r, 1, k]
        score[r] = total
        for i in range(n):
            total = 0.0
            for k in range(bins):
                total += own[i, 0, k] * pair[r, 0, k] - own[i, 1, k] * pair[r, 1, k]
            crossed[r, i] = total
    left_00, left_01, left_11 = p_00, p_01, p_11
    for i in range(n):
        for j in range(n):
            left_00 -= crossed[0, i] * inverse[i, j] * crossed[0, j]
            left_01 -= crossed[0, i] * inverse[i, j] * crossed[1, j]
            left_11 -= crossed[1, i] * inverse[i, j] * crossed[1, j]
    determinant = left_00 * left_11 - left_01 * left_01
    if not determinant > LEAST_LEFT * p_00 * p_11:
        return 0.0
    a, b = score
    return (left_11 * a * a - 2 * left_01 * a * b + left_00 * b * b) / determinant


@_entry
@njit(**OPTIONS)
def best_fall(tables, data, bases, theta, inverse, cost, dof, numerator, modes):
    """What the cost of fitted points of one record falls by most with a pair of directions of the response.

    Parameters
    ----------
    tables : Tables
    data : Arrays
    bases : tuple of (K, terms) complex
        Of A, B and C on driven bins.
    theta : (points, n) float
    inverse : (points, n, n) float
        Of the normal matrices.
    cost : (points,) float
    dof : float
        Complex degrees of freedom of it.
    numerator : (K, 2) complex
        A pair of directions over A.
    modes : (N, 2, 2, K) float
        Pairs of directions, real and imaginary parts.

    Returns
    -------
    best : (points,) int
        0: the numerator, 1 + k: mode k.
    fall : (points,) float
        0 where the fit has taken a direction up already.
    chance : (points,) float
        Logarithm of the probability that noise makes as much, for N modes tried.
    """
    basis_a, basis_b, basis_c = bases
    _, last, basis, row, place_of, _, _, _ = tables.driven
    y, u, _, variance_y, variance_u, covariance = data
    points, n = theta.shape
    bins, a, b = basis_a.shape[0], basis_a.shape[1] - 1, basis_b.shape[1]
    own, slope, power = np.empty((n, 2, bins)), np.empty((2, bins)), np.empty(bins)
    pair, score, crossed = np.empty((2, 2, bins)), np.empty(2), np.empty((2, n))
    memory, _, _, _, at, _, _ = _memory(1, tables.c, n)
    flat, rows = memory[:2]
    best, found, least = np.zeros(points, np.int64), np.zeros(points), np.zeros(points)
    trials = np.log(max(modes.shape[0], 1))
    for point in range(points):
        _inside(theta[point : point + 1], tables.c, at)
        for k in range(bins):
            block, place = k // BLOCK, k % BLOCK
            if place == 0:
                _fill(variance_y[point, 0], block, ROW_VY, 1, rows)
                _fill(variance_u[point, 0], block, ROW_VU, 1, rows)
                _fill(covariance[point, 0], block, ROW_COV, 2, rows)
                _combine(basis, row, place_of, block, at[0], False, rows)
                _weigh_driven(y, u, point, 0, y.shape[2] - last.shape[0] + block, flat)
            of_a = complex(rows[ROW_A, place], rows[ROW_A + 1, place])
            # what a response more takes off half the cost; weights are those of B, the response times A
            of_slope = -of_a * complex(rows[ROW_OF_B, place], rows[ROW_OF_B + 1, place])
            slope[0, k], slope[1, k] = of_slope.real, of_slope.imag
            power[k] = rows[ROW_BB, place] * (of_a.real * of_a.real + of_a.imag * of_a.imag)
            by_a = of_a * complex(rows[ROW_AB, place], rows[ROW_AB + 1, place])
            by_b = of_a * rows[ROW_BB, place]
            by_c = of_a * complex(rows[ROW_BC, place], -rows[ROW_BC + 1, place])
            for i in range(n):
                if i < a:
                    value = by_a * basis_a[k, i].conjugate()
                elif i < a + b:
                    value = by_b * basis_b[k, i - a].conjugate()
                else:
                    value = by_c * basis_c[k, i - a - b].conjugate()
                own[i, 0, k], own[i, 1, k] = value.real, value.imag
            for r in range(2):
                value = numerator[k, r] / of_a
                pair[r, 0, k], pair[r, 1, k] = value.real, value.imag
        for m in range(1 + modes.shape[0]):
            tried = pair if m == 0 else modes[m - 1]
            fall = _fall(tried, own, slope, power, inverse[point], score, crossed)
            chance = (dof - 1) * np.log1p(-fall / cost[point]) + (0.0 if m == 0 else trials)
            if chance < least[point]:
                best[point], found[point], least[point] = m, fall, chance
    return best, found, least
