# SPDX-License-Identifier: Apache-2.0
"""Spectra of periodic records, each transformed once; means of its periods, and the covariance of their noise.

The spectrum of P consecutive periods has P - 1 bins between harmonics. A periodic excitation leaves them to
noise and transient. The fast local polynomial method fits a polynomial in the bin offset to the nearest of them
around each line, extrapolates it to the line and subtracts it, for input and output alike; the residuals of the
fit give the 2 x 2 noise covariance. The neighbours lie alike around all lines but those at the ends of the
spectrum, so the fit is one constant real matrix times the bins around all lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt
import scipy.fft

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.multisine import checked_harmonics

METHODS = ("local polynomial", "average")
_NOT_FINITE = "u, y: samples are not finite, expected a complete record"


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


def mean_spectra(
    record: Spectrum,
    harmonics: npt.ArrayLike,
    *,
    method: str = "local polynomial",
    order: int = 2,
    dof: int = 6,
) -> PeriodicSpectra:
    """Mean spectra (..., 2, F) of a record; see `estimate.frf_of_record` and `transient_free_spectra`."""
    if method not in METHODS:
        raise ValueError(f"method: {method!r}, accepted are {', '.join(METHODS)}")
    if record.periods > 1 and method == "local polynomial":
        return transient_free_spectra(record, harmonics, order=order, dof=dof)
    return averaged_spectra(record, harmonics, unsettled_periods=1 if record.periods > 2 else 0)


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
        raise ValueError(_NOT_FINITE)
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


def transient_free_spectra(
    record: Spectrum, harmonics: npt.ArrayLike, *, order: int = 2, dof: int = 6
) -> PeriodicSpectra:
    """Mean spectra without the transient, and their noise covariance, from two periods or more.

    Parameters
    ----------
    record : Spectrum
    harmonics : (F,) int
        Lines wanted, ascending, from 1 to below half of the samples of a period. Only these are
        computed; other lines may well be excited.
    order : int
        Order of the polynomial for the transient. 2 suits most; a mode of damping ratio 1 % at high
        signal-to-noise ratio wants 4.
    dof : int
        Degrees of freedom of the covariance, at least: the neighbours are the nearest
        ``2 ceil((dof + order + 1) / 2)`` bins between harmonics, less ``order + 1``.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted; also where a sample is not finite.

    Examples
    --------
    >>> spectra = transient_free_spectra(Spectrum.of(u, y), np.arange(4, 4001))  # u, y: (8, 20000)

    Notes
    -----
    For P = 2 a single bin lies between harmonics and the neighbours spread over several of them:
    the transient must be smooth over that range.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 7; Pintelon, Barbe, Vandersteen & Schoukens, MSSP 25 (2011) 2683-2704.
    """
    samples, periods, bins = record.samples_per_period, record.periods, record.bins
    harmonics = checked_harmonics(harmonics, samples)
    groups = neighbourhoods(harmonics.tobytes(), samples, periods, order, dof)
    batch = bins.shape[:-2]
    spectra = np.empty((*batch, 2, harmonics.size), complex)
    covariance = np.empty((*batch, 2, 2, harmonics.size), complex)
    for group in groups:
        lines = group.lines
        # a real matrix times complex numbers: real and imaginary parts are columns of their own
        columns = np.take(bins, group.bins, axis=-1).view(float)  # (..., 2, W, 2 L)
        projected = np.matmul(group.projector, columns).view(complex)  # (..., 2, 1 + dof, L)
        spectra[..., lines] = projected[..., 0, :]
        y, u = projected[..., 0, 1:, :], projected[..., 1, 1:, :]  # residuals
        covariance[..., 0, 0, lines] = power(y).sum(axis=-2)
        covariance[..., 1, 1, lines] = power(u).sum(axis=-2)
        cross = np.sum(y * u.conj(), axis=-2)  # (..., L)
        covariance[..., 0, 1, lines] = cross
        covariance[..., 1, 0, lines] = cross.conj()
    if not np.isfinite(spectra.sum()):  # the sum shows it, at half the cost of testing all
        raise ValueError(_NOT_FINITE)
    return PeriodicSpectra(
        harmonics=harmonics,
        samples_per_period=samples,
        periods=periods,
        spectra=spectra,
        covariance=covariance,
        noise_dof=groups[0].projector.shape[0] - 1,
        method=f"fast local polynomial method, order {order}",
    )


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Lines that share one pattern of neighbouring bins, hence one projector.

    Attributes
    ----------
    lines : slice or (L,) int
        Which of the harmonics these are, ascending; a slice where they are contiguous: that writes faster.
    bins : (W, L) int
        The line itself, then its neighbours, in the spectrum of the whole record.
    projector : (1 + dof, W) float
        Its first row takes the bins to the line without its transient; the others to residuals
        whose sum of products is the covariance of that.
    """

    lines: slice | IntArray
    bins: IntArray
    projector: FloatArray


@lru_cache(maxsize=16)
def neighbourhoods(
    harmonics: bytes, samples_per_period: int, periods: int, order: int, dof: int
) -> tuple[Neighbourhood, ...]:
    """Group lines by their neighbouring bins.

    Neighbours are the nearest bins that are no harmonic. Harmonics that are not excited do not
    count: they carry the periodic part of nonlinear distortion, which is not noise. Zero frequency,
    the Nyquist bin and whatever lies beyond do not count either (beyond, the spectrum only repeats
    itself), so lines at the ends of the spectrum have more neighbours on one side. Those of the latest
    kinds of records are kept, because one measurement is like the next.

    Parameters
    ----------
    harmonics : bytes
        Of int64, ascending: the lines wanted.
    samples_per_period, periods, order, dof : int
        See `transient_free_spectra`.

    Raises
    ------
    ValueError
        If there are too few bins between harmonics for `order` and `dof`; a single period has none.
    """
    if order < 0:
        raise ValueError(f"order: {order}, expected at least 0")
    if dof < 1:
        raise ValueError(f"dof: {dof}, expected at least 1")
    count = 2 * -(-(dof + order + 1) // 2)  # as many on either side
    last = (periods * samples_per_period - 1) // 2  # below the Nyquist bin
    available = last - last // periods
    if available < count:
        raise ValueError(
            f"order, dof: {order}, {dof} need {count} bins between harmonics, a record of "
            f"{periods} x {samples_per_period} samples has {available}; lower either or record more"
        )
    # the nearest first, the lower of two as near; on one side alone every second may be a harmonic
    offsets = np.arange(-2 * count, 2 * count + 1)
    offsets = offsets[offsets % periods != 0]
    offsets = offsets[np.argsort(np.abs(offsets), kind="stable")]
    centre = np.frombuffer(harmonics, np.int64) * periods
    there = (centre[:, None] + offsets >= 1) & (centre[:, None] + offsets <= last)
    nearest = there & (np.cumsum(there, axis=1) <= count)  # (F, offsets)
    lines_of: dict[bytes, list[int]] = {}
    for line, pattern in enumerate(nearest):
        lines_of.setdefault(pattern.tobytes(), []).append(line)
    groups = []
    for lines in map(np.array, lines_of.values()):
        neighbours = np.sort(offsets[nearest[lines[0]]])
        bins = centre[lines] + np.concatenate([[0], neighbours])[:, None]
        first, stop = int(lines[0]), int(lines[-1]) + 1
        where = slice(first, stop) if stop - first == lines.size else lines
        groups.append(Neighbourhood(where, bins, _extrapolation_projector(neighbours, order)))
    return tuple(groups)


def _extrapolation_projector(offsets: npt.NDArray[np.integer], order: int) -> FloatArray:
    """Projector of a polynomial fit to neighbouring bins (B,), given relative to the line, extrapolated to it.

    Returns
    -------
    (1 + B - order - 1, 1 + B) float
        Row 0: the line minus the extrapolated polynomial. Rows i > 0: residuals, scaled so that
        ``sum_i r_i conj(s_i)`` is an unbiased covariance of row 0 applied to two channels. For
        white noise of variance v per bin that is ``v (1 + c)``, c from the extrapolation.
    """
    position = offsets / np.max(np.abs(offsets))  # well conditioned powers
    powers = position[:, None] ** np.arange(order + 1)  # (B, order + 1)
    q, r = np.linalg.qr(powers, mode="complete")
    extrapolation = q[:, : order + 1] @ np.linalg.solve(r[: order + 1].T, np.eye(order + 1)[0])
    residual_basis = q[:, order + 1 :]
    residual_dof = offsets.size - order - 1
    # variance of the line's own noise (1) and of the extrapolated polynomial
    mean_variance = 1 + extrapolation @ extrapolation
    projector = np.zeros((1 + residual_dof, 1 + offsets.size))
    projector[0, 0] = 1
    projector[0, 1:] = -extrapolation
    projector[1:, 1:] = residual_basis.T * np.sqrt(mean_variance / residual_dof)
    return projector


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
