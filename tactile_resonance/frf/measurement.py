# SPDX-License-Identifier: Apache-2.0
"""The FRF of one measurement, while its records come in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.contact.force_spread import joined_spread
from tactile_resonance.frf.distortion import DETECTING, distortion_in_band, spectra_between
from tactile_resonance.frf.estimate import frf_of_realisations
from tactile_resonance.frf.faults import FaultReport, find_faults, worst_of
from tactile_resonance.frf.result import FRF, BandBins, FrfStatus, band_bins, stacked_bins
from tactile_resonance.frf.skew import correct_skew
from tactile_resonance.frf.spectra import PeriodicSpectra, Spectrum, mean_spectra, stacked_spectra
from tactile_resonance.multisine import Excitation
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.record import Contact, Origin, Record

LEAST_COVERAGE = 0.8
"""Of the time of a measurement its force must be known."""

MOST_BINS = 20000
"""More than this of one band and record are refused: they travel with every result."""


class MeasurementFrf:
    """Takes in the records of one measurement; after each, the FRF so far.

    The record of the realisation so far is kept, and transformed again with every block from which on it is as
    long as the ones before: what comes of it is what the whole record at once gives.

    Parameters
    ----------
    measurement_id : int
    band_hz : (low, high), optional
        Only lines in this band are computed; all excited lines without.
    order, dof : int
        Of the local polynomial method.
    bins_band_hz : (low, high), optional
        All bins of this band go with the FRF, as long as those of all realisations are no more than
        `MOST_BINS`; where an excitation names bands, theirs instead.
    """

    def __init__(
        self,
        measurement_id: int,
        *,
        band_hz: tuple[float, float] | None = None,
        order: int = 2,
        dof: int = 6,
        bins_band_hz: tuple[float, float] | None = None,
    ) -> None:
        self.measurement_id = measurement_id
        self._band_hz, self._order, self._dof = band_hz, order, dof
        self._bins_bands_hz: tuple[tuple[float, float], ...] = ()
        if bins_band_hz is not None:
            self._bins_bands_hz = (bins_band_hz,)
        self._bands: tuple[PoleBand, ...] = ()
        self._played: Excitation | None = None  # the first: all realisations excite the same lines
        self._lines: IntArray = np.empty(0, np.int64)
        self._lines_of_bands: list[IntArray] = []  # where others between them show distortion
        self._samples: FloatArray = np.empty((2, 0, 0))  # (2, room, N), rows [y; u]
        self._periods: dict[int, int] = {}
        # of each realisation that counts; bins and lines that show distortion in each band
        self._parts: dict[int, tuple[PeriodicSpectra, list[BandBins], list[PeriodicSpectra]]] = {}
        self._frf = FRF(np.empty(0), np.empty(0, complex), status=FrfStatus.FAILED)
        self._notes: list[str] = []
        self._faults = FaultReport()  # the worst of each kind that a single block shows
        self._first: Record | None = None
        self._last: Record | None = None
        self._contacts: list[tuple[Contact, float]] = []  # of each block, with its length [s]
        self.saturated = False

    def add(self, record: Record, excitation: Excitation) -> FRF:
        """FRF with the next record, played as `excitation`.

        A gap in the block indices is noted; what follows it in that realisation is not used, because
        the periods would no longer be consecutive. A block that comes twice is used once. A realisation
        under way counts once it has as many periods as the ones before; one that ends with fewer is left
        out, which is noted.

        Raises
        ------
        ValueError
            If the record does not fit the excitation, or this the first one, the band holds no line of it, or
            too many bins would go with the FRF.
        """
        n = excitation.samples_per_period
        u, y = record.actuator.volts(), record.sensor.volts()
        if u.shape != y.shape or u.size == 0 or u.size % n or record.samples_per_period != n:
            raise ValueError(
                f"record: {u.size} and {y.size} samples, expected whole periods of {n} on both "
                "channels"
            )
        if record.block_index * (u.size // n) < self._periods.get(record.realisation, 0):
            return self.frf()  # it came twice
        if excitation.level_v == 0:
            self._remember(record)
            self._note("nothing was played")
            return self.frf()
        if self._played is None:
            self._bands = excitation.bands
            if self._bands:
                self._bins_bands_hz = tuple(band.ends_hz for band in self._bands)
            self._lines = self._lines_of(excitation)
            self._lines_of_bands = [
                _lines_in(excitation, band.ends_hz, "bands")
                for band in (self._bands if excitation.grid in DETECTING else ())
            ]
            self._samples = np.empty((2, excitation.periods, n))
            self._played = excitation
        played = self._played
        alike = (excitation.sample_rate_hz, n) == (played.sample_rate_hz, played.samples_per_period)
        if not alike or not np.array_equal(excitation.harmonics, played.harmonics):
            raise ValueError(
                f"realisation: {record.realisation + 1} was played at another rate, with another period or on "
                "other lines than the first record, expected the same"
            )
        self._remember(record)
        block = Spectrum.of(u.reshape(-1, n), y.reshape(-1, n))
        rate_hz, harmonics = excitation.sample_rate_hz, excitation.harmonics
        found = find_faults(block, sample_rate_hz=rate_hz, harmonics=harmonics)
        self._faults = worst_of([[*self._faults.faults, *found.faults]])
        so_far = self._periods.setdefault(record.realisation, 0)
        if record.block_index * (u.size // n) != so_far:
            self._note(
                f"realisation {record.realisation + 1}: blocks lost before block {record.block_index + 1}, "
                "not used from there on"
            )
        else:
            self._take(block, record.realisation, played)
        return self.frf()

    def frf(self) -> FRF:
        """The FRF so far; status FAILED where no period could be used.

        A delay of the sensor channel that the record states is taken out; bins, which hold the
        transient too, then do not come along.
        """
        frf = replace(self._frf, bands=self._bands)
        delay_s = float("nan") if self._last is None else self._last.channel_delay_s
        if frf.g.size and np.isfinite(delay_s) and delay_s != 0:
            frf = correct_skew(replace(frf, bins=None, further_bins=()), delay_s)
        frf = self._faults.marked(frf)
        return frf.suspected("; ".join(self._notes)) if self._notes else frf

    def origin(self) -> Origin:
        """Where the FRF comes from: middle of the acquisition, last pose, force over all blocks.

        Raises
        ------
        ValueError
            Before the first record.
        """
        if self._first is None or self._last is None:
            raise ValueError("records: none so far, expected at least 1")
        last = self._last.origin
        end_ns = last.time_ns + round(self._last.duration_s * 1e9)
        force_n, force_std_n = mean_force(
            [(of.force_n, of.force_std_n, seconds) for of, seconds in self._contacts]
        )
        spread = joined_spread([(of.force_n, of.spread, seconds) for of, seconds in self._contacts])
        return replace(
            last,
            time_ns=(self._first.origin.time_ns + end_ns) // 2,
            contact=replace(last.contact, force_n=force_n, force_std_n=force_std_n, spread=spread),
        )

    def _lines_of(self, excitation: Excitation) -> IntArray:
        """Excited harmonics in the band."""
        line_hz = excitation.sample_rate_hz / excitation.samples_per_period
        for low_hz, high_hz in self._bins_bands_hz:
            top_hz = min(high_hz, excitation.sample_rate_hz / 2)
            count = (top_hz - low_hz) / line_hz * excitation.periods
            if count > MOST_BINS:
                raise ValueError(
                    f"bins: {low_hz:g} to {high_hz:g} Hz are {count:.0f} bins after "
                    f"{excitation.periods} periods, at most {MOST_BINS} are accepted: choose a "
                    "narrower band"
                )
        if self._band_hz is None:
            return excitation.harmonics
        return _lines_in(excitation, self._band_hz, "band_hz")

    def _take(self, record: Spectrum, realisation: int, excitation: Excitation) -> None:
        """Periods (P, N) that follow those of the same realisation without a gap."""
        if not np.all(np.isfinite(record.bins[..., 0])):
            raise ValueError("record: samples are not finite, expected a complete block")
        so_far = self._periods[realisation]
        periods = so_far + record.periods
        if periods > self._samples.shape[1]:
            raise ValueError(
                f"record: {periods} periods of realisation {realisation + 1}, at most "
                f"{self._samples.shape[1]} are accepted, those of the excitation"
            )
        self._samples[:, so_far:periods] = record.samples
        self._periods[realisation] = periods
        if periods < max(self._periods.values()):
            return  # it counts once it is as long as the others
        if so_far:
            record = Spectrum(self._samples[:, :periods])
        spectra = mean_spectra(record, self._lines, order=self._order, dof=self._dof)
        rate_hz, harmonics = excitation.sample_rate_hz, excitation.harmonics
        found = [
            band_bins(record, harmonics, sample_rate_hz=rate_hz, band_hz=band_hz)
            for band_hz in self._bins_bands_hz
        ]
        bins = [of for of in found if of is not None]
        if len(bins) < len(found):
            bins = []
        # the first period is left out: what a polynomial leaves of the transient hides distortion
        detection = [
            spectra_between(record, lines, harmonics) for lines in self._lines_of_bands
        ]
        self._parts[realisation] = spectra, bins, detection
        # with one that lost blocks all others would count as equally short
        for number, count in self._periods.items():
            if 0 < count < periods:
                self._note(f"realisation {number + 1}: left out, shorter than the others")
        whole = [part for part in self._parts.values() if part[0].periods == periods]
        each, bins_of_each, detection_of_each = zip(*whole, strict=True)
        frf = frf_of_realisations(stacked_spectra(each), sample_rate_hz=rate_hz)
        stacked = tuple(stacked_bins(of) for of in zip(*bins_of_each, strict=True))
        if any(of.u.size > MOST_BINS for of in stacked):
            stacked = ()
        of_bands = zip(*detection_of_each, strict=True)
        in_bands = zip(self._bands, self._lines_of_bands, of_bands, strict=False)
        self._frf = replace(
            frf,
            bins=stacked[0] if stacked else None,
            further_bins=stacked[1:],
            distortion=tuple(
                distortion_in_band(stacked_spectra(of), lines, band.ends_hz, sample_rate_hz=rate_hz)
                for band, lines, of in in_bands
            ),
        )

    def _remember(self, record: Record) -> None:
        if self._first is None:
            self._first = record
        self._last = record
        self._contacts.append((record.origin.contact, record.duration_s))
        for channel, name in ((record.actuator, "actuator"), (record.sensor, "sensor")):
            if channel.saturated:
                self.saturated = True
                self._note(f"{name} saturated")

    def _note(self, text: str) -> None:
        if text not in self._notes:
            self._notes.append(text)


def _lines_in(excitation: Excitation, band_hz: tuple[float, float], field: str) -> IntArray:
    """Excited harmonics in a band."""
    f, (low_hz, high_hz) = excitation.frequency_hz, band_hz
    lines = excitation.harmonics[(f >= low_hz) & (f <= high_hz)]
    if lines.size == 0:
        raise ValueError(
            f"{field}: {low_hz:g}..{high_hz:g} holds no excited line, they reach "
            f"from {f[0]:g} to {f[-1]:g} Hz"
        )
    return lines


def mean_force(blocks: Sequence[tuple[float, float, float]]) -> tuple[float, float]:
    """Mean force over blocks and its standard deviation [N].

    Parameters
    ----------
    blocks : sequence of (mean [N], its standard deviation [N], length [s])
        NaN where unknown.

    Returns
    -------
    force_n, force_std_n : float
        NaN where the force of more than a fifth of the time is unknown, or one of the deviations. The blocks
        of a contact share the error of its zero, so their errors count as one and the same: the deviation
        is an upper bound.
    """
    known = [block for block in blocks if math.isfinite(block[0])]
    length_s = sum(block[2] for block in known)
    if not known or length_s < LEAST_COVERAGE * sum(block[2] for block in blocks):
        return math.nan, math.nan
    mean_n = sum(force * seconds for force, _, seconds in known) / length_s
    std_n = sum(std * seconds for _, std, seconds in known) / length_s
    return mean_n, std_n
