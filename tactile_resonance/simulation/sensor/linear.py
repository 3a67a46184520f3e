# SPDX-License-Identifier: Apache-2.0
"""Linear systems as sums over their poles, periodic excitations as sums of lines, and their sampled periods.

A system is ``G(s) = direct + sum r_k / (s - p_k)``: every state is one number that decays by itself, so any
instant is reached without the instants before it. The polynomial form of the same system is useless in
floating point at this order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.fields import require
from tactile_resonance.multisine import Excitation


@dataclass(frozen=True)
class PoleResidueModel:
    """A real, stable, strictly diagonalisable single-input single-output system.

    Attributes
    ----------
    poles_rad_s : (K,) array
        Poles with imaginary part 0 or above [rad/s]; conjugates are implied.
    residues_rad_s : (K,) array
        Their residues [V/V rad/s].
    direct : float
        Direct term [V/V].

    Notes
    -----
    State ``z_k' = p_k z_k + r_k u``; output ``direct u + sum weight_k Re z_k``, weight 2 for a
    complex pole (it stands for the pair), 1 for a real one.
    """

    poles_rad_s: ComplexArray
    residues_rad_s: ComplexArray
    direct: float

    @property
    def weights(self) -> FloatArray:
        """How often each listed pole counts, shape (K,): 2 for a complex pole, 1 for a real one."""
        return np.where(self.poles_rad_s.imag > 0, 2.0, 1.0)

    def frequency_response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Return G(j 2 pi f), of the shape of `frequency_hz`."""
        upper, lower = self.resolvents(frequency_hz)
        weighted = self.residues_rad_s * self.weights / 2
        return np.asarray(self.direct + upper @ weighted + lower @ np.conj(weighted))

    def resolvents(self, frequency_hz: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Return ``1 / (s - p)`` and ``1 / (s - conj p)`` at s = j 2 pi f, both (..., K)."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=float)[..., None]  # (..., 1)
        return 1 / (s - self.poles_rad_s), 1 / (s - np.conj(self.poles_rad_s))


@dataclass(frozen=True, eq=False)
class Lines:
    """A checked excitation: harmonics (F,), complex peak amplitudes (F,) [V], and the sampling.

    ``u(t) = Re sum_k phasor_v[k] exp(j 2 pi f_k t)``.
    """

    harmonics: IntArray
    phasor_v: ComplexArray
    sample_rate_hz: float
    samples_per_period: int

    def __post_init__(self) -> None:
        count, harmonics = self.samples_per_period, self.harmonics
        require(count >= 2, "samples_per_period", count, "an integer of 2 or above")
        rate = self.sample_rate_hz
        require(0 < rate < np.inf, "sample_rate_hz", rate, "a number above 0")
        good = harmonics.ndim == 1 and harmonics.size > 0 and bool(np.all(np.diff(harmonics) > 0))
        require(good, "harmonics", harmonics, "at least one line, in ascending order")
        good = bool(harmonics[0] >= 0) and 2 * int(harmonics[-1]) < count
        extent = (int(harmonics[0]), int(harmonics[-1]))
        accepted = f"from 0 to below samples_per_period / 2 = {count / 2:g}"
        require(good, "harmonics", extent, accepted)
        phasor, accepted = self.phasor_v, f"{harmonics.size} finite values each"
        good = phasor.shape == harmonics.shape and bool(np.all(np.isfinite(phasor)))
        require(good, "amplitude_v, phase_rad", phasor, accepted)

    @classmethod
    def of(cls, excitation: Excitation | Lines) -> Lines:
        """Check an excitation and convert it; raises ``ValueError`` naming the field at fault."""
        if isinstance(excitation, Lines):
            return excitation
        amplitude = np.asarray(excitation.amplitude_v, dtype=float)
        phase = np.asarray(excitation.phase_rad, dtype=float)
        same = amplitude.shape == phase.shape
        require(same, "phase_rad", phase.shape, f"the shape of amplitude_v, {amplitude.shape}")
        return cls(
            np.asarray(excitation.harmonics).astype(np.int64),
            amplitude * np.exp(1j * phase),
            float(excitation.sample_rate_hz),
            int(excitation.samples_per_period),
        )

    @property
    def period_s(self) -> float:
        """Length of one period [s]."""
        return self.samples_per_period / self.sample_rate_hz

    @property
    def frequency_hz(self) -> FloatArray:
        """Frequencies of the lines [Hz], shape (F,)."""
        return np.asarray(self.harmonics * (self.sample_rate_hz / self.samples_per_period), float)

    def same_signal(self, other: Lines | None) -> bool:
        """Whether another excitation is this one, sample for sample."""
        if other is None or other is self:
            return other is self
        return (
            self.sample_rate_hz == other.sample_rate_hz
            and self.samples_per_period == other.samples_per_period
            and np.array_equal(self.harmonics, other.harmonics)
            and np.array_equal(self.phasor_v, other.phasor_v)
        )

    def resampled(self, factor: int) -> Lines:
        """Return the same signal sampled `factor` times as fast."""
        return Lines(
            self.harmonics,
            self.phasor_v,
            self.sample_rate_hz * factor,
            self.samples_per_period * factor,
        )

    def shifted(self, time_s: float) -> ComplexArray:
        """Return the phasors of ``u(t + time_s)``, shape (F,)."""
        return self.phasor_v * np.exp(2j * np.pi * self.frequency_hz * time_s)


def sample_period(lines: Lines, gain: ArrayLike = 1.0, *, shift_s: float = 0.0) -> FloatArray:
    """Return one period of ``Re sum gain_k phasor_k exp(j 2 pi f_k (t + shift))``, exactly.

    Parameters
    ----------
    lines : Lines
    gain : complex or (F,) array
        Response at the lines [V/V].
    shift_s : float
        Time of the first sample [s].

    Returns
    -------
    (samples_per_period,) array
    """
    count = lines.samples_per_period
    spectrum = np.zeros(count // 2 + 1, dtype=complex)
    phasor = lines.phasor_v if shift_s == 0.0 else lines.shifted(shift_s)
    spectrum[lines.harmonics] = np.asarray(gain, complex) * phasor * (count / 2)
    if lines.harmonics[0] == 0:
        spectrum[0] *= 2
    return np.asarray(scipy.fft.irfft(spectrum, count))
