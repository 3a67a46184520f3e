# SPDX-License-Identifier: Apache-2.0
"""The cost of ``Y = (B U + C) / A`` on bins, for (points, records, bins), and its minimum, compiled by numba.

A record has undriven bins, on which there is only a transient C and noise, and then driven ones:

    cost = sum_undriven |Y - C/A|^2 / s_rest^2
         + sum_driven |Y - (B U + C)/A|^2 / (s_Y^2 + s_U^2 |B/A|^2 - 2 Re(s_YU conj(B/A)))

(Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012), sections
8.3, 9.11 and 12.3). The records of a point share A and B; each has a C of its own. An FRF is one record
of driven bins with U = 1 and without C.

Derivatives of the error are basis functions times one complex factor for A, one for B, one for C. So the
normal matrix ``Re J^H J`` and the gradient are sums over bins of products of two basis functions, which
are computed once (`tables.Tables`), times weights that all coefficients of a kind share (`_weigh_driven`
and its neighbours). The gradient is exact; the normal matrix leaves out the derivative of the variance,
which is smaller by the signal-to-noise ratio of the input.

Points are fitted some side by side (`GROUP`), so that a block of basis functions is read from the cache once
for all of them; each goes its own way.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.poles.compiled import entry, inner

if TYPE_CHECKING:
    from tactile_resonance.poles.data import BinData
    from tactile_resonance.poles.tables import Tables

BLOCK = 48
"""Bins taken together: a multiple of the vectors of all processors, and few enough for the cache."""
CACHE_LINE = 64  # bytes
GROUP = 16
"""Records that are fitted side by side."""

# Rows of a block in the memory of a kernel: real parts of A, B, C, the error E, and behind each the
# imaginary ones; one over the variance of E.
ROW_A, ROW_B, ROW_C, ROW_E, ROW_V = 0, 2, 4, 6, 8
ROW_POWER = ROW_V  # |E|^2 of undriven bins
# Then weights, in the order of their rows, complex ones real part first. With X = Y - E and w = 1 / (|A|^2
# v): w |X|^2, -w conj(X), w; the gradient by A, and minus that by C. With an input: -w conj(X) U, w |U|^2,
# w conj(U); minus the gradient by B.
ROW_AA, ROW_AC, ROW_CC, ROW_OF_A, ROW_OF_C, ROW_AB, ROW_BB, ROW_BC, ROW_OF_B = (
    9,
    10,
    12,
    13,
    15,
    17,
    19,
    20,
    22,
)
ROWS = 24

# Rows of a block of data, real parts first: Y, U; then of undriven bins one over the variance of Y, of driven
# ones the variances of Y and U and their covariance.
Y, U, INVERSE, VARIANCE_Y, VARIANCE_U, COVARIANCE = 0, 2, 4, 4, 5, 6
PLANES = 8

# What is linearised: the error, or ``A Y - B U - C`` over |A| or over 1 (Sanathanan-Koerner iterations).
EXACT, LINEAR, LINEAR_UNWEIGHTED = 0, 1, 2

TINY = float(np.finfo(float).tiny)
MOST_INVERTED = 1 / float(np.finfo(float).eps)
"""Condition of a matrix of which rounding leaves nothing of the inverse."""
# A step is the last one where the next would be smaller than so many deviations, as the residuals show them.
STEP_TOLERANCE = 1e-2
# Rounding of a residual relative to the data it is the residual of.
ROUNDING = 1e-14
MOST_DAMPING = 1e10
LEAST_DAMPING = 1e-3
# A step is the last one, too, where the next one would be smaller than the tolerance by this factor, should
# steps go on to become shorter as they did.
SURELY = 0.1
FEWEST_PIECES = 4
"""Fewer pieces of undriven bins are not tested for equal powers."""


class Rules(NamedTuple):
    """How points are fitted.

    Attributes
    ----------
    iterations : int
        Most steps tried.
    pieces, size : int
        Of the undriven bins: how many pieces, of how many bins, the last one longer. With no piece the data
        bring their variances; else their undriven bins show them, where these are flat noise.
    chance : float
        Squared correlation of errors and inputs on undriven bins beyond which the input is taken for exact:
        what is seen there has come through the system then.
    flat : float
        Largest ``log mean - mean log`` of the variances of pieces that is flat.
    """

    iterations: int = 60
    pieces: int = 0
    size: int = 0
    chance: float = 0.0
    flat: float = 0.0


class Solution(NamedTuple):
    """Coefficients of points.

    Attributes
    ----------
    theta : (points, M, n) float
        Coefficients [A without its last, B, C] of each record; A and B are alike in all.
    cost : (points,) float
    part_cost : (points, 2) float
        Of undriven and driven bins.
    residual : (points, M, K_driven) complex
        Weighted errors, turned by the phase of the input: errors of a response are smooth over lines,
        those of Y only after this, for the phases of the excitation are random.
    converged : (points,) bool
    normal : (points, M, 2, n, n) float
        ``Re J^H J`` of undriven and of driven bins, where the last step began; empty for single records.
    marginal : (points, M, n, n) float
        Blocks of the inverse of the normal matrix: of the coefficients that records share and those of one;
        NaN where it is singular or not finite.
    condition : (points,) float
        Root of the Frobenius condition number of the normal matrix with unit diagonal: that of a Jacobian with
        unit columns, within a factor n. Infinite where there is no inverse.
    leverage : (points, 2) float
        Real coefficients that go to undriven and to driven bins.
    noise : (points, 2) float
        Variances of Y and U that undriven bins show; NaN where they were not asked for.
    plain : (points,) bool
        False where undriven bins show noise other than flat, or alike in both channels: not fitted yet.
    """

    theta: FloatArray
    cost: FloatArray
    part_cost: FloatArray
    residual: ComplexArray
    converged: BoolArray
    normal: FloatArray
    marginal: FloatArray
    condition: FloatArray
    leverage: FloatArray
    noise: FloatArray
    plain: BoolArray

    @classmethod
    def empty(cls, points: int, records: int, n: int, driven: int) -> Solution:
        """Room for so many points, records, coefficients of each and driven bins."""
        return cls(
            np.empty((points, records, n)),
            np.empty(points),
            np.empty((points, 2)),
            np.empty((points, records, driven), complex),
            np.zeros(points, bool),
            np.empty((points if records > 1 else 0, records, 2, n, n)),
            np.empty((points, records, n, n)),
            np.empty(points),
            np.empty((points, 2)),
            np.full((points, 2), np.nan),
            np.ones(points, bool),
        )

    def rows(self, which: npt.NDArray) -> Solution:
        """Some of the points."""
        return Solution._make(x[which] if len(x) else x for x in self)

    def put(self, which: npt.NDArray, others: Solution) -> None:
        """Write other solutions in place of some; what undriven bins show stays as it was found."""
        for name, here, there in zip(self._fields, self, others, strict=True):
            if name not in ("noise", "plain") and here.size:
                here[which] = there

    def inverse(self, shared: int) -> FloatArray:
        """(points, s + M c, s + M c) of the normal matrix of all coefficients; NaN where `marginal` is."""
        if self.theta.shape[1] == 1:
            return self.marginal[:, 0]
        half = half_inverse(_of_all(self.normal.sum(axis=2), shared))
        return half.swapaxes(-1, -2) @ half

    def sandwich(self, normal: FloatArray, shared: int) -> FloatArray:
        """(points, s, s) of the shared coefficients, of gradients with covariances (points, M, n, n)."""
        half = half_inverse(_of_all(self.normal.sum(axis=2), shared))
        return sandwich(half, _of_all(normal, shared))[:, :shared, :shared]


def _of_all(normal: FloatArray, shared: int) -> FloatArray:
    """(points, s + M c, s + M c) of all coefficients from (points, M, n, n) of those of each record."""
    points, records, n = normal.shape[:3]
    own = n - shared
    whole = np.zeros((points, *2 * [shared + records * own]))
    whole[:, :shared, :shared] = normal[:, :, :shared, :shared].sum(axis=1)
    for m in range(records):
        here = slice(shared + m * own, shared + (m + 1) * own)
        whole[:, here, :shared] = normal[:, m, shared:, :shared]
        whole[:, :shared, here] = normal[:, m, :shared, shared:]
        whole[:, here, here] = normal[:, m, shared:, shared:]
    return whole


def half_inverse(matrices: FloatArray) -> FloatArray:
    """Matrices H (batch, n, n) whose ``H^T H`` are the inverses of positive definite ones.

    NaN where one is not positive definite to rounding. What stands between two inverses is to be taken between
    H and ``H^T`` first, where it is about a unit matrix: else what is small beside the largest variance is lost
    to rounding.
    """
    scale = 1 / np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))[:, None]  # (batch, 1, n)
    with suppress(np.linalg.LinAlgError):
        return np.linalg.inv(np.linalg.cholesky(matrices * (scale * scale.swapaxes(1, 2)))) * scale
    if len(matrices) == 1:
        return np.full(matrices.shape, np.nan)
    # one fails all: it is looked for by halves
    return np.concatenate([half_inverse(part) for part in np.array_split(matrices, 2)])


def sandwich(half: FloatArray, middle: FloatArray) -> FloatArray:
    """(batch, n, n) ``H^T H middle H^T H`` of a `half_inverse`."""
    across = half.swapaxes(-1, -2)
    return across @ (half @ middle @ across) @ half


class _Work(NamedTuple):
    """Memory of G points of M records, in b blocks of undriven, then of driven bins.

    Attributes
    ----------
    values : (G, M, b, PLANES BLOCK) float
        Data of blocks, the rows of each one after the other.
    rows, flat : (ROWS, BLOCK) and (ROWS BLOCK,) float
        Of a block, the same memory.
    power : (G, 2, b_undriven, BLOCK) float
        Squared moduli of errors and of inputs, sums over records.
    cross : (G, 2) float
        Sum of ``error conj(u)`` over undriven bins.
    at, trial : (G, M, n + 1) float
        Coefficients [A without its last, B, C], and 1.
    gram, there : (G, M, 2, n (n + 1) + 1) float
        Normal matrices with half the gradients of undriven and driven bins, flat (n, n + 1) matrices; at
        `at` and at `trial`.
    cost, then : (G, 2) float
        Of undriven and driven bins at either.
    systems : (M, n, n + 1, G) float
    shared : (n - c, n - c + 1, G) float
    step : (M, n, G) float
    fall : (G,) float
    """

    values: FloatArray
    rows: FloatArray
    flat: FloatArray
    power: FloatArray
    cross: FloatArray
    at: FloatArray
    trial: FloatArray
    gram: FloatArray
    there: FloatArray
    cost: FloatArray
    then: FloatArray
    systems: FloatArray
    shared: FloatArray
    step: FloatArray
    fall: FloatArray


@inner
def _aligned(size):
    """Zeros from a multiple of a cache line on, so that vectors as long as one are not read in two halves."""
    memory = np.zeros(size + CACHE_LINE // 8)
    first = -memory.ctypes.data % CACHE_LINE // 8
    return memory[first : first + size]


@inner
def _memory(tables, points, records):
    """Memory for so many points."""
    c, n = tables.c, tables.a + tables.b + tables.c
    undriven = tables.undriven.last.shape[0]
    blocks = undriven + tables.driven.last.shape[0]
    flat, size = _aligned(ROWS * BLOCK), points * records * blocks * PLANES * BLOCK
    values = _aligned(size).reshape(points, records, blocks, PLANES * BLOCK)
    values[..., INVERSE * BLOCK : (INVERSE + 1) * BLOCK] = 1.0  # of what blocks are filled up with
    size = n * (n + 1) + 1
    return _Work(
        values,
        flat.reshape(ROWS, BLOCK),
        flat,
        np.zeros((points, 2, undriven, BLOCK)),
        np.zeros((points, 2)),
        np.ones((points, records, n + 1)),
        np.ones((points, records, n + 1)),
        np.zeros((points, records, 2, size)),
        np.zeros((points, records, 2, size)),
        np.zeros((points, 2)),
        np.zeros((points, 2)),
        _aligned(records * n * (n + 1) * points).reshape(records, n, n + 1, points),
        _aligned((n - c) * (n - c + 1) * points).reshape(n - c, n - c + 1, points),
        _aligned(records * n * points).reshape(records, n, points),
        np.zeros(points),
    )


@inner
def _load(data, point, values, power):
    """Bring a point into memory, and the power of its inputs. What blocks are filled up with adds nothing."""
    order, undriven, same = data.order, data.undriven, min(point, data.u.shape[0] - 1)
    before = -(-undriven // BLOCK)
    for m in range(values.shape[0]):
        y, u = data.y[point, m], data.u[same, m]
        for block in range(values.shape[1]):
            of, first, end = values[m, block], BLOCK * block, undriven
            if block >= before:
                first, end = undriven + BLOCK * (block - before), order.size
            for k in range(min(BLOCK, end - first)):
                place = np.uint64(order[first + k])  # without a sign: none counts from the end
                of[Y * BLOCK + k], of[(Y + 1) * BLOCK + k] = y[place].real, y[place].imag
                of[U * BLOCK + k], of[(U + 1) * BLOCK + k] = u[place].real, u[place].imag
        _load_noise(data, point, before, values[m])
    power[:] = 0.0
    for m in range(values.shape[0]):
        for block in range(before):
            of, to = values[m, block], power[block]
            for k in range(BLOCK):
                re, im = of[U * BLOCK + k], of[(U + 1) * BLOCK + k]
                to[k] += re * re + im * im


@inner
def _load_noise(data, point, before, values):
    """Bring the variances of a point into memory."""
    both = data.covariance_yu[point]
    _fill(values[:before], INVERSE, 1 / data.rest[point], data.undriven)
    driven = data.order.size - data.undriven
    _fill(values[before:], VARIANCE_Y, data.variance_y[point], driven)
    _fill(values[before:], VARIANCE_U, data.variance_u[point], driven)
    _fill(values[before:], COVARIANCE, both.real, driven)
    _fill(values[before:], COVARIANCE + 1, both.imag, driven)


@inner
def _fill(values, row, entries, bins):
    """A row of blocks, of entries for each of the bins, of one for all, or of none."""
    if entries.size == 1:
        values[:, row * BLOCK : (row + 1) * BLOCK] = entries[0]
    elif entries.size > 1:
        for k in range(bins):
            values[k // BLOCK, row * BLOCK + k % BLOCK] = entries[k]


@inner
def _combine(basis, row, place, theta, linear, flat):
    """A, B and C of a block; of a linear kind A alone."""
    for i in range(row.size):
        to, more = row[i], row[i] >= 0
        if not more:
            to = -1 - to
        if linear and to >= ROW_B:
            continue
        first, second, of = theta[place[i, 0]], theta[place[i, 1]], basis[i]
        to *= BLOCK
        if more:
            for k in range(BLOCK):
                flat[to + k] += first * of[k] + second * of[BLOCK + k]
        else:
            for k in range(BLOCK):
                flat[to + k] = first * of[k] + second * of[BLOCK + k]


@inner
def _weigh_linear(of, last, driven, weighted, flat):
    """Weights of ``A Y - B U - C`` over ``|A|``, or over 1, with the derivatives at 0."""
    for k in range(BLOCK):
        w = 1 / of[VARIANCE_Y * BLOCK + k] if driven else of[INVERSE * BLOCK + k]
        if weighted:
            re, im = flat[ROW_A * BLOCK + k], flat[(ROW_A + 1) * BLOCK + k]
            w /= re * re + im * im
        l_re, l_im = last[k], -last[BLOCK + k]
        y_re, y_im = of[Y * BLOCK + k], of[(Y + 1) * BLOCK + k]
        u_re, u_im = of[U * BLOCK + k], of[(U + 1) * BLOCK + k]
        squared, x_re, x_im = w * (y_re * y_re + y_im * y_im), -w * y_re, w * y_im
        z_re, z_im = x_re * l_re - x_im * l_im, x_re * l_im + x_im * l_re
        flat[ROW_AA * BLOCK + k] = squared
        flat[ROW_AC * BLOCK + k], flat[(ROW_AC + 1) * BLOCK + k] = x_re, x_im
        flat[ROW_CC * BLOCK + k] = w
        flat[ROW_OF_A * BLOCK + k] = squared * l_re
        flat[(ROW_OF_A + 1) * BLOCK + k] = squared * l_im
        flat[ROW_OF_C * BLOCK + k], flat[(ROW_OF_C + 1) * BLOCK + k] = z_re, z_im
        flat[ROW_AB * BLOCK + k] = x_re * u_re - x_im * u_im
        flat[(ROW_AB + 1) * BLOCK + k] = x_re * u_im + x_im * u_re
        flat[ROW_BB * BLOCK + k] = w * (u_re * u_re + u_im * u_im)
        flat[ROW_BC * BLOCK + k], flat[(ROW_BC + 1) * BLOCK + k] = w * u_re, -w * u_im
        flat[ROW_OF_B * BLOCK + k] = z_re * u_re - z_im * u_im
        flat[(ROW_OF_B + 1) * BLOCK + k] = z_re * u_im + z_im * u_re


@inner
def _weigh_undriven(of, flat):
    """Weights of undriven bins, and the power of their errors; their cost, and sum of ``error conj(u)``."""
    cost = both_re = both_im = 0.0
    for k in range(BLOCK):
        re, im = flat[ROW_A * BLOCK + k], flat[(ROW_A + 1) * BLOCK + k]
        c_re, c_im = flat[ROW_C * BLOCK + k], flat[(ROW_C + 1) * BLOCK + k]
        u_re, u_im = of[U * BLOCK + k], of[(U + 1) * BLOCK + k]
        squared = 1 / (re * re + im * im)
        m_re, m_im = squared * (c_re * re + c_im * im), squared * (c_im * re - c_re * im)
        e_re, e_im = of[Y * BLOCK + k] - m_re, of[(Y + 1) * BLOCK + k] - m_im
        v = of[INVERSE * BLOCK + k]
        w = v * squared
        z_re, z_im = w * (e_re * re - e_im * im), -w * (e_re * im + e_im * re)
        own = e_re * e_re + e_im * e_im
        cost += v * own
        flat[ROW_POWER * BLOCK + k] = own
        both_re += e_re * u_re + e_im * u_im
        both_im += e_im * u_re - e_re * u_im
        flat[ROW_AA * BLOCK + k] = w * (m_re * m_re + m_im * m_im)
        flat[ROW_AC * BLOCK + k], flat[(ROW_AC + 1) * BLOCK + k] = -w * m_re, w * m_im
        flat[ROW_CC * BLOCK + k] = w
        flat[ROW_OF_A * BLOCK + k] = z_re * m_re - z_im * m_im
        flat[(ROW_OF_A + 1) * BLOCK + k] = z_re * m_im + z_im * m_re
        flat[ROW_OF_C * BLOCK + k], flat[(ROW_OF_C + 1) * BLOCK + k] = -z_re, -z_im
    return cost, both_re, both_im


@inner
def _weigh_driven(of, flat):
    """Errors and weights of a block of driven bins; its cost.

    The variance of the error depends on the response: the gradient has its derivative too.
    """
    cost = 0.0
    for k in range(BLOCK):
        re, im = flat[ROW_A * BLOCK + k], flat[(ROW_A + 1) * BLOCK + k]
        squared = 1 / (re * re + im * im)
        i_re, i_im = re * squared, -im * squared
        b_re, b_im = flat[ROW_B * BLOCK + k], flat[(ROW_B + 1) * BLOCK + k]
        g_re, g_im = b_re * i_re - b_im * i_im, b_re * i_im + b_im * i_re
        u_re, u_im = of[U * BLOCK + k], of[(U + 1) * BLOCK + k]
        c_re, c_im = flat[ROW_C * BLOCK + k], flat[(ROW_C + 1) * BLOCK + k]
        m_re = c_re * i_re - c_im * i_im + g_re * u_re - g_im * u_im
        m_im = c_re * i_im + c_im * i_re + g_re * u_im + g_im * u_re
        e_re, e_im = of[Y * BLOCK + k] - m_re, of[(Y + 1) * BLOCK + k] - m_im
        of_u = of[VARIANCE_U * BLOCK + k]
        s_re, s_im = of[COVARIANCE * BLOCK + k], of[(COVARIANCE + 1) * BLOCK + k]
        # half the derivative of the variance by g
        d_re, d_im = of_u * g_re - s_re, s_im - of_u * g_im
        v = 1 / (of[VARIANCE_Y * BLOCK + k] + (d_re - s_re) * g_re - (d_im + s_im) * g_im)
        power = v * (e_re * e_re + e_im * e_im)
        cost += power
        w = v * squared
        z_re, z_im = v * (e_re * i_re + e_im * i_im), v * (e_re * i_im - e_im * i_re)
        h = v * power
        h_re, h_im = h * (d_re * i_re - d_im * i_im), h * (d_re * i_im + d_im * i_re)
        x_re, x_im = -w * m_re, w * m_im
        flat[ROW_E * BLOCK + k], flat[(ROW_E + 1) * BLOCK + k] = e_re, e_im
        flat[ROW_V * BLOCK + k] = v
        flat[ROW_AA * BLOCK + k] = w * (m_re * m_re + m_im * m_im)
        flat[ROW_AC * BLOCK + k], flat[(ROW_AC + 1) * BLOCK + k] = x_re, x_im
        flat[ROW_CC * BLOCK + k] = w
        flat[ROW_OF_A * BLOCK + k] = z_re * m_re - z_im * m_im + h_re * g_re - h_im * g_im
        flat[(ROW_OF_A + 1) * BLOCK + k] = z_re * m_im + z_im * m_re + h_re * g_im + h_im * g_re
        flat[ROW_OF_C * BLOCK + k], flat[(ROW_OF_C + 1) * BLOCK + k] = -z_re, -z_im
        flat[ROW_AB * BLOCK + k] = x_re * u_re - x_im * u_im
        flat[(ROW_AB + 1) * BLOCK + k] = x_re * u_im + x_im * u_re
        flat[ROW_BB * BLOCK + k] = w * (u_re * u_re + u_im * u_im)
        flat[ROW_BC * BLOCK + k], flat[(ROW_BC + 1) * BLOCK + k] = w * u_re, -w * u_im
        flat[ROW_OF_B * BLOCK + k] = -(z_re * u_re - z_im * u_im + h_re)
        flat[(ROW_OF_B + 1) * BLOCK + k] = -(z_re * u_im + z_im * u_re + h_im)
    return cost


@inner
def _add_up(products, weight, target, rows, gram):
    """Add the normal matrix and half the gradient of a block."""
    for pair in range(weight.size):
        row, of = weight[pair], products[pair]
        first = second = 0.0
        for k in range(BLOCK):
            w = rows[row, k]
            first += of[k] * w
            second += of[BLOCK + k] * w
        gram[target[pair, 0]] += first
        gram[target[pair, 1]] += second


@inner
def _sums(tables, part, work, which, theta, kind, gram, cost):
    """Normal matrices, half the gradients and costs of undriven (0) or driven bins (1), of some points."""
    bins = tables.driven if part else tables.undriven
    _, last, basis, row, place, products, weight, target = bins
    rows, flat, power, cross = work.rows, work.flat, work.power, work.cross
    records, before = theta.shape[1], tables.undriven.last.shape[0] if part else 0
    for g in which:
        cost[g, part] = 0.0
        gram[g, :, part] = 0.0
        power[g, 0] = 0.0
        cross[g] = 0.0
    for block in range(last.shape[0]):
        for g in which:
            for m in range(records):
                of = work.values[g, m, before + block]
                if kind != LINEAR_UNWEIGHTED:
                    _combine(basis[block], row, place, theta[g, m], kind == LINEAR, flat)
                if kind != EXACT:
                    _weigh_linear(of, last[block], part == 1, kind == LINEAR, flat)
                elif part:
                    cost[g, 1] += _weigh_driven(of, flat)
                else:
                    more, both_re, both_im = _weigh_undriven(of, flat)
                    cost[g, 0] += more
                    cross[g, 0] += both_re
                    cross[g, 1] += both_im
                    to = power[g, 0, block]
                    for k in range(BLOCK):
                        to[k] += flat[ROW_POWER * BLOCK + k]
                _add_up(products[block], weight, target, rows, gram[g, m, part])


@inner
def _eliminate(system, first):
    """Eliminate the unknowns from `first` on, the last one at first, of points side by side.

    Rows hold the right side, then coefficients up to the diagonal. Pivots become their inverses, NaN where one
    is not above 0.
    """
    rows, _, points = system.shape
    for i in range(rows - 1, first - 1, -1):
        pivot = system[i, i + 1]
        for g in range(points):
            pivot[g] = 1 / pivot[g] if pivot[g] > 0 else np.nan
        for j in range(i):
            of = system[i, j + 1]
            for k in range(j + 2):
                other, to = system[i, k], system[j, k]
                for g in range(points):
                    to[g] -= of[g] * pivot[g] * other[g]


@inner
def _substitute(system, first, step):
    """Solve for the unknowns from `first` on, which `_eliminate` has taken out of the equations before."""
    rows, _, points = system.shape
    for i in range(first, rows):
        to, right, pivot = step[i], system[i, 0], system[i, i + 1]
        for g in range(points):
            to[g] = right[g]
        for j in range(i):
            of, known = system[i, j + 1], step[j]
            for g in range(points):
                to[g] -= of[g] * known[g]
        for g in range(points):
            to[g] *= pivot[g]


@inner
def _solve(work, which, damping):
    """Solve the normal equations of some points side by side; steps NaN where they are singular.

    Own coefficients of each record are eliminated first: the cost of a step grows as M, not as its cube
    (Golub & Van Loan, *Matrix Computations*, 4th ed. (2013), section 3.2.11). Without pivoting, whose
    rounding is that of Cholesky's method whatever the scales of the unknowns. Written are steps and their
    decrements of the cost.
    """
    gram, systems, total, step, fall = work.gram, work.systems, work.shared, work.step, work.fall
    (records, n, points), shared, width = step.shape, total.shape[0], systems.shape[2]
    total[:] = 0.0
    for m in range(records):
        system = systems[m]
        for g in which:
            first, second = gram[g, m, 0], gram[g, m, 1]
            for i in range(n):
                row = i * width
                system[i, 0, g] = first[row + n] + second[row + n]
                for j in range(i, n):
                    system[j, i + 1, g] = first[row + j] + second[row + j]
                system[i, i + 1, g] *= 1 + 1e-15 + damping[g]
        _eliminate(system, shared)
        for i in range(shared):
            for j in range(i + 2):
                of, to = system[i, j], total[i, j]
                for g in range(points):
                    to[g] += of[g]
    _eliminate(total, 0)
    _substitute(total, 0, step[0])
    fall[:] = 0.0
    for m in range(records):
        step[m, :shared] = step[0, :shared]
        _substitute(systems[m], shared, step[m])
        for g in which:
            for i in range(n):
                at = i * width + n
                fall[g] += step[m, i, g] * (gram[g, m, 0, at] + gram[g, m, 1, at])


@inner
def _unpacked(gram, g, normal, point):
    """Normal matrices (points, M, 2, n, n)."""
    n = normal.shape[3]
    for m in range(normal.shape[1]):
        for part in range(2):
            for i in range(n):
                for j in range(i, n):
                    value = gram[g, m, part, i * (n + 1) + j]
                    normal[point, m, part, i, j] = normal[point, m, part, j, i] = value


def moments(
    tables: Tables, data: BinData, theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cost, gradient and normal matrices of a batch, at theta (points, M, n) as in `Solution`.

    Returns
    -------
    cost : (points, 2) float
        Of undriven and of driven bins.
    gradient : (points, M, n) float
        Half of it.
    normal : (points, M, 2, n, n) float
    """
    points, records, n = theta.shape
    cost, gradient = np.empty((points, 2)), np.empty((points, records, n))
    normal = np.empty((points, records, 2, n, n))
    _moments(tables, data, theta, cost, gradient, normal)
    return cost, gradient, normal


@entry
def _moments(tables, data, theta, cost, gradient, normal):
    """Put what `moments` gives into the last three."""
    points, records, n = theta.shape
    work, which = _memory(tables, 1, records), np.zeros(1, np.int64)
    for point in range(points):
        _load(data, point, work.values[0], work.power[0, 1])
        work.at[0, :, :n] = theta[point]
        for part in range(2):
            _sums(tables, part, work, which, work.at, EXACT, work.gram, work.cost)
        cost[point] = work.cost[0]
        _unpacked(work.gram, 0, normal, point)
        for m in range(records):
            for i in range(n):
                k = i * (n + 1) + n
                gradient[point, m, i] = work.gram[0, m, 0, k] + work.gram[0, m, 1, k]


@inner
def _start(tables, work, which):
    """Two Sanathanan-Koerner iterations; NaN where the equations are singular."""
    undamped = np.zeros(work.fall.size)
    for kind in (LINEAR_UNWEIGHTED, LINEAR):
        if tables.from_driven:
            for g in which:
                work.gram[g, :, 0] = 0.0
        else:
            _sums(tables, 0, work, which, work.at, kind, work.gram, work.cost)
        _sums(tables, 1, work, which, work.at, kind, work.gram, work.cost)
        _solve(work, which, undamped)
        for g in which:
            found = np.isfinite(work.fall[g])
            for m in range(work.at.shape[1]):
                for i in range(work.step.shape[1]):
                    work.at[g, m, i] = -work.step[m, i, g] if found else np.nan


@inner
def _weight_with(values, gram, cost, g, before, variance_y, variance_u):
    """Flat variances, in memory and in what sums there are of undriven bins."""
    factor = 1 / variance_y
    change = factor / values[g, 0, 0, INVERSE * BLOCK]
    gram[g, :, 0] *= change
    cost[g, 0] *= change
    values[g, :, :before, INVERSE * BLOCK : (INVERSE + 1) * BLOCK] = factor
    values[g, :, before:, VARIANCE_Y * BLOCK : (VARIANCE_Y + 1) * BLOCK] = variance_y
    values[g, :, before:, VARIANCE_U * BLOCK : (VARIANCE_U + 1) * BLOCK] = variance_u


@inner
def _are_flat(power, whole, bins, rules, sums):
    """Whether ``log mean - mean log`` of the power of pieces of the band passes the test."""
    if rules.pieces < FEWEST_PIECES or whole == 0:
        return True
    size, last = rules.size, rules.pieces - 1
    sums[: last + 1] = 0.0
    for k in range(size):  # of all pieces at once: each is too short for a loop of its own
        for piece in range(last + 1):
            sums[piece] += power[piece * size + k]
    for k in range(rules.pieces * size, bins):
        sums[last] += power[k]
    sums[last] *= size / (bins - last * size)
    total, logarithm, product = 0.0, 0.0, 1.0
    for piece in range(rules.pieces):
        value = sums[piece] * (bins / (whole * size))
        total += value
        product *= value
        if not 1e-100 < product < 1e100:  # a logarithm costs as much as all else
            logarithm += np.log(product)
            product = 1.0
    logarithm += np.log(product)
    return np.log(total / rules.pieces) - logarithm / rules.pieces <= rules.flat


@inner
def _from_noise(tables, work, which, rules, noise, plain, last_fall):
    """One step with flat weights from what undriven bins show, then what they show of noise.

    Residuals are all but noise then. Written are `noise` (G, 2), the variances of Y and U, and `plain` (G,):
    whether that is all there is to it, flat noise without anything that both channels have in common; and
    `last_fall` (G,), what the step was expected to bring.
    """
    records, before = work.at.shape[1], tables.undriven.last.shape[0]
    bins, c, n = tables.undriven.bins, tables.c, work.step.shape[1]
    values, sums = records * bins, np.empty(rules.pieces)
    for last in (False, True):
        _sums(tables, 0, work, which, work.at, EXACT, work.gram, work.cost)
        for g in which:
            error_power, u_power = work.power[g, 0].reshape(-1), work.power[g, 1].reshape(-1)
            of_error, of_u = error_power.sum(), u_power.sum()
            if not np.isfinite(of_error):  # without start values nothing is known
                of_error = of_u = 0.0
            common = work.cross[g, 0] ** 2 + work.cross[g, 1] ** 2
            alike = common > rules.chance * max(of_error * of_u, TINY)
            variance_y, variance_u = of_error / values, of_u / values
            if last:
                variance_y *= values / max(values - records * c / 2, 1.0)
                noise[g, 0], noise[g, 1] = variance_y, variance_u
                plain[g] = not alike and (
                    not of_error > 0
                    or _are_flat(error_power, of_error, bins, rules, sums)
                    and _are_flat(u_power, of_u, bins, rules, sums)
                )
            elif alike:
                variance_u = 0.0
            if not variance_y > TINY:  # no noise: any weights do
                variance_y = 1.0
            _weight_with(work.values, work.gram, work.cost, g, before, variance_y, variance_u)
        _sums(tables, 1, work, which, work.at, EXACT, work.gram, work.cost)
        if not last:
            _solve(work, which, np.zeros(work.fall.size))
            for g in which:
                if np.isfinite(work.fall[g]):
                    work.at[g, :, :n] -= work.step[:, :, g]
                    last_fall[g] = work.fall[g]


@inner
def _weighted_power(values, before):
    """``sum |Y|^2 / s_Y^2`` of a point."""
    total = 0.0
    for m in range(values.shape[0]):
        for block in range(values.shape[1]):
            of, driven = values[m, block], block >= before
            for k in range(BLOCK):
                re, im, v = of[Y * BLOCK + k], of[(Y + 1) * BLOCK + k], of[INVERSE * BLOCK + k]
                total += (re * re + im * im) * (1 / v if driven else v)
    return total


@inner
def _expect(gram, g, step, cost):
    """Costs of undriven and driven bins after a step, as their sums here expect them."""
    records, n = step.shape[:2]
    for m in range(records):
        for part in range(2):
            change = 0.0
            for i in range(n):
                row, moved = i * (n + 1), 0.5 * gram[g, m, part, i * (n + 1) + i] * step[m, i, g]
                for j in range(i + 1, n):
                    moved += gram[g, m, part, row + j] * step[m, j, g]
                change += step[m, i, g] * (moved - gram[g, m, part, row + n])
            cost[g, part] += 2 * change


@inner
def _descend(tables, work, which, rules, last_fall, total, converged):
    """Levenberg-Marquardt steps from `_Work.at`, whose sums there are.

    Written are `total` (G,), the cost, and `converged` (G,). The last step is taken without looking at the
    sums behind it: costs are as expected there.
    """
    c, n = tables.c, tables.a + tables.b + tables.c
    records, bins = work.at.shape[1], tables.undriven.bins + tables.driven.bins
    tolerance = STEP_TOLERANCE**2 / max(records * (2 * bins - c) - (n - c), 1)
    damping, floor = np.zeros(work.fall.size), np.zeros(work.fall.size)
    for g in which:
        total[g], converged[g] = work.cost[g, 0] + work.cost[g, 1], False
        power = _weighted_power(work.values[g], tables.undriven.last.shape[0])
        floor[g] = ROUNDING**2 * power
    which = which.copy()
    count = which.size
    for _ in range(rules.iterations):
        left = 0
        _solve(work, which[:count], damping)
        for g in which[:count]:
            if not np.isfinite(total[g]) or damping[g] > MOST_DAMPING:
                continue
            fall = work.fall[g]
            if damping[g] == 0 and (
                fall <= max(tolerance * total[g], floor[g])
                or fall * fall <= SURELY**2 * tolerance * total[g] * last_fall[g]
            ):
                work.at[g, :, :n] -= work.step[:, :, g]
                _expect(work.gram, g, work.step, work.cost)
                total[g] = work.cost[g, 0] + work.cost[g, 1]
                converged[g] = True
                continue
            last_fall[g] = fall if damping[g] == 0 else 0.0
            work.trial[g, :, :n] = work.at[g, :, :n] - work.step[:, :, g]
            if not np.isfinite(fall):
                work.trial[g, 0, 0] = np.nan
            which[left] = g
            left += 1
        count = left
        if count == 0:
            break
        for part in range(2):
            _sums(tables, part, work, which[:count], work.trial, EXACT, work.there, work.then)
        for g in which[:count]:
            cost = work.then[g, 0] + work.then[g, 1]
            # rounding of the cost itself must not count as an increase
            if cost <= total[g] * (1 + 1e-12) + floor[g]:
                total[g] = cost
                work.at[g], work.gram[g], work.cost[g] = work.trial[g], work.there[g], work.then[g]
                damping[g] = 0.0 if damping[g] < 0.1 * LEAST_DAMPING else damping[g] / 10
            else:
                damping[g] = max(10 * damping[g], LEAST_DAMPING)


@inner
def _residuals(tables, work, which, first, residual):
    """Weighted errors of driven bins, turned by the phase of the input, into (points, M, K_driven)."""
    _, last, basis, row, place, _, _, _ = tables.driven
    flat, before, bins = work.flat, tables.undriven.last.shape[0], tables.driven.bins
    for block in range(last.shape[0]):
        begin = BLOCK * block
        for g in which:
            for m in range(residual.shape[1]):
                of, to = work.values[g, m, before + block], residual[first + g, m]
                _combine(basis[block], row, place, work.at[g, m], False, flat)
                _weigh_driven(of, flat)
                for k in range(BLOCK):
                    re, im = of[U * BLOCK + k], of[(U + 1) * BLOCK + k]
                    e_re, e_im = flat[ROW_E * BLOCK + k], flat[(ROW_E + 1) * BLOCK + k]
                    squared = re * re + im * im
                    nothing = not squared > 0
                    re, squared = (1.0 if nothing else re), (1.0 if nothing else squared)
                    scale = np.sqrt(flat[ROW_V * BLOCK + k] / squared)
                    flat[ROW_AC * BLOCK + k] = scale * (e_re * re + e_im * im)
                    flat[(ROW_AC + 1) * BLOCK + k] = scale * (e_im * re - e_re * im)
                for k in range(min(BLOCK, bins - begin)):
                    to[begin + k] = complex(flat[ROW_AC * BLOCK + k], flat[(ROW_AC + 1) * BLOCK + k])


@inner
def _inverted(matrix, inverse, scale, row):
    """Write the inverse of a positive definite matrix; return what `Solution.condition` is of it."""
    n = matrix.shape[0]
    before = 0.0
    for i in range(n):
        scale[i] = 1 / np.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(n):
            value = matrix[i, j] * scale[i] * scale[j]
            inverse[i, j] = value
            before += value * value
    good = np.isfinite(before)
    for k in range(n):  # sweeps
        pivot = inverse[k, k]
        if not (good and pivot > 0):
            good = False
            break
        factor = 1 / pivot
        for j in range(n):
            row[j] = inverse[k, j]
        for i in range(n):
            if i != k:
                times = row[i] * factor
                for j in range(n):
                    inverse[i, j] -= times * row[j]
                inverse[i, k] = times
        for j in range(n):
            inverse[k, j] *= factor
        inverse[k, k] = -factor
    after = 0.0
    for i in range(n):
        for j in range(i + 1):  # both halves: rounding made them differ
            value = -0.5 * (inverse[i, j] + inverse[j, i])
            after += value * value * (1.0 if i == j else 2.0)
            value *= scale[i] * scale[j]
            inverse[i, j], inverse[j, i] = value, value
        good = good and inverse[i, i] > 0
    condition = np.sqrt(before * after)
    if not (good and condition < MOST_INVERTED):
        inverse[:] = np.nan
        return np.inf
    return np.sqrt(condition)


@inner
def _marginals(gram, g, c, whole, inverse, scale, row, marginal, leverage, point):
    """Blocks of the inverse of a point's normal matrix, and what they add up to; its condition number."""
    (_, records, n, _), width, shared = marginal.shape, marginal.shape[2] + 1, marginal.shape[2] - c
    whole[:] = 0.0
    for m in range(records):
        for i in range(n):
            to = i if i < shared else i + m * c
            for j in range(i, n):
                at = j if j < shared else j + m * c
                whole[to, at] += gram[g, m, 0, i * width + j] + gram[g, m, 1, i * width + j]
    for i in range(whole.shape[0]):
        for j in range(i):
            whole[i, j] = whole[j, i]
    condition = _inverted(whole, inverse, scale, row)
    leverage[point, 0] = leverage[point, 1] = 0.0
    for m in range(records):
        for i in range(n):
            from_i = i if i < shared else i + m * c
            for j in range(i, n):
                value = inverse[from_i, j if j < shared else j + m * c]
                marginal[point, m, i, j] = marginal[point, m, j, i] = value
                value *= 1.0 if i == j else 2.0
                leverage[point, 0] += value * gram[g, m, 0, i * width + j]
                leverage[point, 1] += value * gram[g, m, 1, i * width + j]
    return condition


@entry
def minimise(tables, data, start, rules, found):
    """Put the solution of least cost of each point into what `Solution.empty` made.

    From a start (points, M, n); where that is empty from two Sanathanan-Koerner iterations.
    """
    points, records = data.y.shape[:2]
    c, n = tables.c, tables.a + tables.b + tables.c
    theta, cost, part_cost, residual, converged, normal, marginal, condition, leverage, noise, plain = found
    group, size = max(1, min(GROUP // records, points)), n + (records - 1) * c
    work, last_fall = _memory(tables, group, records), np.empty(group)
    whole, inverse, scale, row = np.empty((size, size)), np.empty((size, size)), np.empty(size), np.empty(size)
    for first in range(0, points, group):
        count = min(group, points - first)
        here, which = slice(first, first + count), np.arange(count)
        last_fall[:] = 0.0
        for g in range(count):
            _load(data, first + g, work.values[g], work.power[g, 1])
            if start.shape[0] > 0:
                work.at[g, :, :n] = start[first + g]
        if start.shape[0] == 0:
            _start(tables, work, which)
        if rules.pieces > 0:
            _from_noise(tables, work, which, rules, noise[here], plain[here], last_fall)
            which = which[plain[here]]
        else:
            for part in range(2):
                _sums(tables, part, work, which, work.at, EXACT, work.gram, work.cost)
        _descend(tables, work, which, rules, last_fall, cost[here], converged[here])
        _residuals(tables, work, which, first, residual)
        for g in range(count):
            point = first + g
            theta[point] = work.at[g, :, :n]
            part_cost[point, 0], part_cost[point, 1] = work.cost[g, 0], work.cost[g, 1]
            condition[point] = _marginals(
                work.gram, g, c, whole, inverse, scale, row, marginal, leverage, point
            )
            if records > 1:
                _unpacked(work.gram, g, normal, point)
