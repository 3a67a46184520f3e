# SPDX-License-Identifier: Apache-2.0
"""Covariance of the parameters, and of the poles that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_resonance.identification.rational_fit import RationalFit
from tactile_resonance.identification.result import (
    ComplexArray,
    FloatArray,
    natural_frequency_and_damping_jacobian,
)


@dataclass(frozen=True)
class ParameterCovariance:
    """Covariance of [denominator, numerator] for unit-variance weighted residuals.

    Attributes
    ----------
    inverse : (n, n) float
        ``(J^T J)^-1`` for the column-scaled Jacobian.
    scaled_jacobian : (2 F, n) float
    column : (n,) float
        Norms the columns were divided by.
    condition_number : float
        Of the scaled Jacobian.
    """

    inverse: FloatArray
    scaled_jacobian: FloatArray
    column: FloatArray
    condition_number: float

    @classmethod
    def of(cls, fit: RationalFit) -> ParameterCovariance:
        """Through the singular values: J^T J would square the condition number."""
        column = np.linalg.norm(fit.jacobian, axis=0)
        column[column == 0] = 1.0
        scaled = fit.jacobian / column
        _, singular, vh = np.linalg.svd(scaled, full_matrices=False)
        condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")
        with np.errstate(divide="ignore", invalid="ignore"):
            half = vh.T / singular
        return cls(half @ half.T, scaled, column, condition)

    def from_weights(self) -> FloatArray:
        """(n, n) covariance where the variance of each line is the one it was weighted with.

        The two real components of a circular complex error have half its variance each.
        """
        return 0.5 * self.inverse / np.outer(self.column, self.column)

    def from_variance(self, ratio: FloatArray) -> FloatArray:
        """(n, n) covariance where the variance is `ratio` (F,) times the one weighted with."""
        weighted = self.scaled_jacobian * np.concatenate([ratio, ratio])[:, None]
        inner = self.scaled_jacobian.T @ weighted
        return 0.5 * self.inverse @ inner @ self.inverse / np.outer(self.column, self.column)


def pole_covariance(
    fit: RationalFit, poles_rad_s: ComplexArray, parameters: FloatArray
) -> FloatArray:
    """(n_poles, 2, 2) covariance of (Re, Im) of simple poles, to first order."""
    sensitivity = fit.pole_sensitivity(poles_rad_s)  # (n_poles, n)
    stacked = np.stack([sensitivity.real, sensitivity.imag], axis=1)  # (n_poles, 2, n)
    return stacked @ parameters @ np.swapaxes(stacked, -1, -2)


def f0_damping_covariance(poles_rad_s: ComplexArray, covariance: FloatArray) -> FloatArray:
    """(n_poles, 2, 2) covariance of (f0_hz, damping_ratio) from that of (Re, Im)."""
    jacobian = natural_frequency_and_damping_jacobian(poles_rad_s)
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)
