# SPDX-License-Identifier: Apache-2.0
"""What the compiled estimators of one mode multiply data with: bases, and their products by rows.

Normal matrices and gradients are sums over bins of a weight times a product of basis functions. A row
of `GroupTable.products` is one such product, real or imaginary part, with the weight that belongs to
it and the place where the sum goes. Of the polynomials of an imaginary variable every second part is
zero: these rows are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinGroup

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]

# Bins of a group are followed by others of no weight, up to a multiple of this: no loop has a rest.
LANES = 8
# Rows of the same weight come in blocks of so many, each of them loaded once for all.
BLOCK = 2

# Weights, in the order of their rows in the memory of a kernel; of X = Y - error:
# w |X|^2; -w conj(X); w; gradient by A; minus gradient by C.
AA, AC, CC, OF_A, OF_C = 0, 1, 3, 4, 6
# With an input: -w conj(X) U; w |U|^2; w conj(U); minus gradient by B.
AB, BB, BC, OF_B = 8, 10, 11, 13
WEIGHTS = 15
# Where there are no bins: so large that nothing is left of what is divided by A.
FAR = 1e100


class GroupTable(NamedTuple):
    """Constants of a group of bins; K is padded to a multiple of `LANES`.

    Attributes
    ----------
    size : int
        Bins that count.
    denominator : (2, K) float
        The last polynomial of A, which is real, and the imaginary part of the one before; the first
        is 1.
    numerator, transient : (2 terms, K) float
        Real parts, then imaginary ones.
    products : (rows, K) float
        In blocks of `BLOCK`.
    blocks : (rows / BLOCK,) int
        Weight of each block.
    targets : (rows,) int
        Places in a flat (n, n + 1) matrix, above the diagonal, the gradient in the last column; one
        beyond its end for rows that fill a block.
    """

    size: int
    denominator: FloatArray
    numerator: FloatArray
    transient: FloatArray
    products: FloatArray
    blocks: IntArray
    targets: IntArray

    @classmethod
    def of(
        cls, group: BinGroup, sizes: tuple[int, int, int], order: IntArray | None = None
    ) -> GroupTable:
        """Of a group of a problem with so many free coefficients of A (two), B and C.

        Parameters
        ----------
        order : (size,) int, optional
            In which its bins stand, when not in their own.
        """
        size = group.size
        padded = -(-size // LANES) * LANES
        order = np.arange(size) if order is None else order
        empty = np.empty((size, 0), complex)
        polynomials, numerator, transient = (
            empty if basis is None else basis[order]
            for basis in (group.denominator, group.numerator, group.transient)
        )
        if (
            np.any(polynomials[:, 0] != 1)
            or polynomials[:, 1].real.any()
            or polynomials[:, 2].imag.any()
        ):
            raise ValueError("denominator: not 1, an imaginary and a real polynomial")
        blocks = (polynomials[:, :-1], numerator, transient)
        first = np.cumsum([0, *sizes])
        n = int(first[-1])
        by_weight: dict[int, list[tuple[int, FloatArray]]] = {}
        for weight, i, j, values in _products(blocks, first, n):
            if np.any(values):
                by_weight.setdefault(weight, []).append((i * (n + 1) + j, values))
        targets, rows, weights = [], [], []
        for weight, entries in sorted(by_weight.items()):
            filling = -len(entries) % BLOCK
            entries += [(n * (n + 1), np.zeros(size))] * filling
            targets += [target for target, _ in entries]
            rows += [values for _, values in entries]
            weights += [weight] * (len(entries) // BLOCK)
        denominator = _padded(np.stack([polynomials[:, 2].real, polynomials[:, 1].imag]), padded)
        denominator[0, size:] = FAR
        return cls(
            size,
            denominator,
            _padded(np.concatenate([numerator.real.T, numerator.imag.T]), padded),
            _padded(np.concatenate([transient.real.T, transient.imag.T]), padded),
            _padded(np.array(rows), padded),
            np.array(weights),
            np.array(targets),
        )


def interleaved(counts: IntArray) -> IntArray:
    """(sum counts,) places of values in pieces: the first ones of all pieces, then the second ones.

    Those by which the last piece is longer than the others come at the end.
    """
    rounds, pieces = int(counts[0]), counts.size
    whole = np.arange(rounds * pieces).reshape(pieces, rounds).T.ravel()
    return np.append(whole, np.arange(whole.size, counts.sum()))


def _products(
    blocks: tuple[ComplexArray, ...], first: IntArray, n: int
) -> Iterator[tuple[int, int, int, FloatArray]]:
    """Weight, row, column and values of what adds up to ``Re J^H J`` and the gradient."""
    weights = {(0, 0): AA, (0, 1): AB, (0, 2): AC, (1, 1): BB, (1, 2): BC, (2, 2): CC}
    for (one, other), weight in weights.items():
        for i, p in enumerate(blocks[one].T):
            for j, q in enumerate(blocks[other].T):
                product = p.conj() * q
                row, column = int(first[one]) + i, int(first[other]) + j
                if one != other:
                    yield weight, row, column, product.real
                    yield weight + 1, row, column, -product.imag
                elif row <= column:
                    yield weight, row, column, product.real
    for one, weight in enumerate((OF_A, OF_B, OF_C)):
        for i, p in enumerate(blocks[one].T):
            yield weight, int(first[one]) + i, n, p.real
            yield weight + 1, int(first[one]) + i, n, -p.imag


def _padded(rows: FloatArray, length: int) -> FloatArray:
    """(rows, length) with zeros behind."""
    out = np.zeros((rows.shape[0], length))
    out[:, : rows.shape[1]] = rows
    return out
