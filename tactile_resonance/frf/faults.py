# SPDX-License-Identifier: Apache-2.0
"""Acquisition faults that a single record shows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.tones import MAINS_HZ, ROUNDING

SHARE_AT_TOP = 1 / np.sqrt(2)
"""Largest share of a quantised peak's two topmost values that is at the top: a parabola's, cut at both."""
FEWEST_ON_TOP = 4
"""Samples at the largest value; fewer stand there by chance, whether quantised or not."""
GRID_SAMPLES, FEW_ALIKE = 2000, 0.98
"""Equal samples of a converter from which on its counts are taken to repeat."""
FEW_LEVELS = 32
"""With no more values than these a channel may stand still by the steps of its converter alone."""
LARGE_OFFSET = 0.1
"""Mean against the rms of the rest."""
LARGE_DRIFT = 0.05
"""Spread of the means of the periods against the rms of the rest."""
FEWEST_LINES = 8
LEAST_TURN, SPOILING_TURN = 1e-3, 0.1
"""Phase [rad] that the actuator's highest line shifts by over a record: seen, and too far."""
MAINS_HARMONICS = 5
_FALSE_ALARM = 1e-4
_TONE = 25.0
"""Power of a bin over the mean of ten beside: of noise 18 in one of 1e4 records, 1/3 of them each bin."""


class FaultKind(Enum):
    """What is wrong with a record."""

    MISSING_SAMPLES = "missing samples"
    LOST_SAMPLES = "samples lost"
    CLOCKS = "clocks of generator and converter differ"
    SATURATION = "saturation"
    OFFSET = "offset"
    DRIFT = "drift"
    HUM = "mains hum"
    CHANNEL_SKEW = "channel skew suspected"


@dataclass(frozen=True)
class Fault:
    """One fault of one channel.

    Attributes
    ----------
    kind : FaultKind
    channel : str
        ``actuator``, ``sensor``, or ``both`` where it lies between them.
    value : float
        How bad; the message says in which unit. Larger is worse.
    spoils : bool
        The FRF cannot be trusted because of it; otherwise it is worth knowing only.
    text : str
        For people to read; no full stop. Of several records also in how many.
    """

    kind: FaultKind
    channel: str
    value: float
    spoils: bool
    text: str

    @property
    def message(self) -> str:
        """A sentence for people."""
        return f"{self.text}."


@dataclass(frozen=True)
class FaultReport:
    """All faults seen.

    Attributes
    ----------
    faults : tuple of Fault
        One per kind and channel, the worst over all records.
    """

    faults: tuple[Fault, ...] = ()

    @property
    def suspect(self) -> bool:
        """True where a fault spoils the FRF."""
        return any(fault.spoils for fault in self.faults)

    @property
    def message(self) -> str:
        """All sentences."""
        return " ".join(fault.message for fault in self.faults)

    def marked(self, frf: FRF) -> FRF:
        """The FRF with what was found in its message, and SUSPECT where a fault spoils it."""
        if not self.faults:
            return frf
        if self.suspect:
            return frf.suspected(self.message)
        message = "; ".join(filter(None, [frf.message, self.message]))
        return replace(frf, message=message)


def find_faults(
    record: Spectrum,
    *,
    sample_rate_hz: float,
    harmonics: npt.NDArray[np.integer],
) -> FaultReport:
    """Look for acquisition faults in records.

    Parameters
    ----------
    record : Spectrum
    sample_rate_hz : float
    harmonics : (F,) int
        Excited lines.

    Notes
    -----
    What is looked for, per record: `CHECKS`. A channel skew needs a loop-back measurement
    (`skew.skew_from_loopback`); from an FRF it can only be suspected (`skew.suspected_skew`). A first period
    that has not settled, and a slow drift, are no faults of an FRF by local polynomials, which take both out.
    """
    batch = record.samples.ndim - 3
    samples, bins, by_period = (
        values.reshape(-1, *values.shape[batch:])
        for values in (record.samples, record.bins, record.by_period)
    )
    reports = []
    for index in range(len(samples)):
        faults: list[Fault] = []
        for row, name in ((1, "actuator"), (0, "sensor")):
            of = (index, row)
            channel = _Channel(
                name,
                samples[of],
                bins[of],
                by_period[of],
                sample_rate_hz,
                np.asarray(harmonics),
            )
            # of a channel that lacks samples nothing more can be detected
            checks = CHECKS if channel.complete else (missing_samples,)
            faults += filter(None, (check(channel) for check in checks))
        reports.append(faults)
    return worst_of(reports)


def worst_of(per_record: Iterable[list[Fault]]) -> FaultReport:
    """One report from the faults of each record: the worst of each kind and channel."""
    records = list(per_record)
    found: dict[tuple[FaultKind, str], list[Fault]] = defaultdict(list)
    for faults in records:
        for fault in faults:
            found[fault.kind, fault.channel].append(fault)
    merged = []
    for same in found.values():
        worst = max(same, key=lambda fault: (fault.spoils, fault.value))
        if len(records) > 1:
            text = f"{worst.text} (in {len(same)} of {len(records)} records)"
            worst = replace(worst, text=text)
        merged.append(worst)
    return FaultReport(tuple(merged))


@dataclass(frozen=True, eq=False)
class _Channel:
    """One channel of one record: samples (P, N), bins (K,), harmonics of each period (P, N // 2 + 1)."""

    name: str
    samples: FloatArray
    bins: ComplexArray
    by_period: ComplexArray
    sample_rate_hz: float
    harmonics: npt.NDArray[np.integer]

    @property
    def periods(self) -> int:
        return self.samples.shape[0]

    @property
    def complete(self) -> bool:
        """False where a sample is missing, which makes all bins NaN."""
        return bool(np.isfinite(self.bins[0]))

    @cached_property
    def rms(self) -> float:
        """About the mean [V]."""
        return float(np.std(self.samples))

    def fault(self, kind: FaultKind, value: float, spoils: bool, text: str) -> Fault:
        return Fault(kind, self.name, float(value), spoils, text)


def missing_samples(x: _Channel) -> Fault | None:
    """Samples that are not finite, or one value held over a whole cycle of the fastest line."""
    if not x.complete:
        bad = int(np.count_nonzero(~np.isfinite(x.samples)))
        text = f"{bad} samples of the {x.name} are missing (not finite)"
        return x.fault(FaultKind.MISSING_SAMPLES, bad, True, text)
    record = x.samples.ravel()
    cycle = max(8, -(-x.samples.shape[1] // int(np.max(x.harmonics))))
    some = record[:: cycle // 4]
    same = some[1:] == some[:-1]
    if not np.any(same[2:] & same[1:-1] & same[:-2]):
        return None  # of what is held for longer than a cycle, four of these are neighbours
    starts = np.concatenate([[0], np.flatnonzero(np.diff(record) != 0) + 1])
    lengths, value = np.diff(np.append(starts, record.size)), record[starts]
    # a clipped peak is held too, but that is saturation
    held = (lengths > cycle) & (value != record.max()) & (value != record.min())
    if record.max() == record.min():
        held = lengths > cycle
    if not np.any(held):
        return None
    total = int(lengths[held].sum())
    text = f"The {x.name} stands still for {total} samples: a gap filled with the last value"
    levels = np.unique(record).size
    if 1 < levels <= FEW_LEVELS:
        text += f", or a converter whose steps are too coarse for it ({levels} values in all)"
    return x.fault(FaultKind.MISSING_SAMPLES, total, True, text)


def saturation(x: _Channel) -> Fault | None:
    """Flat tops."""
    record = x.samples.ravel()
    count = sum(_clipped(sign * record, x.periods) for sign in (1, -1))
    if count == 0:
        return None
    text = f"The {x.name} is saturated: {count} samples on flat tops"
    return x.fault(FaultKind.SATURATION, count, True, text)


def offset(x: _Channel) -> Fault | None:
    """A mean that is large against the signal. It harms no line, but takes up range."""
    mean = float(np.mean(x.samples))
    if abs(mean) <= LARGE_OFFSET * x.rms:
        return None
    text = f"The {x.name} has an offset of {mean:.3g} V beside {x.rms:.3g} V rms"
    return x.fault(FaultKind.OFFSET, abs(mean), False, text)


def drift(x: _Channel) -> Fault | None:
    """Period means that wander by more than noise. In a single period drift looks like slow lines."""
    if x.periods < 2:
        return None
    means = x.samples.mean(axis=-1)
    spread = float(np.ptp(means))
    if spread <= LARGE_DRIFT * float(np.std(x.samples - means[:, None])) or spread <= _spread_of_noise(x):
        return None
    text = f"The mean of the {x.name} drifts by {spread:.3g} V over the record"
    return x.fault(FaultKind.DRIFT, spread, False, text)


def _spread_of_noise(x: _Channel) -> float:
    """What the means of periods of noise hardly differ by, from the bins between the lowest harmonics."""
    at = np.arange(x.periods + 1, min(10 * x.periods, x.bins.size - 1))
    at = at[at % x.periods != 0]
    if at.size == 0:
        return 0.0
    # of white noise a mean has as much power as the bins of one period; their median bears a tone
    variance = x.periods * np.median(np.abs(x.bins[at]) ** 2) / np.log(2)
    pairs = x.periods * (x.periods - 1) / 2
    return float(special.stdtrit(at.size, 1 - _FALSE_ALARM / (2 * pairs)) * np.sqrt(2 * variance))


def hum(x: _Channel) -> Fault | None:
    """Mains frequency and its harmonics, at bins that are not excited.

    A tone stands out of all bins beside it; the skirt of a mode that rings elsewhere does not, nor a mode that
    dies out within the record. Spoils the FRF only where an excited line lies within the bins that the local
    polynomial method draws on. Records shorter than ten periods of the mains are not tested. Hum that falls
    exactly on a harmonic of several periods cannot be seen: it looks like excitation or distortion.
    """
    lines = np.asarray(x.harmonics, np.int64).tobytes()
    at, hz, mains_hz, beside, near = _hum_places(x.sample_rate_hz, *x.samples.shape, lines)
    if not at.size:
        return None
    power = 2 * np.abs(x.bins[: int(beside.max()) + 1]) ** 2  # mean square per bin
    around = power[beside]  # (B, 16)
    level = np.maximum(_TONE * around[:, 6:].mean(axis=1), around.max(axis=1))
    stands = power[at] > np.maximum(level, ROUNDING * x.rms**2)
    found: list[float] = []
    for mains in MAINS_HZ:
        seen = np.unique(hz[stands & (mains_hz == mains)])
        # the fundamental may be hidden, a single high harmonic may be anything
        if seen.size > 1 or mains in seen:
            found += seen.tolist()
    if not found:
        return None
    of = np.isin(hz, found)
    rms = float(np.sqrt(power[np.unique(at[of])].sum()))
    names = ", ".join(f"{tone:g}" for tone in found)
    text = f"Mains hum in the {x.name} at {names} Hz, at least {rms:.2g} V rms"
    spoils = bool(near[of].any())
    if spoils and len(found) == 1:
        text += ", or a mode that rings on there"
    return x.fault(FaultKind.HUM, rms, spoils, text)


@lru_cache(maxsize=16)
def _hum_places(
    sample_rate_hz: float, periods: int, samples: int, harmonics: bytes
) -> tuple[np.ndarray, ...]:
    """Where hum shows: bins (B,), their tone and mains frequency [Hz], bins beside, whether a line is near.

    Beside (B, 16) are the nearest three on either side from two bins away on, and five from five bins away on.
    `harmonics` are bytes of int64. Bins of a single period are harmonics: those of odd and of even order, which
    hold distortion of their own, are compared apart.
    """
    resolution = sample_rate_hz / (periods * samples)
    count = periods * samples // 2 + 1
    usable = np.ones(count, bool)
    usable[np.frombuffer(harmonics, np.int64) * periods] = False
    excited = np.flatnonzero(~usable)
    usable[0] = False
    if periods > 1:
        usable[::periods] = False  # harmonics not excited may hold distortion
    rows = []
    # of shorter records the bins beside lie at the next harmonic, where the response is another one
    for mains in (hz for hz in MAINS_HZ if 10 * resolution <= hz):
        for hz in mains * np.arange(1, MAINS_HARMONICS + 1):
            centre = round(hz / resolution)
            near = bool(np.any(np.abs(excited - centre) <= 5))
            for at in np.arange(centre - 1, centre + 2):
                alike = np.arange(max(at - 30, 0), min(at + 31, count))
                alike = alike[usable[alike] & ((alike - at) % (2 if periods == 1 else 1) == 0)]
                off = alike - at
                beside = [*alike[off < -4][-5:], *alike[off > 4][:5]]
                close = [*alike[off < -1][-3:], *alike[off > 1][:3]]
                if 0 in off and len(beside) == 10:
                    rows.append((at, hz, mains, close + beside, near))
    return tuple(np.array(column) for column in (zip(*rows, strict=True) if rows else [()] * 5))


def lost_samples(x: _Channel) -> Fault | None:
    """Periods shifted against each other: samples were lost between or within them."""
    # the first period may hold a transient: with three others it is left out
    start = 1 if x.periods > 2 else 0
    if x.periods - start < 2:
        return None
    lines = x.by_period[start:, x.harmonics]
    cross = lines[1:] * lines[0].conj()
    magnitude = np.abs(cross)
    # all lines alike, so that the peak of the correlation is sharp
    cross = np.divide(cross, magnitude, out=np.zeros_like(cross), where=magnitude > 0)
    if np.all(2 * np.abs(cross.real.sum(axis=-1)) >= np.count_nonzero(cross, axis=-1)):
        return _few_lost(x)  # the correlation at no shift is at least half of what it can be at any
    spectra = np.zeros((cross.shape[0], x.by_period.shape[1]), complex)
    spectra[:, x.harmonics] = cross
    samples = x.samples.shape[1]
    correlation = scipy.fft.irfft(spectra, samples, axis=-1)
    shift = np.argmax(correlation, axis=-1)
    shift = np.where(shift > samples // 2, shift - samples, shift)
    unshifted = correlation[:, 0]
    # a shift that explains the data no better than none is chance, and so is one that noise makes
    clear = np.max(correlation, axis=-1) > 2 * np.abs(unshifted)
    shift = np.where(clear & _coherent(lines, shift, x.harmonics, samples), shift, 0)
    if not np.any(shift):
        return None
    worst = int(shift[np.argmax(np.abs(shift))])
    text = f"Periods of the {x.name} are shifted by {worst} samples: some were lost in between"
    text += ", or a mode rings through them" if x.name == "sensor" else ""
    return x.fault(FaultKind.LOST_SAMPLES, abs(worst), True, text)


def _few_lost(x: _Channel) -> Fault | None:
    """Samples lost at one place, less than half a cycle of the fastest line.

    What was sampled within one period before that place, and nothing else, differs from what follows one
    period later; it does not from what follows so many samples less.
    """
    start, samples = 0 if x.name == "actuator" else 1, x.samples.shape[1]
    record = x.samples[start:].ravel()
    if record.size < 3 * samples or samples < 64:
        return None
    edges = np.arange(0, record.size - samples, samples // 8)
    power = np.add.reduceat((record[samples:] - record[:-samples]) ** 2, edges)
    level = np.partition(power, power.size // 4)[power.size // 4]
    dof = x.harmonics.size / 4  # of an eighth of a period of noise in their band
    high = np.flatnonzero(power > level * max(3, special.fdtri(dof, dof, 1 - _FALSE_ALARM / power.size)))
    # of a sensor what differs from the start on decays, as a mode from rest
    if not 1 < high.size <= high[-1] - high[0] + 1 <= 9 or start > high[0]:
        return None
    # the first and the last may differ in part only
    inner = high[1:-1] if high.size > 2 else high
    at = np.arange(edges[inner[0]], np.append(edges, record.size - samples)[inner[-1] + 1])
    most = min(samples // (2 * int(x.harmonics[-1])) + 1, samples // 8)
    shifts = np.arange(-most, most + 1)
    rest = [np.sum((record[at + samples] - record[np.maximum(at + k, 0)]) ** 2) for k in shifts]
    lost = int(shifts[np.argmin(rest)])
    if lost == 0 or min(rest) > max(2 * level * at.size / (samples // 8), rest[most] / 100):
        return None
    place = edges[high[0]] + samples if high[0] else edges[high[-1]]
    seconds = (place + (start + 1 / 16) * samples) / x.sample_rate_hz
    text = f"The {x.name} shifts by {abs(lost)} samples at about {seconds:.3g} s: some were "
    text += ("lost" if lost > 0 else "doubled") + (", or it was disturbed" if start else "") + " there"
    return x.fault(FaultKind.LOST_SAMPLES, abs(lost), True, text)


def _coherent(
    lines: ComplexArray,
    shift: IntArray,
    harmonics: npt.NDArray[np.integer],
    samples: int,
) -> BoolArray:
    """(P - 1,) whether periods, shifted back, are more alike to the first than periods of noise.

    The coherence r^2 over F lines of noise exceeds c with the probability (1 - c)^(F - 1) at one shift, with
    at most N times that at any of N (Carter, Knapp, Nuttall, IEEE Trans. Audio Electroacoust. 21, 1973, 337),
    and P - 1 times that in any period.
    """
    level = np.sqrt(np.mean(np.abs(lines) ** 2, axis=0))  # (F,), of noise that is not white
    white = np.divide(lines, level, out=np.zeros_like(lines), where=level > 0)
    back = np.exp(2j * np.pi * shift[:, None] * harmonics / samples)
    power = np.sum(np.abs(white) ** 2, axis=-1)
    cross = np.abs(np.sum(white[1:] * back * white[0].conj(), axis=-1)) ** 2
    incoherent = 1 - cross / np.maximum(power[1:] * power[0], np.finfo(float).tiny)  # (P - 1,)
    chance = (_FALSE_ALARM / (samples * shift.size)) ** (1 / max(harmonics.size - 1, 1))
    return np.asarray(incoherent < chance)


def clocks(x: _Channel) -> Fault | None:
    """Periods of the actuator that shift by as much each, their phases in proportion to frequency."""
    if x.name != "actuator" or x.periods < 2 or x.harmonics.size < FEWEST_LINES:
        return None
    lines, h = x.by_period[:, x.harmonics], x.harmonics.astype(float)
    cross = lines[1:] * lines[:-1].conj()  # (P - 1, F)
    whole = cross.sum(axis=0)
    weight, phase = np.abs(whole), np.angle(whole)
    if not np.sum(weight) > 0:
        return None
    slope = np.sum(weight * h * phase) / np.sum(weight * h**2)
    rest = np.sum(weight * (phase - slope * h) ** 2) / np.sum(weight) * h.size / (h.size - 1)
    std = np.sqrt(rest * np.sum((weight * h) ** 2)) / np.sum(weight * h**2)
    turned = abs(slope) * h[-1] * (x.periods - 1)  # over the record, of the highest line
    least = max(6.0, -float(special.stdtrit(h.size - 1, _FALSE_ALARM / 2)))
    if turned < LEAST_TURN or np.abs(phase).max() > 1 or abs(slope) < least * std:
        return None
    # samples lost between two periods shift these alone
    each = np.sum(cross.imag * h, axis=-1) / np.sum(np.abs(cross) * h**2, axis=-1)  # (P - 1,)
    if np.any(np.abs(each - slope) > abs(slope) / 2 + 4 * std * np.sqrt(x.periods - 1)):
        return None
    ppm = abs(slope) / (2 * np.pi) * 1e6
    when = "early" if slope > 0 else "late"
    text = (
        f"Each period of the actuator comes {ppm:.3g} ppm of its length {when}: the generator's clock is not "
        "the converter's, or the period is no whole number of samples"
    )
    if x.periods <= 3:  # so few are shifted as evenly by samples lost within the second
        text += ", or samples were lost"
    return x.fault(FaultKind.CLOCKS, ppm, bool(turned > SPOILING_TURN), text)


CHECKS = (missing_samples, saturation, offset, drift, hum, lost_samples, clocks)
"""What is looked for in each channel."""


def _clipped(record: FloatArray, periods: int) -> int:
    """How many samples stand at the largest value, if suspiciously many, else 0.

    Without clipping the values thin out towards the largest; of a quantised sine at most 2.4 times
    as many stand at the largest value as at the next. A few more may by chance (binomial test).
    """
    largest = record.max()
    top = int(np.count_nonzero(record == largest))
    if top < FEWEST_ON_TOP or top == record.size:
        return 0
    second = np.max(record, where=record < largest, initial=-np.inf)
    following = np.count_nonzero(record == second)
    some = record[:GRID_SAMPLES]
    some = some[(some < largest) & (some > record.min())]
    if np.unique(some).size > FEW_ALIKE * some.size:
        # not quantised: equal values are no chance, unless a period without noise is repeated
        spans = record.reshape(periods, -1)
        repeated = periods if np.array_equal(spans[1:], spans[:-1]) else 1
        return top if top >= FEWEST_ON_TOP * repeated else 0
    # probability of so many or more out of both; periods repeat each other, one counts
    one, next_one = top // periods, -(-following // periods)
    chance = special.bdtrc(one - 1, one + next_one, SHARE_AT_TOP) if one else 1.0
    return top if chance < _FALSE_ALARM else 0
