# SPDX-License-Identifier: Apache-2.0
"""Basis functions and values of bins in the blocks that the kernels of `likelihood` work on.

What numba compiles stands in `likelihood` alone: its cache looks at the date of that file.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba.core import event

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles import likelihood
from tactile_resonance.poles.likelihood import (
    BLOCK,
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

CACHE_LINE = 64  # bytes

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
    last : (blocks, 2, BLOCK) float
        Polynomial of A whose coefficient is 1: real and imaginary part.
    basis : (blocks, pairs, 2, BLOCK) float
        Real or imaginary parts of basis functions, those that are not 0 throughout: of polynomials of an
        imaginary variable every second one is. In pairs that add to the same row of the memory.
    row : (pairs,) int
        That row; less one and with a minus where nothing is there yet.
    place : (pairs, 2) int
        Which coefficient each belongs to, in the order C, A, B and 1.
    products : (blocks, pairs, 2, BLOCK) float
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
            _blocks([last.real, last.imag], blocks),
            _paired([pair for _, *pair in added], blocks),
            *_numbers(added),
            _paired([pair for _, *pair in pairs], blocks),
            *_numbers(pairs),
        )


def _paired(pairs: list[list[tuple[FloatArray, int]]], blocks: int) -> FloatArray:
    """(blocks, pairs, 2, BLOCK)."""
    rows = _blocks([values for pair in pairs for values, _ in pair], blocks)
    return rows.reshape(blocks, len(pairs), 2, BLOCK)


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
    """Basis functions on all bins, and the numbers of coefficients of A, B and C."""

    undriven: Part
    driven: Part
    a: int
    b: int
    c: int

    @classmethod
    def of(
        cls, denominator: ComplexArray, numerator: ComplexArray, transient: ComplexArray
    ) -> Tables:
        """Of bases (K, a + 1), (K_driven, b) and (K, c) with the undriven bins first."""
        first = denominator.shape[0] - numerator.shape[0]
        a, b, c = denominator.shape[1] - 1, numerator.shape[1], transient.shape[1]
        n = a + b + c
        undriven, driven = (
            Part.of(denominator[here, a], [transient[here], denominator[here, :a], *more], n)
            for here, more in ((slice(0, first), ()), (slice(first, None), (numerator,)))
        )
        return cls(undriven, driven, a, b, c)


def from_planes(blocks: FloatArray, undriven: int, driven: int) -> ComplexArray:
    """Complex values (points, M, K) of `planes`."""
    points, records, count = blocks.shape[:3]
    values = (blocks[..., 0, :] + 1j * blocks[..., 1, :]).reshape(points, records, count * BLOCK)
    first = -(-undriven // BLOCK) * BLOCK
    return np.concatenate([values[..., :undriven], values[..., first : first + driven]], axis=-1)


def in_blocks(values: Sequence[npt.NDArray], points: int = 1) -> FloatArray:
    """Real values (points, M or 1, K or 1) in blocks (points, M or 1, blocks, how many, BLOCK), filled with 1.

    One block of one for all bins where the last axis is 1 long; no block where there are no values.
    """
    if not values:
        return np.empty((points, 1, 0, 1, 1))
    shape, bins = values[0].shape[:-1], values[0].shape[-1]
    if bins == len(values) == 1:
        return np.ascontiguousarray(values[0], float)[..., None, None]
    if bins == 1:
        return np.ascontiguousarray(np.stack(values, axis=-2), float)[..., None, :, :]
    blocks = -(-bins // BLOCK)
    out = np.ones((*shape, blocks * BLOCK, len(values)))
    for k, value in enumerate(values):
        out[..., :bins, k] = value
    out = out.reshape(*shape, blocks, BLOCK, len(values))
    return np.ascontiguousarray(out.swapaxes(-1, -2))


@cache
def compiled() -> int:
    """How many kernels were not in the cache and had to be compiled, of those that fits call.

    About a minute of work, once per installation, which the log says before it begins.
    """
    with event.install_listener("numba:compile", _Notice()):
        _call_kernels()
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in likelihood.KERNELS)


class _Notice(event.Listener):
    """Says on the log that kernels are compiled, as the first of them begins."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: object) -> None:
        """Say it once."""
        if not self._said:
            logging.getLogger(__name__).warning(
                "compiling the pole fits, once per installation: about a minute; ahead of the first use: "
                "tactile_resonance compile"
            )
        self._said = True

    def on_end(self, event: object) -> None:
        """Nothing to say."""


def _call_kernels() -> None:
    """Call each kernel that a fit calls, on a little data."""
    bins, undriven = 4 * BLOCK, 3 * BLOCK
    s = 1j * np.linspace(0.8, 1.2, bins)
    one = np.ones((bins, 1), complex)
    tables = Tables.of(np.stack([one[:, 0], s, s**2 + 0.5], axis=-1), one[undriven:], one)
    rng = np.random.default_rng(0)
    u = rng.standard_normal((1, 1, bins, 2)).view(complex)[..., 0]
    y = u / (s**2 + 0.04 * s + 1)
    flat = in_blocks([np.ones((1, 1, 1))])
    order = np.arange(bins)
    data = likelihood.Arrays(
        likelihood.planes(y, order, undriven),
        likelihood.planes(u, order, undriven),
        flat,
        flat,
        flat,
        in_blocks([]),
    )
    theta, _ = likelihood.begin(tables, True, data, 1.0, BLOCK, 3)
    likelihood.linear_fit(tables, data, theta, likelihood.LINEAR)
    likelihood.undriven_powers(tables, data, theta, BLOCK, 3)
    likelihood.undriven_errors(tables, data, theta)
    likelihood.minimise(tables, data, theta, 2, 1e-2, 1e-14)
    inverse, _ = likelihood.invert(likelihood.moments(tables, data, theta)[2][:, 0, 1])
    modes = np.ones((1, 2, 2, bins - undriven))
    two = np.ones((bins - undriven, 2), complex)
    bases = (two, one[undriven:], one[undriven:])
    at, inverse = theta[:, 0, :3], inverse[:, :3, :3]
    likelihood.best_fall(tables, data, bases, at, inverse, np.ones(1), 9.0, two, modes)
