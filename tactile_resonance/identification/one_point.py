# SPDX-License-Identifier: Apache-2.0
"""The linearised cost of a single point, with the least calls.

A batch takes its normal matrices from products with constants (`bins`); for one point the time is in
the number of calls, not of operations: here all groups are stacked and the Jacobian is written out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.normal_equations import solve_one

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class StackedBasis:
    """Basis functions of all groups on their bins, one after the other.

    Attributes
    ----------
    rows : (n, K) complex
        Of the free coefficients of A, then B, then C; 0 where a group has none.
    last : (K,) complex
        Of the fixed coefficient of A.
    real, conjugate : (n, 2 K) float
        The rows, and their conjugates, as real and imaginary parts in turn.
    kinds : tuple of slice
        Rows of A, of B, of C.
    parts : tuple of slice
        Bins of each group.
    """

    rows: ComplexArray
    last: ComplexArray
    real: FloatArray
    conjugate: FloatArray
    kinds: tuple[slice, slice, slice]
    parts: tuple[slice, ...]

    @classmethod
    def of(cls, groups: Sequence[BinGroup], sizes: tuple[int, int, int]) -> StackedBasis:
        """Stack of groups with these numbers of free coefficients."""
        edges = np.cumsum([0] + [group.size for group in groups])
        parts = tuple(slice(int(a), int(b)) for a, b in pairwise(edges))
        offset = np.cumsum([0, *sizes])
        rows = np.zeros((offset[3], edges[-1]), complex)
        for group, part in zip(groups, parts, strict=True):
            blocks = (group.denominator[:, :-1], group.numerator, group.transient)
            for block, first, end in zip(blocks, offset[:-1], offset[1:], strict=True):
                if block is not None:
                    rows[first:end, part] = block.T
        last = np.concatenate([group.denominator[:, -1] for group in groups])
        a, b, c = (slice(int(i), int(j)) for i, j in pairwise(offset))
        return cls(rows, last, rows.view(float), rows.conj().view(float), (a, b, c), parts)


class OnePoint:
    """Cost, gradient and normal matrices of one point.

    Parameters
    ----------
    basis : StackedBasis
    data : sequence of BinData
        Of each group, with a batch of 1.
    """

    def __init__(self, basis: StackedBasis, data: Sequence[BinData]) -> None:
        self._basis = basis
        size = basis.last.size
        self._y = np.empty(size, complex)
        self._u = np.ones(size, complex)
        self._variance_y = np.empty(size)
        self._variance_u: FloatArray | None = None
        self._covariance: ComplexArray | None = None
        for values, part in zip(data, basis.parts, strict=True):
            self._y[part] = values.y[0]
            self._variance_y[part] = values.variance_y[0]
            if values.u is not None:
                self._u[part] = values.u[0]
            if values.variance_u is not None:
                if self._variance_u is None:
                    self._variance_u = np.zeros(size)
                self._variance_u[part] = values.variance_u[0]
            if values.covariance_yu is not None:
                if self._covariance is None:
                    self._covariance = np.zeros(size, complex)
                self._covariance[part] = values.covariance_yu[0]
        self._jacobian = np.empty(basis.rows.shape, complex)

    @property
    def weighted_power(self) -> float:
        """``sum |y|^2 / s_Y^2``."""
        y = self._y
        return float((y.real**2 + y.imag**2) @ (1 / self._variance_y))

    def linearise(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (groups,), half its gradient (n,), normals (groups, n, n) at theta (n,)."""
        basis = self._basis
        a, b, c = (self._value(which, theta) for which in range(3))
        inverse = 1 / a
        g = b * inverse
        model = g * self._u
        model += c * inverse
        variance = self._variance_y
        if self._variance_u is not None:
            variance = variance + self._variance_u * (g.real**2 + g.imag**2)
            if self._covariance is not None:
                variance -= 2 * np.real(self._covariance * g.conj())
        root = 1 / np.sqrt(variance)
        error = self._y - model
        error *= root
        real = self._weighted_jacobian(model, inverse * root)
        flat = error.view(float)
        gradient = real @ flat
        if self._variance_u is not None:
            slope = self._variance_u * g.conj()
            if self._covariance is not None:
                slope -= self._covariance.conj()
            h = (error.real**2 + error.imag**2) / variance * slope * inverse
            for_a, for_b, _ = basis.kinds
            gradient[for_a] += basis.conjugate[for_a] @ (h * g).view(float)
            gradient[for_b] -= basis.conjugate[for_b] @ h.view(float)
        n = gradient.size
        normal = np.empty((len(basis.parts), n, n))
        cost = np.empty(len(basis.parts))
        for k, part in enumerate(basis.parts):
            here = slice(2 * part.start, 2 * part.stop)
            np.matmul(real[:, here], real[:, here].T, out=normal[k])
            cost[k] = flat[here] @ flat[here]
        return cost, gradient, normal

    def start(self, iterations: int) -> FloatArray:
        """(n,) coefficients by Sanathanan-Koerner iterations."""
        basis = self._basis
        root = 1 / np.sqrt(self._variance_y)
        right = -self._y * basis.last
        theta = np.empty(0)
        for iteration in range(iterations):
            scale = root if iteration == 0 else root / np.abs(self._value(0, theta))
            real = self._weighted_jacobian(self._y, scale)
            theta = solve_one(real @ real.T, real @ (right * scale).view(float))
        return theta

    def _weighted_jacobian(self, y: ComplexArray, weight: npt.NDArray) -> FloatArray:
        """(n, 2 K) real and imaginary parts of ``weight (y p, -u q, -t)``; valid until the next call."""
        rows, jacobian = self._basis.rows, self._jacobian
        for_a, for_b, for_c = self._basis.kinds
        np.multiply(rows[for_a], y * weight, out=jacobian[for_a])
        np.multiply(rows[for_b], -self._u * weight, out=jacobian[for_b])
        np.multiply(rows[for_c], -weight, out=jacobian[for_c])
        return jacobian.view(float)

    def _value(self, which: int, theta: FloatArray) -> ComplexArray:
        """(K,) of A (0), B (1) or C (2)."""
        kind = self._basis.kinds[which]
        value = (theta[kind] @ self._basis.real[kind]).view(complex)
        if which == 0:
            value += self._basis.last
        return value
