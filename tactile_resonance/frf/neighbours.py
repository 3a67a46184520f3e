# SPDX-License-Identifier: Apache-2.0
"""The bins around an excited line that carry noise and transient only, and the fit to them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.result import ComplexArray, FloatArray

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Excited lines that share one pattern of neighbouring bins, hence one projector.

    Attributes
    ----------
    lines : (L,) int
        Indices of these lines among the plan's harmonics, ascending.
    centre_bins : (L,) int
        Bin of each line in the spectrum of the whole record.
    offsets : (W,) int
        0 first, then the neighbouring bins relative to the line.
    projector : (1 + dof, W) float
        Its first row takes the bins of `offsets` to the line without its transient; the others to
        residuals whose sum of products is the covariance of that.
    """

    lines: IntArray
    centre_bins: IntArray
    offsets: IntArray
    projector: FloatArray

    @cached_property
    def where(self) -> slice | IntArray:
        """`lines` as an index, a slice where they are contiguous: that writes faster."""
        first, last = int(self.lines[0]), int(self.lines[-1])
        return slice(first, last + 1) if last - first + 1 == self.lines.size else self.lines

    @cached_property
    def folded(self) -> tuple[FloatArray, FloatArray] | None:
        """Projector for sums and differences of the bins at either side; None where sides differ.

        (n, 1 + W // 2) for the line and the sums, (m, W // 2) for the differences ``upper - lower``,
        n + m = 1 + dof, by growing distance: together half the work of `projector`.
        """
        if not is_symmetric(self.offsets[1:]):
            return None
        upper = self.projector[:, 1 + self.offsets.size // 2 :]
        odd = upper[:, 0] == -self.projector[:, self.offsets.size // 2]
        even = np.concatenate([self.projector[~odd, :1], upper[~odd]], axis=1)
        return even, upper[odd]

    def project_folded(
        self,
        sums: npt.NDArray[np.complexfloating],
        differences: npt.NDArray[np.complexfloating],
    ) -> ComplexArray:
        """Same as `project`, from the line with the sums (..., 1 + W // 2, 2, L) and the differences.

        Raises
        ------
        ValueError
            If the neighbours are not symmetric.
        """
        if self.folded is None:
            raise ValueError("offsets: not symmetric, expected as many bins on either side")
        even, odd = self.folded
        batch, lines = sums.shape[:-3], sums.shape[-2:]
        result = np.empty((*batch, even.shape[0] + odd.shape[0], *lines), sums.dtype)
        flat = result.reshape(*batch, -1, 2 * lines[-1]).view(float)  # (..., 1 + dof, 4 L)
        for matrix, bins, rows in (
            (even, sums, slice(0, even.shape[0])),
            (odd, differences, slice(even.shape[0], None)),
        ):
            columns = bins.reshape(*batch, -1, 2 * lines[-1]).view(float)
            np.matmul(matrix, columns, out=flat[..., rows, :])
        return result

    def project(self, bins: npt.NDArray[np.complexfloating]) -> ComplexArray:
        """(..., 1 + dof, 2, L) projector times the bins (..., W, 2, L), C-contiguous."""
        # a real matrix times complex numbers: channels, real and imaginary parts are more columns
        columns = bins.reshape(*bins.shape[:-2], -1).view(bins.real.dtype)  # (..., W, 4 L)
        product = np.matmul(self.projector.astype(columns.dtype, copy=False), columns)
        return product.view(bins.dtype).reshape(*product.shape[:-1], *bins.shape[-2:])


def neighbourhoods(
    harmonics: IntArray, samples_per_period: int, periods: int, order: int, dof: int, scale: float
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
        See `local_polynomial.LocalPolynomialPlan`.
    scale : float
        Factor on the line, e.g. 1 / (N P).

    Raises
    ------
    ValueError
        If the record has too few bins between harmonics.
    """
    count = neighbour_count(order, dof)
    last = (periods * samples_per_period - 1) // 2  # below the Nyquist bin
    available = last - last // periods
    if available < count:
        raise ValueError(
            f"order, dof: {order}, {dof} need {count} bins between harmonics, a record of "
            f"{periods} x {samples_per_period} samples has {available}; lower either or record more"
        )
    inner = _nearest(0, -count * 2, count * 2, periods, count)
    centre = harmonics.astype(np.int64) * periods
    is_inner = (centre + inner.min() >= 1) & (centre + inner.max() <= last)
    patterns: dict[tuple[int, ...], list[int]] = {}
    for line in np.flatnonzero(~is_inner):
        offsets = _nearest(int(centre[line]), 1, last, periods, count)
        patterns.setdefault(tuple(offsets), []).append(int(line))
    groups = [(inner, np.flatnonzero(is_inner))] if np.any(is_inner) else []
    groups += [(np.array(offsets), np.array(lines)) for offsets, lines in patterns.items()]
    return tuple(
        Neighbourhood(
            lines=lines.astype(np.int64),
            centre_bins=centre[lines],
            offsets=np.concatenate([[0], offsets]).astype(np.int64),
            projector=scale * extrapolation_projector(offsets, order),
        )
        for offsets, lines in groups
    )


def neighbour_count(order: int, dof: int) -> int:
    """Neighbouring bins used: at least ``dof + order + 1``, and even: as many on either side."""
    return 2 * -(-(dof + order + 1) // 2)


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
    if is_symmetric(offsets):
        # any orthonormal basis serves; one of even and odd vectors is what folding needs
        extrapolation = (extrapolation + extrapolation[::-1]) / 2
        residual_basis = _even_and_odd_complement(powers)
    residual_dof = offsets.size - order - 1
    # variance of the line's own noise (1) and of the extrapolated polynomial
    mean_variance = 1 + extrapolation @ extrapolation
    projector = np.zeros((1 + residual_dof, 1 + offsets.size))
    projector[0, 0] = 1
    projector[0, 1:] = -extrapolation
    projector[1:, 1:] = residual_basis.T * np.sqrt(mean_variance / residual_dof)
    return projector


def is_symmetric(offsets: npt.NDArray[np.integer]) -> bool:
    """True for ascending offsets with as many, as far, on either side of zero."""
    return bool(np.array_equal(offsets, -offsets[::-1]))


def _even_and_odd_complement(powers: FloatArray) -> FloatArray:
    """(B, B - order - 1) orthonormal, orthogonal to `powers` (B, order + 1), even vectors first.

    For symmetric positions even and odd powers are orthogonal, so each half has its own complement.
    """
    half = powers.shape[0] // 2
    columns = []
    for parity in (0, 1):
        mine = powers[half:, parity::2]  # (B / 2, n)
        q, _ = np.linalg.qr(mine, mode="complete")
        upper = q[:, mine.shape[1] :] / np.sqrt(2)
        columns.append(np.concatenate([(-1) ** parity * upper[::-1], upper]))
    return np.concatenate(columns, axis=1)


def _nearest(centre: int, first: int, last: int, periods: int, count: int) -> IntArray:
    """Offsets of the `count` bins of first..last nearest to `centre` that are no harmonic."""
    # enough even when all lie on one side and every second is a harmonic
    reach = 2 * count + periods
    bins = np.arange(max(first, centre - reach), min(last, centre + reach) + 1)
    bins = bins[bins % periods != 0]
    order = np.argsort(np.abs(bins - centre), kind="stable")[:count]
    return np.sort(bins[order] - centre)
