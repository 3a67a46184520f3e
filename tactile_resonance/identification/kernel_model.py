# SPDX-License-Identifier: Apache-2.0
"""The model of the joint estimator on a group of bins, and its normal equations: see `many_points`.

A group is (bases, products): of A, B and C the real and imaginary parts (terms, K) of the basis, and
of the six pairs of them the products that normal matrices are made of. B is empty between harmonics.
"""

from __future__ import annotations

from tactile_resonance.identification.kernel_algebra import (
    add_scaled,
    combine,
    compiled,
    cross_block,
    difference,
    dot,
    invert,
    multiply,
    real_dot_row,
    scale,
    square_block,
    two_products,
    weighted_power,
)

# Rows of a group's values.
INVERSE, SQUARED, MODEL, ERROR, G, WEIGHT, VALUES = 0, 2, 3, 5, 7, 9, 10
WORK = 9


@compiled
def evaluate(group, theta, data, values):
    """The model at theta (n,) in `values` (VALUES, K), without weights."""
    d_re, d_im, n_re, n_im, t_re, t_im = group[0]
    a, b = d_re.shape[0] - 1, theta.size - d_re.shape[0] + 1 - t_re.shape[0]
    i_re, i_im = values[INVERSE], values[INVERSE + 1]
    m_re, m_im = values[MODEL], values[MODEL + 1]
    i_re[:], i_im[:] = d_re[a], d_im[a]
    combine(d_re, d_im, theta[:a], i_re, i_im)
    invert(i_re, i_im, values[SQUARED])
    m_re[:], m_im[:] = 0.0, 0.0
    combine(t_re, t_im, theta[a + b :], m_re, m_im)
    multiply(m_re, m_im, i_re, i_im)
    if n_re.shape[0] > 0:
        g_re, g_im = values[G], values[G + 1]
        g_re[:], g_im[:] = 0.0, 0.0
        combine(n_re, n_im, theta[a : a + b], g_re, g_im)
        multiply(g_re, g_im, i_re, i_im)
        e_re, e_im = values[ERROR], values[ERROR + 1]
        two_products(e_re, g_re, data[2], g_im, data[3], -1.0)
        two_products(e_im, g_re, data[3], g_im, data[2], 1.0)
        add_scaled(m_re, e_re, 1.0)
        add_scaled(m_im, e_im, 1.0)
    difference(values[ERROR], data[0], m_re)
    difference(values[ERROR + 1], data[1], m_im)


@compiled
def weigh_driven(values, variance_y, variance_u):
    """Weights of bins with an input, and the cost there."""
    weight, g_re, g_im = values[WEIGHT], values[G], values[G + 1]
    for k in range(weight.size):
        weight[k] = 1 / (variance_y + variance_u * (g_re[k] * g_re[k] + g_im[k] * g_im[k]))
    cost = 0.0
    e_re, e_im = values[ERROR], values[ERROR + 1]
    for k in range(weight.size):
        cost += weight[k] * (e_re[k] * e_re[k] + e_im[k] * e_im[k])
    return cost


@compiled
def power_of_error(values):
    """Sum of the squared moduli of the errors."""
    e_re, e_im = values[ERROR], values[ERROR + 1]
    return dot(e_re, e_re) + dot(e_im, e_im)


@compiled
def set_normal(group, weight, y_re, y_im, data, work, normal):
    """Set the normal matrix of columns ``y p``, ``-u q``, ``-t`` with these weights (K,)."""
    aa, ab_re, ab_im, ac_re, ac_im, bb, bc_re, bc_im, cc = group[1]
    a, c = group[0][0].shape[0] - 1, group[0][4].shape[0]
    b = normal.shape[0] - a - c
    power, w_re, w_im = work[0], work[1], work[2]
    normal[:] = 0.0
    weighted_power(power, weight, y_re, y_im)
    square_block(normal, 0, a, aa, power)
    scale(w_re, weight, y_re, -1.0)
    scale(w_im, weight, y_im, 1.0)
    cross_block(normal, (0, a + b), (a, c), ac_re, ac_im, w_re, w_im)
    square_block(normal, a + b, c, cc, weight)
    if bb.shape[0] > 0:
        u_re, u_im = data[2], data[3]
        multiply(w_re, w_im, u_re, u_im)
        cross_block(normal, (0, a), (a, b), ab_re, ab_im, w_re, w_im)
        weighted_power(power, weight, u_re, u_im)
        square_block(normal, a, b, bb, power)
        scale(w_re, weight, u_re, 1.0)
        scale(w_im, weight, u_im, -1.0)
        cross_block(normal, (a, a + b), (b, c), bc_re, bc_im, w_re, w_im)


@compiled
def add_gradient(group, za_re, za_im, zb_re, zb_im, zc_re, zc_im, factor, gradient):
    """Add ``Re sum z_a p``, ``- Re sum z_b q``, ``- Re sum z_c t`` times a factor."""
    d_re, d_im, n_re, n_im, t_re, t_im = group[0]
    a, c = d_re.shape[0] - 1, t_re.shape[0]
    first = gradient.size - c
    for i in range(a):
        gradient[i] += factor * real_dot_row(d_re, d_im, i, za_re, za_im)
    for i in range(n_re.shape[0]):
        gradient[a + i] -= factor * real_dot_row(n_re, n_im, i, zb_re, zb_im)
    for i in range(c):
        gradient[first + i] -= factor * real_dot_row(t_re, t_im, i, zc_re, zc_im)


@compiled
def linearise_others(group, values, data, weight, work, normal, gradient):
    """Normal matrix, and gradient added, of bins between harmonics with one weight for all."""
    i_re, i_im = values[INVERSE], values[INVERSE + 1]
    m_re, m_im = values[MODEL], values[MODEL + 1]
    e_re, e_im = values[ERROR], values[ERROR + 1]
    set_normal(group, values[SQUARED], m_re, m_im, data, work, normal)
    for i in range(normal.shape[0]):
        for j in range(normal.shape[0]):
            normal[i, j] *= weight
    z_re, z_im, za_re, za_im = work[3], work[4], work[5], work[6]
    two_products(z_re, e_re, i_re, e_im, i_im, 1.0)
    two_products(z_im, e_re, i_im, e_im, i_re, -1.0)
    two_products(za_re, z_re, m_re, z_im, m_im, -1.0)
    two_products(za_im, z_re, m_im, z_im, m_re, 1.0)
    add_gradient(group, za_re, za_im, z_re, z_im, z_re, z_im, weight, gradient)


@compiled
def linearise_driven(group, values, data, variance_u, work, normal, gradient):
    """The same of bins with an input, whose variance has a derivative; after `weigh_driven`."""
    i_re, i_im = values[INVERSE], values[INVERSE + 1]
    m_re, m_im = values[MODEL], values[MODEL + 1]
    e_re, e_im = values[ERROR], values[ERROR + 1]
    g_re, g_im, weight = values[G], values[G + 1], values[WEIGHT]
    u_re, u_im = data[2], data[3]
    x = work[7]
    scale(x, weight, values[SQUARED], 1.0)
    set_normal(group, x, m_re, m_im, data, work, normal)
    z_re, z_im, za_re, za_im, zb_re, zb_im = work[3], work[4], work[5], work[6], work[7], work[8]
    for k in range(weight.size):
        w = weight[k]
        z_re[k] = w * (e_re[k] * i_re[k] + e_im[k] * i_im[k])
        z_im[k] = w * (e_re[k] * i_im[k] - e_im[k] * i_re[k])
        h = w * w * variance_u * (e_re[k] * e_re[k] + e_im[k] * e_im[k])
        h_re = h * (g_re[k] * i_re[k] + g_im[k] * i_im[k])
        h_im = h * (g_re[k] * i_im[k] - g_im[k] * i_re[k])
        za_re[k] = z_re[k] * m_re[k] - z_im[k] * m_im[k] + h_re * g_re[k] - h_im * g_im[k]
        za_im[k] = z_re[k] * m_im[k] + z_im[k] * m_re[k] + h_re * g_im[k] + h_im * g_re[k]
        zb_re[k] = z_re[k] * u_re[k] - z_im[k] * u_im[k] + h_re
        zb_im[k] = z_re[k] * u_im[k] + z_im[k] * u_re[k] + h_im
    add_gradient(group, za_re, za_im, zb_re, zb_im, z_re, z_im, 1.0, gradient)


@compiled
def start_group(group, theta, first, data, values, work, normal, gradient):
    """Normal equations of a Sanathanan-Koerner iteration, with weights 1 at `first`, else of theta."""
    d_re, d_im = group[0][0], group[0][1]
    a = d_re.shape[0] - 1
    weight = values[SQUARED]
    if first:
        weight[:] = 1.0
    else:
        re, im = values[INVERSE], values[INVERSE + 1]
        re[:], im[:] = d_re[a], d_im[a]
        combine(d_re, d_im, theta[:a], re, im)
        invert(re, im, weight)
    y_re, y_im, u_re, u_im = data[0], data[1], data[2], data[3]
    set_normal(group, weight, y_re, y_im, data, work, normal)
    z_re, z_im, za_re, za_im, zb_re, zb_im = work[3], work[4], work[5], work[6], work[7], work[8]
    last_re, last_im = d_re[a], d_im[a]
    # minus conj(y last), weighted
    two_products(z_re, y_re, last_re, y_im, last_im, -1.0)
    two_products(z_im, y_re, last_im, y_im, last_re, 1.0)
    scale(z_re, z_re, weight, -1.0)
    scale(z_im, z_im, weight, 1.0)
    two_products(za_re, z_re, y_re, z_im, y_im, -1.0)
    two_products(za_im, z_re, y_im, z_im, y_re, 1.0)
    two_products(zb_re, z_re, u_re, z_im, u_im, -1.0)
    two_products(zb_im, z_re, u_im, z_im, u_re, 1.0)
    add_gradient(group, za_re, za_im, zb_re, zb_im, z_re, z_im, 1.0, gradient)
