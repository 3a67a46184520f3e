# SPDX-License-Identifier: Apache-2.0
"""Which harmonics an input record excites."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, special

from tactile_resonance._typing import BoolArray, FloatArray, IntArray
from tactile_resonance.frf.spectra import Spectrum, power

GAP_DB = 15.0
"""A step this large between neighbouring sorted levels parts excited lines from distortion [dB]."""

_FALSE_ALARM = 1e-4  # probability that any pure-noise line of a record passes for a signal
_NOISE_BINS = 16  # bins wanted for the noise level at a line
# lines of noise: their weakest four are 15 dB below the next once in 31^4 records
_FEWEST_BELOW = 4
_STRAY_SHARE = 0.03  # even lines, relative to the odd ones, up to which a grid is called odd


def find_excited_harmonics(record: Spectrum) -> IntArray:
    """Excited harmonics of a multisine, from its input record alone.

    A line is a candidate if it stands above the noise around it. The candidates, sorted by level,
    are then cut at the first step of `GAP_DB` from the top: what lies below is distortion of the
    input (generator, amplifier), not excitation. So the levels of excited lines may span any range
    as long as no step between two neighbouring levels reaches `GAP_DB`. Where nearly all of these
    lines are odd (97 %), the grid is odd, and the few even lines are interference (mains hum).

    Parameters
    ----------
    record : Spectrum
        All leading axes (realisations) excite the same lines; their powers are averaged.

    Returns
    -------
    (F,) int
        Ascending, zero frequency and the Nyquist line never among them.

    Raises
    ------
    ValueError
        If samples are not finite, no line is above the noise, or, for a single period, no step of
        `GAP_DB` parts lines from noise.

    Notes
    -----
    For P >= 2 the noise level is that of the bins between harmonics, taken locally (coloured
    noise); F-tests admit a false line in one of ten thousand records. Over 9336 records of 2 to 8
    periods in thirteen noises, white to the fourth power of 1/f and narrow resonances, at -20 and 0 dB
    of the multisine, 9 had one: the first harmonic of two periods, where the noise falls steeply, but
    for one at a resonance. Lines less than some 14 dB above the noise on a bin are missed.

    For P = 1 there are no such bins: the noise level is that of the weaker half of the lines. Where
    more than half are excited nothing stands above that; then a step of `GAP_DB` must part them from
    at least four lines of noise, which noise alone does in less than one record of a hundred
    thousand. Coloured noise above the level of the lines cannot then be distinguished from excitation.
    """
    periods, samples = record.periods, record.samples_per_period
    if samples < 4:
        raise ValueError(f"u: {samples} samples in a period, expected 4 or more")
    u = record.bins[..., 1, :]  # (..., P N // 2 + 1)
    if not np.all(np.isfinite(u[..., 0])):  # one sample that is missing makes all bins NaN
        raise ValueError("u: holds samples that are not finite, expected a complete record")
    u = u.reshape(-1, u.shape[-1])
    power_of_bins = np.mean(power(u), axis=0)
    harmonics = np.arange(1, (samples - 1) // 2 + 1)  # (H,)
    line_power = power_of_bins[harmonics * periods]  # (H,)
    records = u.shape[0]
    if periods == 1:
        # the lower quartile over all lines is the median of the weaker half; were half of the lines
        # excited, it is still a level that noise reaches
        low = special.gammaincinv(records, 0.25)
        high = special.gammainccinv(records, _FALSE_ALARM / line_power.size)
        threshold = np.quantile(line_power, 0.25) * high / low
    else:
        threshold = _noise_threshold_between(power_of_bins, harmonics, periods, records)
    candidate = line_power > threshold
    level_db = 10 * np.log10(np.maximum(line_power, np.finfo(float).tiny))
    if periods == 1 and not np.any(candidate):
        candidate = _above_a_step(level_db)
    if not np.any(candidate):
        raise ValueError(
            "u: no line stands above the noise, expected a multisine; give the excited harmonics"
        )
    odd = harmonics % 2 == 1
    # an odd grid is looked for first, so that hum on an even line cannot pass for excitation
    for grid, most_beside in ((odd, _STRAY_SHARE), (np.ones_like(odd), 0.0)):
        cut_db = _cut_level(level_db, candidate, grid, needs_step=periods == 1)
        if cut_db is not None:
            excited = candidate & (level_db > cut_db)
            if np.sum(excited & ~grid) <= most_beside * np.sum(excited & grid):
                return harmonics[excited & grid]
    raise ValueError(
        f"u: a single period, and no step of {GAP_DB:g} dB between excited lines and noise; "
        "give the excited harmonics"
    )


def _above_a_step(level_db: FloatArray) -> BoolArray:
    """(H,) lines above the last step of `GAP_DB` that has `_FEWEST_BELOW` lines or more below it."""
    order = np.argsort(level_db)
    steps = np.flatnonzero(np.diff(level_db[order]) >= GAP_DB)
    above = np.zeros(level_db.size, bool)
    if steps.size and steps[-1] + 1 >= _FEWEST_BELOW:
        above[order[steps[-1] + 1 :]] = True
    return above


def _cut_level(
    level_db: FloatArray,
    candidate: BoolArray,
    among: BoolArray,
    *,
    needs_step: bool,
) -> float | None:
    """Middle of the first step of `GAP_DB` from the top [dB], among some of the lines.

    Without such a step every candidate is excited (minus infinity), or, where the noise level is
    only guessed (`needs_step`), no line can be detected (None).
    """
    sorted_db = -np.sort(-level_db[candidate & among])
    if sorted_db.size == 0:
        return None
    if needs_step and np.any(among & ~candidate):
        sorted_db = np.append(sorted_db, np.max(level_db[among & ~candidate]))
    steps = np.flatnonzero(-np.diff(sorted_db) >= GAP_DB)
    if steps.size:
        return float(np.mean(sorted_db[steps[0] : steps[0] + 2]))
    return None if needs_step else -np.inf


def _noise_threshold_between(
    power: FloatArray, harmonics: IntArray, periods: int, records: int
) -> FloatArray:
    """(H,) level that a line of noise alone hardly exceeds, from the bins between harmonics."""
    # (H, P - 1): the bins that follow each harmonic, and as many before the first
    first = np.concatenate([[0], harmonics]) * periods + 1
    between = power[np.minimum(first[:, None] + np.arange(periods - 1), power.size - 1)]
    around = -(-_NOISE_BINS // (2 * (periods - 1)))  # harmonics on either side
    mean = np.mean(between, axis=-1)  # (H + 1,), between harmonic h and h + 1
    # average over the `around` intervals before and after each harmonic
    width = 2 * around
    local = ndimage.uniform_filter1d(mean, width, mode="nearest", origin=0)[1:]
    bins = width * (periods - 1)
    # the ratio of two exponential means is F distributed
    quantile = special.fdtri(2 * records, 2 * bins * records, 1 - _FALSE_ALARM / harmonics.size)
    return np.asarray(quantile * local)
