# SPDX-License-Identifier: Apache-2.0
"""Responses from which a sensor is calibrated."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.frf.estimate import frf_of_record
from tactile_resonance.frf.excited import find_excited_harmonics
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.frf.spectra import Spectrum

SMOOTH_LINES = 41
"""Over which the variance of the noise is averaged."""


class Load(str, Enum):
    """What the tip touches while it is recorded, or that there is no sensor."""

    AIR = "air"
    MASS = "mass"
    SPRING = "spring"
    LOOPBACK = "loopback"


@dataclass(frozen=True, eq=False)
class CalibrationRecord:
    """Response of one record.

    Attributes
    ----------
    frf : FRF
        In the steady state, with a variance.
    load : Load
    value, value_std : float
        Of a mass [kg] or spring [N/m].
    noise_v_per_root_hz : float
        Of the sensor channel, one-sided; NaN where unknown.
    name : str
        For people.
    """

    frf: FRF
    load: Load
    value: float = 0.0
    value_std: float = 0.0
    noise_v_per_root_hz: float = float("nan")
    name: str = ""

    @classmethod
    def of_samples(
        cls,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        *,
        sample_rate_hz: float,
        harmonics: npt.ArrayLike | None = None,
        load: Load,
        value: float = 0.0,
        value_std: float = 0.0,
        name: str = "",
    ) -> CalibrationRecord:
        """Of actuator and sensor (P, N) or (M, P, N) [V] in the steady state.

        Of three periods or more the first is left out.

        Raises
        ------
        ValueError
            If one period is all there is.
        """
        sensed = np.array(y, float, ndmin=3)
        record = Spectrum.of(np.array(u, float, ndmin=3), sensed)
        if harmonics is None:
            harmonics = find_excited_harmonics(record)
        frf = frf_of_record(record, harmonics, sample_rate_hz=sample_rate_hz, method="average")
        settled = sensed[..., 1 if sensed.shape[-2] > 2 else 0 :, :]
        accepted = "two periods or more: one alone has no covariance"
        require(settled.shape[-2] > 1, f"{name or load.value} periods", 1, accepted)
        of_samples = settled.var(axis=-2, ddof=1).mean()
        noise = float(np.sqrt(2 * of_samples / sample_rate_hz))
        return cls(frf, load, value, value_std, noise, name)

    def __post_init__(self) -> None:
        if self.load in (Load.MASS, Load.SPRING):
            require(0 < self.value < np.inf, f"{self.load.value}", self.value, "above 0")
            good = 0 <= self.value_std < self.value
            require(good, f"{self.load.value} std", self.value_std, "0 or above, below the value")
        frf = self.frf
        good = frf.status is not FrfStatus.FAILED and frf.variance is not None and frf.g.ndim == 1
        require(good, f"{self.name or self.load.value}", frf.status.value, "an FRF with a variance")

    @property
    def s_rad_s(self) -> ComplexArray:
        """(F,) lines on the imaginary axis."""
        return np.asarray(2j * np.pi * self.frf.frequency_hz, complex)

    def stiffness(self, s: ComplexArray) -> ComplexArray:
        """(F,) stiffness at the tip for a value of 1."""
        return (
            s**2 if self.load is Load.MASS else np.full(s.shape, self.load is Load.SPRING, complex)
        )

    @property
    def variance(self) -> FloatArray:
        """(F,) of the response, that of the sensor's spectrum averaged over neighbouring lines [V^2/V^2]."""
        assert self.frf.variance is not None  # see __post_init__
        amplitude = self.frf.actuator_amplitude
        power = np.ones(self.frf.frequency_hz.size) if amplitude is None else amplitude**2
        size = min(SMOOTH_LINES, power.size)
        return np.asarray(ndimage.uniform_filter1d(self.frf.variance * power, size) / power)
