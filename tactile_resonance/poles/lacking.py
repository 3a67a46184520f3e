# SPDX-License-Identifier: Apache-2.0
"""What a fit lacks: one mode more, or two residual terms more.

Score tests. What a richer model has in addition are directions of the response. The part of the
residuals along such a direction that the fit's own coefficients cannot take up is what the cost would
fall by in the richer fit, which need not be made (Rao, *Linear Statistical Inference and Its
Applications*, 2nd ed. (1973), section 6e). The pole of another mode is searched for on a grid; the
threshold allows for the number of trials.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.poles.basis import PolynomialBasis
from tactile_resonance.poles.compiled import entry, inner
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.whiteness import are_smooth

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan


# How often each of the two tests finds something lacking in a model that is complete.
FALSE_ALARM = 2e-4
# Part of a direction's power that a fit must leave for it to be tried.
LEAST_LEFT = 1e-8
# Half widths of the modes tried: from the spacing of the lines to this part of the band. Wider ones are
# residual terms.
WIDEST = 1 / 8
# Distance of the modes tried, in half widths.
GRID = 1.5
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
        """Directions on lines.

        Parameters
        ----------
        frequency_hz : (K,) float
            Ascending.
        x : (K,) complex
            The variable of the model there.
        numerator_order : int
        """
        pole = poles_tried(frequency_hz)
        s = 2j * np.pi * frequency_hz[:, None]
        above, below = 1 / (s - pole), 1 / (s - pole.conj())
        phi = np.stack([above + below, 1j * (above - below)], axis=-1)  # (K, N, 2)
        phi *= np.abs(pole.real)[:, None]
        phi = phi.transpose(1, 2, 0)
        modes = np.ascontiguousarray(np.stack([phi.real, phi.imag], axis=2))
        more = PolynomialBasis.on_lines(x, numerator_order + 2).values[:, numerator_order + 1 :]
        return cls(pole, modes, np.ascontiguousarray(more))


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


@np.errstate(invalid="ignore")
def asks(
    plan: JointPlan, cost: FloatArray, expected: FloatArray, residual: ComplexArray
) -> BoolArray:
    """(batch,) for which points of a batch `lacking_terms` is worth its time.

    Parameters
    ----------
    plan : JointPlan
    cost, expected : (batch,) float
        Of the excited bins.
    residual : (batch, K) complex
        Weighted, turned by the phase of the input.
    """
    others = plan.others_at.size
    if others == 0:
        return are_smooth(residual, plan.structure.parameters, SMOOTHNESS_ASKS)
    return np.asarray(cost > expected + COST_ASKS * np.sqrt(expected * (1 + expected / others)))


@np.errstate(all="ignore")
def lacking_terms(
    plan: JointPlan,
    data: BinData,
    theta: FloatArray,
    inverse: FloatArray,
    cost: FloatArray,
) -> FloatArray:
    """What the model of fitted points lacks.

    Parameters
    ----------
    plan : JointPlan
    data : BinData
        Of one record each.
    theta : (batch, n) float
        The fit.
    inverse : (batch, n, n) float
        Of its normal matrices.
    cost : (batch,) float
        Of all bins.

    Returns
    -------
    (batch, 3) float
        Chi-square of what is lacking, its number of parameters, and f0 [Hz] of the mode, NaN for
        residual terms; all NaN where nothing is lacking.

    Notes
    -----
    The level of the noise is what the residuals of all bins have besides that direction, so that each
    direction has an F test of 2 and ``2 (dof - 1)`` degrees of freedom: a share R of the cost is
    exceeded by chance with ``(1 - R)^(dof - 1)``.
    """
    directions = plan.directions
    dof = data.undriven + data.driven - theta.shape[1] / 2
    fall = _falls(data, plan.driven_bases, theta, inverse, directions.numerator, directions.modes)
    found = np.full((len(fall), 3), np.nan)
    least = 1 - FALSE_ALARM ** (1 / max(dof - 1, 0.5))  # of the cost: chance makes it fall by less
    for k in np.flatnonzero((fall > least * cost[:, None]).any(axis=1)):
        chance = (dof - 1) * np.log1p(-fall[k] / cost[k])
        chance[1:] += np.log(max(directions.poles_rad_s.size, 1))
        chance[np.isnan(chance)] = 0.0
        best = np.argmin(chance)
        if chance[best] < np.log(FALSE_ALARM):
            found[k, 0] = 2 * fall[k, best] * (dof - 1) / (cost[k] - fall[k, best])
            found[k, 1] = 2.0 if best == 0 else 4.0
            if best > 0:
                found[k, 2] = np.abs(directions.poles_rad_s[best - 1]) / (2 * np.pi)
    return found


@entry
def _falls(data, bases, theta, inverse, numerator, modes):
    """(points, 1 + N) what costs fall by with two residual terms more, or with each of N modes.

    Of fitted points (points, n) of one record, with `bases` of A, B and C on driven bins. 0 where the fit has
    taken a direction up already.
    """
    basis_a, basis_b, basis_c = bases
    points, n = theta.shape
    bins, a, b = basis_a.shape[0], basis_a.shape[1] - 1, basis_b.shape[1]
    own, slope, power = np.empty((n, 2, bins)), np.empty((2, bins)), np.empty(bins)
    pair, crossed = np.empty((2, 2, bins)), np.empty((2, n))
    falls, same_y, same_u = np.empty((points, 1 + modes.shape[0])), data.variance_y, data.variance_u
    same_yu = data.covariance_yu
    for point in range(points):
        for k in range(bins):
            place = data.order[data.undriven + k]
            y, u = data.y[point, 0, place], data.u[point, 0, place]
            of_a, of_b, of_c = basis_a[k, a], 0j, 0j
            for i in range(a):
                of_a += theta[point, i] * basis_a[k, i]
            for i in range(b):
                of_b += theta[point, a + i] * basis_b[k, i]
            for i in range(n - a - b):
                of_c += theta[point, a + b + i] * basis_c[k, i]
            inverse_a = 1 / of_a
            g = of_b * inverse_a
            model = g * u + of_c * inverse_a
            error, half = y - model, 0j  # half the derivative of the variance by g
            variance = same_y[point, min(k, same_y.shape[1] - 1)]
            if same_u.shape[1] > 0:
                half += same_u[point, min(k, same_u.shape[1] - 1)] * g.conjugate()
            if same_yu.shape[1] > 0:
                covariance = same_yu[point, min(k, same_yu.shape[1] - 1)]
                variance -= (covariance * g.conjugate()).real
                half -= covariance.conjugate()
            weight = 1 / (variance + (half * g).real)
            # what a response more takes off half the cost
            squared = error.real * error.real + error.imag * error.imag
            value = weight * (error.conjugate() * u + weight * squared * half)
            slope[0, k], slope[1, k] = value.real, value.imag
            power[k] = weight * (u.real * u.real + u.imag * u.imag)
            for i in range(n):
                if i < a:
                    value = -model * basis_a[k, i]
                elif i < a + b:
                    value = u * basis_b[k, i - a]
                else:
                    value = basis_c[k, i - a - b]
                value *= weight * inverse_a * u.conjugate()
                own[i, 0, k], own[i, 1, k] = value.real, value.imag
            for r in range(2):
                value = numerator[k, r] * inverse_a
                pair[r, 0, k], pair[r, 1, k] = value.real, value.imag
        falls[point, 0] = _fall(pair, own, slope, power, inverse[point], crossed)
        for m in range(modes.shape[0]):
            falls[point, 1 + m] = _fall(modes[m], own, slope, power, inverse[point], crossed)
    return falls


@inner
def _fall(pair, own, slope, power, inverse, crossed):
    """What the cost falls by along a pair of responses (2, 2, K), real and imaginary parts."""
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
    determinant = left_00 * left_11 - left_01 * left_01
    if not determinant > LEAST_LEFT * p_00 * p_11:
        return 0.0
    return (left_11 * s_0 * s_0 - 2 * left_01 * s_0 * s_1 + left_00 * s_1 * s_1) / determinant
