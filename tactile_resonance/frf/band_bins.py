# SPDX-License-Identifier: Apache-2.0
"""All bins of a band of the Fourier transforms of whole records, excited or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance._typing import ComplexArray, IntArray

if TYPE_CHECKING:
    from tactile_resonance.frf.spectra import Spectrum


@dataclass(frozen=True, eq=False)
class BandBins:
    """Bins of records of whole periods, one a realisation, scaled by one over their number of samples.

    Attributes
    ----------
    first_bin : int
        Bin k lies at ``k sample_rate_hz / (samples_per_period periods)``.
    u, y : (M, K) complex
        Actuator and sensor [V] of M realisations at bins ``first_bin`` to ``first_bin + K - 1``.
    harmonics : (F,) int
        Excited multiples of ``sample_rate_hz / samples_per_period`` among them.
    sample_rate_hz : float
    samples_per_period, periods : int
        Of each realisation.
    """

    first_bin: int
    u: ComplexArray
    y: ComplexArray
    harmonics: IntArray
    sample_rate_hz: float
    samples_per_period: int
    periods: int

    def __post_init__(self) -> None:
        if self.u.shape != self.y.shape or self.u.ndim != 2 or self.u.size == 0:
            raise ValueError(f"u, y: shapes {self.u.shape}, {self.y.shape}, expected (M, K) both")
        if self.first_bin < 0:
            raise ValueError(f"first_bin: {self.first_bin}, expected 0 or above")
        for name in ("sample_rate_hz", "samples_per_period", "periods"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)}, expected above 0")
        last = self.first_bin + self.count - 1
        if 2 * last > self.samples_per_period * self.periods:
            raise ValueError(
                f"u, y: bins to {last}, half of {self.samples_per_period * self.periods} samples "
                "are the most"
            )

    @property
    def count(self) -> int:
        """Bins K."""
        return self.u.shape[1]

    @property
    def resolution_hz(self) -> float:
        """Distance of neighbouring bins."""
        return self.sample_rate_hz / (self.samples_per_period * self.periods)

    @property
    def band_hz(self) -> tuple[float, float]:
        """First and last bin."""
        first = self.first_bin
        return first * self.resolution_hz, (first + self.count - 1) * self.resolution_hz


def stacked_bins(realisations: Sequence[BandBins]) -> BandBins:
    """Of several realisations of as many periods and bins."""
    return replace(
        realisations[0],
        u=np.concatenate([bins.u for bins in realisations]),
        y=np.concatenate([bins.y for bins in realisations]),
    )


def band_bins(
    record: Spectrum,
    harmonics: IntArray,
    *,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
) -> BandBins | None:
    """Of a record of M realisations; None where the band holds no excited line.

    Parameters
    ----------
    record : Spectrum
        Of samples (2, P, N) or (M, 2, P, N).
    harmonics : (F,) int
        All excited lines.
    sample_rate_hz : float
    band_hz : (low, high)
        Of it the bins above zero and below half the sample rate.

    Raises
    ------
    ValueError
        If the band is not 0 <= low < high.
    """
    low_hz, high_hz = band_hz
    if not 0 <= low_hz < high_hz:
        raise ValueError(f"bins: band {low_hz:g} to {high_hz:g} Hz, expected 0 <= low < high")
    periods, samples = record.periods, record.samples_per_period
    low, high = (hz * samples / sample_rate_hz for hz in band_hz)
    lines = harmonics[(harmonics >= low - 1e-9) & (harmonics <= high + 1e-9)]
    if lines.size == 0:
        return None
    first = max(1, int(np.ceil(low * periods - 1e-9)))
    last = min((periods * samples - 1) // 2, int(np.floor(high * periods + 1e-9)))
    # copies: the whole spectrum need not be kept for them
    bins = record.bins[..., first : last + 1].reshape(-1, 2, last + 1 - first)
    return BandBins(
        first, bins[:, 1].copy(), bins[:, 0].copy(), lines, sample_rate_hz, samples, periods
    )
