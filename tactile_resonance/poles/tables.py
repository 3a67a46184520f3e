# SPDX-License-Identifier: Apache-2.0
"""What fits of points on the same bins, or lines, share whatever the data: structure, bases, their tables.

The tables hold basis functions and their products in the blocks that the functions of `likelihood` work on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.compiled import compiled
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import SEVERAL_MODES, best_of_split, minimise
from tactile_resonance.poles.lacking import Directions
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
    Rules,
    Solution,
)
from tactile_resonance.poles.model import PolynomialBasis, RationalModel, Variable, modes_in_band
from tactile_resonance.poles.structure import ModelStructure

if TYPE_CHECKING:
    from typing_extensions import Self

# Of fits that are only compared: a mode too many, which no data determine, converges slowly and nowhere
# in particular.
COMPARISON = Rules(iterations=8)
# Weight of the products of two kinds of coefficients, of A, B and C in this order.
WEIGHTS = {
    (0, 0): ROW_AA,
    (0, 1): ROW_AB,
    (0, 2): ROW_AC,
    (1, 1): ROW_BB,
    (1, 2): ROW_BC,
    (2, 2): ROW_CC,
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
        Which coefficient each belongs to, in the order A, B, C and 1.
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
        """Of the last polynomial of A (K,), bases (K, terms) of A, B and C, and all coefficients."""
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
            row, weight = (ROW_A, ROW_B, ROW_C)[kind], (ROW_OF_A, ROW_OF_B, ROW_OF_C)[kind]
            for k, values in enumerate((f.real, f.imag)):
                if np.any(values):
                    by_row.setdefault(row + k, []).append((values, i))
            # a complex weight times the product, its real part
            products = [(weight, f, n)]
            for j, (g, its) in enumerate(functions[i:], i):
                products.append((WEIGHTS[kind, its], f.conj() * g, j))
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
        blocks = last.size // BLOCK
        values, rows, place, first = _in_pairs(by_row, n, blocks)
        both = _blocks([last.real, last.imag], blocks).reshape(blocks, 2 * BLOCK)
        of_products = _in_pairs(by_weight, n * (n + 1), blocks)[:3]
        return cls(bins, both, values, np.where(first, -1 - rows, rows), place, *of_products)


def _in_pairs(
    by_row: dict[int, list[tuple[FloatArray, int]]], nowhere: int, blocks: int
) -> tuple[FloatArray, IntArray, IntArray, BoolArray]:
    """(blocks, pairs, 2 BLOCK) values in pairs of one row, that row, places (pairs, 2), and which is the first.

    A last one that has no partner gets zeros, to be put `nowhere`.
    """
    rest = [(np.zeros(blocks * BLOCK), nowhere)]
    pairs = [
        (row, k, first, second)
        for row, entries in sorted(by_row.items())
        for k, (first, second) in enumerate(zip(entries[::2], entries[1::2] + rest, strict=False))
    ]
    values = _blocks([values for *_, first, second in pairs for values, _ in (first, second)], blocks)
    return (
        values.reshape(blocks, len(pairs), 2 * BLOCK),
        np.array([row for row, *_ in pairs], np.int64),
        np.array([[first[1], second[1]] for *_, first, second in pairs], np.int64).reshape(-1, 2),
        np.array([k == 0 for _, k, *_ in pairs], bool),
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

    @cached_property
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
        of_b = np.append(np.zeros((first, b), complex), self.numerator, axis=0)
        undriven, driven = (
            Part.of(of_a[:, a], [of_a[:, :a], of_b, of_c], n)
            for of_a, of_b, of_c in (
                (x[part] for x in (self.denominator, of_b, self.transient))
                for part in (slice(first), slice(first, None))
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
        alpha = np.empty((*theta.shape[:-1], a + 1))
        alpha[..., :a], alpha[..., a] = theta[..., :a], 1.0
        return (
            alpha,
            np.ascontiguousarray(theta[..., a : a + b]),
            np.ascontiguousarray(theta[..., a + b :]),
        )

    def response(self, theta: FloatArray) -> ComplexArray:
        """(batch, K_driven) B / A of coefficients (batch, n)."""
        alpha, beta, _ = self.split(theta)
        return np.asarray(beta @ self.numerator.T / (alpha @ self.denominator[self.undriven :].T))


class FitPlan(ABC):
    """Bases on which points are fitted: of all bins of a band (`joint`), or of lines (`lines`).

    Attributes
    ----------
    structure : ModelStructure
    band_hz : (low, high)
    weights : pair of float arrays, or None
        In which the bases of A, on all bins, and of B, on the driven ones, are orthonormal.
    """

    structure: ModelStructure
    band_hz: tuple[float, float]
    weights: tuple[FloatArray, FloatArray] | None = None

    @property
    @abstractmethod
    def frequency_hz(self) -> FloatArray:
        """(K,) of all bins, or lines."""

    @property
    def excited_at(self) -> IntArray | slice:
        """Places of the driven bins that are used among all."""
        return slice(None)

    @cached_property
    def variable(self) -> Variable:
        """Of the polynomials."""
        return Variable.for_lines(self.frequency_hz, self.structure)

    @cached_property
    def x(self) -> ComplexArray:
        """(K,) the variable on all bins."""
        return self.variable.of_frequency(self.frequency_hz)

    @cached_property
    def denominator_basis(self) -> PolynomialBasis:
        """Of A."""
        return PolynomialBasis.on_lines(self.x, self.structure.order, self.weights and self.weights[0])

    @cached_property
    def numerator_basis(self) -> PolynomialBasis:
        """Of B."""
        x, degree = self.x[self.excited_at], self.structure.numerator_order
        return PolynomialBasis.on_lines(x, degree, self.weights and self.weights[1])

    @property
    @abstractmethod
    def problem(self) -> Problem:
        """What the fit is made of."""

    @cached_property
    def directions(self) -> Directions:
        """What a richer model has in addition, on the driven bins."""
        driven = self.excited_at
        return Directions.on_lines(
            self.frequency_hz[driven], self.x[driven], self.structure.numerator_order
        )

    @abstractmethod
    def with_structure(self, structure: ModelStructure) -> Self | None:
        """The plan of another structure; None where there are too few lines for it."""

    @cached_property
    def richer(self) -> Self | None:
        """With one mode more and as many residual terms; None where there are too few lines for it."""
        return self._with_more(2)

    @cached_property
    def poorer(self) -> Self | None:
        """With one mode less and as many residual terms; None where the model has none to spare."""
        return self._with_more(-2)

    def _with_more(self, poles: int) -> Self | None:
        of = self.structure
        order, numerator_order = of.order + poles, of.numerator_order + poles
        if order < 1 or numerator_order < 0:
            return None
        return self.with_structure(replace(of, order=order, numerator_order=numerator_order))

    def model_of(self, theta: FloatArray) -> RationalModel:
        """The model of coefficients (..., n)."""
        coefficients, bases = self.problem.split(theta), (self.denominator_basis, self.numerator_basis)
        return RationalModel(*coefficients, self.variable, *bases)

    def poles_in_band(self, theta: FloatArray) -> ComplexArray:
        """(batch, places) poles [rad/s] of coefficients (batch, n)."""
        roots = self.denominator_basis.roots(self.problem.split(theta)[0])
        return modes_in_band(self.variable.to_s(roots), self.band_hz)

    def compared(self, data: BinData, start: FloatArray | None = None) -> ComplexArray:
        """Poles (points, places) of a fit of few iterations that others are compared with."""
        return self.poles_in_band(minimise(self.problem, data, start, COMPARISON).theta[:, 0])

    def batched(self, data: BinData) -> tuple[Self, Solution]:
        """Compiled fit of all points, and the plan of its coefficients, which may have other bases.

        What does not converge stays as it is: a mode that the data do not determine costs full precision
        more than all else, and ends in one of many minima.
        """
        solution = minimise(self.problem, data)
        if self.structure.order >= SEVERAL_MODES:
            solution = best_of_split(self, data, solution)
        return self, solution
