# SPDX-License-Identifier: Apache-2.0
"""Loops over the bins between harmonics: they have a transient and noise, and are most of all bins.

Their normal equations are summed from the transient's basis itself: products for all pairs of its
terms would not stay in the cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tactile_resonance.identification.joint_noise import BINS_PER_BAND
from tactile_resonance.identification.kernel_memory import (
    C_ROW,
    FIRST_WEIGHT,
    IM,
    LAST,
    SLOPE,
    SLOPE_ROW,
    STRIDE,
    C,
    E,
    U,
    Y,
    combine,
    compiled,
    inlined,
)
from tactile_resonance.identification.kernel_tables import AC, CC, OF_C

AC_ROW, CC_ROW, OF_C_ROW = (FIRST_WEIGHT + k for k in (AC, CC, OF_C))
AC_AT, CC_AT, OF_C_AT = (row * STRIDE for row in (AC_ROW, CC_ROW, OF_C_ROW))


@inlined
def _products(w, m_re, m_im, z_re, z_im, slope, t_re, t_im, v_re, v_im):
    """What a bin adds to the entries of A, and to those of two terms t and v of C.

    By the coefficients of A, ``A' = 1`` and ``j slope``, its error changes by ``m A' / A``, by those of C
    by ``-t / A``; `w` is ``1 / |A|^2``, `z` conj(error) / A.
    """
    x_re, x_im = -w * m_re, w * m_im
    y_re, y_im = slope * x_im, -slope * x_re
    squared = w * (m_re * m_re + m_im * m_im)
    return (
        squared,
        slope * slope * squared,
        z_re * m_re - z_im * m_im,
        -slope * (z_re * m_im + z_im * m_re),
        x_re * t_re - x_im * t_im,
        x_re * v_re - x_im * v_im,
        y_re * t_re - y_im * t_im,
        y_re * v_re - y_im * v_im,
        w * (t_re * t_re + t_im * t_im),
        w * (t_re * v_re + t_im * v_im),
        w * (v_re * v_re + v_im * v_im),
        z_im * t_im - z_re * t_re,
        z_im * v_im - z_re * v_re,
    )


def _pass(start: bool, kept: bool) -> Any:
    """A pass over all bins: error and sums of A and of the first two terms of C.

    Parameters
    ----------
    start : bool
        Weights of a Sanathanan-Koerner iteration in place of the linearised error.
    kept : bool
        Whether there are further terms: C comes from the memory then, and weights stay there.
    """

    @compiled
    def sums(flat, basis, a_0, a_1, gamma):
        """Power of the error, which is in the memory then, and sums; the variance of Y counts as 1."""
        terms = basis.shape[0] // 2
        j = min(1, terms - 1)
        c_0, c_1 = gamma[0], gamma[j] * j
        power = s_00 = s_11 = g_0 = g_1 = 0.0
        at_0 = av_0 = at_1 = av_1 = tt = tv = vv = g_t = g_v = 0.0
        for k in range(basis.shape[1]):
            last, slope = flat[LAST + k], flat[SLOPE + k]
            re, im = last + a_0, a_1 * slope
            w = 1 / (re * re + im * im)
            y_re, y_im = flat[Y + k], flat[Y + IM + k]
            t_re, t_im = basis[0, k], basis[terms, k]
            v_re, v_im = basis[j, k], basis[terms + j, k]
            if start:
                m_re, m_im = y_re, y_im
                z_re, z_im = -w * last * y_re, w * last * y_im
            else:
                i_re, i_im = re * w, -im * w
                if kept:
                    c_re, c_im = flat[C + k], flat[C + IM + k]
                else:
                    c_re, c_im = c_0 * t_re + c_1 * v_re, c_0 * t_im + c_1 * v_im
                m_re, m_im = c_re * i_re - c_im * i_im, c_re * i_im + c_im * i_re
                e_re, e_im = y_re - m_re, y_im - m_im
                z_re, z_im = e_re * i_re + e_im * i_im, e_re * i_im - e_im * i_re
                flat[E + k], flat[E + IM + k] = e_re, e_im
                power += e_re * e_re + e_im * e_im
            if kept:
                flat[AC_AT + k], flat[AC_AT + IM + k] = -w * m_re, w * m_im
                flat[CC_AT + k] = w
                flat[OF_C_AT + k], flat[OF_C_AT + IM + k] = -z_re, -z_im
            p = _products(w, m_re, m_im, z_re, z_im, slope, t_re, t_im, v_re, v_im)
            s_00, s_11, g_0, g_1 = s_00 + p[0], s_11 + p[1], g_0 + p[2], g_1 + p[3]
            at_0, av_0, at_1, av_1 = at_0 + p[4], av_0 + p[5], at_1 + p[6], av_1 + p[7]
            tt, tv, vv, g_t, g_v = tt + p[8], tv + p[9], vv + p[10], g_t + p[11], g_v + p[12]
        return power, (s_00, s_11, g_0, g_1), (at_0, av_0, at_1, av_1, tt, tv, vv, g_t, g_v)

    return sums


_error, _error_kept, _start, _start_kept = (
    _pass(start, kept) for start in (False, True) for kept in (False, True)
)


@compiled
def add_up_undriven(group, basis, theta, start, normal):
    """Normal equations at theta; power of the error, which is in the memory then.

    With `start` those of a Sanathanan-Koerner iteration. `normal` as for
    `kernel_driven.add_up_driven`.
    """
    memory, flat = group
    terms, n = basis.shape[0] // 2, theta.size
    width, first = n + 1, n - terms
    for k in range(normal.size):
        normal[k] = 0.0
    a_0, a_1, gamma = theta[0], theta[1], theta[first:]
    if terms > 2 and start:
        found = _start_kept(flat, basis, a_0, a_1, gamma)
    elif terms > 2:
        combine(memory, C_ROW, basis, theta, first)
        found = _error_kept(flat, basis, a_0, a_1, gamma)
    elif start:
        found = _start(flat, basis, a_0, a_1, gamma)
    else:
        found = _error(flat, basis, a_0, a_1, gamma)
    power, of_a, pair = found
    normal[0], normal[width + 1], normal[n], normal[width + n] = of_a
    _place_pair(normal, width, n, first, first + min(1, terms - 1), pair)
    for i in range(2, terms, 2):
        j = min(i + 1, terms - 1)  # a last one by itself counts twice, in the same places
        pair = _sums_of_pair(memory, basis, i, j)
        _place_pair(normal, width, n, first + i, first + j, pair)
    for i in range(0, terms - 2, 2):
        p, q = first + i, first + i + 1
        for k in range(i + 2, terms, 2):
            m = min(k + 1, terms - 1)
            r, s = first + k, first + m
            cross = _sums_between_pairs(memory, basis, i, i + 1, k, m)
            normal[p * width + r], normal[p * width + s] = cross[0], cross[1]
            normal[q * width + r], normal[q * width + s] = cross[2], cross[3]
    return power


@inlined
def _place_pair(normal, width, n, p, q, sums):
    """Entries of two terms of C with A and with each other, and gradients by them."""
    normal[p], normal[q] = sums[0], sums[1]
    normal[width + p], normal[width + q] = sums[2], sums[3]
    normal[p * width + p], normal[p * width + q], normal[q * width + q] = sums[4:7]
    normal[p * width + n], normal[q * width + n] = sums[7], sums[8]


@compiled
def _sums_of_pair(memory, basis, i, j):
    """Of two further terms, from weights in the memory; in the order of `_place_pair`."""
    terms = basis.shape[0] // 2
    at_0 = av_0 = at_1 = av_1 = tt = tv = vv = g_t = g_v = 0.0
    for k in range(basis.shape[1]):
        w, x_re, x_im = memory[CC_ROW, k], memory[AC_ROW, k], memory[AC_ROW + 1, k]
        z_re, z_im = memory[OF_C_ROW, k], memory[OF_C_ROW + 1, k]
        slope = memory[SLOPE_ROW, k]
        y_re, y_im = slope * x_im, -slope * x_re
        t_re, t_im = basis[i, k], basis[terms + i, k]
        v_re, v_im = basis[j, k], basis[terms + j, k]
        at_0 += x_re * t_re - x_im * t_im
        av_0 += x_re * v_re - x_im * v_im
        at_1 += y_re * t_re - y_im * t_im
        av_1 += y_re * v_re - y_im * v_im
        tt += w * (t_re * t_re + t_im * t_im)
        tv += w * (t_re * v_re + t_im * v_im)
        vv += w * (v_re * v_re + v_im * v_im)
        g_t += z_re * t_re - z_im * t_im
        g_v += z_re * v_re - z_im * v_im
    return at_0, av_0, at_1, av_1, tt, tv, vv, g_t, g_v


@compiled
def _sums_between_pairs(memory, basis, i, j, m, n):
    """Entries of two terms of C with two others."""
    terms = basis.shape[0] // 2
    s_im = s_in = s_jm = s_jn = 0.0
    for k in range(basis.shape[1]):
        w = memory[CC_ROW, k]
        i_re, i_im = w * basis[i, k], w * basis[terms + i, k]
        j_re, j_im = w * basis[j, k], w * basis[terms + j, k]
        m_re, m_im, n_re, n_im = basis[m, k], basis[terms + m, k], basis[n, k], basis[terms + n, k]
        s_im += i_re * m_re + i_im * m_im
        s_in += i_re * n_re + i_im * n_im
        s_jm += j_re * m_re + j_im * m_im
        s_jn += j_re * n_re + j_im * n_im
    return s_im, s_in, s_jm, s_jn


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
def spread_of_pieces(memory, row, counts, mean_power):
    """``log mean - mean log`` of the mean powers of pieces.

    Bins stand in the order of `kernel_tables.interleaved`. The product of the mean powers is below
    what a number can be only where they are far from equal: then the spread is infinite.
    """
    pieces = counts.size
    total, product = 0.0, 1.0
    scale = 1 / (BINS_PER_BAND * mean_power)
    for p in range(pieces - 1):
        part = 0.0
        for j in range(BINS_PER_BAND):
            re, im = memory[row, p + j * pieces], memory[row + 1, p + j * pieces]
            part += re * re + im * im
        total += part * scale
        product *= part * scale
    part, last, behind = 0.0, counts[pieces - 1], BINS_PER_BAND * pieces
    for j in range(BINS_PER_BAND):
        re, im = memory[row, (j + 1) * pieces - 1], memory[row + 1, (j + 1) * pieces - 1]
        part += re * re + im * im
    for k in range(behind, behind + last - BINS_PER_BAND):
        part += memory[row, k] * memory[row, k] + memory[row + 1, k] * memory[row + 1, k]
    part /= last * mean_power
    return np.log((total + part) / pieces) - np.log(product * part) / pieces
