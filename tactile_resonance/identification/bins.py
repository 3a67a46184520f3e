# SPDX-License-Identifier: Apache-2.0
"""Bins of the band, what the model is made of on them, and the fit's normal equations.

The model on a bin is ``Y = (B U + C) / A``: A, B and C are polynomials with real coefficients over
fixed bases, C the numerator of the transient. Bins come in groups: on excited ones there is an
input, on the bins between harmonics of a periodic input only the transient. An FRF is one group
with U = 1 and no C.

The Jacobian of the weighted residual is a fixed basis times one complex weight per bin and kind of
coefficient, so the normal matrices of a whole batch of points are matrix products of these weights
with products of basis functions that are computed once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations_with_replacement

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class BinData:
    """Data of a batch on the K bins of a group.

    Attributes
    ----------
    y : (batch, K) complex
    u : (batch, K) complex or None
        None stands for 1.
    variance_y : (batch, K) or (batch, 1) float
        Of y; infinite where the bin is to be left out.
    variance_u : (batch, K) or (batch, 1) float or None
        Of u, and with it ``covariance_yu = E dY conj(dU)`` of the same shape, complex.
    covariance_yu : complex array or None
    """

    y: ComplexArray
    u: ComplexArray | None
    variance_y: FloatArray
    variance_u: FloatArray | None = None
    covariance_yu: ComplexArray | None = None

    def rows(self, which: slice | npt.NDArray) -> BinData:
        """The data of some points of the batch."""

        def cut(array):
            return None if array is None else array[which]

        return BinData(
            self.y[which],
            cut(self.u),
            self.variance_y[which],
            cut(self.variance_u),
            cut(self.covariance_yu),
        )

    def turned(self, error: ComplexArray) -> ComplexArray:
        """(batch, K) errors of y turned by the phase of u.

        Errors of a response are smooth over lines; those of y are so only after this, for the phases
        of the excitation are random.
        """
        if self.u is None:
            return error
        size = np.abs(self.u)
        with np.errstate(divide="ignore", invalid="ignore"):
            return error * np.where(size > 0, self.u.conj() / size, 1.0)

    def residual_variance(self, g: ComplexArray | None) -> FloatArray:
        """(batch, K or 1) variance of ``y - g u`` for a response g (batch, K)."""
        if self.variance_u is None or g is None:
            return self.variance_y
        variance = self.variance_y + self.variance_u * (g.real**2 + g.imag**2)
        if self.covariance_yu is not None:
            variance = variance - 2 * np.real(self.covariance_yu * np.conj(g))
        return variance


@dataclass(frozen=True, eq=False)
class BinGroup:
    """Basis functions on the K bins of a group.

    Parameters
    ----------
    denominator : (K, n + 1) complex
        The last coefficient of A is fixed at 1.
    numerator : (K, m + 1) complex or None
    transient : (K, t) complex or None
    """

    denominator: ComplexArray
    numerator: ComplexArray | None = None
    transient: ComplexArray | None = None
    _evaluation: list[FloatArray | None] = field(init=False, repr=False)
    _gradient: list[FloatArray | None] = field(init=False, repr=False)
    _products: list[tuple[int, int, slice, FloatArray]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        blocks = [self.denominator[:, :-1], self.numerator, self.transient]
        evaluation = [_rows(b) for b in (self.denominator, self.numerator, self.transient)]
        gradient = [None if b is None else _columns(b) for b in blocks]
        products = []
        first_entry = 0
        for i, j in combinations_with_replacement(range(3), 2):
            first, second = blocks[i], blocks[j]
            if first is None or second is None:
                continue
            product = first.conj()[:, :, None] * second[:, None, :]  # (K, n_i, n_j)
            if i == j:
                row, column = np.triu_indices(first.shape[1])
                constant = np.ascontiguousarray(product[:, row, column].real)
            else:
                constant = _columns(product.reshape(product.shape[0], -1))
            entries = slice(first_entry, first_entry + constant.shape[1])
            first_entry = entries.stop
            products.append((i, j, entries, constant))
        object.__setattr__(self, "_evaluation", evaluation)
        object.__setattr__(self, "_gradient", gradient)
        object.__setattr__(self, "_products", products)

    def places(self, sizes: tuple[int, int, int]) -> npt.NDArray[np.int64]:
        """(n, n) which entry of `normal_entries` stands where among all coefficients."""
        offset = np.cumsum([0, *sizes])
        total = self._products[-1][2].stop
        places = np.full((offset[3], offset[3]), total)  # the last entry is 0
        for i, j, entries, _ in self._products:
            index = np.arange(entries.start, entries.stop)
            if i == j:
                row, column = np.triu_indices(sizes[i])
            else:
                row, column = (k.ravel() for k in np.indices((sizes[i], sizes[j])))
            places[row + offset[i], column + offset[j]] = index
            places[column + offset[j], row + offset[i]] = index
        return places

    @property
    def size(self) -> int:
        """Number of bins K."""
        return self.denominator.shape[0]

    def evaluate(self, which: int, coefficients: FloatArray) -> ComplexArray:
        """(batch, K) values of A (0), B (1) or C (2) for coefficients (batch, terms)."""
        constant = self._evaluation[which]
        assert constant is not None
        return (coefficients @ constant).view(complex)

    def gradient(self, which: int, weight: ComplexArray) -> FloatArray:
        """(batch, terms) ``Re sum_k weight_k basis_k``."""
        constant = self._gradient[which]
        assert constant is not None
        return np.ascontiguousarray(weight).view(float) @ constant

    def normal_entries(self, m: FloatArray, y: ComplexArray, u: ComplexArray | None) -> FloatArray:
        """(batch, entries + 1) distinct entries of ``Re J^H J``, and a zero.

        J has columns ``y p``, ``-u q`` and ``-t``, each times a root of the real weight `m` (batch,
        K).
        """
        result = np.empty((m.shape[0], self._products[-1][2].stop + 1))
        result[:, -1] = 0.0
        my = np.conj(y) * -m
        for i, j, entries, constant in self._products:
            weight: npt.NDArray
            if (i, j) == (0, 0):
                weight = -(y.real * my.real - y.imag * my.imag)
            elif (i, j) == (0, 1):
                weight = my if u is None else my * u
            elif (i, j) == (0, 2):
                weight = my
            elif (i, j) == (1, 1):
                weight = m if u is None else m * _abs2(u)
            elif (i, j) == (1, 2):
                weight = m.astype(complex) if u is None else m * np.conj(u)
            else:
                weight = m
            if i != j:
                weight = np.ascontiguousarray(weight).view(float)
            np.matmul(weight, constant, out=result[:, entries])
        return result


def _abs2(x: ComplexArray) -> FloatArray:
    return x.real**2 + x.imag**2


def _rows(basis: ComplexArray | None) -> FloatArray | None:
    """(terms, 2 K) float: real coefficients times this are complex values."""
    return None if basis is None else np.ascontiguousarray(basis.T).view(float)


def _columns(basis: ComplexArray) -> FloatArray:
    """(2 K, terms) float: complex weights as floats times this are ``Re sum weight basis``."""
    return np.ascontiguousarray(np.ascontiguousarray(basis.conj().T).view(float).T)
