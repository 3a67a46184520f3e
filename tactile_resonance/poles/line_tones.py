# SPDX-License-Identifier: Apache-2.0
"""Tones on the lines of an FRF: found, named, left out of the fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.outliers import (
    FALSE_ALARM,
    MOST_TONES,
    chances_of,
    falls_without_each,
)
from tactile_resonance.poles.result import PolesBatch, PolesStatus
from tactile_resonance.tones import ROUNDING, Tone

# Lines over which the variance counts as constant: that of one alone is too uncertain to divide by.
ALIKE_LINES = 9


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
    response = fit.response(frf.frequency_hz)
    if not np.isfinite(response).all() or used.sum() <= batch.structure.fewest_lines:
        return None
    x = fit.variable.of_frequency(frf.frequency_hz)
    p, q = (basis.at(x, 0)[0] for basis in (fit.denominator_basis, fit.numerator_basis))
    smooth = median_filter(np.where(used, variance, np.median(variance[used])), ALIKE_LINES)
    by_line = str(batch.variance_model) == "per line"
    weight = used / np.sqrt(np.where(used, variance, 1.0) if by_line else smooth)
    delay = np.exp(-2j * np.pi * frf.frequency_hz * fit.delay_s)
    scale = weight * delay / (p @ fit.denominator)
    error = np.asarray(np.where(used, frf.g - response, 0) * weight, complex)[None]
    bases = p, q, np.empty((used.size, 0), complex)
    none = np.zeros_like(used)
    least = ROUNDING * np.mean(np.abs(response[used]) ** 2) * weight**2
    power = falls_without_each(bases, response[None], np.ones_like(error), scale, error)[0]
    dof = frf.dof if by_line and frf.dof else np.inf
    chance = chances_of(power, [used, none, none], 1, np.where(used, least, 1.0), dof)
    line = int(np.argmin(chance))
    return line if chance[line] * used.sum() < FALSE_ALARM else None
