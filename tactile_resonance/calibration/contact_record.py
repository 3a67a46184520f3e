# SPDX-License-Identifier: Apache-2.0
"""What of a record the calibrated estimator reads: bins of a band, and all lines that were excited."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.frf.band_bins import BandBins
from tactile_resonance.frf.spectra import Spectrum


class Start(str, Enum):
    """State of the sensor at the first sample of a record."""

    REST = "rest"
    UNKNOWN = "unknown"


@dataclass(frozen=True, eq=False)
class ContactRecord:
    """Bins of a band of one record, and all lines that were excited.

    Attributes
    ----------
    frequency_hz : (K,) float
    y : (K,) complex
        Sensor [V], scaled by one over the samples.
    line_hz : (F,) float
    u : (F,) complex
        Actuator [V] at the lines.
    samples : int
    sample_rate_hz : float
    start : Start
    """

    frequency_hz: FloatArray
    y: ComplexArray
    line_hz: FloatArray
    u: ComplexArray
    samples: int
    sample_rate_hz: float
    start: Start = Start.REST

    @classmethod
    def of_bins(cls, bins: BandBins, start: Start = Start.REST) -> ContactRecord:
        """Of the bins of one realisation that hold all lines that were excited."""
        require(bins.u.shape[0] == 1, "bins", bins.u.shape, "one realisation")
        resolution, index = bins.resolution_hz, bins.harmonics * bins.periods
        return cls(
            np.asarray((bins.first_bin + np.arange(bins.count)) * resolution, float),
            bins.y[0],
            np.asarray(index * resolution, float),
            bins.u[0, index - bins.first_bin],
            bins.samples_per_period * bins.periods,
            bins.sample_rate_hz,
            start,
        )

    @classmethod
    def of_samples(
        cls,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        *,
        sample_rate_hz: float,
        harmonics: npt.ArrayLike,
        band_hz: tuple[float, float],
        start: Start = Start.REST,
    ) -> ContactRecord:
        """Of whole periods (P, N) of actuator and sensor [V]."""
        record = Spectrum.of(u, y)
        samples = record.periods * record.samples_per_period
        resolution = sample_rate_hz / samples
        index = np.asarray(harmonics) * record.periods
        low, high = band_hz
        first, last = np.ceil(low / resolution - 1e-9), np.floor(high / resolution + 1e-9)
        inside = np.arange(max(1, int(first)), min(samples // 2 - 1, int(last)) + 1)
        return cls(
            np.asarray(inside * resolution, float),
            record.bins[0, inside],
            index * resolution,
            record.bins[1, index],
            samples,
            sample_rate_hz,
            start,
        )

    @property
    def excited(self) -> BoolArray:
        """(K,) bins that are lines."""
        return np.isin(
            np.rint(self.frequency_hz * self.duration_s), np.rint(self.line_hz * self.duration_s)
        )

    @property
    def duration_s(self) -> float:
        """Of the record."""
        return self.samples / self.sample_rate_hz
