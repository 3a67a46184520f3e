# SPDX-License-Identifier: Apache-2.0
"""Further starts for models of several modes: a peak split in two, modes moved to where one is missing.

Two modes nearer than their widths look like one. A fit that begins with one of its modes elsewhere stays
there: the cost has a minimum with a single mode for both, and the other one fits noise. So the highest peak
is split.

In models of many modes Sanathanan-Koerner iterations place some poles on noise, for noise enters their
equations with the model's own denominator. From there a fit ends in a minimum in which a true mode is not
fitted at all. The score test of `lacking` shows where one is missing; the fit begins anew with a mode there in
place of the one that is missed least, and so on while the cost falls.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import (
    Linearised,
    least_squares,
    minimise,
    numerator_columns,
    real_solution,
)
from tactile_resonance.poles.lacking import most_missed, poles_tried
from tactile_resonance.poles.likelihood import Solution

if TYPE_CHECKING:
    from tactile_resonance.poles.lines import LinesPlan
    from tactile_resonance.poles.tables import FitPlan

SEVERAL_MODES = 4
"""Order from which on a model has more than one mode."""

LEAST_FALL = 4.0
"""Of the cost, in units of the noise, that a start must bring: less is another mode on noise, not one more."""

APART = 0.7
"""Natural frequencies of the two, from that of the one, over its half width."""

# A mode is moved to where noise makes as much less often than this: a start that is no use costs time alone.
CHANCE = 0.3
# Starts that are tried before a minimum is taken for the deepest, those of the least cost first.
STARTS = 3
# Points that start anew in one pass: of many lines more take gigabytes.
AT_ONCE = 128


@np.errstate(all="ignore")
def best_of_split(plan: FitPlan, data: BinData, solution: Solution) -> Solution:
    """The solution, of order 4 or more, or that from a start with its highest peak split.

    If that costs less by more than noise.
    """
    poles, split = _highest_split(plan, solution.theta[:, 0])
    parts = [split[k : k + AT_ONCE] for k in range(0, split.size, AT_ONCE)]
    if not parts:
        return solution
    found = np.concatenate([_coefficients(plan, data.rows(part), poles[part]) for part in parts])
    finite = np.isfinite(found).all(axis=1)
    rows, found = split[finite], found[finite]
    shared = sum(plan.problem.sizes[:2])
    of_record = np.arange(shared, found.shape[1]).reshape(data.records, -1)
    start = np.stack([found[:, np.append(np.arange(shared), own)] for own in of_record], axis=1)
    again = minimise(plan.problem, data.rows(rows), start)
    dof = data.records * data.order.size - sum(plan.problem.sizes) / 2
    fall = LEAST_FALL / max(dof, LEAST_FALL)
    better = again.converged & (
        ~solution.converged[rows] | (again.cost < solution.cost[rows] * (1 - fall))
    )
    solution.put(rows[better], again.rows(better))
    return solution


def _highest_split(plan: FitPlan, theta: FloatArray) -> tuple[ComplexArray, IntArray]:
    """Poles (points, a) [rad/s] of theta (points, n), the pair of the least peak at that of the highest.

    And the points that have two pairs.
    """
    model = plan.model_of(theta)
    poles = model.poles_rad_s()
    heights = np.abs(model.residues_and_sensitivity(poles)[0]) / np.abs(poles.real)
    above, each = poles.imag > 0, np.arange(len(poles))
    highest = poles[each, np.where(above, heights, -np.inf).argmax(axis=-1), None]
    least = poles[each, np.where(above, heights, np.inf).argmin(axis=-1), None]
    two = np.concatenate([highest, highest.conj(), least, least.conj()], axis=-1)
    moved = (poles[..., None] == two[:, None]).any(axis=-1)
    usable = (np.isfinite(heights) | ~above).all(axis=-1) & (above.sum(axis=-1) > 1)
    split = np.flatnonzero(usable & (moved.sum(axis=-1) == 4))
    pair = (highest + np.array([1j, -1j]) * APART * np.abs(highest.real))[split]
    at = split.repeat(4), moved[split].nonzero()[1]
    poles[at] = np.concatenate([pair, pair.conj()], axis=-1).ravel()
    return poles, split


def _coefficients(plan: FitPlan, data: BinData, poles: ComplexArray) -> FloatArray:
    """(points, a + b + M c) of A with given poles (points, a) [rad/s], and of the B and C that fit best."""
    roots, hessenberg = plan.variable.of_s(poles), plan.denominator_basis.hessenberg
    a, basis = plan.problem.sizes[0], plan.problem.denominator
    x = hessenberg[0, 0] + hessenberg[1, 0] * basis[:, 1]  # (K,) of the bins: x p_0 of the basis
    # many factors over decades overflow
    logarithm = np.sum(np.log(x[:, None] - roots[:, None]), axis=-1)
    phase = np.exp(1j * logarithm.imag)  # (points, K) A / |A|
    size = logarithm.real
    weight = np.exp(np.mean(size, axis=-1, keepdims=True) - size)
    denominator = real_solution(weight[..., None] * basis, phase)
    alpha = denominator / denominator[:, -1:]
    target = data.y[..., data.order] / np.sqrt(data.variance)[:, None]  # (points, M, K)
    scale = 1 / (np.sqrt(data.variance) * (alpha @ basis.T))  # (points, K)
    columns = scale[:, None, :, None] * numerator_columns(plan.problem, data)
    points, records, bins = target.shape
    own = real_solution(
        columns.reshape(points, records * bins, columns.shape[-1]), target.reshape(points, records * bins)
    )
    return np.concatenate([alpha[:, :a], own], axis=-1)


@np.errstate(all="ignore")
def exchanged(
    plan: LinesPlan, row: BinData, found: Solution
) -> tuple[LinesPlan, Solution]:
    """The deepest minimum that is found by moving modes of a solution of one point; bases that suit it."""
    tried = poles_tried(plan.frequency_hz)
    for _ in range(2 * plan.structure.order):
        missing, chance = most_missed(plan, row, found, tried)
        if not chance < np.log(CHANCE):
            break
        more = np.array([missing, np.conj(missing)])
        starts = [np.append(rest, more) for rest in _one_less(_poles(plan, found))]
        starts.sort(key=lambda poles: _cost_from(plan, row, poles))
        for start in starts[:STARTS]:
            again = _minimum_from(plan, row, start)
            if again is not None and again[1].cost[0] < found.cost[0] * (1 - 1e-9):
                plan, found = again
                break
        else:
            break
    return plan, found


@np.errstate(all="ignore")
def moved_to(
    plan: LinesPlan, row: BinData, there: LinesPlan, found: Solution
) -> Solution:
    """A solution of one plan as that of another one."""
    if there is plan:
        return found
    start = _coefficients(plan, row, _poles(there, found)[None])[0]
    return least_squares(plan.problem, row, start, None, plan.start_size)


def _poles(plan: LinesPlan, solution: Solution) -> ComplexArray:
    return plan.model_of(solution.theta[:, 0]).poles_rad_s()[0]


def _minimum_from(
    plan: LinesPlan, row: BinData, poles: ComplexArray
) -> tuple[LinesPlan, Solution] | None:
    """Fit that begins with these poles, of a plan with bases that suit them; None where there is none."""
    logarithm = 2 * np.sum(np.log(np.abs(plan.x[:, None] - plan.variable.of_s(poles))), axis=-1)
    there = plan.of_size(row, np.exp(logarithm - logarithm.mean()))
    start = None if there is None else _coefficients(there, row, poles[None])[0]
    if there is None or start is None or not np.isfinite(start).all():
        return None
    solution = least_squares(there.problem, row, start, None, there.start_size)
    return (there, solution) if np.isfinite(solution.cost[0]) else None


def _one_less(poles: ComplexArray) -> list[ComplexArray]:
    """All but each complex pair, and all but two real poles next to each other."""
    above, below, real = poles[poles.imag > 0], poles[poles.imag < 0], poles[poles.imag == 0]
    real = np.sort_complex(real)
    mirrored = [np.argmin(np.abs(below - pole.conj())) for pole in above]
    return [
        *(np.concatenate([np.delete(above, k), np.delete(below, m), real]) for k, m in enumerate(mirrored)),
        *(np.concatenate([above, below, np.delete(real, [k, k + 1])]) for k in range(0, real.size - 1, 2)),
    ]


def _cost_from(plan: LinesPlan, row: BinData, poles: ComplexArray) -> float:
    """Cost with given poles [rad/s] and the numerator that fits best."""
    error = Linearised.of(plan.problem, row, _coefficients(plan, row, poles[None])[0]).residual
    cost = float(np.sum(error.real**2 + error.imag**2))
    return cost if np.isfinite(cost) else np.inf
