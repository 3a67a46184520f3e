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
import numpy.typing as npt

from tactile_resonance.poles.basis import PolynomialBasis
from tactile_resonance.poles.bins import BinData
from tactile_resonance.poles.likelihood import invert, moments
from tactile_resonance.poles.whiteness import are_smooth

if TYPE_CHECKING:
    from tactile_resonance.poles.joint_layout import JointLayout

BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

# How often each of the two tests finds something lacking in a model that is complete.
FALSE_ALARM = 2e-4
# Half widths of the modes tried: from the spacing of the lines to this part of the band. Wider ones are
# residual terms.
WIDEST = 1 / 8
# Distance of the modes tried, in half widths.
GRID = 1.5
# Part of a direction's power that the fit must leave for it to be tried.
LEAST_LEFT = 1e-8
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
    modes : (2 K, 2 N) float
        Their responses for residues 1 and j; weights as floats times this are ``Re sum weight phi``.
    mode_products : (K, 3 N) float
        See `_products`.
    numerator : (K, 2) complex
        The next two polynomials of the numerator.
    numerator_products : (K, 3) float
    """

    poles_rad_s: ComplexArray
    modes: FloatArray
    mode_products: FloatArray
    numerator: ComplexArray
    numerator_products: FloatArray

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
        low, high = frequency_hz[0], frequency_hz[-1]
        half_width = np.median(np.diff(frequency_hz))
        poles = [np.empty(0, complex)]
        while half_width <= WIDEST * (high - low) * (1 + 1e-9):
            places = 1 + int(np.ceil((high - low) / (GRID * half_width)))
            poles.append(-half_width + 1j * np.linspace(low, high, places))
            half_width *= 2
        pole = np.asarray(2 * np.pi * np.concatenate(poles), complex)
        s = 2j * np.pi * frequency_hz[:, None]
        above, below = 1 / (s - pole), 1 / (s - pole.conj())
        phi = np.stack([above + below, 1j * (above - below)], axis=-1)  # (K, N, 2)
        phi *= np.abs(pole.real)[:, None]
        flat = phi.reshape(x.size, -1)
        more = PolynomialBasis.on_lines(x, numerator_order + 2).values[:, numerator_order + 1 :]
        return cls(
            pole,
            np.stack([flat.real, -flat.imag], axis=1).reshape(2 * x.size, -1),
            _products(phi),
            more,
            _products(more[:, None]),
        )


@np.errstate(invalid="ignore")
def asks(
    layout: JointLayout, cost: FloatArray, expected: FloatArray, residual: ComplexArray
) -> BoolArray:
    """(batch,) for which points of a batch `lacking_terms` is worth its time.

    Parameters
    ----------
    layout : JointLayout
    cost, expected : (batch,) float
        Of the excited bins.
    residual : (batch, K) complex
        Weighted, turned by the phase of the input.
    """
    others = layout.other_bins.size
    if others == 0:
        return are_smooth(residual, layout.structure.parameters, SMOOTHNESS_ASKS)
    return np.asarray(cost > expected + COST_ASKS * np.sqrt(expected * (1 + expected / others)))


@np.errstate(all="ignore")
def lacking_terms(
    layout: JointLayout, data: BinData, theta: FloatArray, inverse: FloatArray | None = None
) -> FloatArray:
    """What the model of fitted points lacks.

    Parameters
    ----------
    layout : JointLayout
    data : BinData
        Of one record each.
    theta : (batch, n) float
        The fit.
    inverse : (batch, n, n) float, optional
        Of its normal matrices, where at hand.

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
    problem, directions = layout.problem, layout.directions
    costs, _, normal = moments(problem.tables, data.arrays, theta[:, None])
    cost = costs.sum(axis=-1)
    if inverse is None:
        inverse = invert(normal[:, 0].sum(axis=1))[0]
    alpha, beta, gamma = problem.split(theta)
    driven = slice(problem.undriven, None)
    denominator, transient = problem.denominator[driven], problem.transient[driven]
    one_over_a = 1 / (alpha @ denominator.T)  # (batch, K)
    response = (beta @ problem.numerator.T) * one_over_a
    u = data.u_driven[:, 0]
    model = response * u + (gamma @ transient.T) * one_over_a
    error = data.y_driven[:, 0] - model
    weight = 1 / data.residual_variance(response)[:, 0]  # (batch, K)
    slope = np.conj(error) * u * weight  # what a response more takes off half the cost
    if data.variance_u is not None:
        by_g = data.variance_u[:, 0] * np.conj(response)
        if data.covariance_yu is not None:
            by_g = by_g - np.conj(data.covariance_yu[:, 0])
        slope = slope + by_g * np.abs(error * weight) ** 2
    scaled = np.conj(one_over_a) * u * weight
    blocks = [
        (-np.conj(model) * scaled)[:, None] * denominator[:, :-1].conj().T,
        (np.conj(u) * scaled)[:, None] * problem.numerator.conj().T,
        scaled[:, None] * transient.conj().T,
    ]
    of_fit = np.ascontiguousarray(np.concatenate(blocks, axis=1))  # (batch, n, K)
    power = weight * (u.real**2 + u.imag**2)
    terms = one_over_a[..., None] * directions.numerator  # (batch, K, 2)
    by_terms = np.real(slope[:, None] @ terms)[:, 0]
    own = (np.abs(one_over_a) ** 2 * power) @ directions.numerator_products
    falls = [_fall(inverse, by_terms, own, np.real(of_fit @ terms))]
    if directions.poles_rad_s.size:
        by_modes = np.ascontiguousarray(slope).view(float) @ directions.modes
        crossed = of_fit.view(float).reshape(-1, directions.modes.shape[0]) @ directions.modes
        crossed = crossed.reshape(*theta.shape, -1)
        falls.append(_fall(inverse, by_modes, power @ directions.mode_products, crossed))
    fall = np.concatenate(falls, axis=1)  # (batch, 1 + N)
    dof = data.y.shape[-1] - theta.shape[1] / 2
    chance = (dof - 1) * np.log1p(-fall / cost[:, None])
    chance[:, 1:] += np.log(max(directions.poles_rad_s.size, 1))
    best = np.argmin(np.nan_to_num(chance), axis=1)[:, None]
    fall, chance = (np.take_along_axis(v, best, axis=1) for v in (fall, chance))
    chi_square = 2 * fall * (dof - 1) / (cost[:, None] - fall)
    f0_hz = np.append(np.nan, np.abs(directions.poles_rad_s) / (2 * np.pi))[best]
    found = np.concatenate([chi_square, np.where(best > 0, 4.0, 2.0), f0_hz], axis=1)
    return np.where(chance < np.log(FALSE_ALARM), found, np.nan)


def _products(pairs: ComplexArray) -> FloatArray:
    """(K, 3 N) ``Re conj(phi_i) phi_j`` of each pair of (K, N, 2): 00, 01, 11."""
    first, second = pairs[..., 0], pairs[..., 1]
    products = [np.abs(first) ** 2, np.real(first.conj() * second), np.abs(second) ** 2]
    return np.stack(products, axis=-1).reshape(pairs.shape[0], -1)


def _fall(
    inverse: FloatArray, score: FloatArray, own: FloatArray, crossed: FloatArray
) -> FloatArray:
    """(batch, N) what the cost falls by along pairs of directions.

    Parameters
    ----------
    inverse : (batch, n, n) float
        Of the normal matrix of the fit.
    score : (batch, 2 N) float
    own : (batch, 3 N) float
        Products of the two of a pair with each other, as `_products`.
    crossed : (batch, n, 2 N) float
        Products with the fit's own directions.
    """
    taken = inverse @ crossed
    first, second = slice(0, None, 2), slice(1, None, 2)
    left = [
        own[:, k::3] - np.einsum("bnk,bnk->bk", crossed[..., i], taken[..., j])
        for k, (i, j) in enumerate(((first, first), (first, second), (second, second)))
    ]
    determinant = left[0] * left[2] - left[1] ** 2
    a, b = score[:, first], score[:, second]
    fall = (left[2] * a**2 - 2 * left[1] * a * b + left[0] * b**2) / determinant
    return np.where(determinant > LEAST_LEFT * own[:, ::3] * own[:, 2::3], fall, 0.0)
