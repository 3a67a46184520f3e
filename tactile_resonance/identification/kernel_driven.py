# SPDX-License-Identifier: Apache-2.0
"""Loops over bins with an input: lines of an FRF, or the excited bins of a record."""

from __future__ import annotations

import numpy as np

from tactile_resonance.identification import kernel_tables
from tactile_resonance.identification.kernel_memory import (
    FIRST_WEIGHT,
    IM,
    LAST,
    SLOPE,
    B,
    C,
    E,
    S,
    U,
    V,
    Y,
    compiled,
)
from tactile_resonance.identification.kernel_tables import BLOCK

AA, AC, CC, OF_A, OF_C, AB, BB, BC, OF_B = (
    (FIRST_WEIGHT + getattr(kernel_tables, name)) * IM
    for name in ("AA", "AC", "CC", "OF_A", "OF_C", "AB", "BB", "BC", "OF_B")
)


@compiled
def linearise_driven(flat, a_0, a_1, variance_u, bins):
    """Error and weights of bins with an input, whose B, C and variances are there; the cost.

    The variance of the residual depends on the response: the gradient has its derivative too.
    """
    cost = 0.0
    for k in range(bins):
        re, im = flat[LAST + k] + a_0, a_1 * flat[SLOPE + k]
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
def weigh_start(flat, a_0, a_1, first, bins):
    """Weights of a Sanathanan-Koerner iteration: those there in the first one, else over ``|A|^2``."""
    for k in range(bins):
        last = flat[LAST + k]
        re, im = last + a_0, a_1 * flat[SLOPE + k]
        w = flat[V + k] if first else flat[V + k] / (re * re + im * im)
        y_re, y_im = flat[Y + k], flat[Y + IM + k]
        x_re, x_im = -w * y_re, w * y_im
        z_re, z_im = x_re * last, x_im * last
        u_re, u_im = flat[U + k], flat[U + IM + k]
        flat[AA + k] = w * (y_re * y_re + y_im * y_im)
        flat[AC + k], flat[AC + IM + k] = x_re, x_im
        flat[AB + k], flat[AB + IM + k] = x_re * u_re - x_im * u_im, x_re * u_im + x_im * u_re
        flat[BB + k] = w * (u_re * u_re + u_im * u_im)
        flat[BC + k], flat[BC + IM + k] = w * u_re, -w * u_im
        flat[CC + k] = w
        flat[OF_A + k], flat[OF_A + IM + k] = z_re * y_re - z_im * y_im, z_re * y_im + z_im * y_re
        flat[OF_B + k] = -(z_re * u_re - z_im * u_im)
        flat[OF_B + IM + k] = -(z_re * u_im + z_im * u_re)
        flat[OF_C + k], flat[OF_C + IM + k] = -z_re, -z_im


@compiled
def add_up_driven(memory, table, normal):
    """Normal matrix and gradient of weights: `normal` is flat, flat (n, n + 1), and one beyond."""
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
