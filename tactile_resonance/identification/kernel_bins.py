# SPDX-License-Identifier: Apache-2.0
"""Loops over the bins of a group, compiled by numba for the kernels of one mode.

All that a kernel knows of a group stands in one flat memory of rows `STRIDE` apart: so the compiler
sees that no row meets another, and makes vector instructions of whole loops. Complex numbers are
pairs of rows.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any
from zlib import crc32

import numpy as np
from numba import njit

from tactile_resonance.identification.kernel_tables import BLOCK, WEIGHTS

# Sums may be reordered, NaN and infinity keep their meaning.
OPTIONS: dict[str, Any] = {
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
    "error_model": "numpy",
}
compiled = njit(**OPTIONS)
# Counting who holds an array would take as long as some of the sums: not in calls that are no calls.
inlined = njit(forceinline=True, **OPTIONS)

MOST_BINS = 4096
# Not a power of two, but an odd number of cache lines beyond: rows do not share places in the cache.
STRIDE = MOST_BINS + 37 * 8
# Rows: polynomials of A; Y and U; B and C; the error and what it is weighted with; the variance of Y;
# then the weights of `kernel_tables`.
FIRST_WEIGHT = 18
ROWS = FIRST_WEIGHT + WEIGHTS
Y_ROW, U_ROW, B_ROW, C_ROW, E_ROW, V_ROW, S_ROW = 6, 8, 10, 12, 14, 16, 17
A0, A1, A2, Y, U, B, C, E, V, S = (k * STRIDE for k in (0, 2, 4, 6, 8, 10, 12, 14, 16, 17))
AA, AC, CC, OF_A, OF_C, AB, BB, BC, OF_B = (
    (FIRST_WEIGHT + k) * STRIDE for k in (0, 1, 3, 4, 6, 8, 10, 11, 13)
)
AA_ROW, AC_ROW, CC_ROW, OF_A_ROW, OF_C_ROW = (FIRST_WEIGHT + k for k in (0, 1, 3, 4, 6))
IM = STRIDE


def fingerprint(*modules: ModuleType) -> int:
    """Of the sources of modules: numba's cache of a function watches its own file, and values like this."""
    return crc32(b"".join(Path(str(m.__file__)).read_bytes() for m in modules))


@compiled
def prepared(table):
    """Memory (ROWS, STRIDE) of a group, with its constants, without data; weights and variances are 1."""
    memory = np.empty((ROWS, STRIDE))
    bins = table.denominator.shape[1]
    for row in range(6):
        memory[row, :bins] = table.denominator[row]
    for row in range(Y_ROW, E_ROW):
        memory[row, :bins] = 0.0
    for row in (V_ROW, S_ROW):
        memory[row, :bins] = 1.0
    return memory


@compiled
def fill(memory, row, value, bins):
    """Set a row."""
    for k in range(bins):
        memory[row, k] = value


@compiled
def combine(memory, row, basis, theta, first):
    """Set B or C to ``sum_i theta[first + i] basis_i``."""
    terms, bins = basis.shape[0] // 2, basis.shape[1]
    if terms == 1:
        p = theta[first]
        for k in range(bins):
            memory[row, k], memory[row + 1, k] = p * basis[0, k], p * basis[1, k]
        return
    p, q = theta[first], theta[first + 1]
    for k in range(bins):
        memory[row, k] = p * basis[0, k] + q * basis[1, k]
        memory[row + 1, k] = p * basis[terms, k] + q * basis[terms + 1, k]
    for i in range(2, terms - 1, 2):
        p, q = theta[first + i], theta[first + i + 1]
        for k in range(bins):
            memory[row, k] += p * basis[i, k] + q * basis[i + 1, k]
            memory[row + 1, k] += p * basis[terms + i, k] + q * basis[terms + i + 1, k]
    if terms % 2 == 1:
        p = theta[first + terms - 1]
        for k in range(bins):
            memory[row, k] += p * basis[terms - 1, k]
            memory[row + 1, k] += p * basis[2 * terms - 1, k]


@compiled
def linearise_undriven(flat, a_0, a_1, bins):
    """Error and weights of bins without input, whose C is there; the power of the error.

    The variance of Y counts as 1.
    """
    power = 0.0
    for k in range(bins):
        re = flat[A2 + k] + a_0 * flat[A0 + k] + a_1 * flat[A1 + k]
        im = flat[A2 + IM + k] + a_0 * flat[A0 + IM + k] + a_1 * flat[A1 + IM + k]
        w = 1 / (re * re + im * im)
        i_re, i_im = re * w, -im * w
        c_re, c_im = flat[C + k], flat[C + IM + k]
        m_re, m_im = c_re * i_re - c_im * i_im, c_re * i_im + c_im * i_re
        e_re, e_im = flat[Y + k] - m_re, flat[Y + IM + k] - m_im
        z_re, z_im = e_re * i_re + e_im * i_im, e_re * i_im - e_im * i_re
        flat[E + k], flat[E + IM + k] = e_re, e_im
        flat[AA + k] = w * (m_re * m_re + m_im * m_im)
        flat[AC + k], flat[AC + IM + k] = -w * m_re, w * m_im
        flat[CC + k] = w
        flat[OF_A + k], flat[OF_A + IM + k] = z_re * m_re - z_im * m_im, z_re * m_im + z_im * m_re
        flat[OF_C + k], flat[OF_C + IM + k] = -z_re, -z_im
        power += e_re * e_re + e_im * e_im
    return power


@compiled
def linearise_driven(flat, a_0, a_1, variance_u, bins):
    """Error and weights of bins with an input, whose B, C and variances are there; the cost.

    The variance of the residual depends on the response: the gradient has its derivative too.
    """
    cost = 0.0
    for k in range(bins):
        re = flat[A2 + k] + a_0 * flat[A0 + k] + a_1 * flat[A1 + k]
        im = flat[A2 + IM + k] + a_0 * flat[A0 + IM + k] + a_1 * flat[A1 + IM + k]
        i_2 = 1 / (re * re + im * im)
        i_re, i_im = re * i_2, -im * i_2
        b_re, b_im = flat[B + k], flat[B + IM + k]
        g_re, g_im = b_re * i_re - b_im * i_im, b_re * i_im + b_im * i_re
        u_re, u_im = flat[U + k], flat[U + IM + k]
        c_re, c_im = flat[C + k], flat[C + IM + k]
        m_re = c_re * i_re - c_im * i_im + g_re * u_re - g_im * u_im
        m_im = c_re * i_im + c_im * i_re + g_re * u_im + g_im * u_re
        e_re, e_im = flat[Y + k] - m_re, flat[Y + IM + k] - m_im
        v = 1 / (flat[S + k] + variance_u * (g_re * g_re + g_im * g_im))
        squared = v * (e_re * e_re + e_im * e_im)
        cost += squared
        w = v * i_2
        z_re, z_im = v * (e_re * i_re + e_im * i_im), v * (e_re * i_im - e_im * i_re)
        h = v * variance_u * squared
        h_re, h_im = h * (g_re * i_re + g_im * i_im), h * (g_re * i_im - g_im * i_re)
        flat[E + k], flat[E + IM + k], flat[V + k] = e_re, e_im, v
        flat[AA + k] = w * (m_re * m_re + m_im * m_im)
        x_re, x_im = -w * m_re, w * m_im
        flat[AC + k], flat[AC + IM + k] = x_re, x_im
        flat[AB + k], flat[AB + IM + k] = x_re * u_re - x_im * u_im, x_re * u_im + x_im * u_re
        flat[BB + k] = w * (u_re * u_re + u_im * u_im)
        flat[BC + k], flat[BC + IM + k] = w * u_re, -w * u_im
        flat[CC + k] = w
        flat[OF_A + k] = z_re * m_re - z_im * m_im + h_re * g_re - h_im * g_im
        flat[OF_A + IM + k] = z_re * m_im + z_im * m_re + h_re * g_im + h_im * g_re
        flat[OF_B + k] = -(z_re * u_re - z_im * u_im + h_re)
        flat[OF_B + IM + k] = -(z_re * u_im + z_im * u_re + h_im)
        flat[OF_C + k], flat[OF_C + IM + k] = -z_re, -z_im
    return cost


@compiled
def weigh_start(flat, a_0, a_1, first, driven, bins):
    """Weights of a Sanathanan-Koerner iteration: those there in the first one, else over ``|A|^2``."""
    for k in range(bins):
        l_re, l_im = flat[A2 + k], flat[A2 + IM + k]
        re = l_re + a_0 * flat[A0 + k] + a_1 * flat[A1 + k]
        im = l_im + a_0 * flat[A0 + IM + k] + a_1 * flat[A1 + IM + k]
        w = flat[V + k] if first else flat[V + k] / (re * re + im * im)
        y_re, y_im = flat[Y + k], flat[Y + IM + k]
        z_re, z_im = -w * (y_re * l_re - y_im * l_im), w * (y_re * l_im + y_im * l_re)
        flat[AA + k] = w * (y_re * y_re + y_im * y_im)
        flat[AC + k], flat[AC + IM + k] = -w * y_re, w * y_im
        flat[CC + k] = w
        flat[OF_A + k], flat[OF_A + IM + k] = z_re * y_re - z_im * y_im, z_re * y_im + z_im * y_re
        flat[OF_C + k], flat[OF_C + IM + k] = -z_re, -z_im
    if not driven:
        return
    for k in range(bins):
        x_re, x_im, w = flat[AC + k], flat[AC + IM + k], flat[CC + k]
        z_re, z_im = flat[OF_C + k], flat[OF_C + IM + k]
        u_re, u_im = flat[U + k], flat[U + IM + k]
        flat[AB + k], flat[AB + IM + k] = x_re * u_re - x_im * u_im, x_re * u_im + x_im * u_re
        flat[BB + k] = w * (u_re * u_re + u_im * u_im)
        flat[BC + k], flat[BC + IM + k] = w * u_re, -w * u_im
        flat[OF_B + k], flat[OF_B + IM + k] = z_re * u_re - z_im * u_im, z_re * u_im + z_im * u_re


@compiled
def add_up_driven(memory, table, normal):
    """Normal matrix and gradient of weights: `normal` is flat (n, n + 1), and one beyond."""
    normal[:] = 0.0
    targets = table.targets
    for block in range(table.blocks.size):
        row = BLOCK * block
        sums = _two_sums(table.products, row, memory, FIRST_WEIGHT + table.blocks[block])
        normal[targets[row]] += sums[0]
        normal[targets[row + 1]] += sums[1]


@compiled
def _two_sums(products, row, memory, weight):
    """Sums over bins of two rows of products, with one row of weights."""
    s_0 = s_1 = 0.0
    for k in range(products.shape[1]):
        w = memory[weight, k]
        s_0 += products[row, k] * w
        s_1 += products[row + 1, k] * w
    return s_0, s_1


@compiled
def add_up_undriven(memory, basis, n, normal):
    """The same of bins without input, most of all: from the transient's basis (2 terms, K) itself.

    Products for all pairs of terms would not stay in the cache.
    """
    normal[:] = 0.0
    terms, width = basis.shape[0] // 2, n + 1
    first = n - terms
    (
        normal[0],
        normal[1],
        normal[width + 1],
        normal[n],
        normal[width + n],
    ) = _sums_of_denominator(memory, basis.shape[1])
    for i in range(0, terms, 2):
        j = min(i + 1, terms - 1)  # a last one by itself counts twice, in the same places
        sums = _sums_of_pair(memory, basis, i, j)
        p, q = first + i, first + j
        normal[p], normal[q] = sums[0], sums[1]
        normal[width + p], normal[width + q] = sums[2], sums[3]
        normal[p * width + p], normal[p * width + q], normal[q * width + q] = sums[4:7]
        normal[p * width + n], normal[q * width + n] = sums[7], sums[8]
        for k in range(i + 2, terms, 2):
            m = min(k + 1, terms - 1)
            cross = _sums_between_pairs(memory, basis, i, j, k, m)
            r, s = first + k, first + m
            normal[p * width + r], normal[p * width + s] = cross[0], cross[1]
            normal[q * width + r], normal[q * width + s] = cross[2], cross[3]


@compiled
def _sums_of_denominator(memory, bins):
    """Entries of the two coefficients of A, and gradients by them."""
    s_00 = s_01 = s_11 = g_0 = g_1 = 0.0
    for k in range(bins):
        w, z_re, z_im = memory[AA_ROW, k], memory[OF_A_ROW, k], memory[OF_A_ROW + 1, k]
        p_re, p_im, q_re, q_im = memory[0, k], memory[1, k], memory[2, k], memory[3, k]
        s_00 += w * (p_re * p_re + p_im * p_im)
        s_01 += w * (p_re * q_re + p_im * q_im)
        s_11 += w * (q_re * q_re + q_im * q_im)
        g_0 += z_re * p_re - z_im * p_im
        g_1 += z_re * q_re - z_im * q_im
    return s_00, s_01, s_11, g_0, g_1


@compiled
def _sums_of_pair(memory, basis, i, j):
    """Entries of two terms of C with A and with each other, and gradients by them."""
    terms = basis.shape[0] // 2
    a_0 = b_0 = a_1 = b_1 = s_00 = s_01 = s_11 = g_0 = g_1 = 0.0
    for k in range(basis.shape[1]):
        w, x_re, x_im = memory[CC_ROW, k], memory[AC_ROW, k], memory[AC_ROW + 1, k]
        z_re, z_im = memory[OF_C_ROW, k], memory[OF_C_ROW + 1, k]
        p_re, p_im, q_re, q_im = memory[0, k], memory[1, k], memory[2, k], memory[3, k]
        t_re, t_im = basis[i, k], basis[terms + i, k]
        v_re, v_im = basis[j, k], basis[terms + j, k]
        xp_re, xp_im = x_re * p_re + x_im * p_im, x_im * p_re - x_re * p_im
        xq_re, xq_im = x_re * q_re + x_im * q_im, x_im * q_re - x_re * q_im
        a_0 += xp_re * t_re - xp_im * t_im
        b_0 += xp_re * v_re - xp_im * v_im
        a_1 += xq_re * t_re - xq_im * t_im
        b_1 += xq_re * v_re - xq_im * v_im
        s_00 += w * (t_re * t_re + t_im * t_im)
        s_01 += w * (t_re * v_re + t_im * v_im)
        s_11 += w * (v_re * v_re + v_im * v_im)
        g_0 += z_re * t_re - z_im * t_im
        g_1 += z_re * v_re - z_im * v_im
    return a_0, b_0, a_1, b_1, s_00, s_01, s_11, g_0, g_1


@compiled
def _sums_between_pairs(memory, basis, i, j, m, n):
    """Entries of two terms of C with two others."""
    terms = basis.shape[0] // 2
    s_im = s_in = s_jm = s_jn = 0.0
    for k in range(basis.shape[1]):
        w = memory[CC_ROW, k]
        i_re, i_im, j_re, j_im = (
            w * basis[i, k],
            w * basis[terms + i, k],
            w * basis[j, k],
            w * basis[terms + j, k],
        )
        m_re, m_im, n_re, n_im = basis[m, k], basis[terms + m, k], basis[n, k], basis[terms + n, k]
        s_im += i_re * m_re + i_im * m_im
        s_in += i_re * n_re + i_im * n_im
        s_jm += j_re * m_re + j_im * m_im
        s_jn += j_re * n_re + j_im * n_im
    return s_im, s_in, s_jm, s_jn


@compiled
def power(memory, row, bins):
    """Sum of squared moduli of a row and the next."""
    total = 0.0
    for k in range(bins):
        total += memory[row, k] * memory[row, k] + memory[row + 1, k] * memory[row + 1, k]
    return total


@compiled
def error_with_input(flat, bins):
    """Squared modulus of ``sum E conj(U)``."""
    re = im = 0.0
    for k in range(bins):
        e_re, e_im, u_re, u_im = flat[E + k], flat[E + IM + k], flat[U + k], flat[U + IM + k]
        re += e_re * u_re + e_im * u_im
        im += e_im * u_re - e_re * u_im
    return re * re + im * im


@compiled
def spread_of_pieces(memory, row, starts, counts, mean_power):
    """``log mean - mean log`` of the mean powers of pieces."""
    total, logs, product = 0.0, 0.0, 1.0
    for p in range(starts.size):
        part = 0.0
        for k in range(starts[p], starts[p] + counts[p]):
            part += memory[row, k] * memory[row, k] + memory[row + 1, k] * memory[row + 1, k]
        part /= counts[p] * mean_power
        total += part
        product *= part  # few enough at a time to stay in range
        if p % 8 == 7:
            logs += np.log(product)
            product = 1.0
    logs += np.log(product)
    return np.log(total / starts.size) - logs / starts.size


@compiled
def turned_residual(flat, factor, out):
    """Weighted error times `factor`, turned by the phase of the input, in `out` (K,) complex."""
    size = out.size
    for k in range(size):
        u_re, u_im = flat[U + k], flat[U + IM + k]
        squared = u_re * u_re + u_im * u_im
        if not squared > 0:
            u_re, u_im, squared = 1.0, 0.0, 1.0
        scale = factor * np.sqrt(flat[V + k] / squared)
        e_re, e_im = flat[E + k] * scale, flat[E + IM + k] * scale
        flat[AC + k], flat[AC + IM + k] = e_re * u_re + e_im * u_im, e_im * u_re - e_re * u_im
    for k in range(size):
        out[k] = complex(flat[AC + k], flat[AC + IM + k])
