# SPDX-License-Identifier: Apache-2.0
"""Spectrum of a growing record in a narrow band, period by period.

The bins of a record of P periods lie at fractions of a harmonic that change with P. Each period is
therefore kept as a few samples of its continuous spectrum on a grid of half harmonics, from which
the spectrum anywhere in the band follows by interpolation: a non-uniform Fourier transform with
the Kaiser-Bessel kernel (Fessler & Sutton, IEEE Trans. Signal Process. 51 (2003) 560-574;
Greengard & Lee, SIAM Rev. 46 (2004) 443-454).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy import special

from tactile_resonance.frf.neighbours import IntArray, Neighbourhood
from tactile_resonance.frf.result import ComplexArray, FloatArray

OVERSAMPLING = 2
"""Grid points per harmonic."""

_KERNEL_POINTS = 15  # error near 1e-14 of the largest spectrum at this oversampling
_SHAPE = np.pi * _KERNEL_POINTS * (1 - 1 / (2 * OVERSAMPLING))


class BandSpectrum:
    """Keeps periods and gives their joint spectrum at the bins of whatever record they make up.

    Parameters
    ----------
    samples_per_period : int
        N.
    low, high : float
        Band that can be asked for, in harmonics.
    """

    def __init__(self, samples_per_period: int, low: float, high: float) -> None:
        self._samples = samples_per_period
        half = _KERNEL_POINTS / 2
        self._first = int(np.floor(OVERSAMPLING * low - half))
        grid = np.arange(self._first, int(np.ceil(OVERSAMPLING * high + half)) + 1)
        centre = samples_per_period // 2
        self._weight = _weight(samples_per_period)  # (N,)
        # the transform of real samples of length 2 N: grid points outside 0..N by symmetry
        length = OVERSAMPLING * samples_per_period
        folded = grid % length
        self._conjugate = folded > length // 2
        self._index = np.where(self._conjugate, length - folded, folded)
        self._phase = np.exp(2j * np.pi * ((centre * grid) % length) / length)
        self._centre = centre
        self._periods: list[ComplexArray] = []

    @property
    def periods(self) -> int:
        """Periods so far."""
        return len(self._periods)

    def add(self, channels: npt.NDArray[np.floating]) -> None:
        """Keep the next period, (C, N) samples."""
        weighted = channels * self._weight
        spectrum = scipy.fft.rfft(weighted, OVERSAMPLING * self._samples, axis=-1)[..., self._index]
        np.conjugate(spectrum, out=spectrum, where=self._conjugate)
        self._periods.append(spectrum * self._phase)  # (C, K), centred in time

    def clear(self) -> None:
        """Forget all periods."""
        self._periods.clear()

    def bins(self, group: Neighbourhood) -> ComplexArray:
        """(W, C, L) bins of the record so far around lines, as ``group.gather`` of its spectra."""
        return self.at(group.offsets, group.centre_bins)

    def at(self, offsets: IntArray, centres: IntArray) -> ComplexArray:
        """(W, C, L) bins of the record so far at ``centres + offsets``.

        Parameters
        ----------
        offsets : (W,) int
        centres : (L,) int
            Multiples of the number of periods.
        """
        periods = self.periods
        samples = self._samples
        # the bin lies at harmonic h + r / P: all lines share the fraction r / P
        position = OVERSAMPLING * offsets / periods
        nearest = np.ceil(position - _KERNEL_POINTS / 2).astype(np.int64)  # first grid point used
        kernel = _kernel(nearest[:, None] + np.arange(_KERNEL_POINTS) - position[:, None])  # (W, J)
        # delay of each period at that bin, whole harmonics drop out: (W, P)
        delay = np.exp(-2j * np.pi * (np.outer(offsets, np.arange(periods)) % periods) / periods)
        kept = np.stack(self._periods, axis=1)  # (C, P, K)
        grid = delay @ kept  # (C, W, K)
        channels, _, points = kept.shape
        first = nearest[:, None] + OVERSAMPLING * (centres // periods) - self._first  # (W, L)
        flat = np.arange(offsets.size)[:, None] * points + first
        grid = grid.reshape(channels, -1)
        result = np.zeros((channels, offsets.size, centres.size), complex)
        for point in range(_KERNEL_POINTS):
            result += np.take(grid, flat + point, axis=1) * kernel[:, point, None]
        # back from the centre of the period to its first sample; integers keep the phase exact
        bins = centres + offsets[:, None]
        length = periods * samples
        result *= np.exp(-2j * np.pi * ((self._centre * bins) % length) / length)
        return np.ascontiguousarray(result.transpose(1, 0, 2))


@lru_cache(maxsize=4)
def _weight(samples_per_period: int) -> FloatArray:
    """(N,) factors that take the kernel's transform out of a period again."""
    centre = samples_per_period // 2
    time = (np.arange(samples_per_period) - centre) / (OVERSAMPLING * samples_per_period)
    weight = 1 / _kernel_transform(time)
    weight.flags.writeable = False
    return weight


def _kernel(distance: FloatArray) -> FloatArray:
    """Kaiser-Bessel window, `distance` in grid points."""
    inside = np.maximum(1 - (2 * distance / _KERNEL_POINTS) ** 2, 0)
    return np.where(
        np.abs(distance) <= _KERNEL_POINTS / 2, special.i0(_SHAPE * np.sqrt(inside)), 0.0
    )


def _kernel_transform(time: FloatArray) -> FloatArray:
    """Its Fourier transform, `time` in units of the grid's period."""
    root = np.sqrt(_SHAPE**2 - (np.pi * _KERNEL_POINTS * time) ** 2)
    return _KERNEL_POINTS * np.sinh(root) / root
