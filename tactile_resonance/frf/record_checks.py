# SPDX-License-Identifier: Apache-2.0
"""Single checks of one channel of one record, x of shape (P, N); each gives a list of faults."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy import special

from tactile_resonance.frf.fault_types import Fault, FaultKind
from tactile_resonance.frf.spectra import period_spectra
from tactile_resonance.tones import MAINS_HZ, ROUNDING

Samples = npt.NDArray[np.floating]
Lines = npt.NDArray[np.integer]

SHARE_AT_TOP = 1 / np.sqrt(2)
"""Largest share of a quantised peak's two topmost values that is at the top: a parabola's, cut at both."""
GRID_SAMPLES, FEW_ALIKE = 2000, 0.98
"""Samples of a converter that counts repeat each other; these many tell."""
LARGE_OFFSET = 0.1
"""Mean against the rms of the rest."""
LARGE_DRIFT = 0.05
"""Spread of the means of the periods against the rms of the rest."""
MAINS_HARMONICS = 5
_HUM_FLOOR_BINS = (10, 40)  # distance from the mains frequency at which the floor is taken
_FALSE_ALARM = 1e-4


def missing_samples(x: Samples, channel: str, harmonics: Lines) -> list[Fault]:
    """Samples that are not finite, or one value held over a whole cycle of the fastest line."""
    bad = int(np.count_nonzero(~np.isfinite(x)))
    if bad:
        text = f"{bad} samples of the {channel} are missing (not finite)."
        return [Fault(FaultKind.MISSING_SAMPLES, channel, bad, True, text)]
    record = x.ravel()
    starts, lengths = _runs(record)
    cycle = max(8, -(-x.shape[-1] // int(np.max(harmonics))))
    value = record[starts]
    # a clipped peak is held too, but that is saturation
    held = (lengths > cycle) & (value != record.max()) & (value != record.min())
    if record.max() == record.min():
        held = lengths > cycle
    if not np.any(held):
        return []
    total = int(lengths[held].sum())
    text = f"The {channel} stands still for {total} samples: a gap filled with the last value."
    return [Fault(FaultKind.MISSING_SAMPLES, channel, total, True, text)]


def saturation(x: Samples, channel: str, range_v: tuple[float, float] | None) -> list[Fault]:
    """Samples at the ends of the range, or flat tops where the range is not known."""
    record = x.ravel()
    if range_v is not None:
        low, high = range_v
        margin = 1e-6 * (high - low)
        count = int(np.count_nonzero((record <= low + margin) | (record >= high - margin)))
        where = f"at the ends of its range ({low:g} to {high:g} V)"
    else:
        count = sum(_clipped(sign * record, x.shape[0]) for sign in (1, -1))
        where = "on flat tops"
    if count == 0:
        return []
    text = f"The {channel} is saturated: {count} samples {where}."
    return [Fault(FaultKind.SATURATION, channel, count, True, text)]


def offset(x: Samples, channel: str) -> list[Fault]:
    """A mean that is large against the signal. It harms no line, but takes up range."""
    rms = float(np.std(x))
    mean = float(np.mean(x))
    if abs(mean) <= LARGE_OFFSET * rms:
        return []
    text = f"The {channel} has an offset of {mean:.3g} V beside {rms:.3g} V rms."
    return [Fault(FaultKind.OFFSET, channel, abs(mean), False, text)]


def drift(x: Samples, channel: str, *, spoils: bool) -> list[Fault]:
    """Period means that wander. A single period cannot tell drift from its slowest lines."""
    rms = float(np.std(x - x.mean(axis=-1, keepdims=True)))
    means = x.mean(axis=-1)
    spread = float(np.ptp(means))
    if x.shape[0] < 2 or spread <= LARGE_DRIFT * rms:
        return []
    text = f"The mean of the {channel} drifts by {spread:.3g} V over the record."
    return [Fault(FaultKind.DRIFT, channel, spread, spoils, text)]


def hum(x: Samples, channel: str, sample_rate_hz: float, harmonics: Lines) -> list[Fault]:
    """Mains frequency and its harmonics, at bins that are not excited.

    Spoils the FRF only where an excited line lies within the bins that the local polynomial method
    draws on. Hum that falls exactly on a harmonic of several periods cannot be seen: it looks like
    excitation or distortion.
    """
    periods, samples = x.shape
    length = periods * samples
    resolution = sample_rate_hz / length
    highest = MAINS_HARMONICS * max(MAINS_HZ) / resolution + _HUM_FLOOR_BINS[1]
    spectrum = scipy.fft.rfft(x.ravel() - x.mean())[: math.ceil(highest) + 1]
    power = 2 * np.abs(spectrum) ** 2 / length**2  # mean square per bin
    rounding = ROUNDING * float(np.var(x))
    excited = np.zeros(power.size, bool)
    lines = np.asarray(harmonics) * periods
    excited[lines[lines < power.size]] = True
    usable = ~excited
    if periods > 1:
        usable[::periods] = False  # harmonics not excited may hold distortion
    found: list[tuple[float, float, bool]] = []
    for mains in MAINS_HZ:
        peaks = []
        for k in range(1, MAINS_HARMONICS + 1):
            centre = round(k * mains / resolution)
            # the floor is taken where leakage of the hum has died out
            away = np.arange(*_HUM_FLOOR_BINS)
            around = centre + np.concatenate([-away, away])
            around = around[(around > 0) & (around < power.size)]
            around = around[usable[around]]
            peak = centre + np.arange(-1, 2)
            peak = peak[(peak > 0) & (peak < power.size)]
            peak = peak[usable[peak]]
            if around.size < 8 or peak.size == 0:
                continue
            floor = np.median(power[around]) / np.log(2)  # mean of an exponential distribution
            # the floor of a few bins is itself uncertain
            limit = special.fdtri(2, 2 * around.size, 1 - _FALSE_ALARM / peak.size)
            if power[peak].max() > max(2 * limit * floor, rounding):
                near = bool(np.any(excited[max(0, centre - 5) : centre + 6]))
                peaks.append((k * mains, float(power[peak].sum()), near))
        # the fundamental may be hidden, a single high harmonic may be anything
        if peaks and (peaks[0][0] == mains or len(peaks) > 1):
            found += peaks
    if not found:
        return []
    rms = float(np.sqrt(sum(line[1] for line in found)))
    names = ", ".join(f"{line[0]:g}" for line in found)
    text = f"Mains hum in the {channel} at {names} Hz, at least {rms:.2g} V rms."
    return [Fault(FaultKind.HUM, channel, rms, any(line[2] for line in found), text)]


def lost_samples(x: Samples, channel: str, harmonics: Lines) -> list[Fault]:
    """Periods shifted against each other: samples were lost between them."""
    # the first period may hold a transient: with three others it is left out
    start = 1 if x.shape[0] > 2 else 0
    if x.shape[0] - start < 2:
        return []
    spectra = np.zeros((x.shape[0] - start, x.shape[1] // 2 + 1), complex)
    spectra[:, harmonics] = period_spectra(x[start:], np.asarray(harmonics))
    cross = spectra[1:] * spectra[0].conj()
    magnitude = np.abs(cross)
    # all lines alike, so that the peak of the correlation is sharp
    cross = np.divide(cross, magnitude, out=np.zeros_like(cross), where=magnitude > 0)
    correlation = scipy.fft.irfft(cross, x.shape[1], axis=-1)
    shift = np.argmax(correlation, axis=-1)
    shift = np.where(shift > x.shape[1] // 2, shift - x.shape[1], shift)
    unshifted = correlation[:, 0]
    # a shift that explains the data no better than none is chance
    clear = np.max(correlation, axis=-1) > 2 * np.abs(unshifted)
    shift = np.where(clear, shift, 0)
    if not np.any(shift):
        return []
    worst = int(shift[np.argmax(np.abs(shift))])
    text = f"Periods of the {channel} are shifted by {worst} samples: some were lost in between."
    return [Fault(FaultKind.LOST_SAMPLES, channel, abs(worst), True, text)]


def unsettled(x: Samples, channel: str, harmonics: Lines, *, spoils: bool) -> list[Fault]:
    """Whether the first period differs from the others by more than noise; needs three periods."""
    periods = x.shape[0]
    if periods < 3:
        return []
    spectra = period_spectra(x, np.asarray(harmonics)).astype(complex)  # (P, F)
    mean = spectra[1:].mean(axis=0)
    noise = np.sum(np.abs(spectra[1:] - mean) ** 2) / (periods - 2)
    difference = np.sum(np.abs(spectra[0] - mean) ** 2) / (1 + 1 / (periods - 1))
    dof = 2 * len(harmonics)
    limit = special.fdtri(dof, dof * (periods - 2), 1 - _FALSE_ALARM)
    rounding = np.finfo(x.dtype).eps ** 2 * np.sum(np.abs(mean) ** 2)
    # twice the limit: noise of few lines may dominate and vary
    if difference <= 2 * limit * (noise + rounding):
        return []
    level = 10 * np.log10(difference / np.sum(np.abs(mean) ** 2))
    text = f"The first period of the {channel} has not settled: {level:.0f} dB off the others."
    return [Fault(FaultKind.UNSETTLED, channel, float(10 ** (level / 20)), spoils, text)]


def _clipped(record: Samples, periods: int) -> int:
    """How many samples stand at the largest value, if suspiciously many, else 0.

    Without clipping the values thin out towards the largest; of a quantised sine at most 2.4 times
    as many stand at the largest value as at the next. A few more may by chance (binomial test).
    """
    largest = record.max()
    rest = record[record < largest]
    if rest.size == 0:
        return 0
    top = record.size - rest.size
    following = np.count_nonzero(rest == rest.max())
    some = record[:GRID_SAMPLES]
    some = some[(some < largest) & (some > record.min())]
    if np.unique(some).size > FEW_ALIKE * some.size:
        # not quantised: equal values are no chance, unless a period without noise is repeated
        spans = record.reshape(periods, -1)
        repeated = periods if np.array_equal(spans[1:], spans[:-1]) else 1
        return top if top >= 4 * repeated else 0
    # probability of so many or more out of both; periods repeat each other, one counts
    one, next_one = top // periods, -(-following // periods)
    chance = special.bdtrc(one - 1, one + next_one, SHARE_AT_TOP) if one else 1.0
    return top if chance < _FALSE_ALARM else 0


def _runs(record: Samples) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First index and length of each run of equal samples."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(record) != 0) + 1])
    return starts, np.diff(np.append(starts, record.size))
