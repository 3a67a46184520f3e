# SPDX-License-Identifier: Apache-2.0
"""Spectra of two records of P periods at the bins near harmonics, faster than by long transforms.

A bin of a whole record, ``hP + r``, is harmonic h of the signal

    x_r[n] = exp(-j 2 pi r n / (P N)) sum_p x[pN + n] exp(-j 2 pi r p / P),

so the record takes a short transform over the periods, a twiddle factor, and a transform of length
N for each r (decimation in frequency: Gentleman & Sande, 1966). All of it is done in place, on
several r at a time, the bins of one r of all harmonics lie side by side, and only the r asked for
are computed. Two real records go through one complex transform, ``z = y + j s u``: theirs are the
even and odd parts under conjugation, ``Y(k) = (Z(k) + conj Z(-k)) / 2``, ``s U(k) = (Z(k) - conj
Z(-k)) / 2j``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy.fft

from tactile_resonance.frf.result import ComplexArray

IntArray = npt.NDArray[np.int64]

Place = tuple[int, "slice | IntArray"]
"""Row and columns of bins in a transform."""


@dataclass(frozen=True, eq=False)
class PairSpectrum:
    """Transform of two records, still mixed.

    Attributes
    ----------
    values : (..., R, N) complex
        Z at bins ``hP + r``, column h, one row per r asked for.
    scale : float
        The factor s of the second record, a power of two: it balances the records, so that the
        smaller does not drown in the rounding errors of the larger.
    """

    values: ComplexArray
    scale: float

    def gather(self, places: tuple[tuple[Place, Place], ...]) -> ComplexArray:
        """(..., W, 2, L) values Z(k) and Z(-k) at `PairTransform.places` of bins k."""
        found = self.values[..., places[0][0][0], places[0][0][1]]
        shape = (*found.shape[:-1], len(places), 2, found.shape[-1])
        bins = np.empty(shape, self.values.dtype)
        for index, pair in enumerate(places):
            for sign, (row, columns) in enumerate(pair):
                bins[..., index, sign, :] = self.values[..., row, columns]
        return bins

    def gather_folded(
        self, places: tuple[tuple[Place, Place], ...]
    ) -> tuple[ComplexArray, ComplexArray]:
        """Line and sums (..., 1 + W // 2, 2, L), and differences, of bins at either side of the line.

        `places` are those of the line, then of W bins symmetric about it, ascending.
        """
        values, half = self.values, len(places) // 2
        (row, columns), _ = places[0]
        line = values[..., row, columns]
        sums = np.empty((*line.shape[:-1], half + 1, 2, line.shape[-1]), values.dtype)
        differences = np.empty((*line.shape[:-1], half, 2, line.shape[-1]), values.dtype)
        for sign, (row, columns) in enumerate(places[0]):
            sums[..., 0, sign, :] = values[..., row, columns]
        for index in range(half):
            for sign in (0, 1):
                (row, columns) = places[1 + half + index][sign]
                upper = values[..., row, columns]
                (row, columns) = places[half - index][sign]
                lower = values[..., row, columns]
                np.add(upper, lower, out=sums[..., index + 1, sign, :])
                np.subtract(upper, lower, out=differences[..., index, sign, :])
        return sums, differences


@dataclass(frozen=True, eq=False)
class PairTransform:
    """Transform of pairs of records of P periods of N samples.

    Parameters
    ----------
    samples_per_period, periods : int
        N and P.
    offsets : (W,) int
        Bins wanted, relative to harmonics; others may be missing from the transform.

    Attributes
    ----------
    rows : (R,) int
        The remainders r, ascending.
    twiddle : (R, N) complex
        Factors ``exp(-j 2 pi r n / (P N))``.
    """

    samples_per_period: int
    periods: int
    offsets: IntArray
    rows: IntArray = field(init=False)
    twiddle: ComplexArray = field(init=False)

    def __post_init__(self) -> None:
        rows = np.unique(np.concatenate([self.offsets, -self.offsets]) % self.periods)
        turn = np.exp(
            -2j
            * np.pi
            / (self.periods * self.samples_per_period)
            * np.arange(self.samples_per_period)
        )
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "twiddle", np.stack([turn**r for r in rows.tolist()]))

    def __call__(self, y: npt.NDArray[np.floating], u: npt.NDArray[np.floating]) -> PairSpectrum:
        """Mixed transform of records y and u, (..., P, N) each; not scaled by 1/(N P)."""
        scale = _balance(y, u)
        # single precision turns double on its way into the only working array
        z = np.empty(np.broadcast_shapes(y.shape, u.shape), complex)
        z.real = y
        np.multiply(u, scale, out=z.imag)
        z = scipy.fft.fft(z, axis=-2, overwrite_x=True)
        if self.rows.size < self.periods:
            z = z[..., self.rows, :]
        z *= self.twiddle
        return PairSpectrum(scipy.fft.fft(z, axis=-1, overwrite_x=True), scale)

    def places(self, centre_bins: IntArray, offsets: IntArray) -> tuple[tuple[Place, Place], ...]:
        """Where Z(k) and Z(-k) stand, for bins k around harmonics.

        Parameters
        ----------
        centre_bins : (L,) int
            Bins of harmonics, multiples of P.
        offsets : (W,) int
            Bins relative to these.

        Returns
        -------
        tuple of W pairs
        """
        harmonics = centre_bins // self.periods
        return tuple(
            (self._place(harmonics, offset), self._place(-harmonics, -offset))
            for offset in offsets.tolist()
        )

    def _place(self, harmonics: IntArray, offset: int) -> Place:
        further, remainder = divmod(offset, self.periods)
        columns = (harmonics + further) % self.samples_per_period
        return int(np.searchsorted(self.rows, remainder)), _as_slice(columns)


def _balance(y: npt.NDArray[np.floating], u: npt.NDArray[np.floating]) -> float:
    """Power of two, times which u is about as large as y."""
    # the last period of the first record will do
    size_y, size_u = (float(np.linalg.norm(x[(0,) * (x.ndim - 2)][-1])) for x in (y, u))
    ratio = size_y / size_u if size_u > 0 else 0.0
    return float(2.0 ** np.round(np.log2(ratio))) if 0 < ratio < np.inf else 1.0


def _as_slice(columns: IntArray) -> slice | IntArray:
    """Evenly spaced columns as a slice, which reads faster."""
    steps = np.unique(np.diff(columns))
    if steps.size > 1:
        return columns
    first, last = int(columns[0]), int(columns[-1])
    step = int(steps[0]) if steps.size else 1
    stop = last + (1 if step > 0 else -1)
    return slice(first, stop if stop >= 0 else None, step)
