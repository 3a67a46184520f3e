# SPDX-License-Identifier: Apache-2.0
"""Responses from which a sensor is calibrated; where the fit begins: their peaks, and how a load moves them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import numpy.typing as npt
import scipy  # its parts are loaded where they are used first: scipy.signal takes 0.6 s
from scipy import ndimage

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.calibration.model import SensorModel
from tactile_resonance.fields import require
from tactile_resonance.frf.estimate import frf_of_record
from tactile_resonance.frf.excited import find_excited_harmonics
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.frf.skew import linear_phase
from tactile_resonance.frf.spectra import Spectrum

SMOOTH_LINES = 41
"""Over which the variance of the noise is averaged."""
PEAK_HEIGHT = 0.15
"""Of the highest peak of ``-w Im 1 / (1 - G)``, over its foot: what counts as a mode."""


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
        """(F,) stiffness at the tip for a mass or spring of 1."""
        return s**2 if self.load is Load.MASS else np.ones_like(s)

    @property
    def variance(self) -> FloatArray:
        """(F,) of the response, that of the sensor's spectrum averaged over neighbouring lines [V^2/V^2]."""
        assert self.frf.variance is not None  # see __post_init__
        amplitude = self.frf.actuator_amplitude
        power = np.ones(self.frf.frequency_hz.size) if amplitude is None else amplitude**2
        size = min(SMOOTH_LINES, power.size)
        return np.asarray(ndimage.uniform_filter1d(self.frf.variance * power, size) / power)


def start_channel(loopback: Sequence[CalibrationRecord]) -> tuple[float, float]:
    """Gain and delay [s] of the first loop-back; 1 and 0 without."""
    if not loopback:
        return 1.0, 0.0
    frf = loopback[0].frf
    delay_s, *_ = linear_phase(frf.frequency_hz, frf.g)
    return float(np.abs(frf.g).mean()), float(delay_s)


def start_in_air(
    record: CalibrationRecord, gain: float, delay: float, modes: int | None
) -> SensorModel:
    """Peaks of ``1 / (1 - G)``, each as high and as wide as one resonance."""
    s = record.s_rad_s
    g = record.frf.g * np.exp(s * delay) / gain
    sharp = 1 / (1 - g)
    natural, damping, strength = _peaks(s, sharp, modes, record.name or "air")
    # far above the modes G is gamma over 1 + a little; where it is not, the fit corrects
    gamma = float(np.clip(np.median(g.real[-max(3, g.size // 50) :]), 1e-3, 0.5))
    with np.errstate(invalid="ignore"):  # a strength below 0 is no sensor's: NaN, from which no fit begins
        coupling_rad_s = np.sqrt(strength * (1 - gamma))
    return SensorModel(
        natural_rad_s=natural,
        damping_ratio=damping,
        coupling_rad_s=coupling_rad_s,
        tip_deflection=np.zeros(natural.size),
        feedthrough=np.array(gamma),
        leak_rad_s=np.array(0.1 * abs(s[0])),
        gain=np.array(gain),
        delay_s=np.array(delay),
    )


def _peaks(
    s: ComplexArray, h: ComplexArray, modes: int | None, name: str
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n,) natural frequencies [rad/s], damping ratios and strengths of resonances in a response."""
    # a peak of chi^2 / (2 zeta w): chi goes as beta, w as beta^2, so that all peaks are about as high
    size = -h.imag * np.abs(s)
    found, traits = scipy.signal.find_peaks(size, prominence=PEAK_HEIGHT * size.max(), width=0)
    ends = np.interp([traits["left_ips"], traits["right_ips"]], np.arange(s.size), np.abs(s))
    if modes is not None:
        kept = np.sort(np.argsort(-traits["prominences"])[:modes])
        found, ends = found[kept], ends[:, kept]
        require(found.size == modes, "modes", modes, f"{found.size}, as many as {name} shows")
    require(found.size > 0, name, 0, "a response with a mode")
    natural = ends.mean(axis=0)
    damping = (ends[1] - ends[0]) / 2 / natural  # at half of the height
    return natural, damping, -2 * damping * natural**2 * h[found].imag


def one_above(sensor: SensorModel, top_hz: float) -> SensorModel:
    """The same with a mode above the band, where frequency and coupling of the last ones lead on to."""
    n = sensor.modes
    natural, coupling = sensor.natural_rad_s, sensor.coupling_rad_s
    step = natural[-1] - natural[-2] if n > 1 else natural[-1]
    return replace(
        sensor,
        natural_rad_s=np.append(natural, max(natural[-1] + step, 2.1 * np.pi * top_hz)),
        damping_ratio=np.append(sensor.damping_ratio, np.median(sensor.damping_ratio)),
        coupling_rad_s=np.append(coupling, coupling[-1]),
        tip_deflection=np.zeros(n + 1),
    )


def start_tip(loaded: Sequence[CalibrationRecord], air: SensorModel, shown: int) -> FloatArray:
    """(n,) mode shapes at the tip from how far the first load moves each peak that shows."""
    record = loaded[0]
    s = record.s_rad_s
    g = record.frf.g * np.exp(s * air.delay_s) / air.gain
    name = record.name or record.load.value
    moved = _peaks(s, 1 / (1 - g), shown, name)[0]
    natural = air.natural_rad_s[:shown]
    of = (natural / moved) ** 2 - 1
    if record.load is Load.SPRING:
        of = moved**2 - natural**2
    got = f"{(moved[0] / natural[0] - 1) * 100:+.2g} % of the first mode"
    accepted = "modes that a mass lowers and a spring raises: are records in air and loaded ones swapped?"
    require(bool(of.max() > 0), f"{name}: modes", got, accepted)
    tip = np.sqrt(np.maximum(of, 1e-6 * np.abs(of).max()) / record.value)
    return np.append(tip, np.full(air.modes - shown, tip[-1]))
