# SPDX-License-Identifier: Apache-2.0
"""Another start for models of several modes: the highest peak split in two.

Two modes nearer than their widths look like one. A fit that begins with one of its modes elsewhere stays
there: the cost has a minimum with a single mode for both, and the other one fits noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import RULES, Linearised, Solution, minimise
from tactile_resonance.poles.likelihood import Rules
from tactile_resonance.poles.model import RationalModel
from tactile_resonance.poles.tables import Problem

SEVERAL_MODES = 4
"""Order from which on a model has more than one mode."""

LEAST_FALL = 4.0
"""Of the cost, in units of the noise, that a start must bring: less is another mode on noise, not one more."""

APART = 0.7
"""Natural frequencies of the two, from that of the one, over its half width."""


def best_of_split(
    problem: Problem,
    data: BinData,
    model: RationalModel,
    solution: Solution,
    rules: Rules = RULES,
) -> Solution:
    """The solution, or that from a start with its highest peak split where it costs less than noise explains.

    Parameters
    ----------
    problem : Problem
    data : BinData
    model : RationalModel
        Of the solution, one a point.
    solution : Solution
        Of a denominator of order 4 or more.
    rules : Rules
    """
    start, there = _split_starts(problem, data, model)
    rows = np.flatnonzero(there)
    if not rows.size:
        return solution
    again = minimise(problem, data.rows(rows), start[rows], rules)
    dof = data.records * (data.undriven + data.driven) - sum(problem.sizes) / 2
    fall = LEAST_FALL / max(dof, LEAST_FALL)
    better = again.converged & (
        ~solution.converged[rows] | (again.cost < solution.cost[rows] * (1 - fall))
    )
    rows = rows[better]
    kept = replace(again.rows(better), noise=solution.noise[rows], plain=solution.plain[rows])
    solution.put(rows, kept)
    return solution


@np.errstate(all="ignore")
def _split_starts(
    problem: Problem, data: BinData, model: RationalModel
) -> tuple[FloatArray, BoolArray]:
    """(points, M, n) coefficients, and for which points there are such."""
    a, b, own = problem.sizes
    shared, records = a + b, data.records
    poles = model.poles_rad_s()  # (points, a)
    start = np.full((len(poles), records, shared + own), np.nan)
    for k, of_point in enumerate(poles):
        above = of_point[of_point.imag > 0]
        if above.size < 2:
            continue
        height = np.abs(model.at((k,)).residues(above)) / np.abs(above.real)
        if not np.isfinite(height).all():
            continue
        highest, least = above[np.argmax(height)], above[np.argmin(height)]
        step = 1j * APART * abs(highest.real)
        kept = [p for p in of_point if p.imag <= 0 or p not in (highest, least)]
        kept = [p for p in kept if np.conj(p) not in (highest, least)]
        pair = np.array([highest + step, highest - step])
        roots = model.variable.of_s(np.concatenate([kept, pair, pair.conj()]))
        if roots.size != a:
            continue
        hessenberg = model.denominator_basis.hessenberg
        theta = coefficients_of_roots(problem, data.rows(slice(k, k + 1)), hessenberg, roots)
        start[k, :, :shared], start[k, :, shared:] = theta[:shared], theta[shared:].reshape(records, own)
    return start, np.isfinite(start).all(axis=(1, 2))


def coefficients_of_roots(
    problem: Problem, data: BinData, hessenberg: FloatArray, roots: ComplexArray
) -> FloatArray:
    """Coefficients with given roots of A, and the B and C that fit best.

    Parameters
    ----------
    problem : Problem
    data : BinData
        Of one point.
    hessenberg : (a + 1, a) float
        Of the basis of A.
    roots : (a,) complex
        In the variable of the polynomials.

    Returns
    -------
    (a + b + M c,) float
        [A without its last, B, C of each record].
    """
    a, b, own = problem.sizes
    basis = problem.denominator
    x = hessenberg[0, 0] + hessenberg[1, 0] * basis[:, 1]  # (K,) of the bins: x p_0 of the basis
    logarithm = np.sum(np.log(x[:, None] - roots), axis=-1)  # many factors over decades overflow
    phase = np.exp(1j * logarithm.imag)  # A / |A|
    weighted = basis * np.exp(np.mean(logarithm.real) - logarithm.real)[:, None]
    denominator = _real_solution(weighted, phase)
    theta = np.zeros(a + b + data.records * own)
    theta[:a] = denominator[:-1] / denominator[-1]
    linear = Linearised.of(problem, data, theta)
    used = np.isfinite(linear.variance)
    weight = np.tile(1 / np.sqrt(linear.variance[used]), data.records)
    theta[a:] = _real_solution(
        linear.slope[:, used, a:].reshape(weight.size, -1) * weight[:, None],
        linear.error[:, used].ravel() * weight,
    )
    return theta


def _real_solution(matrix: ComplexArray, right: ComplexArray) -> FloatArray:
    """Real least squares solution of complex equations, whatever the scales of its unknowns."""
    rows = np.concatenate([matrix.real, matrix.imag])
    scale = np.linalg.norm(rows, axis=0)
    right = np.concatenate([right.real, right.imag])
    if not (np.isfinite(rows).all() and np.isfinite(right).all() and (scale > 0).all()):
        return np.full(scale.size, np.nan)
    return np.linalg.lstsq(rows / scale, right, rcond=None)[0] / scale
