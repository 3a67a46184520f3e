# SPDX-License-Identifier: Apache-2.0
"""Whether the bin, or line, that departs most from a fit does so as noise would make it.

The test of an outlier of a regression: by how much the cost falls without it (Cook & Weisberg,
*Residuals and Influence in Regression* (1982), section 2.2). What it is compared with are medians of
bins around of the same kind, so that coloured noise, distortion and an error of the model, which all
spread over many bins, are no outliers.

Lines of an FRF that depart in another way hold a tone: one after the other they are found, named, and left
out of the fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import special
from scipy.ndimage import median_filter

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.model import real_rows
from tactile_resonance.poles.result import PolesBatch, PolesStatus
from tactile_resonance.tones import ROUNDING, Tone, level_around

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
ALIKE_LINES = 9
"""Lines over which the variance counts as constant: that of one alone is too uncertain to divide by."""


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
    of_own = np.linalg.qr(real_rows(own).reshape(2 * bins, own.shape[-1]))[0]  # (2 K, c)
    rest = real_rows(shared).reshape(records, 2 * bins, n)
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


def poles_without_tones(
    fit: Callable[[FRF], PolesBatch], frf: FRF
) -> tuple[PolesBatch, tuple[Tone, ...]]:
    """Poles from an FRF, lines with a tone left out; see `tones.poles_without_tones` for records.

    Parameters
    ----------
    fit : callable
        Poles from lines, of which those that are not finite are left out.
    frf : FRF
        With (F,) arrays, the lines of the band.
    """
    whole = batch = fit(frf)
    rest, found = frf, list[int]()
    while (line := _most_striking(batch, rest)) is not None:
        found.append(line)
        g = rest.g.copy()
        g[line] = np.nan
        rest = replace(rest, g=g)
        batch = fit(rest)
        if len(found) > MOST_TONES or 1 in np.diff(np.sort(found)):
            return whole, ()  # neighbours stand out, or too many: that is no tone
    if batch.has_status(PolesStatus.MODEL_ERROR) or batch.has_status(PolesStatus.NOT_CONVERGED):
        return whole, ()  # distortion, or what the model leaves out, may be that large on a line
    spacing_hz = float(np.diff(frf.frequency_hz).min()) if found else 0.0
    tones = []
    for line in sorted(found):
        frequency_hz = frf.frequency_hz[line]
        rms_v = np.nan
        if frf.actuator_amplitude is not None:
            error = frf.g[line] - batch.fit.response(frequency_hz[None])[0]
            rms_v = np.sqrt(2) * np.abs(error) * frf.actuator_amplitude[line]
        tones.append(Tone(float(frequency_hz), float(rms_v), "sensor", spacing_hz))
    return batch, tuple(tones)


@np.errstate(all="ignore")
def _most_striking(batch: PolesBatch, frf: FRF) -> int | None:
    """The line that stands out most, if noise would not make it."""
    fit, used = batch.fit, np.isfinite(frf.g)
    variance = np.ones(used.size) if frf.variance is None else frf.variance
    used &= np.isfinite(variance) & (variance > 0)
    x = fit.variable.of_frequency(frf.frequency_hz)
    p, q = (basis.at(x, 0)[0] for basis in (fit.denominator_basis, fit.numerator_basis))
    turned = np.exp(-2j * np.pi * frf.frequency_hz * fit.delay_s) / (p @ fit.denominator)
    response = (q @ fit.numerator) * turned
    if not np.isfinite(response).all() or used.sum() <= batch.structure.fewest_lines:
        return None
    smooth = median_filter(np.where(used, variance, np.median(variance[used])), ALIKE_LINES)
    by_line = str(batch.variance_model) == "per line"
    weight = used / np.sqrt(np.where(used, variance, 1.0) if by_line else smooth)
    scale = weight * turned
    error = np.asarray(np.where(used, frf.g - response, 0) * weight, complex)[None]
    bases = p, q, np.empty((used.size, 0), complex)
    none = np.zeros_like(used)
    least = ROUNDING * np.mean(np.abs(response[used]) ** 2) * weight**2
    power = falls_without_each(bases, response[None], np.ones_like(error), scale, error)[0]
    dof = frf.dof if by_line and frf.dof else np.inf
    chance = chances_of(power, [used, none, none], 1, np.where(used, least, 1.0), dof)
    line = int(np.argmin(chance))
    return line if chance[line] * used.sum() < FALSE_ALARM else None
