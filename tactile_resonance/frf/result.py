# SPDX-License-Identifier: Apache-2.0
"""What an estimate of the frequency response function holds."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.band_bins import BandBins

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


class FrfStatus(Enum):
    """Whether an FRF can be relied on."""

    OK = "ok"
    NO_COVARIANCE = "no covariance"
    SUSPECT = "suspect"
    FAILED = "failed"


@dataclass(frozen=True)
class FRF:
    """Frequency response ``G = U_sensor / U_actuator`` at lines, with ``exp(+j omega t)``.

    A delay therefore has negative phase.

    Attributes
    ----------
    frequency_hz : (F,) float
        Lines, ascending, not necessarily uniform.
    g : (..., F) complex
        Response [V/V].
    variance_noise : (..., F) float or None
        ``E|dG|^2`` of the estimate from noise alone.
    variance_total : (..., F) float or None
        From noise and stochastic nonlinear distortion; needs two realisations.
    noise_dof, total_dof : int
        Degrees of freedom of either; 0 where unknown.
    spectra : (..., 2, F) complex or None
        Mean sensor and actuator spectra, row order [Y; U] [V], scaled by 1/N.
    spectra_covariance : (..., 2, 2, F) complex or None
        Noise covariance of these means [V^2].
    bins : BandBins or None
        All bins of a band of the records behind G, where asked for: of as many realisations.
    periods, realisations : int
        How many were used.
    method : str
    status : FrfStatus
    message : str
        A sentence for people; empty where there is nothing to say.
    """

    frequency_hz: FloatArray
    g: ComplexArray
    variance_noise: FloatArray | None = None
    variance_total: FloatArray | None = None
    noise_dof: int = 0
    total_dof: int = 0
    spectra: ComplexArray | None = None
    spectra_covariance: ComplexArray | None = None
    bins: BandBins | None = None
    periods: int = 1
    realisations: int = 1
    method: str = ""
    status: FrfStatus = FrfStatus.OK
    message: str = ""

    @property
    def variance(self) -> FloatArray | None:
        """(..., F) the largest known: total where it can be told, else noise, else None."""
        return self.variance_noise if self.variance_total is None else self.variance_total

    @property
    def dof(self) -> int:
        """Degrees of freedom of `variance`."""
        return self.noise_dof if self.variance_total is None else self.total_dof

    def band(self, low_hz: float, high_hz: float) -> FRF:
        """The lines from `low_hz` to `high_hz`, ends included."""
        inside = (self.frequency_hz >= low_hz) & (self.frequency_hz <= high_hz)

        def cut(array):
            return None if array is None else array[..., inside]

        return FRF(
            frequency_hz=self.frequency_hz[inside],
            g=self.g[..., inside],
            variance_noise=cut(self.variance_noise),
            variance_total=cut(self.variance_total),
            noise_dof=self.noise_dof,
            total_dof=self.total_dof,
            spectra=cut(self.spectra),
            spectra_covariance=cut(self.spectra_covariance),
            bins=self.bins,
            periods=self.periods,
            realisations=self.realisations,
            method=self.method,
            status=self.status,
            message=self.message,
        )
