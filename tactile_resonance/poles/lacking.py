# SPDX-License-Identifier: Apache-2.0
"""What a fit lacks: one mode more, or two residual terms more.

Score tests. What a richer model has in addition are directions of the response. The part of the
residuals along such a direction that the fit's own coefficients cannot take up is what the cost would
fall by in the richer fit, which need not be made (Rao, *Linear Statistical Inference and Its
Applications*, 2nd ed. (1973), section 6e). The pole of another mode is searched for on a grid; the
threshold allows for the number of trials.

A test finds an error of the model only where that is large beside the noise. Residual terms that are
missing may move poles by several deviations before. So where noise makes the cost fall by as much only once
in `1 / DOUBT` fits, what two terms more would move the poles by counts in the covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.poles.compiled import entry, inner
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.likelihood import Solution
from tactile_resonance.poles.model import PolynomialBasis
from tactile_resonance.poles.noise_level import DOUBT
from tactile_resonance.poles.significance import are_smooth

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan
    from tactile_resonance.poles.tables import FitPlan


# How often each of the two tests finds something lacking in a model that is complete.
FALSE_ALARM = 2e-4
# Of a fit: with fewer the residuals show no level of the noise.
FEWEST_DOF = 3
# Of variances that are from each line, or piece of the band, alone: with fewer the weights follow the noise.
FEWEST_OF_A_LINE = 8
# Part of a direction's power that a fit must leave for it to be tried.
LEAST_LEFT = 1e-8
# Half widths of the modes tried: from the spacing of the lines to this part of the band. Wider ones are
# residual terms.
WIDEST = 1 / 8
# Distance of the modes tried, in half widths.
GRID = 1.5
# Lines times modes that are tried, the widest ones: 64 MB.
MOST_TRIED = 2_000_000
# Modes that are tried in one pass for a better start.
TRIED_AT_ONCE = 128
# Points of a batch are asked where the cost is so many standard deviations above its expectation or,
# where there is no cost, the residuals are this smooth (as a normal score): of clean ones 3 in a hundred.
COST_ASKS, SMOOTHNESS_ASKS = 2.0, 1.5


@dataclass(frozen=True, eq=False)
class Directions:
    """Responses that a richer model has, on the excited lines.

    Attributes
    ----------
    poles_rad_s : (N,) complex
        Of the modes that are tried.
    modes : (N, 2, 2, K) float
        Their responses for residues 1 and j, real and imaginary parts.
    numerator : (K, 2) complex
        The next two polynomials of the numerator.
    """

    poles_rad_s: ComplexArray
    modes: FloatArray
    numerator: ComplexArray

    @classmethod
    def on_lines(
        cls, frequency_hz: FloatArray, x: ComplexArray, numerator_order: int
    ) -> Directions:
        """Directions on ascending lines (K,), where the variable of the model is x (K,)."""
        tried = poles_tried(frequency_hz)  # the widest last
        pole = tried[-max(MOST_TRIED // frequency_hz.size, 1) :]
        more = PolynomialBasis.on_lines(x, numerator_order + 2).values[:, numerator_order + 1 :]
        return cls(pole, _responses(pole, frequency_hz), np.ascontiguousarray(more))


def poles_tried(frequency_hz: FloatArray) -> ComplexArray:
    """(N,) poles of modes above the real axis [rad/s], of all widths that lines (K,) may show."""
    lines = np.arange(frequency_hz.size)
    spacing = np.gradient(frequency_hz)
    poles, width = [np.empty(0, complex)], 1
    while width <= WIDEST * lines[-1] * (1 + 1e-9):
        at = np.linspace(0, lines[-1], 1 + int(np.ceil(lines[-1] / (GRID * width))))
        poles.append(
            -width * np.interp(at, lines, spacing) + 1j * np.interp(at, lines, frequency_hz)
        )
        width *= 2
    return np.asarray(2 * np.pi * np.concatenate(poles), complex)


def _responses(poles_rad_s: ComplexArray, frequency_hz: FloatArray) -> FloatArray:
    """(N, 2, 2, K) of modes with residues 1 and j, over their width, real and imaginary parts."""
    s, pole = 2j * np.pi * frequency_hz, poles_rad_s[:, None]
    above, below = 1 / (s - pole), 1 / (s - pole.conj())
    one, other = ((above + factor * below) * np.abs(pole.real) for factor in (1, -1))  # the other over j
    parts = [one.real, one.imag, -other.imag, other.real]
    return np.stack(parts, axis=1).reshape(pole.size, 2, 2, s.size)


def most_missed(
    plan: FitPlan, data: BinData, solution: Solution, tried: ComplexArray
) -> tuple[complex, float]:
    """Of modes (N,) the one that a fit of one point lacks most, and the logarithm of its chance in noise."""
    no_terms = np.zeros((plan.frequency_hz.size, 2), complex)
    of_fit = data, plan.problem.driven_bases, solution.theta, solution.marginal[:, 0], no_terms
    # not all at once: those tried are about as many as lines
    parts = np.array_split(tried, -(-tried.size // TRIED_AT_ONCE))
    modes = (_responses(part, plan.frequency_hz) for part in parts)
    fall = np.concatenate([_all_falls(*of_fit, each)[0][0, 1:] for each in modes])
    k, dof = int(np.argmax(fall)), data.lines[0] - solution.theta.size / 2
    return complex(tried[k]), float((dof - 1) * np.log1p(-fall[k] / solution.cost[0]) + np.log(tried.size))


@np.errstate(invalid="ignore")
def asks(
    plan: JointPlan, cost: FloatArray, expected: FloatArray, residual: ComplexArray
) -> BoolArray:
    """(batch,) for which points of a batch `Lack.of` is worth its time.

    From cost and expectation (batch,) of the excited bins, and residuals (batch, K) as in `Solution`.
    """
    others = plan.others_at.size
    if others == 0:
        return are_smooth(residual, plan.structure.parameters, SMOOTHNESS_ASKS)
    return np.asarray(cost > expected + COST_ASKS * np.sqrt(expected * (1 + expected / others)))


@dataclass(frozen=True, eq=False)
class Lack:
    """What the models of fitted points lack.

    Attributes
    ----------
    found : (batch, 3) float
        Chi-square of what is lacking, its number of parameters, and f0 [Hz] of the mode, NaN for
        residual terms; all NaN where nothing is.
    chi_square : (batch,) float
        Of two residual terms more; 0 where noise explains them.
    doubt : (batch,) object
        Second moments (n, n) of what these terms move the coefficients by, [A without its last, B, C of each
        record]; None where noise explains them.
    """

    found: FloatArray
    chi_square: FloatArray
    doubt: npt.NDArray[np.object_]

    @classmethod
    @np.errstate(all="ignore")
    def of(
        cls,
        plan: FitPlan,
        data: BinData,
        solution: Solution,
        asked: BoolArray,
        least: FloatArray | None = None,
    ) -> Lack:
        """Of the points that are asked (batch,); nothing of the others.

        The level of the noise over that weighted with is `least` (batch,) at least, where it is known
        beforehand; 0 when absent. It is what the residuals of all bins have besides a direction, so that each
        has an F test of 2 and ``2 (dof - 1)`` degrees of freedom: a share R of the cost is
        exceeded by chance with ``(1 - R)^(dof - 1)``.
        """
        batch, rows = asked.size, asked.nonzero()[0]
        lack = cls(np.full((batch, 3), np.nan), np.zeros(batch), np.full(batch, None, object))
        if not rows.size:
            return lack
        if rows.size < batch:
            data, solution = data.rows(rows), solution.rows(rows)
        known = np.full(rows.size, -np.inf) if least is None else least[rows]
        directions, inverse = plan.directions, solution.inverse(sum(plan.problem.sizes[:2]))
        cost = solution.cost
        dof = data.records * (data.undriven + data.lines) - inverse.shape[-1] / 2  # (batch,)
        rest, modes = np.maximum(dof - 1, 0.5), directions.modes
        fall, taken, left = _all_falls(
            data, plan.problem.driven_bases, solution.theta, inverse, directions.numerator, modes
        )
        doubted = fall[:, 0] > (1 - DOUBT ** (1 / rest)) * cost
        striking = fall.max(axis=1) > (1 - FALSE_ALARM ** (1 / rest)) * cost
        enough = dof > FEWEST_DOF
        for k in (striking & enough).nonzero()[0]:
            level = np.maximum((cost[k] - fall[k]) / rest[k], known[k])
            chance = -rest[k] * np.log1p(fall[k] / (rest[k] * level))
            chance[np.isnan(chance)] = 0.0
            chance[1:] += math.log(max(len(modes), 1))
            best = int(np.argmin(chance))
            if chance[best] < math.log(FALSE_ALARM):
                f0_hz = np.abs(directions.poles_rad_s[best - 1]) / (2 * np.pi) if best else np.nan
                lack.found[rows[k]] = 2 * fall[k, best] / level[best], 4.0 if best else 2.0, f0_hz
        some = (doubted & enough).nonzero()[0]
        if some.size:
            of_terms = fall[some, 0]
            level = np.maximum((cost[some] - of_terms) / rest[some], known[some])
            likely = rest[some] * np.log1p(of_terms / (rest[some] * level)) > -math.log(DOUBT)
            some, level, of_terms = some[likely], level[likely], of_terms[likely]
            own, moved = left[some, :, :2], inverse[some] @ taken[some].swapaxes(1, 2)  # (r, n, 2)
            size = np.linalg.solve(own, left[some, :, 2:])  # (r, 2, 1) of the two terms
            moment = 0.5 * level[:, None, None] * np.linalg.inv(own) + size * size.swapaxes(1, 2)
            lack.chi_square[rows[some]] = 2 * of_terms / level
            for k, matrix in zip(rows[some], moved @ moment @ moved.swapaxes(1, 2), strict=True):
                lack.doubt[k] = matrix
        return lack

    def only_where(self, sound: BoolArray) -> Lack:
        """Without the doubt about other points (batch,)."""
        if not self.chi_square.any():
            return self
        doubt = self.doubt.copy()
        doubt[~sound] = None
        return replace(self, chi_square=np.where(sound, self.chi_square, 0.0), doubt=doubt)

    @property
    def remarks(self) -> npt.NDArray[np.object_]:
        """(batch,) sentences about points that are in doubt; else empty."""
        said = np.full(self.chi_square.size, "", object)
        for k in self.chi_square.nonzero()[0]:
            said[k] = (
                f"two residual terms more fit slightly better (chi-square {self.chi_square[k]:.1f}), as where "
                "modes outside the band matter: the covariance includes what they move the poles by"
            )
        return said


def _all_falls(
    data: BinData,
    bases: tuple[ComplexArray, ComplexArray, ComplexArray],
    theta: FloatArray,
    inverse: FloatArray,
    numerator: ComplexArray,
    modes: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What `_falls` finds, in its order."""
    points, n = inverse.shape[:2]
    found = np.empty((points, 1 + len(modes))), np.empty((points, 2, n)), np.empty((points, 2, 3))
    _falls(data, bases, theta, inverse, numerator, modes, *found)
    return found


@entry
def _falls(data, bases, theta, inverse, numerator, modes, falls, taken, left):
    """Into (points, 1 + N) what costs fall by with two residual terms more, or with each of N modes.

    Of fitted points, theta (points, M, s + c), with `bases` of A, B and C on driven bins and the `inverse`
    (points, n, n) of the normal matrix of all n = s + M c coefficients. 0 where these have taken a direction
    up already. And of the two terms products with the coefficients (points, 2, n), and with each other and the
    error (points, 2, 3), less what the coefficients take up.
    """
    basis_a, basis_b, basis_c = bases
    points, records, _ = theta.shape
    n, bins, c = inverse.shape[1], basis_a.shape[0], basis_c.shape[1]
    a, b = basis_a.shape[1] - 1, basis_b.shape[1]
    own, slope, power = np.empty((n, 2, bins)), np.empty((2, bins)), np.empty(bins)
    pair, crossed, rest = np.empty((2, 2, bins)), np.empty((2, n)), np.empty((2, 3))
    same_y, same_u, same_yu = data.variance_y, data.variance_u, data.covariance_yu
    for point in range(points):
        same = min(point, data.u.shape[0] - 1)
        for k in range(bins):
            place = data.order[data.undriven + k]
            of_a, of_b = basis_a[k, a], 0j
            for i in range(a):
                of_a += theta[point, 0, i] * basis_a[k, i]
            for i in range(b):
                of_b += theta[point, 0, a + i] * basis_b[k, i]
            inverse_a = 1 / of_a
            g, half = of_b * inverse_a, 0j  # half the derivative of the variance by g
            variance = same_y[point, min(k, same_y.shape[1] - 1)]
            if same_u.shape[1] > 0:
                half += same_u[point, min(k, same_u.shape[1] - 1)] * g.conjugate()
            if same_yu.shape[1] > 0:
                covariance = same_yu[point, min(k, same_yu.shape[1] - 1)]
                variance -= (covariance * g.conjugate()).real
                half -= covariance.conjugate()
            weight = 1 / (variance + (half * g).real)
            # what a response more takes off half the cost, and products of responses of A and B with it
            off, with_a, with_b = 0j, 0j, 0.0
            for m in range(records):
                y, u = data.y[point, m, place], data.u[same, m, place]
                of_c = 0j
                for i in range(c):
                    of_c += theta[point, m, a + b + i] * basis_c[k, i]
                model = g * u + of_c * inverse_a
                error = y - model
                squared = error.real * error.real + error.imag * error.imag
                off += error.conjugate() * u + weight * squared * half
                with_a -= model * u.conjugate()
                with_b += u.real * u.real + u.imag * u.imag
                for i in range(c):
                    value = weight * inverse_a * u.conjugate() * basis_c[k, i]
                    own[a + b + m * c + i, 0, k], own[a + b + m * c + i, 1, k] = value.real, value.imag
            slope[0, k], slope[1, k], power[k] = weight * off.real, weight * off.imag, weight * with_b
            for i in range(a + b):
                value = with_a * basis_a[k, i] if i < a else with_b * basis_b[k, i - a]
                value *= weight * inverse_a
                own[i, 0, k], own[i, 1, k] = value.real, value.imag
            for r in range(2):
                value = numerator[k, r] * inverse_a
                pair[r, 0, k], pair[r, 1, k] = value.real, value.imag
        falls[point, 0] = _fall(pair, own, slope, power, inverse[point], crossed, rest)
        taken[point], left[point] = crossed, rest
        for m in range(modes.shape[0]):
            falls[point, 1 + m] = _fall(modes[m], own, slope, power, inverse[point], crossed, rest)


@inner
def _fall(pair, own, slope, power, inverse, crossed, rest):
    """What the cost falls by along a pair of responses (2, 2, K), real and imaginary parts.

    And the products of `_falls`, into `crossed` (2, n) and `rest` (2, 3).
    """
    n, bins = own.shape[0], power.size
    p_00 = p_01 = p_11 = s_0 = s_1 = 0.0
    for k in range(bins):
        re_0, im_0, re_1, im_1 = pair[0, 0, k], pair[0, 1, k], pair[1, 0, k], pair[1, 1, k]
        p_00 += power[k] * (re_0 * re_0 + im_0 * im_0)
        p_01 += power[k] * (re_0 * re_1 + im_0 * im_1)
        p_11 += power[k] * (re_1 * re_1 + im_1 * im_1)
        s_0 += slope[0, k] * re_0 - slope[1, k] * im_0
        s_1 += slope[0, k] * re_1 - slope[1, k] * im_1
    for i in range(n):
        c_0 = c_1 = 0.0
        for k in range(bins):
            c_0 += own[i, 0, k] * pair[0, 0, k] + own[i, 1, k] * pair[0, 1, k]
            c_1 += own[i, 0, k] * pair[1, 0, k] + own[i, 1, k] * pair[1, 1, k]
        crossed[0, i], crossed[1, i] = c_0, c_1
    left_00, left_01, left_11 = p_00, p_01, p_11
    for i in range(n):
        for j in range(n):
            left_00 -= crossed[0, i] * inverse[i, j] * crossed[0, j]
            left_01 -= crossed[0, i] * inverse[i, j] * crossed[1, j]
            left_11 -= crossed[1, i] * inverse[i, j] * crossed[1, j]
    rest[0, 0], rest[0, 1], rest[0, 2] = left_00, left_01, s_0
    rest[1, 0], rest[1, 1], rest[1, 2] = left_01, left_11, s_1
    determinant = left_00 * left_11 - left_01 * left_01
    if not determinant > LEAST_LEFT * p_00 * p_11:
        return 0.0
    return (left_11 * s_0 * s_0 - 2 * left_01 * s_0 * s_1 + left_00 * s_1 * s_1) / determinant
