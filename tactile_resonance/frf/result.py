# SPDX-License-Identifier: Apache-2.0
"""What an estimate of the frequency response function holds; all bins of a band of the records behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.structure import PoleBand

if TYPE_CHECKING:
    from tactile_resonance.frf.spectra import Spectrum

PER_LINE = (
    *("frequency_hz", "g", "variance_noise", "variance_total"),
    *("actuator_amplitude", "sensor_variance_given_actuator"),
)
"""Fields of an `FRF` whose last axis are its lines."""


@dataclass(frozen=True)
class BandDistortion:
    """Nonlinear distortion in one band; ``msg/Distortion.msg`` gives unit and meaning of each field.

    Levels are those of `distortion.DetectionLines`: `even_db` its ``rms_level_db``, `input_even_db` its
    ``rms_input_level_db``, `even_noise_db` its ``rms_noise_level_db``.
    """

    low_hz: float
    high_hz: float
    even_db: float = float("nan")
    odd_db: float = float("nan")
    even_noise_db: float = float("nan")
    odd_noise_db: float = float("nan")
    even_above_noise: bool = False
    odd_above_noise: bool = False
    input_even_db: float = float("nan")
    input_odd_db: float = float("nan")


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


class FrfStatus(Enum):
    """Whether an FRF can be relied on."""

    OK = "ok"
    NO_COVARIANCE = "no covariance"
    SUSPECT = "suspect"
    MODEL_ERROR = "model error"
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
    actuator_amplitude : (..., F) float or None
        Magnitude of the mean spectrum U, scaled by 1/N: a cosine of peak a gives a/2 [V]. Of one
        realisation.
    sensor_variance_given_actuator : (..., F) float or None
        Noise variance of the mean spectrum Y that is not noise of U, which the generator makes:
        ``C_YY - |C_YU|^2 / C_UU`` [V^2]. Of several realisations that of the mean of all.
    bins : BandBins or None
        All bins of a band of the records behind G, where asked for: of as many realisations.
    further_bins : tuple of BandBins
        Of several bands, those of the second and so on.
    bands : tuple of PoleBand
        In which poles are wanted, as the excitation says; empty: it does not.
    distortion : tuple of BandDistortion
        In each band, where the excitation leaves lines out that show it.
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
    actuator_amplitude: FloatArray | None = None
    sensor_variance_given_actuator: FloatArray | None = None
    bins: BandBins | None = None
    further_bins: tuple[BandBins, ...] = ()
    bands: tuple[PoleBand, ...] = ()
    distortion: tuple[BandDistortion, ...] = ()
    periods: int = 1
    realisations: int = 1
    method: str = ""
    status: FrfStatus = FrfStatus.OK
    message: str = ""

    @property
    def variance(self) -> FloatArray | None:
        """(..., F) the largest known: total where it can be estimated, else noise, else None."""
        return self.variance_noise if self.variance_total is None else self.variance_total

    @property
    def dof(self) -> int:
        """Degrees of freedom of `variance`."""
        return self.noise_dof if self.variance_total is None else self.total_dof

    @property
    def variance_distortion(self) -> FloatArray | None:
        """(..., F) variance of the stochastic nonlinear distortion of the FRF of *one* realisation.

        ``M (total - noise)`` for M realisations. Unbiased, hence negative at some lines where
        distortion is lost in noise: average over lines before taking a root. None where either is
        unknown.
        """
        if self.variance_noise is None or self.variance_total is None:
            return None
        return self.realisations * (self.variance_total - self.variance_noise)

    def suspected(self, message: str) -> FRF:
        """With a message added, and SUSPECT unless it is worse."""
        graver = self.status in (FrfStatus.MODEL_ERROR, FrfStatus.FAILED)
        return replace(
            self,
            status=self.status if graver else FrfStatus.SUSPECT,
            message="; ".join(filter(None, [self.message, message])),
        )

    def band(self, low_hz: float, high_hz: float) -> FRF:
        """The lines from `low_hz` to `high_hz`, ends included."""
        inside = (self.frequency_hz >= low_hz) & (self.frequency_hz <= high_hz)
        if inside.all():
            return self
        arrays = {name: getattr(self, name) for name in PER_LINE}
        return replace(
            self, **{name: x[..., inside] for name, x in arrays.items() if x is not None}
        )


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
