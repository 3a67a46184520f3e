# SPDX-License-Identifier: Apache-2.0
"""Basis functions of the model on bins, in the blocks that the functions of `likelihood` work on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.compiled import compiled
from tactile_resonance.poles.likelihood import (
    BLOCK,
    CACHE_LINE,
    ROW_A,
    ROW_AA,
    ROW_AB,
    ROW_AC,
    ROW_B,
    ROW_BB,
    ROW_BC,
    ROW_C,
    ROW_CC,
    ROW_OF_A,
    ROW_OF_B,
    ROW_OF_C,
)

# Weight of the products of two kinds of coefficients, of C, A and B in this order.
WEIGHTS = {
    (0, 0): ROW_CC,
    (0, 1): ROW_AC,
    (0, 2): ROW_BC,
    (1, 1): ROW_AA,
    (1, 2): ROW_AB,
    (2, 2): ROW_BB,
}


class Part(NamedTuple):
    """Undriven or driven bins in blocks, the last one filled up with bins that add nothing.

    Attributes
    ----------
    bins : int
    last : (blocks, 2 BLOCK) float
        Polynomial of A whose coefficient is 1: real and imaginary part.
    basis : (blocks, pairs, 2 BLOCK) float
        Real or imaginary parts of basis functions, those that are not 0 throughout: of polynomials of an
        imaginary variable every second one is. In pairs that add to the same row of the memory.
    row : (pairs,) int
        That row; less one and with a minus where nothing is there yet.
    place : (pairs, 2) int
        Which coefficient each belongs to, in the order C, A, B and 1.
    products : (blocks, pairs, 2 BLOCK) float
        Products of basis functions, real or imaginary parts, in pairs with the same weight.
    weight : (pairs,) int
        Its row in the memory.
    target : (pairs, 2) int
        Where each sum goes in a flat (n, n + 1) matrix: above the diagonal, the gradient in the last
        column; one beyond the end for a row that fills a pair.
    """

    bins: int
    last: FloatArray
    basis: FloatArray
    row: IntArray
    place: IntArray
    products: FloatArray
    weight: IntArray
    target: IntArray

    @classmethod
    def of(cls, last: ComplexArray, bases: Sequence[ComplexArray], n: int) -> Part:
        """Of the last polynomial of A (K,), bases (K, terms) of C, A and B, and all coefficients."""
        bins, empty = last.size, -last.size % BLOCK
        last = np.append(last, np.ones(empty))
        functions = [
            (np.append(f, np.zeros(empty)), kind)
            for kind, basis in enumerate(bases)
            for f in basis.T
        ]
        by_row: dict[int, list[tuple[FloatArray, int]]] = {ROW_A: [], ROW_A + 1: []}
        by_weight: dict[int, list[tuple[FloatArray, int]]] = {}
        for i, (f, kind) in enumerate(functions):
            row, weight = (ROW_C, ROW_A, ROW_B)[kind], (ROW_OF_C, ROW_OF_A, ROW_OF_B)[kind]
            for k, values in enumerate((f.real, f.imag)):
                if np.any(values):
                    by_row.setdefault(row + k, []).append((values, i))
            # a complex weight times the product, its real part
            products = [(weight, f, n)]
            for j, (g, its) in enumerate(functions[i:], i):
                backwards = kind == 0 and its > 0  # weights are of conj(A) C and conj(B) C
                products.append(
                    (WEIGHTS[kind, its], f * g.conj() if backwards else f.conj() * g, j)
                )
            for weight, values, j in products:
                parts = (
                    [values.real]
                    if weight in (ROW_AA, ROW_BB, ROW_CC)
                    else [values.real, -values.imag]
                )
                for k, part in enumerate(parts):
                    if np.any(part):
                        by_weight.setdefault(weight + k, []).append((part, i * (n + 1) + j))
        for k, values in enumerate((last.real, last.imag)):
            by_row[ROW_A + k].append((values, n))
        zeros, blocks = np.zeros(last.size), last.size // BLOCK
        added = [
            (-1 - row if k == 0 else row, *pair)
            for row, entries in by_row.items()
            for k, pair in enumerate(zip(entries[::2], [*entries[1::2], (zeros, n)], strict=False))
        ]
        pairs = [
            (weight, *pair)
            for weight, entries in sorted(by_weight.items())
            for pair in zip(entries[::2], [*entries[1::2], (zeros, n * (n + 1))], strict=False)
        ]
        return cls(
            bins,
            _blocks([last.real, last.imag], blocks).reshape(blocks, 2 * BLOCK),
            _paired([pair for _, *pair in added], blocks),
            *_numbers(added),
            _paired([pair for _, *pair in pairs], blocks),
            *_numbers(pairs),
        )


def _paired(pairs: list[list[tuple[FloatArray, int]]], blocks: int) -> FloatArray:
    """(blocks, pairs, 2 BLOCK)."""
    rows = _blocks([values for pair in pairs for values, _ in pair], blocks)
    return rows.reshape(blocks, len(pairs), 2 * BLOCK)


def _numbers(pairs: list[tuple]) -> tuple[IntArray, IntArray]:
    """(pairs,) first entries, (pairs, 2) last entries of both."""
    return (
        np.array([first for first, *_ in pairs], np.int64),
        np.array([[place for _, place in pair] for _, *pair in pairs], np.int64).reshape(-1, 2),
    )


def _blocks(rows: list[FloatArray], blocks: int) -> FloatArray:
    """(blocks, rows, BLOCK) of rows (blocks BLOCK,)."""
    values = np.array(rows, float).reshape(len(rows), blocks, BLOCK)
    # from a multiple of a cache line on: vectors as long as one would otherwise be read in two halves
    memory = np.empty(values.nbytes + CACHE_LINE, np.uint8)
    first = -memory.ctypes.data % CACHE_LINE
    aligned = memory[first : first + values.nbytes].view(float).reshape(blocks, len(rows), BLOCK)
    aligned[:] = values.swapaxes(0, 1)
    return aligned


class Tables(NamedTuple):
    """Basis functions on all bins, and the numbers of coefficients of A, B and C.

    Attributes
    ----------
    from_driven : bool
        Whether the driven bins hold equations enough for start values. Of a record of many periods they are
        a small part of all bins, and the most informative one.
    """

    undriven: Part
    driven: Part
    a: int
    b: int
    c: int
    from_driven: bool


@dataclass(frozen=True, eq=False)
class Problem:
    """Basis functions on K bins, the undriven ones first.

    Attributes
    ----------
    denominator : (K, a + 1) complex
        The last coefficient of A is fixed at 1.
    numerator : (K_driven, b) complex
    transient : (K, c) complex
        Of no terms where there is no transient.
    """

    denominator: ComplexArray
    numerator: ComplexArray
    transient: ComplexArray

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of free coefficients of A, B and C."""
        a, b, c = (x.shape[1] for x in (self.denominator, self.numerator, self.transient))
        return a - 1, b, c

    @property
    def undriven(self) -> int:
        """Number of bins without input."""
        return int(self.denominator.shape[0] - self.numerator.shape[0])

    @cached_property
    def tables(self) -> Tables:
        """For `likelihood`."""
        compiled()  # here and not in the first fit, whose time may matter
        first, (a, b, c) = self.undriven, self.sizes
        n = a + b + c
        undriven, driven = (
            Part.of(of_a[:, a], [of_c, of_a[:, :a], *of_b], n)
            for of_a, of_c, *of_b in (
                (self.denominator[:first], self.transient[:first]),
                (self.denominator[first:], self.transient[first:], self.numerator),
            )
        )
        return Tables(undriven, driven, a, b, c, first > 0 and self.numerator.shape[0] >= n)

    @property
    def driven_bases(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Of A, B and C on the driven bins."""
        driven = slice(self.undriven, None)
        return self.denominator[driven], self.numerator, self.transient[driven]

    def split(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of A (with its last), B and C, each (..., terms), of theta (..., n)."""
        a, b, _ = self.sizes
        one = np.ones((*theta.shape[:-1], 1))
        return (
            np.concatenate([theta[..., :a], one], axis=-1),
            np.ascontiguousarray(theta[..., a : a + b]),
            np.ascontiguousarray(theta[..., a + b :]),
        )

    def response(self, theta: FloatArray) -> ComplexArray:
        """(batch, K_driven) B / A of coefficients (batch, n)."""
        alpha, beta, _ = self.split(theta)
        return np.asarray(beta @ self.numerator.T / (alpha @ self.denominator[self.undriven :].T))
