# SPDX-License-Identifier: Apache-2.0
"""What stands at the harmonics that a multisine leaves out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance.frf.result import ComplexArray, FloatArray
from tactile_resonance.frf.spectra import IntArray

FALSE_ALARM = 0.01
"""Probability that noise alone passes for distortion."""


@dataclass(frozen=True, eq=False)
class DetectionLines:
    """What stands at the harmonics of one parity that are not excited.

    Arrays have shape (..., M, L) for M realisations and L lines. Outside the excited band the
    response is not known, hence no correction for the input's own distortion: NaN.

    Attributes
    ----------
    harmonics : (L,) int
    frequency_hz : (L,) float
    output, input : complex
        Mean spectra Y and U [V].
    corrected : complex
        ``Y - G U``: the output without what the input's own distortion causes linearly.
    output_variance, input_variance, corrected_variance : float or None
        Noise variance of these means; None for single periods.
    linear_output_power, excited_input_power : (..., L) float
        Power of output and input at the excited lines around, averaged over realisations: what the
        levels refer to. NaN outside the excited band.
    noise_dof : int
        Degrees of freedom of the variances of one realisation.
    """

    harmonics: IntArray
    frequency_hz: FloatArray
    output: ComplexArray
    input: ComplexArray
    corrected: ComplexArray
    output_variance: FloatArray | None
    input_variance: FloatArray | None
    corrected_variance: FloatArray | None
    linear_output_power: FloatArray
    excited_input_power: FloatArray
    noise_dof: int

    @property
    def in_band(self) -> npt.NDArray[np.bool_]:
        """(L,) lines inside the excited band."""
        return np.all(np.isfinite(self.corrected), axis=tuple(range(self.corrected.ndim - 1)))

    @property
    def power(self) -> FloatArray:
        """(..., L) corrected output power over realisations; distortion and noise together."""
        return np.mean(np.abs(self.corrected) ** 2, axis=-2)

    @property
    def noise_power(self) -> FloatArray | None:
        """(..., L) noise in `power`; None where unknown."""
        if self.corrected_variance is None:
            return None
        return np.mean(self.corrected_variance, axis=-2)

    @property
    def level_db(self) -> FloatArray:
        """(..., L) `power` against the linear output around [dB]; holds the noise too."""
        return decibel(self.power / self.linear_output_power)

    @property
    def rms_level_db(self) -> FloatArray:
        """(...) mean power per in-band line against the mean linear power per line there [dB]."""
        return _rms_ratio_db(self.power, self.linear_output_power, self.in_band)

    @property
    def rms_output_level_db(self) -> FloatArray:
        """(...) the same without correction for the input's own distortion."""
        power = np.mean(np.abs(self.output) ** 2, axis=-2)
        return _rms_ratio_db(power, self.linear_output_power, self.in_band)

    @property
    def rms_noise_level_db(self) -> FloatArray | None:
        """(...) the same for noise; None where unknown."""
        noise = self.noise_power
        if noise is None:
            return None
        return _rms_ratio_db(noise, self.linear_output_power, self.in_band)

    @property
    def rms_input_level_db(self) -> FloatArray:
        """(...) the same for the input against its excited lines [dB]."""
        power = np.mean(np.abs(self.input) ** 2, axis=-2)
        return _rms_ratio_db(power, self.excited_input_power, self.in_band)

    @property
    def above_noise(self) -> npt.NDArray[np.bool_] | None:
        """(...) True where the in-band lines hold more than noise, at `FALSE_ALARM`.

        None where it cannot be told: single periods, or no line of this parity.
        """
        noise = self.noise_power
        inside = self.in_band
        if noise is None or not np.any(inside):
            return None
        realisations = self.corrected.shape[-2]
        noise = noise[..., inside]
        total = noise.sum(axis=-1)
        # degrees of freedom of a sum of unequal powers (Satterthwaite); E of a squared estimate is
        # larger than the square by (1 + 1 / dof)
        estimate_dof = realisations * self.noise_dof
        squares = np.sum(noise**2, axis=-1) * estimate_dof / (estimate_dof + 1)
        dof = 2 * realisations * total**2 / squares
        quantile = special.fdtri(dof, dof * self.noise_dof, 1 - FALSE_ALARM)
        return np.asarray(self.power[..., inside].sum(axis=-1) > quantile * total)


def decibel(power_ratio: npt.ArrayLike) -> FloatArray:
    """10 lg of a power ratio."""
    with np.errstate(divide="ignore"):  # nothing at all is minus infinity
        return 10 * np.log10(np.asarray(power_ratio, float))


def _rms_ratio_db(
    power: FloatArray, reference: FloatArray, inside: npt.NDArray[np.bool_]
) -> FloatArray:
    if not np.any(inside):
        return np.full(power.shape[:-1], np.nan)
    return decibel(power[..., inside].mean(axis=-1) / reference[..., inside].mean(axis=-1))
