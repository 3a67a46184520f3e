# SPDX-License-Identifier: Apache-2.0
"""Whether the bin, or line, that departs most from a fit does so as noise would make it.

The test of an outlier of a regression: by how much the cost falls without it (Cook & Weisberg,
*Residuals and Influence in Regression* (1982), section 2.2). What it is compared with are medians of
bins around of the same kind, so that coloured noise, distortion and an error of the model, which all
spread over many bins, are no outliers.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.tones import level_around

FALSE_ALARM = 1e-4
"""Probability that noise of a record has a bin taken for a tone."""
MOST_TONES = 8
"""In a band; where there are more bins that stand out, something else is wrong."""
WINDOW = 33
"""Bins, or lines, around one that give the level there."""
MEDIAN_LOSS = 2.5
"""Times the variance of a mean that a median of exponential powers counts as having: 2.1, and its tails."""
CERTAIN_LEVERAGE = 0.99
"""A bin that the fit follows to this part cannot be tested."""


@np.errstate(divide="ignore", invalid="ignore")
def falls_without_each(
    bases: tuple[ComplexArray, ComplexArray, ComplexArray],
    output: ComplexArray,
    u: ComplexArray,
    scale: FloatArray | ComplexArray,
    error: ComplexArray,
) -> FloatArray:
    """(M, K) what the cost falls by without a bin, in units of its variance.

    0 where the fit goes through a bin whatever is there.

    Parameters
    ----------
    bases : (K, a + 1), (K, b), (K, c) complex
        Of A, B and C.
    output, u : (M, K) complex
        Of the model, and its input.
    scale : (K,) float or complex
        What derivatives of the error are weighted with, over A; 0 on bins not used.
    error : (M, K) complex
        Weighted; E|error|^2 = 1 of noise.
    """
    of_a, of_b, of_c = bases
    shared = np.concatenate([-output[..., None] * of_a[:, :-1], u[..., None] * of_b], axis=-1)
    shared = shared * scale[:, None]  # (M, K, n)
    own = of_c * scale[:, None]
    records, bins, n = shared.shape
    of_own = np.linalg.qr(_real_rows(own))[0]  # (2 K, c)
    rest = _real_rows(shared)  # (M, 2 K, n)
    for _ in range(2):  # twice is enough: the second pass removes what rounding left
        rest = rest - of_own @ (of_own.T @ rest)
    of_shared = np.linalg.qr(rest.reshape(-1, n))[0].reshape(rest.shape)
    whole = np.concatenate([of_shared, np.broadcast_to(of_own, (records, *of_own.shape))], axis=-1)
    q = whole.reshape(records, bins, 2, whole.shape[-1])
    # (I - H) of each bin, 2 x 2: what of an error there the fit has left
    p, r = (1 - np.sum(q[..., k, :] ** 2, axis=-1) for k in (0, 1))
    b = -np.sum(q[..., 0, :] * q[..., 1, :], axis=-1)
    re, im = error.real, error.imag
    falls = (r * re**2 - 2 * b * re * im + p * im**2) / (p * r - b**2)
    least = (p + r) / 2 - np.hypot((p - r) / 2, b)  # eigenvalue
    return np.asarray(np.where(least > 1 - CERTAIN_LEVERAGE, falls, 0.0))


def _real_rows(values: ComplexArray) -> FloatArray:
    """(..., 2 K, n) real and imaginary parts of values (..., K, n), one after the other."""
    parts = np.stack([values.real, values.imag], axis=-2)
    *shape, bins, n = values.shape
    return parts.reshape(*shape, 2 * bins, n)


def chances_of(
    power: FloatArray,
    kinds: list[BoolArray],
    records: int,
    least: FloatArray | float,
    most_dof: float = np.inf,
) -> FloatArray:
    """(K,) probability that noise makes a power as large as that of each bin, from those around.

    Parameters
    ----------
    power : (K,) float
        Means over records.
    kinds : list of (K,) bool
        First excited lines, then kinds of other harmonics, last the bins between, with noise alone.
        Harmonics may hold distortion: they are compared with the larger level of their own kind and of
        the noise. Other harmonics that are few of their kind are compared with the excited ones, and not
        tested where there are none.
    records : int
    least : (K,) float or float
        Level of rounding.
    most_dof : float
        Complex degrees of freedom of what the powers were divided by.
    """
    chance = np.ones(power.size)
    levels = [level_around(power, kind, records, WINDOW) for kind in kinds]
    between, between_around = levels[-1]
    for k, (kind, (own, around)) in enumerate(zip(kinds, levels, strict=True)):
        if not around and 0 < k < len(kinds) - 1:
            own, around = levels[0]
            if not around:
                continue
        level = np.maximum(own, between)
        # the larger of two levels makes fewer false alarms than either
        around = between_around or around
        if around:
            dof = min(records * around / MEDIAN_LOSS, most_dof)
            ratio = power[kind] / np.maximum(level, least)[kind]
            chance[kind] = special.fdtrc(2 * records, 2 * dof, ratio)
    return chance
