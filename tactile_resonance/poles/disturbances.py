# SPDX-License-Identifier: Apache-2.0
"""What disturbs the lines of an FRF: tones, which are found, named and left out, and a transient that is left.

Tested is whether the line, or bin of a record (`tones`), that departs most from a fit does so as noise would
make it. The test of an outlier of a regression: by how much the cost falls without it (Cook & Weisberg,
*Residuals and Influence in Regression* (1982), section 2.2). What it is compared with are medians of bins
around of the same kind, so that coloured noise, distortion and an error of the model, which all spread over
many bins, are no outliers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import special
from scipy.ndimage import median_filter

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.poles.model import real_rows
from tactile_resonance.poles.modes import in_any_direction
from tactile_resonance.poles.result import Poles, PolesBatch, PolesStatus
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
# Half the width of a mode, in bins, from which a polynomial of order 2 follows its transient at 40 dB.
FEWEST_BINS = 16
# A record without a transient is suspected once in ten thousand times.
TRANSIENT_FALSE_ALARM = 1e-4
FEWEST_NEAR = 3
# Deviation in bins of a mode of less than so many, beside what the variance shows: a transient that is left
# changes its shape, by .28 bins of half width at most.
NARROW, UNRESOLVED = 2.0, 0.25


@np.errstate(divide="ignore", invalid="ignore")
def falls_without_each(
    bases: tuple[ComplexArray, ComplexArray, ComplexArray],
    output: ComplexArray,
    u: ComplexArray,
    scale: FloatArray | ComplexArray,
    error: ComplexArray,
) -> FloatArray:
    """(M, K) what the cost falls by without a bin, in units of its variance.

    0 where the fit goes through a bin whatever is there. Of bases (K, terms) of A, B and C, output of the model
    and input (M, K), a `scale` (K,) that derivatives of the error are weighted with, over A, 0 on bins not
    used, and weighted errors (M, K), E|error|^2 = 1 of noise.
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
    left = np.eye(2) - q @ q.swapaxes(-1, -2)
    p, r, b = left[..., 0, 0], left[..., 1, 1], left[..., 0, 1]
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

    Of powers (K,) that are means over records, divided by what has `most_dof` complex degrees of freedom;
    rounding has a level `least`. The kinds (K,) are first excited lines, then kinds of other harmonics, last
    the bins between, with noise alone. Harmonics may hold distortion: they are compared with the larger level
    of their own kind and of the noise. Other harmonics that are few of their kind are compared with the
    excited ones; without excited ones they are not tested.
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


def with_transient_judged(frf: FRF, poles: Poles) -> Poles:
    """The poles; status MODEL_ERROR where a transient is left in the FRF they are from, or it has that status.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays.
    poles : Poles
        Of it.

    Notes
    -----
    What a polynomial leaves of a transient ``c / (s - p)`` on the bins between harmonics counts as
    noise of the output, and is largest beside the mode. So the variance of the output given the input
    (``C_YY - |C_YU|^2 / C_UU``, which noise of the generator does not enter) of the lines within half
    the mode's width, three at least and a quarter of the band at most, is compared with that of the
    farther half of the band by an F-test. It needs `FRF.sensor_variance_given_actuator`, hence two
    periods; of one period, realisations show a transient by what they differ by (status MODEL_ERROR of the
    FRF, see `frf.estimate`). Where none is detected half widths below `FEWEST_BINS` are mentioned.

    Monte Carlo, 30 records a cell of a mode at 250 Hz in 200-300 Hz, lines 2.5 Hz apart, order 2, 2 to 8
    periods, damping ratio .005 to .1, 20 to 80 dB: from rest, mean square errors of f0 over the Cramer-Rao
    bound grow from 1.2 (20 and 40 dB) and 11 (80 dB) at half widths of 20 bins to 2e2, 1e4 and 9e6 at one
    bin (two periods; with eight 1.0, 1.0 and 22 at 16 bins). The stated ellipses held the truth in 97 % or
    more, for what is left raises the variance too: such poles are not wrong, but of next to no precision.
    Of half widths below a bin that is so with `UNRESOLVED`; without, damping ratios were off by up to 16
    deviations. In steady state the ratio was .5 to 2 throughout. The test found every cell with a ratio
    above 3, and none in steady state.
    """
    if frf.status is FrfStatus.MODEL_ERROR:
        return _doubted(frf, poles)
    if "local polynomial" not in frf.method or frf.periods < 2 or poles.f0_hz.size == 0:
        return poles
    left = max(_beside(frf, poles, k) for k in range(poles.f0_hz.size))
    half_width, note = _half_width(frf, poles), ""
    if left > 0:
        note = (
            f"beside the mode the output's variance is {left:.3g} times that of the other lines: the "
            "local polynomials do not follow its transient, and the poles have little precision; use "
            "the joint method, more periods, or drop the first"
        )
        poles = _doubted(frf, poles)
    elif np.any(half_width < FEWEST_BINS):
        note = (
            f"half the width of the mode is {half_width.min():.1f} bins, less than {FEWEST_BINS}: "
            "unless the record began settled, what the local polynomial method leaves of the transient "
            "biases the poles"
        )
    return poles.noting(note)


def _doubted(frf: FRF, poles: Poles) -> Poles:
    """With status MODEL_ERROR unless it is worse, and what a narrow mode is off by in the total covariance."""
    judged = poles.status in (PolesStatus.OK, PolesStatus.NO_COVARIANCE)
    total = poles.covariance if poles.total_covariance is None else poles.total_covariance
    if total is not None:
        std = np.where(_half_width(frf, poles) < NARROW, UNRESOLVED * 2 * np.pi * _bin_hz(frf), 0.0)
        total = total + in_any_direction(std, poles.poles_rad_s)
    return replace(
        poles,
        status=PolesStatus.MODEL_ERROR if judged else poles.status,
        total_covariance=total,
    )


def _beside(frf: FRF, poles: Poles, mode: int) -> float:
    """How much larger the variance beside a mode is than elsewhere; 0 where chance may make it."""
    band = frf.band(*poles.band_hz)
    variance = band.sensor_variance_given_actuator
    if variance is None or band.noise_dof < 2:
        return 0.0
    distance = np.abs(band.frequency_hz - poles.f0_hz[mode])
    order = np.argsort(distance)
    half_width = abs(poles.damping_ratio[mode]) * poles.f0_hz[mode]
    near = int(np.clip(np.sum(distance <= half_width), FEWEST_NEAR, max(order.size // 4, 1)))
    far = order[order.size // 2 :]
    # neighbouring lines share the bins between them
    dof = min(band.noise_dof - 1, (band.periods - 1) * band.realisations)
    mean = float(variance[far].mean()) if far.size else 0.0
    if not mean > 0:
        return 0.0
    ratio = float(variance[order[:near]].mean()) / mean
    alarm = TRANSIENT_FALSE_ALARM / poles.f0_hz.size
    return ratio if ratio > special.fdtri(2 * near * dof, 2 * far.size * dof, 1 - alarm) else 0.0


def _half_width(frf: FRF, poles: Poles) -> FloatArray:
    """(n,) of the modes, in bins of the record."""
    return np.asarray(np.abs(poles.damping_ratio) * poles.f0_hz / _bin_hz(frf))


def _bin_hz(frf: FRF) -> float:
    """One over the duration of the record."""
    return float(np.diff(frf.frequency_hz).min()) / frf.periods
