# SPDX-License-Identifier: Apache-2.0
"""What the kernels of one mode know of a group of bins, and how numba compiles them.

All of a group stands in one flat memory of rows `STRIDE` apart: so the compiler sees that no row meets
another, and makes vector instructions of whole loops. Complex numbers are pairs of rows.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt
from numba import njit

from tactile_resonance.identification.kernel_tables import WEIGHTS, GroupTable

OPTIONS: dict[str, Any] = {
    # Sums may be reordered, NaN and infinity keep their meaning.
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
    "error_model": "numpy",
    # Nothing is allocated in a kernel, and nobody counts who holds an array: that took a sixth of a
    # fit. numba has no public name for it; setup.py says for which versions this one holds.
    "_nrt": False,
}
compiled = njit(**OPTIONS)
inlined = njit(forceinline=True, **OPTIONS)

MOST_BINS = 4096
# Not a power of two, but an odd number of cache lines beyond: rows do not share places in the cache.
STRIDE = MOST_BINS + 37 * 8
# Rows: polynomials of A, the last one and the imaginary part of the one before (the first is 1); Y and
# U; B and C; the error and what it is weighted with; the variance of Y; then the weights of
# `kernel_tables`.
LAST_ROW, SLOPE_ROW, Y_ROW, U_ROW, B_ROW, C_ROW, E_ROW, V_ROW, S_ROW = (
    0, 1, 2, 4, 6, 8, 10, 12, 13,
)  # fmt: skip
FIRST_WEIGHT = 14
ROWS = FIRST_WEIGHT + WEIGHTS
LAST, SLOPE, Y, U, B, C, E, V, S = (
    row * STRIDE for row in (LAST_ROW, SLOPE_ROW, Y_ROW, U_ROW, B_ROW, C_ROW, E_ROW, V_ROW, S_ROW)
)
IM = STRIDE


def fingerprint(*modules: ModuleType) -> int:
    """Of the sources of modules: numba's cache of a function watches its own file, and values like this."""
    return crc32(b"".join(Path(str(m.__file__)).read_bytes() for m in modules))


def prepared(table: GroupTable) -> npt.NDArray[np.float64]:
    """Memory (ROWS, STRIDE) of a group, with its constants, without data; weights and variances are 1."""
    memory = np.empty((ROWS, STRIDE))
    bins = table.denominator.shape[1]
    memory[LAST_ROW : SLOPE_ROW + 1, :bins] = table.denominator
    memory[Y_ROW:E_ROW, :bins] = 0.0
    memory[V_ROW : S_ROW + 1, :bins] = 1.0
    return memory


@compiled
def fill(memory, row, value, bins):
    """Set a row."""
    for k in range(bins):
        memory[row, k] = value


@compiled
def combine(memory, row, basis, theta, first):
    """Set B or C to ``sum_i theta[first + i] basis_i``."""
    terms, bins = basis.shape[0] // 2, basis.shape[1]
    if terms == 1:
        p = theta[first]
        for k in range(bins):
            memory[row, k], memory[row + 1, k] = p * basis[0, k], p * basis[1, k]
        return
    p, q = theta[first], theta[first + 1]
    for k in range(bins):
        memory[row, k] = p * basis[0, k] + q * basis[1, k]
        memory[row + 1, k] = p * basis[terms, k] + q * basis[terms + 1, k]
    for i in range(2, terms - 1, 2):
        p, q = theta[first + i], theta[first + i + 1]
        for k in range(bins):
            memory[row, k] += p * basis[i, k] + q * basis[i + 1, k]
            memory[row + 1, k] += p * basis[terms + i, k] + q * basis[terms + i + 1, k]
    if terms % 2 == 1:
        p = theta[first + terms - 1]
        for k in range(bins):
            memory[row, k] += p * basis[terms - 1, k]
            memory[row + 1, k] += p * basis[2 * terms - 1, k]


@compiled
def power(memory, row, bins):
    """Sum of squared moduli of a row and the next."""
    total = 0.0
    for k in range(bins):
        total += memory[row, k] * memory[row, k] + memory[row + 1, k] * memory[row + 1, k]
    return total
