# SPDX-License-Identifier: Apache-2.0
"""All bins of a band of the Fourier transforms of whole records, excited or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]


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


def stacked_bins(realisations: Sequence[BandBins]) -> BandBins | None:
    """Of several realisations; None where they differ in lines or periods."""
    first = realisations[0]
    for other in realisations[1:]:
        alike = (
            other.periods == first.periods
            and other.samples_per_period == first.samples_per_period
            and other.sample_rate_hz == first.sample_rate_hz
            and other.first_bin == first.first_bin
            and other.count == first.count
            and np.array_equal(other.harmonics, first.harmonics)
        )
        if not alike:
            return None
    return replace(
        first,
        u=np.concatenate([each.u for each in realisations]),
        y=np.concatenate([each.y for each in realisations]),
    )
