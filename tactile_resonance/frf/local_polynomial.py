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
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.frf.spectra import NOT_FINITE, PeriodicSpectra, Spectrum, checked_harmonics


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
        covariance[..., 0, 0, lines] = _sum_of_squares(y)
        covariance[..., 1, 1, lines] = _sum_of_squares(u)
        cross = np.sum(y * u.conj(), axis=-2)  # (..., L)
        covariance[..., 0, 1, lines] = cross
        covariance[..., 1, 0, lines] = cross.conj()
    if not np.isfinite(spectra.sum()):  # the sum shows it, at half the cost of testing all
        raise ValueError(NOT_FINITE)
    return PeriodicSpectra(
        harmonics=harmonics,
        samples_per_period=samples,
        periods=periods,
        spectra=spectra,
        covariance=covariance,
        noise_dof=groups[0].projector.shape[0] - 1,
        method=f"fast local polynomial method, order {order}",
    )


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
        groups.append(Neighbourhood(where, bins, extrapolation_projector(neighbours, order)))
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
