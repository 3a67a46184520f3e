# SPDX-License-Identifier: Apache-2.0
"""What fits of points on the same bins, or lines, share whatever the data: bases, structure, band."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.basis import PolynomialBasis
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import minimise
from tactile_resonance.poles.lacking import Directions
from tactile_resonance.poles.likelihood import Rules, Solution
from tactile_resonance.poles.model import RationalModel, Variable
from tactile_resonance.poles.modes import (
    beside_others,
    modes_in_band,
    pole_quantities,
    second_order,
    significant_modes,
)
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.poles.tables import Problem

if TYPE_CHECKING:
    from typing_extensions import Self

# Of fits that are only compared: a mode too many, which no data determine, converges slowly and nowhere
# in particular.
COMPARISON = Rules(iterations=8)


class FitPlan(ABC):
    """Bases on which points are fitted: of all bins of a band (`joint`), or of lines (`lines_fit`).

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
        """The model of coefficients (batch, n)."""
        coefficients, bases = self.problem.split(theta), (self.denominator_basis, self.numerator_basis)
        return RationalModel(*coefficients, self.variable, *bases)

    def poles_in_band(self, theta: FloatArray) -> ComplexArray:
        """(batch, places) poles [rad/s] of coefficients (batch, n)."""
        roots = self.denominator_basis.roots(self.problem.split(theta)[0])
        return modes_in_band(self.variable.to_s(roots)[0], self.band_hz)

    def compared(self, data: BinData, start: FloatArray | None = None) -> ComplexArray:
        """Poles (points, places) of a fit of few iterations that others are compared with."""
        return self.poles_in_band(minimise(self.problem, data, start, COMPARISON).theta[:, 0])

    @abstractmethod
    def with_covariance(self, data: BinData) -> tuple[ComplexArray, FloatArray]:
        """Poles of a fit, in the band or not, and their covariance as its residuals show it."""

    def poles_and_covariance(
        self, data: BinData, solution: Solution
    ) -> tuple[ComplexArray, FloatArray, BoolArray]:
        """Poles of a solution, in the band or not, and their covariance as its residuals show it.

        Returns
        -------
        poles : (points, places) complex
        covariance : (points, places, 2, 2) float
            Of (f0_hz, damping_ratio); NaN where the data do not determine the mode.
        lost : (points,) bool
            Where a mode is none, or noise makes it and it is not beside another one.
        """
        own, n = self.problem.sizes[2], solution.theta.shape[-1]
        free = data.records * own + n - own
        dof = max(data.records * data.order.size - free / 2, 1)
        covariance = solution.marginal[:, 0] * (solution.cost / (2 * dof))[:, None, None]
        model = self.model_of(solution.theta[:, 0])
        quantities, _ = pole_quantities(model, (0.0, np.inf), covariance)
        poles = quantities["poles_rad_s"]
        lines = np.full(solution.cost.size, int(dof))
        found, distance = significant_modes(model, quantities, covariance, lines)
        in_f0 = quantities["covariance"]
        in_f0[~((np.linalg.det(in_f0) > 0) & (in_f0[..., 0, 0] > 0))] = np.nan  # lost to rounding
        more = second_order(poles, np.isfinite(poles), distance)
        lost = np.asarray((~found & ~beside_others(poles, found)).any(axis=-1))
        return poles, in_f0 + more, lost

