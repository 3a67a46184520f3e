# SPDX-License-Identifier: Apache-2.0
"""The linearised cost of a single point, with the least calls.

A batch takes its normal matrices from products with constants (`bins`); for one point the time is in
the number of calls, not of operations: here all groups are stacked and the Jacobian is written out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from tactile_resonance.identification.bins import BinData, BinGroup

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class StackedBasis:
    """Basis functions of all groups on their bins, one after the other.

    Attributes
    ----------
    rows : (n, K) complex
        Of the free coefficients of A, then B, then C; 0 where a group has none.
    last : (K,) complex
        Of the fixed coefficient of A.
    kind : (n,) int
        0 for A, 1 for B, 2 for C.
    parts : tuple of slice
        Bins of each group.
    """

    rows: ComplexArray
    last: ComplexArray
    kind: IntArray
    parts: tuple[slice, ...]

    @classmethod
    def of(cls, groups: Sequence[BinGroup], sizes: tuple[int, int, int]) -> StackedBasis:
        """Stack of groups with these numbers of free coefficients."""
        edges = np.cumsum([0] + [group.size for group in groups])
        parts = tuple(slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True))
        offset = np.cumsum([0, *sizes])
        rows = np.zeros((offset[3], edges[-1]), complex)
        for group, part in zip(groups, parts, strict=True):
            blocks = (group.denominator[:, :-1], group.numerator, group.transient)
            for block, first, end in zip(blocks, offset[:-1], offset[1:], strict=True):
                if block is not None:
                    rows[first:end, part] = block.T
        last = np.concatenate([group.denominator[:, -1] for group in groups])
        return cls(rows, last, np.repeat(np.arange(3), sizes), parts)


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
        sizes = [part.stop - part.start for part in basis.parts]
        self._y = data[0].y[0] if len(data) == 1 else np.concatenate([v.y[0] for v in data])
        inputs = [
            np.ones(size, complex) if v.u is None else v.u[0]
            for v, size in zip(data, sizes, strict=True)
        ]
        self._u = np.concatenate(inputs)
        self._variance_y = _stacked([v.variance_y for v in data], sizes)
        self._variance_u: FloatArray | None = None
        self._covariance: ComplexArray | None = None
        if any(v.variance_u is not None for v in data):
            self._variance_u = _stacked([v.variance_u for v in data], sizes)
        if any(v.covariance_yu is not None for v in data):
            self._covariance = _stacked([v.covariance_yu for v in data], sizes)
        self._columns = np.empty((3, self._y.size), complex)
        self._columns[1] = -self._u
        self._columns[2] = -1.0

    def linearise(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (1, groups), half its gradient (1, n), normals (1, groups, n, n) at theta (1, n)."""
        basis = self._basis
        values = self._values(theta[0])
        inverse = 1 / values[0]
        g = values[1] * inverse
        model = (values[1] * self._u + values[2]) * inverse
        weight = 1 / self._variance_y
        if self._variance_u is not None:
            variance = self._variance_y + self._variance_u * (g.real**2 + g.imag**2)
            if self._covariance is not None:
                variance -= 2 * np.real(self._covariance * g.conj())
            weight = 1 / variance
        root = np.sqrt(weight)
        error = (self._y - model) * root
        self._columns[0] = model
        jacobian = (self._columns * (inverse * root))[basis.kind]
        jacobian *= basis.rows
        real, flat = jacobian.view(float), error.view(float)
        gradient = real @ flat
        if self._variance_u is not None:
            slope = self._variance_u * g.conj()
            if self._covariance is not None:
                slope -= self._covariance.conj()
            h = (error.real**2 + error.imag**2) * weight * slope * inverse
            by_kind = np.array([h * g, -h, np.zeros_like(h)])
            gradient += np.einsum("nk,nk->n", by_kind[basis.kind], basis.rows).real
        n = gradient.size
        normal = np.empty((1, len(basis.parts), n, n))
        cost = np.empty((1, len(basis.parts)))
        for k, part in enumerate(basis.parts):
            here = slice(2 * part.start, 2 * part.stop)
            np.matmul(real[:, here], real[:, here].T, out=normal[0, k])
            cost[0, k] = flat[here] @ flat[here]
        return cost, gradient[None], normal

    def start(self, iterations: int) -> FloatArray:
        """(1, n) coefficients by Sanathanan-Koerner iterations."""
        basis = self._basis
        root = 1 / np.sqrt(self._variance_y)
        self._columns[0] = self._y
        right = -self._y * basis.last
        theta = np.empty(0)
        for iteration in range(iterations):
            scale = root if iteration == 0 else root / np.abs(self._values(theta)[0])
            jacobian = (self._columns * scale)[basis.kind]
            jacobian *= basis.rows
            real = jacobian.view(float)
            theta = solve_one(real @ real.T, real @ (right * scale).view(float))
        return theta[None]

    def _values(self, theta: FloatArray) -> ComplexArray:
        """(3, K) A, B and C."""
        basis = self._basis
        coefficients = np.zeros((3, theta.size))
        coefficients[basis.kind, np.arange(theta.size)] = theta
        values = (coefficients @ basis.rows.view(float)).view(complex)
        values[0] += basis.last
        return values


def solve_one(normal: FloatArray, gradient: FloatArray, damping: float = 0.0) -> FloatArray:
    """``(N + damping diag N)^-1 gradient`` (n,) by Cholesky; NaN where N is not positive definite."""
    diagonal = normal.diagonal()
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = normal * scale * scale[:, None]
    scaled.flat[:: scale.size + 1] = 1 + 1e-15 + damping
    _, step, fault = lapack.dposv(scaled, gradient * scale)
    return step * scale if fault == 0 else np.full(scale.size, np.nan)


def _stacked(arrays: Sequence[npt.NDArray | None], sizes: Sequence[int]) -> npt.NDArray:
    """(K,) of (1, k) or (1, 1) arrays; 0 where there is none."""
    return np.concatenate(
        [
            np.zeros(size)
            if a is None
            else (a[0] if a.shape[-1] == size else np.full(size, a[0, 0]))
            for a, size in zip(arrays, sizes, strict=True)
        ]
    )
