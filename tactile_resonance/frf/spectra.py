# SPDX-License-Identifier: Apache-2.0
"""Mean input and output spectra of periodic records, with their noise covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.fft

from tactile_resonance.frf.result import ComplexArray, FloatArray

IntArray = npt.NDArray[np.int64]


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
    correlation_lines : int
        Means and covariances of two lines further apart than this many lines are independent.
    method : str
        How the transient was dealt with, for people.
    """

    harmonics: IntArray
    samples_per_period: int
    periods: int
    spectra: ComplexArray
    covariance: ComplexArray | None
    noise_dof: int
    correlation_lines: int
    method: str

    def frequency_hz(self, sample_rate_hz: float) -> FloatArray:
        """(F,) lines [Hz]."""
        return np.asarray(self.harmonics * (sample_rate_hz / self.samples_per_period), float)

    def at(self, harmonics: npt.ArrayLike) -> PeriodicSpectra:
        """Some of the lines.

        Raises
        ------
        ValueError
            If one of them is not there.
        """
        wanted = np.asarray(harmonics)
        missing = np.setdiff1d(wanted, self.harmonics)
        if missing.size:
            raise ValueError(
                f"harmonics: {missing[:5].tolist()} are not among the {self.harmonics.size} lines "
                "of these spectra"
            )
        where = np.searchsorted(self.harmonics, wanted)
        return replace(
            self,
            harmonics=self.harmonics[where],
            spectra=self.spectra[..., where],
            covariance=None if self.covariance is None else self.covariance[..., where],
        )


def period_spectra(
    samples: npt.NDArray[np.floating], harmonics: npt.NDArray[np.int64]
) -> ComplexArray:
    """Spectrum of each period at the given harmonics.

    Parameters
    ----------
    samples : (..., N) float
    harmonics : (F,) int

    Returns
    -------
    (..., F) complex
        ``X[k] = (1/N) sum_n x[n] exp(-j 2 pi k n / N)``; single precision stays single.
    """
    return scipy.fft.rfft(samples, axis=-1, norm="forward")[..., harmonics]


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
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    harmonics: npt.ArrayLike,
    *,
    unsettled_periods: int = 0,
) -> PeriodicSpectra:
    """Mean and sample covariance over periods: right where the record is in steady state.

    Parameters
    ----------
    u, y : (..., P, N) float
        Actuator and sensor [V], P consecutive periods of N samples.
    harmonics : (F,) int
    unsettled_periods : int
        Periods dropped at the start because the transient has not died out.

    Raises
    ------
    ValueError
        If shapes differ, nothing is left, or samples are not finite.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 2.
    """
    u, y = np.asarray(u), np.asarray(y)
    if u.ndim < 2 or u.shape != y.shape:
        raise ValueError(f"u, y: shapes {u.shape}, {y.shape}, expected the same (..., P, N)")
    recorded, samples = u.shape[-2:]
    if not 0 <= unsettled_periods < recorded:
        raise ValueError(
            f"unsettled_periods: {unsettled_periods}, accepted is 0..{recorded - 1} "
            f"({recorded} periods were recorded)"
        )
    harmonics = checked_harmonics(harmonics, samples)
    used = recorded - unsettled_periods
    per_period = np.stack(
        [period_spectra(x[..., unsettled_periods:, :], harmonics) for x in (y, u)], axis=-3
    ).astype(complex, copy=False)  # (..., 2, P', F)
    if not np.all(np.isfinite(per_period)):
        raise ValueError("u, y: samples are not finite, expected a complete record")
    mean = per_period.mean(axis=-2)  # (..., 2, F)
    covariance = None
    if used > 1:
        deviation = per_period - mean[..., None, :]  # (..., 2, P', F)
        covariance = np.einsum("...ipf,...jpf->...ijf", deviation, deviation.conj())
        covariance /= used * (used - 1)  # (..., 2, 2, F), covariance of the mean
    return PeriodicSpectra(
        harmonics=harmonics,
        samples_per_period=samples,
        periods=used,
        spectra=mean,
        covariance=covariance,
        noise_dof=used - 1,
        correlation_lines=0,
        method=f"mean of {used} of {recorded} periods",
    )


def stacked_spectra(realisations: Sequence[PeriodicSpectra]) -> PeriodicSpectra:
    """Spectra (..., M, 2, F) of M realisations from those of each, (..., 2, F).

    The number of periods may differ; `periods` and `noise_dof` are then those of the shortest, and
    without a covariance of each there is none.

    Raises
    ------
    ValueError
        If lines or period lengths differ.
    """
    first = realisations[0]
    for other in realisations[1:]:
        if other.samples_per_period != first.samples_per_period or not np.array_equal(
            other.harmonics, first.harmonics
        ):
            raise ValueError("realisations: lines or period lengths differ, expected the same")
    covariances = [each.covariance for each in realisations if each.covariance is not None]
    complete = len(covariances) == len(realisations)
    return replace(
        first,
        periods=min(each.periods for each in realisations),
        spectra=np.stack([each.spectra for each in realisations], axis=-3),
        covariance=np.stack(covariances, axis=-4) if complete else None,
        noise_dof=min(each.noise_dof for each in realisations) if complete else 0,
    )


def ratio_variance(mean: ComplexArray, covariance: ComplexArray) -> FloatArray:
    """Variance of Y/U, to first order in the noise.

    Parameters
    ----------
    mean : (..., 2, F) complex
        [Y; U].
    covariance : (..., 2, 2, F) complex

    Returns
    -------
    (..., F) float
        ``|Y/U|^2 (C_YY/|Y|^2 + C_UU/|U|^2 - 2 Re(C_YU / (Y conj U)))``, written without dividing by Y
        (Pintelon &
        Schoukens 2012, chapter 2).
    """
    u = np.where(mean[..., 1, :] == 0, np.nan, mean[..., 1, :])
    g = mean[..., 0, :] / u
    return (
        covariance[..., 0, 0, :].real
        + np.abs(g) ** 2 * covariance[..., 1, 1, :].real
        - 2 * np.real(covariance[..., 0, 1, :] * g.conj())
    ) / np.abs(u) ** 2
