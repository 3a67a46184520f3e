# SPDX-License-Identifier: Apache-2.0
"""Spectra of periodic records: each is transformed once, and read by everything that follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.fft

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray

NOT_FINITE = "u, y: samples are not finite, expected a complete record"


class Spectrum:
    """Records of both channels and their Fourier transforms, made when first read and then kept.

    Parameters
    ----------
    samples : (..., 2, P, N) float
        Rows [y; u], sensor and actuator [V]: P consecutive periods of N samples, from the first
        sample on.

    Raises
    ------
    ValueError
        If there is no period or no sample.

    Examples
    --------
    >>> u = np.cos(2 * np.pi * np.arange(40).reshape(4, 10) / 10)
    >>> record = Spectrum.of(u, 3 * u)
    >>> record.bins.shape, abs(record.bins[:, 4]).round(12)
    ((2, 21), array([1.5, 0.5]))
    """

    def __init__(self, samples: FloatArray) -> None:
        if samples.ndim < 3 or samples.shape[-3] != 2 or 0 in samples.shape[-2:]:
            raise ValueError(f"samples: shape {samples.shape}, expected (..., 2, P, N)")
        self.samples = samples

    @classmethod
    def of(cls, u: npt.ArrayLike, y: npt.ArrayLike) -> Spectrum:
        """Of actuator and sensor [V], (..., P, N) each; ValueError unless they are alike."""
        u, y = np.asarray(u), np.asarray(y)
        if u.ndim < 2 or u.shape != y.shape or 0 in u.shape[-2:]:
            raise ValueError(f"u, y: shapes {u.shape}, {y.shape}, expected the same (..., P, N)")
        return cls(np.stack([y, u], axis=-3, dtype=float))

    @property
    def periods(self) -> int:
        """P."""
        return self.samples.shape[-2]

    @property
    def samples_per_period(self) -> int:
        """N."""
        return self.samples.shape[-1]

    @cached_property
    def bins(self) -> ComplexArray:
        """(..., 2, P N // 2 + 1) bins of whole records, scaled by 1 / (P N).

        A cosine of peak a gives a/2. A sample that is missing makes all bins of its channel NaN.
        """
        size = self.periods * self.samples_per_period
        whole = self.samples.reshape(*self.samples.shape[:-2], size)
        return np.asarray(scipy.fft.rfft(whole, axis=-1, norm="forward"))

    @cached_property
    def by_period(self) -> ComplexArray:
        """(..., 2, P, N // 2 + 1) harmonics of each period alone, scaled by 1 / N."""
        if self.periods == 1:
            return self.bins[..., None, :]
        return np.asarray(scipy.fft.rfft(self.samples, axis=-1, norm="forward"))


@dataclass(frozen=True, eq=False)
class PeriodicSpectra:
    """Mean spectra of records of P periods: what every later stage of the FRF starts from.

    Attributes
    ----------
    harmonics : (F,) int
    samples_per_period : int
    periods : int
        How many were used.
    spectra : (..., 2, F) complex
        Means over the periods, row order [Y; U]; a cosine of peak a gives a/2.
    covariance : (..., 2, 2, F) complex or None
        Noise covariance of these means, ``C[i, j] = E dZ_i conj(dZ_j)``; None for a single period.
    noise_dof : int
        Degrees of freedom of the covariance of one record; 0 where unknown.
    method : str
        How the transient was dealt with, for people.
    """

    harmonics: IntArray
    samples_per_period: int
    periods: int
    spectra: ComplexArray
    covariance: ComplexArray | None
    noise_dof: int
    method: str

    def frequency_hz(self, sample_rate_hz: float) -> FloatArray:
        """(F,) lines [Hz]."""
        return np.asarray(self.harmonics * (sample_rate_hz / self.samples_per_period), float)

    def at(self, harmonics: npt.ArrayLike) -> PeriodicSpectra:
        """Some of the lines; ``ValueError`` unless all of them are there."""
        missing = np.setdiff1d(harmonics, self.harmonics)
        if missing.size:
            raise ValueError(f"harmonics: {missing[:5].tolist()} are not among the lines of these spectra")
        where = np.searchsorted(self.harmonics, harmonics)
        return replace(
            self,
            harmonics=self.harmonics[where],
            spectra=self.spectra[..., where],
            covariance=None if self.covariance is None else self.covariance[..., where],
        )


def checked_harmonics(harmonics: npt.ArrayLike, samples_per_period: int) -> IntArray:
    """(F,) int harmonics, read-only; ValueError unless ascending within 1..(N - 1) // 2."""
    array = np.array(harmonics)
    if array.ndim != 1 or array.size == 0 or array.dtype.kind not in "iu":
        raise ValueError(
            f"harmonics: {array.dtype} of shape {array.shape}, expected (F,) integers, F >= 1"
        )
    array = array.astype(np.int64)
    last = (samples_per_period - 1) // 2
    if array[0] < 1 or array[-1] > last or np.any(np.diff(array) < 1):
        raise ValueError(
            f"harmonics: {array.min()}..{array.max()}, expected ascending, within 1..{last}"
        )
    array.flags.writeable = False
    return array


def averaged_spectra(
    record: Spectrum, harmonics: npt.ArrayLike, *, unsettled_periods: int = 0
) -> PeriodicSpectra:
    """Mean and sample covariance over periods: right where the record is in steady state.

    Parameters
    ----------
    record : Spectrum
    harmonics : (F,) int
    unsettled_periods : int
        Periods dropped at the start because the transient has not died out.

    Raises
    ------
    ValueError
        If nothing is left, or samples are not finite.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 2.
    """
    recorded = record.periods
    if not 0 <= unsettled_periods < recorded:
        raise ValueError(
            f"unsettled_periods: {unsettled_periods}, accepted is 0..{recorded - 1} "
            f"({recorded} periods were recorded)"
        )
    harmonics = checked_harmonics(harmonics, record.samples_per_period)
    used = recorded - unsettled_periods
    per_period = record.by_period[..., unsettled_periods:, harmonics]  # (..., 2, P', F)
    if not np.all(np.isfinite(per_period)):
        raise ValueError(NOT_FINITE)
    mean = per_period.mean(axis=-2)  # (..., 2, F)
    covariance = None
    if used > 1:
        deviation = per_period - mean[..., None, :]  # (..., 2, P', F)
        covariance = np.einsum("...ipf,...jpf->...ijf", deviation, deviation.conj())
        covariance /= used * (used - 1)  # (..., 2, 2, F), covariance of the mean
    return PeriodicSpectra(
        harmonics=harmonics,
        samples_per_period=record.samples_per_period,
        periods=used,
        spectra=mean,
        covariance=covariance,
        noise_dof=used - 1,
        method=f"mean of {used} of {recorded} periods",
    )


def stacked_spectra(realisations: Sequence[PeriodicSpectra]) -> PeriodicSpectra:
    """Spectra (..., M, 2, F) of M realisations of as many periods, from those of each, (..., 2, F)."""
    covariances = [each.covariance for each in realisations if each.covariance is not None]
    return replace(
        realisations[0],
        spectra=np.stack([each.spectra for each in realisations], axis=-3),
        covariance=np.stack(covariances, axis=-4) if covariances else None,
    )


def power(spectrum: npt.NDArray[np.complexfloating]) -> FloatArray:
    """Squared magnitudes, without the root that ``abs`` takes."""
    return np.asarray(spectrum.real**2 + spectrum.imag**2)


def ratio(mean: ComplexArray) -> ComplexArray:
    """(..., F) Y/U of mean spectra (..., 2, F), [Y; U]; NaN where there is no input."""
    u = mean[..., 1, :]
    return np.asarray(mean[..., 0, :] / np.where(u == 0, np.nan, u))


def error_variance(g: ComplexArray, covariance: ComplexArray) -> FloatArray:
    """(..., F) variance of ``Y - G U`` for noise of covariance (..., 2, 2, F), [Y; U]."""
    cross = covariance[..., 0, 1, :]
    return np.asarray(
        covariance[..., 0, 0, :].real
        + power(g) * covariance[..., 1, 1, :].real
        - 2 * (cross.real * g.real + cross.imag * g.imag)
    )


def conditional_variance(covariance: ComplexArray) -> FloatArray:
    """(..., F) variance of Y given U, for noise of covariance (..., 2, 2, F), [Y; U]."""
    u = covariance[..., 1, 1, :].real
    explained = power(covariance[..., 0, 1, :]) / np.where(u == 0, np.inf, u)
    return np.asarray(covariance[..., 0, 0, :].real - explained)
