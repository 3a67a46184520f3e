# SPDX-License-Identifier: Apache-2.0
"""Fast local polynomial method: transient-free mean spectra and their noise covariance.

The spectrum of P consecutive periods has P - 1 bins between harmonics. A periodic excitation
leaves them to noise and transient. Around each excited line a polynomial in the bin offset is
fitted to the nearest of them, extrapolated to the line and subtracted, for input and output alike;
the residuals of the fit give the 2 x 2 noise covariance. The neighbours lie alike around all lines
but those at the ends of the spectrum, so the fit is one constant real matrix times the bins around
all lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.frf.spectra import NOT_FINITE, PeriodicSpectra, Spectrum, checked_harmonics


class LocalPolynomialPlan:
    """Everything of the fast local polynomial method that does not depend on the samples.

    Parameters
    ----------
    harmonics : (F,) int
        Lines wanted, ascending, from 1 to below half of `samples_per_period`. Only these are
        computed; other lines may well be excited.
    samples_per_period : int
        N.
    periods : int
        P, at least 2.
    order : int
        Order of the polynomial for the transient. 2 suits most; a mode of damping ratio 1 % at high
        signal-to-noise ratio wants 4.
    dof : int
        Degrees of freedom of the covariance, at least.

    Attributes
    ----------
    groups : tuple of Neighbourhood
        Lines by pattern of neighbouring bins.
    noise_dof : int
        Degrees of freedom of the covariance: the neighbours are the nearest
        ``2 ceil((dof + order + 1) / 2)`` bins between harmonics, less ``order + 1``.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.

    Examples
    --------
    >>> plan = LocalPolynomialPlan(np.arange(4, 4001), samples_per_period=20000, periods=8)
    >>> spectra = plan(Spectrum.of(u, y))  # u, y: (8, 20000)

    Notes
    -----
    For P = 2 a single bin lies between harmonics and the neighbours spread over several of them:
    the transient must be smooth over that range.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 7; Pintelon, Barbe, Vandersteen & Schoukens, MSSP 25 (2011) 2683-2704.
    """

    def __init__(
        self,
        harmonics: npt.ArrayLike,
        samples_per_period: int,
        periods: int,
        order: int = 2,
        dof: int = 6,
    ) -> None:
        self.harmonics: IntArray = checked_harmonics(harmonics, samples_per_period)
        if periods < 2:
            raise ValueError(
                f"periods: {periods}, expected at least 2: a single period has no bins "
                "between harmonics from which to estimate noise and transient"
            )
        if order < 0:
            raise ValueError(f"order: {order}, expected at least 0")
        if dof < 1:
            raise ValueError(f"dof: {dof}, expected at least 1")
        self.samples_per_period, self.periods, self.order = samples_per_period, periods, order
        self.groups = neighbourhoods(self.harmonics, samples_per_period, periods, order, dof)
        self.noise_dof = self.groups[0].projector.shape[0] - 1

    def __call__(self, record: Spectrum) -> PeriodicSpectra:
        """Mean spectra of records.

        Parameters
        ----------
        record : Spectrum

        Raises
        ------
        ValueError
            If the shapes do not fit the plan or a sample is not finite.
        """
        shape = (self.periods, self.samples_per_period)
        if record.samples.shape[-2:] != shape:
            raise ValueError(
                f"record: shape {record.samples.shape}, expected (..., 2, {shape[0]}, {shape[1]})"
            )
        return self.from_bins(record.bins)

    def from_bins(self, bins: ComplexArray) -> PeriodicSpectra:
        """The same from bins (..., 2, P N // 2 + 1), as `Spectrum.bins`."""
        batch = bins.shape[:-2]
        spectra = np.empty((*batch, 2, self.harmonics.size), complex)
        covariance = np.empty((*batch, 2, 2, self.harmonics.size), complex)
        for group in self.groups:
            lines = group.where
            projected = group.project(bins)  # (..., 2, 1 + dof, L)
            spectra[..., lines] = projected[..., 0, :]
            y, u = projected[..., 0, 1:, :], projected[..., 1, 1:, :]  # residuals
            covariance[..., 0, 0, lines] = _sum_of_squares(y)
            covariance[..., 1, 1, lines] = _sum_of_squares(u)
            cross = np.sum(y * u.conj(), axis=-2)  # (..., L)
            covariance[..., 0, 1, lines] = cross
            covariance[..., 1, 0, lines] = cross.conj()
        if not np.isfinite(spectra.sum()):  # the sum shows it, at half the cost of testing all
            raise ValueError(NOT_FINITE)
        return PeriodicSpectra(
            harmonics=self.harmonics,
            samples_per_period=self.samples_per_period,
            periods=self.periods,
            spectra=spectra,
            covariance=covariance,
            noise_dof=self.noise_dof,
            method=f"fast local polynomial method, order {self.order}",
        )


@lru_cache(maxsize=16)
def kept_plan(
    harmonics: bytes, samples_per_period: int, periods: int, order: int, dof: int
) -> LocalPolynomialPlan:
    """Plan of one of the latest kinds, because one measurement is like the next; bytes of int64."""
    lines = np.frombuffer(harmonics, np.int64)
    return LocalPolynomialPlan(lines, samples_per_period, periods, order, dof)


def _sum_of_squares(residual: ComplexArray) -> FloatArray:
    """(..., L) sum of absolute squares of residuals (..., dof, L)."""
    parts = residual.view(float)  # (..., dof, 2 L), real and imaginary alternate
    squares = np.einsum("...ij,...ij->...j", parts, parts)  # no complex product, no root
    return np.asarray(squares[..., 0::2] + squares[..., 1::2])


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Lines that share one pattern of neighbouring bins, hence one projector.

    Attributes
    ----------
    lines : (L,) int
        Indices of these lines among the plan's harmonics, ascending.
    bins : (W, L) int
        The line itself, then its neighbours, in the spectrum of the whole record.
    projector : (1 + dof, W) float
        Its first row takes the bins to the line without its transient; the others to residuals
        whose sum of products is the covariance of that.
    """

    lines: IntArray
    bins: IntArray
    projector: FloatArray

    @cached_property
    def where(self) -> slice | IntArray:
        """`lines` as an index, a slice where they are contiguous: that writes faster."""
        first, last = int(self.lines[0]), int(self.lines[-1])
        return slice(first, last + 1) if last - first + 1 == self.lines.size else self.lines

    def project(self, bins: ComplexArray) -> ComplexArray:
        """(..., 1 + dof, L) lines and residuals, from bins (..., K)."""
        # a real matrix times complex numbers: real and imaginary parts are columns of their own
        columns = np.take(bins, self.bins, axis=-1).view(float)  # (..., W, 2 L)
        return np.matmul(self.projector, columns).view(complex)


def neighbourhoods(
    harmonics: IntArray, samples_per_period: int, periods: int, order: int, dof: int
) -> tuple[Neighbourhood, ...]:
    """Group lines by their neighbouring bins.

    Neighbours are the nearest bins that are no harmonic. Harmonics that are not excited do not
    count: they carry the periodic part of nonlinear distortion, which is not noise. Zero frequency,
    the Nyquist bin and whatever lies beyond do not count either (beyond, the spectrum only repeats
    itself), so lines at the ends of the spectrum have more neighbours on one side.

    Parameters
    ----------
    harmonics : (F,) int
        Excited lines, ascending.
    samples_per_period, periods, order, dof : int
        See `LocalPolynomialPlan`.

    Raises
    ------
    ValueError
        If the record has too few bins between harmonics.
    """
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
    centre = harmonics * periods
    there = (centre[:, None] + offsets >= 1) & (centre[:, None] + offsets <= last)
    nearest = there & (np.cumsum(there, axis=1) <= count)  # (F, offsets)
    lines_of: dict[bytes, list[int]] = {}
    for line, pattern in enumerate(nearest):
        lines_of.setdefault(pattern.tobytes(), []).append(line)
    groups = []
    for lines in map(np.array, lines_of.values()):
        neighbours = np.sort(offsets[nearest[lines[0]]])
        bins = centre[lines] + np.concatenate([[0], neighbours])[:, None]
        groups.append(Neighbourhood(lines, bins, extrapolation_projector(neighbours, order)))
    return tuple(groups)


def extrapolation_projector(offsets: npt.NDArray[np.integer], order: int) -> FloatArray:
    """Projector of a polynomial fit to neighbouring bins, extrapolated to the line.

    Parameters
    ----------
    offsets : (B,) int
        Bins relative to the line.
    order : int
        Order of the polynomial.

    Returns
    -------
    (1 + B - order - 1, 1 + B) float
        Row 0: the line minus the extrapolated polynomial. Rows i > 0: residuals, scaled so that
        ``sum_i r_i conj(s_i)`` is an unbiased covariance of row 0 applied to two channels. For
        white noise of variance v per bin that is ``v (1 + c)``, c from the extrapolation.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 7 (local polynomial method, periodic signals); Pintelon, Barbe, Vandersteen &
    Schoukens, MSSP 25 (2011) 2683-2704.
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
