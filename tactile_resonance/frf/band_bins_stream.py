# SPDX-License-Identifier: Apache-2.0
"""All bins of a band while a record grows, each period transformed once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.band_bins import BandBins
from tactile_resonance.frf.band_spectrum import BandSpectrum
from tactile_resonance.frf.spectra import IntArray, checked_harmonics

MOST_BINS = 20000
"""More than this of one band and record are refused: they travel with every result."""


class BandBinsStream:
    """Bins of a band after each period.

    Parameters
    ----------
    harmonics : (F,) int
        All excited lines.
    samples_per_period : int
    sample_rate_hz : float
    band_hz : (low, high)
    max_periods : int

    Raises
    ------
    ValueError
        If the band is not 0 <= low < high, or holds more than `MOST_BINS` bins after the last period.
    """

    def __init__(
        self,
        harmonics: npt.ArrayLike,
        samples_per_period: int,
        *,
        sample_rate_hz: float,
        band_hz: tuple[float, float],
        max_periods: int,
    ) -> None:
        low_hz, high_hz = band_hz
        if not 0 <= low_hz < high_hz:
            raise ValueError(f"bins: band {low_hz:g} to {high_hz:g} Hz, expected 0 <= low < high")
        line_hz = sample_rate_hz / samples_per_period
        lines = checked_harmonics(harmonics, samples_per_period)
        low, high = low_hz / line_hz, min(high_hz / line_hz, (samples_per_period - 1) // 2)
        count = (high - low) * max_periods
        if count > MOST_BINS:
            raise ValueError(
                f"bins: {low_hz:g} to {high_hz:g} Hz are {count:.0f} bins after {max_periods} "
                f"periods, at most {MOST_BINS} are accepted: choose a narrower band"
            )
        self._low, self._high = low, high
        self.harmonics: IntArray = lines[(lines >= low - 1e-9) & (lines <= high + 1e-9)]
        self._sample_rate_hz, self._samples_per_period = sample_rate_hz, samples_per_period
        # whole harmonics around the band: bins are computed for all fractions between them
        self._lines = np.arange(int(np.floor(low + 1e-9)), int(np.floor(high + 1e-9)) + 1)
        self._spectrum = BandSpectrum(samples_per_period, self._lines[0], self._lines[-1] + 1)

    def add_period(self, u: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> None:
        """The next period, (N,) samples of either channel, without a gap to the one before."""
        self._spectrum.add(np.stack([u, y]))

    def clear(self) -> None:
        """Forget all periods: another record begins."""
        self._spectrum.clear()

    def bins(self) -> BandBins | None:
        """Of the periods so far; None where the band holds no excited line, or without periods."""
        periods = self._spectrum.periods
        if periods == 0 or self.harmonics.size == 0:
            return None
        offsets, centres = np.arange(periods), self._lines * periods
        values = self._spectrum.at(offsets, centres)  # (P, 2, L)
        values = values.transpose(1, 2, 0).reshape(2, -1)  # (2, L P), ascending
        every = centres[0] + np.arange(values.shape[1])
        first = max(1, int(np.ceil(self._low * periods - 1e-9)))
        last = int(np.floor(self._high * periods + 1e-9))
        u, y = values[:, (every >= first) & (every <= last)] / (self._samples_per_period * periods)
        return BandBins(
            first,
            u[None],
            y[None],
            self.harmonics,
            self._sample_rate_hz,
            self._samples_per_period,
            periods,
        )
