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
from tactile_resonance.poles.bins import BinData
from tactile_resonance.poles.likelihood import best_fall
from tactile_resonance.poles.whiteness import are_smooth

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan


# How often each of the two tests finds something lacking in a model that is complete.
FALSE_ALARM = 2e-4
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
    best, fall, chance = best_fall(
        plan.problem.tables,
        data.arrays,
        plan.driven_bases,
        theta,
        inverse,
        cost,
        dof,
        directions.numerator,
        directions.modes,
    )
    found = np.full((best.size, 3), np.nan)
    for k in np.flatnonzero(chance < np.log(FALSE_ALARM)):
        found[k, 0] = 2 * fall[k] * (dof - 1) / (cost[k] - fall[k])
        found[k, 1] = 2.0 if best[k] == 0 else 4.0
        if best[k] > 0:
            found[k, 2] = np.abs(directions.poles_rad_s[best[k] - 1]) / (2 * np.pi)
    return found
