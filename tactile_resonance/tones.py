# SPDX-License-Identifier: Apache-2.0
"""Hum and other tones by name; tones and noise of a record without drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy import special
from scipy.ndimage import median_filter

from tactile_resonance._typing import BoolArray, FloatArray, IntArray
from tactile_resonance.frf.excited import find_excited_harmonics
from tactile_resonance.frf.spectra import Spectrum

MAINS_HZ = (50.0, 60.0)
MAINS_TOLERANCE_HZ = 0.2
"""Of a mains frequency; of its harmonics as many times as much."""
MOST_HARMONICS = 25
"""Beyond them the tolerances of all fill the axis."""
FEWEST_AROUND = 8
"""Fewer powers give no level."""
ROUNDING = 1e-14
"""Of the power of a signal: what is smaller is no tone."""


@dataclass(frozen=True)
class Tone:
    """A sinusoid that the excitation did not make.

    Attributes
    ----------
    frequency_hz : float
    rms_v : float
        In the channel that it was seen in; over several records the quadratic mean [V]. NaN where it is
        not known.
    channel : str
        ``actuator`` or ``sensor``.
    resolution_hz : float
        Of the record: one over its length.
    """

    frequency_hz: float
    rms_v: float
    channel: str
    resolution_hz: float

    @property
    def mains_hz(self) -> tuple[float, ...]:
        """Mains frequencies of which it may be a harmonic."""
        fitting = []
        for mains in MAINS_HZ:
            k = round(self.frequency_hz / mains)
            away = abs(self.frequency_hz - k * mains)
            if 1 <= k <= MOST_HARMONICS and away <= k * MAINS_TOLERANCE_HZ + self.resolution_hz / 2:
                fitting.append(mains)
        return tuple(fitting)

    def text(self, what: str = "") -> str:
        """Such as ``tone at 250.0 Hz left out: fits hum of 50 Hz, 7e-05 V rms in the sensor``."""
        volts = f"{self.rms_v:.2g} V rms in the {self.channel}" if self.rms_v > 0 else ""
        mains = " or ".join(f"{hz:g}" for hz in self.mains_hz)
        hum = f"fits hum of {mains} Hz" if mains else ""
        start = f"tone at {self.frequency_hz:.1f} Hz{what and ' ' + what}"
        return ": ".join(filter(None, [start, ", ".join(filter(None, [hum, volts]))]))


def level_around(
    power: FloatArray, kind: BoolArray, records: int, window: int
) -> tuple[FloatArray, int]:
    """(K,) mean power of noise at each bin by the median of those of a kind around.

    And how many these are; level and number are zero where there are too few.

    Parameters
    ----------
    power : (K,) float
        Means over records.
    kind : (K,) bool
    records : int
    window : int
        How many bins of the kind count as around.
    """
    at = np.flatnonzero(kind)
    around = min(window, at.size)
    if around < FEWEST_AROUND:
        return np.zeros(power.size), 0
    if around < window or window % 2 == 0:
        medians = np.median(np.lib.stride_tricks.sliding_window_view(power[at], around), axis=-1)
    else:
        half = around // 2
        medians = median_filter(power[at], around)[half : at.size - half]
    nearest = np.searchsorted(at, np.arange(power.size))
    first = np.clip(nearest - around // 2, 0, medians.size - 1)
    return medians[first] * (records / special.gammaincinv(records, 0.5)), around


MOST_SAMPLES = 2**18
"""Of a piece; longer records are cut, and the powers of the pieces averaged."""
_FALSE_ALARM = 1e-4
"""Probability that noise of a channel makes a tone."""
_WINDOW = 33
DOF_OF_A_BIN = 1 / 4.2
"""Of a median of powers: 2.1 for the median, 2.0 bins that the window makes alike."""
NOISE_BINS = 2.004353
"""Bins whose noise the window takes together."""
MAIN_LOBE = 4
"""Bins on either side that the window spreads a tone over; its side lobes are 92 dB down."""
FIRST_BIN = 16
"""Below, a drift is too steep to be compared with what is around."""
MOST_NAMED = 12
DRIVEN = 100
"""Power at excited lines over that between them, above which a record was not taken without drive."""
EXACT = 1e-28
"""Power of a tone over that of the signal, below which it is rounding."""


@dataclass(frozen=True)
class SilentRecord:
    """Tones and noise of a record without drive.

    Attributes
    ----------
    tones : tuple of Tone
        Of both channels, the largest first.
    actuator_noise, sensor_noise : float
        Median over the band of the square root of the one-sided power density [V/sqrt(Hz)].
    band_hz : (float, float)
        In which tones and noise were looked for: not below `FIRST_BIN` over the length of a record.
    """

    tones: tuple[Tone, ...]
    actuator_noise: float
    sensor_noise: float
    band_hz: tuple[float, float]

    def text(self) -> str:
        """Lines for people."""
        low, high = self.band_hz
        lines = [
            f"{name}: noise {level:.2g} V/sqrt(Hz), median from {low:g} to {high:g} Hz"
            for name, level in (("actuator", self.actuator_noise), ("sensor", self.sensor_noise))
        ]
        lines += [tone.text() for tone in self.tones[:MOST_NAMED]] or [f"no tones from {low:g} to {high:g} Hz"]
        if len(self.tones) > MOST_NAMED:
            lines.append(f"and {len(self.tones) - MOST_NAMED} smaller ones")
        return "\n".join(lines)


def silent_record(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    *,
    sample_rate_hz: float,
    band_hz: tuple[float, float] | None = None,
) -> SilentRecord:
    """Tones and noise of records taken without drive.

    Parameters
    ----------
    u, y : (..., P, N) float
        Actuator and sensor [V]; the last two axes without a gap.
    sample_rate_hz : float
    band_hz : (low, high), optional
        All that the record shows when absent.

    Raises
    ------
    ValueError
        If a channel holds samples that are not finite, or the band too few bins.

    Notes
    -----
    Pieces are weighted with the Blackman-Harris window of four terms: F. J. Harris, *On the use of
    windows for harmonic analysis with the discrete Fourier transform*, Proc. IEEE 66 (1978) 51-83. A
    tone is a peak above the median of the bins around, beyond what noise makes. Its frequency and size
    are those of a parabola through the logarithms of its three largest bins.
    """
    from scipy.signal import welch  # half a second, which nodes need not wait for

    tones: list[Tone] = []
    noise = []
    edges = (0.0, sample_rate_hz / 2) if band_hz is None else band_hz
    for x, channel in ((u, "actuator"), (y, "sensor")):
        if not np.all(np.isfinite(x)):
            raise ValueError(f"{channel}: holds samples that are not finite, expected volts")
        records = np.asarray(x, float).reshape(-1, int(np.prod(np.shape(x)[-2:])))
        pieces = -(-records.shape[1] // MOST_SAMPLES)
        samples = records.shape[1] // pieces
        resolution_hz = sample_rate_hz / samples
        _, each = welch(records, sample_rate_hz, "blackmanharris", samples, 0, scaling="spectrum")
        power = each.mean(axis=0)  # (K,) mean squares of tones
        kind = np.zeros(power.size, bool)
        first = max(int(np.ceil(edges[0] / resolution_hz)), FIRST_BIN)
        kind[first : int(edges[1] / resolution_hz) + 1] = True
        count = pieces * len(records)
        level, around = level_around(power, kind, count, _WINDOW)
        if not around:
            raise ValueError(
                f"band_hz: {edges[0]:g}..{edges[1]:g} Hz hold {kind.sum()} bins above the "
                f"{FIRST_BIN * resolution_hz:g} Hz from which a record of this length shows tones, "
                "expected 8 or more"
            )
        noise.append(float(np.sqrt(np.median(level[kind]) / (NOISE_BINS * resolution_hz))))
        used = kind & (power > EXACT * np.mean(records**2))
        for at, size in _peaks(power, used, level, count, around):
            tones.append(Tone(float(at * resolution_hz), float(np.sqrt(size)), channel, resolution_hz))
    tones.sort(key=lambda tone: -tone.rms_v)
    seen_hz = float(max(edges[0], FIRST_BIN * resolution_hz)), float(edges[1])  # alike of both channels
    return SilentRecord(tuple(tones), noise[0], noise[1], seen_hz)


def check_undriven(
    u: npt.NDArray[np.floating], harmonics: IntArray | None, sample_rate_hz: float
) -> None:
    """Refuse a record whose actuator was driven.

    Parameters
    ----------
    u : (M, P, N) float
        Actuator [V]: M realisations of P consecutive periods. Of one period nothing lies between lines.
    harmonics : (F,) int or None
        Excited multiples of one over the period, ascending; None where they are not known: then there are more
        than `MOST_NAMED` that are no harmonics of the mains where it was driven.
    sample_rate_hz : float

    Raises
    ------
    ValueError
        Where their power is more than `DRIVEN` times that between them.
    """
    realisations, periods, samples = u.shape
    if periods == 1 or np.ptp(u) == 0:
        return
    if harmonics is None:
        try:
            harmonics = find_excited_harmonics(Spectrum.of(u, u))
        except ValueError:  # nothing stands above the noise
            return
        line_hz = sample_rate_hz / samples
        # within a line of a harmonic
        of_mains = [np.abs(harmonics * line_hz / hz % 1 - 0.5) > 0.5 - line_hz / hz for hz in MAINS_HZ]
        if np.count_nonzero(~np.any(of_mains, axis=0)) <= MOST_NAMED:
            return
    spectrum = scipy.fft.rfft(u.reshape(realisations, periods * samples))
    power = np.mean(np.abs(spectrum) ** 2, axis=0)  # (K,), lines at multiples of the periods
    lines = harmonics * periods
    around = np.arange(lines[0] - 1, lines[-1] + 2)
    driven, between = np.median(power[lines]), np.median(power[around[around % periods != 0]])
    if driven > DRIVEN * between:
        with np.errstate(divide="ignore"):  # of noise-free records there is nothing between
            above_db = 10 * np.log10(driven / between)
        raise ValueError(
            f"record: the actuator has {above_db:.0f} dB more power at the excited lines than between them, "
            "expected a record taken without drive; without --silent its response is estimated"
        )


def _peaks(
    power: FloatArray, used: BoolArray, level: FloatArray, records: int, around: int
) -> list[tuple[float, float]]:
    """Place, in bins, and power of each peak that noise would not make."""
    dof = records * around * DOF_OF_A_BIN
    chance = np.ones(power.size)
    ratio = power[used] / np.maximum(level[used], np.finfo(float).tiny)
    chance[used] = special.fdtrc(2 * records, 2 * dof, ratio)
    found = []
    for k in np.flatnonzero(used & (chance * np.count_nonzero(used) < _FALSE_ALARM)):
        near = power[k - MAIN_LOBE : k + MAIN_LOBE + 1]
        if near.size < 2 * MAIN_LOBE + 1 or power[k] < near.max():
            continue
        a, b, c = np.log(power[k - 1 : k + 2])
        shift = 0.5 * (a - c) / (a - 2 * b + c)
        found.append((k + shift, float(np.exp(b - 0.25 * (a - c) * shift))))
    return found
