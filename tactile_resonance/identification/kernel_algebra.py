# SPDX-License-Identifier: Apache-2.0
"""Loops over bins and small matrices, compiled by numba for `joint_kernel`.

Complex numbers are pairs of arrays, and loops touch few of them: so they become vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

# Sums may be reordered, NaN and infinity keep their meaning.
OPTIONS: dict[str, Any] = {
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
    "error_model": "numpy",
}
compiled = njit(**OPTIONS)


@compiled
def dot(x, y):
    """Sum of products."""
    total = 0.0
    for k in range(x.size):
        total += x[k] * y[k]
    return total


@compiled
def real_dot(x_re, x_im, y_re, y_im):
    """Real part of the sum of products of complex numbers."""
    total = 0.0
    for k in range(x_re.size):
        total += x_re[k] * y_re[k] - x_im[k] * y_im[k]
    return total


@compiled
def real_dot_row(rows_re, rows_im, row, y_re, y_im):
    """`real_dot` with a row of (n, K) arrays: no view is made of it, which would be counted."""
    total = 0.0
    for k in range(y_re.size):
        total += rows_re[row, k] * y_re[k] - rows_im[row, k] * y_im[k]
    return total


@compiled
def dot_row(rows, row, y):
    """`dot` with a row of an (n, K) array."""
    total = 0.0
    for k in range(y.size):
        total += rows[row, k] * y[k]
    return total


@compiled
def add_row(out, rows, row, factor):
    """Add ``factor`` times a row of an (n, K) array."""
    for k in range(out.size):
        out[k] += factor * rows[row, k]


@compiled
def combine(basis_re, basis_im, coefficients, re, im):
    """Add ``sum_i coefficients[i] basis[i]`` to (K,) arrays."""
    for i in range(coefficients.size):
        add_row(re, basis_re, i, coefficients[i])
        add_row(im, basis_im, i, coefficients[i])


@compiled
def add_scaled(out, x, factor):
    """Add ``factor x``."""
    for k in range(x.size):
        out[k] += factor * x[k]


@compiled
def scale(out, x, y, factor):
    """``factor x y``."""
    for k in range(x.size):
        out[k] = factor * x[k] * y[k]


@compiled
def difference(out, x, y):
    """``x - y``."""
    for k in range(x.size):
        out[k] = x[k] - y[k]


@compiled
def two_products(out, x, p, y, q, factor):
    """``x p + factor y q``."""
    for k in range(x.size):
        out[k] = x[k] * p[k] + factor * y[k] * q[k]


@compiled
def weighted_power(out, weight, re, im):
    """``weight |x|^2``."""
    for k in range(re.size):
        out[k] = weight[k] * (re[k] * re[k] + im[k] * im[k])


@compiled
def invert(re, im, squared):
    """``1 / x`` in place, and its squared modulus."""
    for k in range(re.size):
        p, q = re[k], im[k]
        factor = 1 / (p * p + q * q)
        re[k], im[k], squared[k] = p * factor, -q * factor, factor


@compiled
def multiply(re, im, by_re, by_im):
    """``x by`` in place."""
    for k in range(re.size):
        p, q = re[k], im[k]
        re[k], im[k] = p * by_re[k] - q * by_im[k], p * by_im[k] + q * by_re[k]


@compiled
def square_block(normal, first, size, products, weight):
    """Set the block of one kind of coefficient: `products` are of its upper triangle."""
    row = 0
    for i in range(first, first + size):
        for j in range(i, first + size):
            total = dot_row(products, row, weight)
            normal[i, j] = total
            normal[j, i] = total
            row += 1


@compiled
def cross_block(normal, first, size, products_re, products_im, w_re, w_im):
    """Set the block of two kinds of coefficients, from `first` and of `size`."""
    row = 0
    for i in range(first[0], first[0] + size[0]):
        for j in range(first[1], first[1] + size[1]):
            total = real_dot_row(products_re, products_im, row, w_re, w_im)
            normal[i, j] = total
            normal[j, i] = total
            row += 1


@compiled
def factorise(normal, unit, lower, trace):
    """Cholesky factor of the normal matrix with unit diagonal; whether there is one."""
    n = unit.size
    for i in range(n):
        if not normal[i, i] > 0:
            return False
        unit[i] = 1 / np.sqrt(normal[i, i])
    for i in range(n):
        for j in range(i + 1):
            total = normal[i, j] * unit[i] * unit[j] if i != j else 1.0 + trace
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    return True


@compiled
def solve(lower, unit, right, step):
    """Solution of the normal equations by that factor, in `step`."""
    n = unit.size
    for i in range(n):
        total = right[i] * unit[i]
        for k in range(i):
            total -= lower[i, k] * step[k]
        step[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * step[k]
        step[i] = total / lower[i, i]
    for i in range(n):
        step[i] *= unit[i]


@compiled
def spread_of_pieces(starts, counts, re, im):
    """``log mean - mean log`` of the mean powers of pieces."""
    pieces = starts.size
    total, logs, product = 0.0, 0.0, 1.0
    overall = (dot(re, re) + dot(im, im)) / re.size
    for p in range(pieces):
        part = 0.0
        for k in range(starts[p], starts[p] + counts[p]):
            part += re[k] * re[k] + im[k] * im[k]
        part /= counts[p] * overall
        total += part
        product *= part  # few enough at a time to stay in range
        if p % 8 == 7:
            logs += np.log(product)
            product = 1.0
    logs += np.log(product)
    return np.log(total / pieces) - logs / pieces


@compiled
def f_quantile(normal, dof_1, dof_2):
    """As `noise_level.f_quantile`, from the normal quantile."""
    a, b = 2 / (9 * dof_1), 2 / (9 * dof_2)
    bottom = (1 - b) ** 2 - normal**2 * b
    if not bottom > 0:
        return np.inf
    under = (1 - a) ** 2 * b + (1 - b) ** 2 * a - normal**2 * a * b
    return (((1 - a) * (1 - b) + normal * np.sqrt(max(under, 0.0))) / bottom) ** 3
