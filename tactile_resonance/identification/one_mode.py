# SPDX-License-Identifier: Apache-2.0
"""The pole of one mode of one point and what follows from it, written out: few numbers, no arrays.

For a single point run as it is; `kernel_judgement` compiles it.
"""

from __future__ import annotations

import numpy as np

# Columns of `figures`.
COST, EXPECTED, CONDITION, NOISE_Y, NOISE_U, F0_HZ, DAMPING, POLE, RESIDUE = (
    *(0, 1, 2, 3, 4, 5, 6),
    *(7, 9),
)
POLE_COVARIANCE, COVARIANCE, FIGURES = 11, 15, 19


def pole_in_band(alpha, beta, covariance, bases, band, values, figures):
    """The pole, its residue and covariances in `figures`; whether it is one stable pair in the band.

    Parameters
    ----------
    alpha, beta : (2,), (m + 1,) float
        Coefficients of A without its last, and of B.
    covariance : (n, n) float
        Of all coefficients, those of A first.
    bases : two (m + 1, m) float
        Hessenberg matrices of denominator and numerator.
    band : (3,) float
        Scale of the variable [rad/s], least and largest f0 [Hz].
    values : (m + 1,) complex
        Overwritten.
    figures : (FIGURES,) float
    """
    h, h_b = bases
    scale, least_hz, largest_hz = band
    last_0, last_1 = h[2, 1] * alpha[0], h[2, 1] * alpha[1]
    first, second = h[0, 0], h[1, 1] - last_1
    under = ((first - second) / 2) ** 2 + (h[0, 1] - last_0) * h[1, 0]
    if not under < 0:
        return False
    x = complex((first + second) / 2, np.sqrt(-under))
    pole = x * scale
    size = abs(pole)
    f0_hz = size / (2 * np.pi)
    if not (pole.real < 0 and least_hz <= f0_hz <= largest_hz):
        return False
    # A and its slope
    p_1 = (x - h[0, 0]) / h[1, 0]
    slope_1 = 1 / h[1, 0]
    slope_2 = (p_1 + (x - h[1, 1]) * slope_1) / h[2, 1]
    ratio = scale / (alpha[1] * slope_1 + slope_2)
    terms = h_b.shape[0]
    values[0] = 1.0
    b = complex(beta[0], 0.0)
    for k in range(terms - 1):
        total = x * values[k]
        for j in range(k + 1):
            total -= h_b[j, k] * values[j]
        values[k + 1] = total / h_b[k + 1, k]
        b += beta[1 + k] * values[k + 1]
    residue = b * ratio
    s_0, s_1 = -ratio, -p_1 * ratio
    c_00, c_01, c_11 = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    # (Re, Im) of the pole
    rr = s_0.real**2 * c_00 + 2 * s_0.real * s_1.real * c_01 + s_1.real**2 * c_11
    ii = s_0.imag**2 * c_00 + 2 * s_0.imag * s_1.imag * c_01 + s_1.imag**2 * c_11
    ri = s_0.real * s_0.imag * c_00 + s_1.real * s_1.imag * c_11
    ri += (s_0.real * s_1.imag + s_0.imag * s_1.real) * c_01
    re, im = pole.real, pole.imag
    f_r, f_i = re / (2 * np.pi * size), im / (2 * np.pi * size)
    d_r, d_i = -(im**2) / size**3, re * im / size**3
    cross = f_r * d_r * rr + (f_r * d_i + f_i * d_r) * ri + f_i * d_i * ii
    figures[F0_HZ], figures[DAMPING] = f0_hz, -re / size
    figures[POLE], figures[POLE + 1] = re, im
    figures[RESIDUE], figures[RESIDUE + 1] = residue.real, residue.imag
    figures[POLE_COVARIANCE], figures[POLE_COVARIANCE + 3] = rr, ii
    figures[POLE_COVARIANCE + 1] = figures[POLE_COVARIANCE + 2] = ri
    figures[COVARIANCE] = f_r**2 * rr + 2 * f_r * f_i * ri + f_i**2 * ii
    figures[COVARIANCE + 1] = figures[COVARIANCE + 2] = cross
    figures[COVARIANCE + 3] = d_r**2 * rr + 2 * d_r * d_i * ri + d_i**2 * ii
    return True
