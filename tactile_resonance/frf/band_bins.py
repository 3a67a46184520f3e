# SPDX-License-Identifier: Apache-2.0
"""All bins of a band of the Fourier transform of a whole record, excited or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class BandBins:
    """Bins of a record of whole periods, scaled by one over its number of samples.

    Attributes
    ----------
    first_bin : int
        Bin k lies at ``k sample_rate_hz / (samples_per_period periods)``.
    u, y : (K,) complex
        Actuator and sensor [V] at bins ``first_bin`` to ``first_bin + K - 1``.
    harmonics : (F,) int
        Excited multiples of ``sample_rate_hz / samples_per_period`` among them.
    sample_rate_hz : float
    samples_per_period, periods : int
    """

    first_bin: int
    u: ComplexArray
    y: ComplexArray
    harmonics: IntArray
    sample_rate_hz: float
    samples_per_period: int
    periods: int

    def __post_init__(self) -> None:
        if self.u.shape != self.y.shape or self.u.ndim != 1 or self.u.size == 0:
            raise ValueError(f"u, y: shapes {self.u.shape}, {self.y.shape}, expected (K,) both")
        if self.first_bin < 0:
            raise ValueError(f"first_bin: {self.first_bin}, expected 0 or above")
        for name in ("sample_rate_hz", "samples_per_period", "periods"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)}, expected above 0")
        last = self.first_bin + self.u.size - 1
        if 2 * last > self.samples_per_period * self.periods:
            raise ValueError(
                f"u, y: bins to {last}, half of {self.samples_per_period * self.periods} samples "
                "are the most"
            )

    @property
    def resolution_hz(self) -> float:
        """Distance of neighbouring bins."""
        return self.sample_rate_hz / (self.samples_per_period * self.periods)

    @property
    def band_hz(self) -> tuple[float, float]:
        """First and last bin."""
        first = self.first_bin
        return first * self.resolution_hz, (first + self.u.size - 1) * self.resolution_hz
