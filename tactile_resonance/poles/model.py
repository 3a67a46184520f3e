# SPDX-License-Identifier: Apache-2.0
"""The identified transfer function: poles, zeros, residues, response, and their derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.poles.basis import PolynomialBasis
from tactile_resonance.poles.compiled import entry
from tactile_resonance.poles.structure import ModelStructure


@dataclass(frozen=True, eq=False)
class Variable:
    """The variable x of the polynomials: ``s / scale`` or ``z``."""

    domain: str
    scale_rad_s: float
    sample_rate_hz: float | None = None

    @classmethod
    def for_lines(cls, frequency_hz: FloatArray, structure: ModelStructure) -> Variable:
        """Scaled to the highest line."""
        scale = 2 * np.pi * float(np.max(frequency_hz))
        return cls(structure.domain, scale if scale > 0 else 1.0, structure.sample_rate_hz)

    def of_frequency(self, frequency_hz: FloatArray) -> ComplexArray:
        """The x of lines [Hz]."""
        return self.of_s(np.asarray(2j * np.pi * np.asarray(frequency_hz), complex))

    def of_s(self, s_rad_s: ComplexArray) -> ComplexArray:
        """The x of points of the s-plane."""
        if self.sample_rate_hz is not None and self.domain == "z":
            return np.asarray(np.exp(s_rad_s / self.sample_rate_hz))
        return s_rad_s / self.scale_rad_s

    def to_s(self, x: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """The s [rad/s] of x, and the derivative ds/dx."""
        if self.sample_rate_hz is not None and self.domain == "z":
            with np.errstate(divide="ignore", invalid="ignore"):
                s = np.asarray(self.sample_rate_hz * np.log(x), complex)
                return s, self.sample_rate_hz / x
        return np.asarray(x * self.scale_rad_s, complex), np.full(
            np.shape(x), self.scale_rad_s, complex
        )


@dataclass(frozen=True, eq=False)
class RationalModel:
    """``B / A exp(-s delay)`` with coefficients over fixed bases; leading axes are batch axes.

    Attributes
    ----------
    denominator : (..., n + 1) float
        Over `denominator_basis`; the last one is 1.
    numerator : (..., m + 1) float
        Over `numerator_basis`.
    transient : (..., t) float
        Coefficients of the transient's numerator, none where there is no transient; of several records
        one after the other.
    variable : Variable
    denominator_basis, numerator_basis : PolynomialBasis
    delay_s : (...) float
    """

    denominator: FloatArray
    numerator: FloatArray
    transient: FloatArray
    variable: Variable
    denominator_basis: PolynomialBasis
    numerator_basis: PolynomialBasis
    delay_s: FloatArray | float = 0.0

    def at(self, index: tuple[int, ...] | tuple[npt.NDArray[np.intp]]) -> RationalModel:
        """The model of one point of a batch, or of some of them."""
        delay = self.delay_s if np.ndim(self.delay_s) == 0 else np.asarray(self.delay_s)[index]
        return replace(
            self,
            denominator=self.denominator[index],
            numerator=self.numerator[index],
            transient=self.transient[index],
            delay_s=delay,
        )

    def poles_rad_s(self) -> ComplexArray:
        """(..., n) all poles [rad/s]."""
        return self.variable.to_s(self.denominator_basis.roots(self.denominator))[0]

    def zeros_rad_s(self) -> ComplexArray:
        """(..., m) all zeros [rad/s]."""
        if self.numerator.shape[-1] < 2:
            return np.empty((*self.numerator.shape[:-1], 0), complex)
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.variable.to_s(self.numerator_basis.roots(self.numerator))[0]

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """(..., F) the model at any frequencies (F,)."""
        x = self.variable.of_frequency(frequency_hz)
        a = self.denominator @ self.denominator_basis.at(x, 0)[0].T
        b = self.numerator @ self.numerator_basis.at(x, 0)[0].T
        phase = 2 * np.pi * np.asarray(frequency_hz) * np.asarray(self.delay_s)[..., None]
        return b / a * np.exp(-1j * phase)

    def residues_and_sensitivity(
        self, poles_rad_s: ComplexArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Residues (..., k) of ``B / A`` at simple poles (..., k) [rad/s], and derivatives (..., k, n).

        In the z-domain residues are of the s-plane function with the same behaviour close to the pole. The
        derivatives are those of the poles by the free coefficients of A.
        """
        x = self.variable.of_s(poles_rad_s)
        points = math.prod(x.shape[:-1])
        arrays = (x, self.variable.to_s(x)[1], self.denominator, self.numerator)
        residues, sensitivity = _residues_and_sensitivity(
            *(array.reshape(points, array.shape[-1]) for array in arrays),
            self.denominator_basis.hessenberg,
            self.numerator_basis.hessenberg,
        )
        return residues.reshape(x.shape), sensitivity.reshape(*x.shape, sensitivity.shape[-1])

    def zero_sensitivity(self, zeros_rad_s: ComplexArray) -> ComplexArray:
        """(..., k, m + 1) derivative of simple zeros (..., k) by the coefficients of B."""
        x = self.variable.of_s(zeros_rad_s)
        values, slopes = self.numerator_basis.at(x)
        factor = -self.variable.to_s(x)[1] / _dot(slopes, self.numerator)
        return values * factor[..., None]

    def residue_sensitivity(self, poles_rad_s: ComplexArray) -> ComplexArray:
        """(..., k, n + m + 1) derivative of the residues by the free coefficients of A, then B."""
        x = self.variable.of_s(poles_rad_s)
        values, slopes, bends = self.denominator_basis.at(x, 2)
        a1 = _dot(slopes, self.denominator)
        a2 = _dot(bends, self.denominator)
        b_values, b_slopes = self.numerator_basis.at(x)
        b, b1 = _dot(b_values, self.numerator), _dot(b_slopes, self.numerator)
        map_1 = self.variable.to_s(x)[1]
        map_2 = -map_1 / x if self.variable.domain == "z" else np.zeros_like(map_1)
        dx = -values[..., :-1] / a1[..., None]
        residue = b / a1
        by_x = (b1 - residue * a2) / a1 * map_1 + residue * map_2
        by_alpha = by_x[..., None] * dx - (residue / a1 * map_1)[..., None] * slopes[..., :-1]
        by_beta = b_values * (map_1 / a1)[..., None]
        return np.concatenate([by_alpha, by_beta], axis=-1)

    def residue_covariance(self, poles_rad_s: ComplexArray, coefficients: FloatArray) -> FloatArray:
        """(..., k, 2, 2) of (Re, Im) of the residues at simple poles (..., k).

        Of `coefficients` (..., p, p), the covariance of the free ones of A, then B.
        """
        return real_covariance(self.residue_sensitivity(poles_rad_s), coefficients)

    def zero_covariance(self, zeros_rad_s: ComplexArray, coefficients: FloatArray) -> FloatArray:
        """(..., k, 2, 2) of (Re, Im) of simple zeros (..., k); see `residue_covariance`."""
        first = self.denominator.shape[-1] - 1
        return real_covariance(self.zero_sensitivity(zeros_rad_s), coefficients[..., first:, first:])


@entry
def _residues_and_sensitivity(x, ds_dx, denominator, numerator, hessenberg_a, hessenberg_b):
    """Of models (points, terms) at their poles x (points, k), (points, k) and (points, k, n)."""
    (points, count), n, terms = x.shape, hessenberg_a.shape[1], hessenberg_b.shape[1] + 1
    residues = np.empty((points, count), np.complex128)
    sensitivity = np.empty((points, count, n), np.complex128)
    value, slope = np.empty(max(n + 1, terms), np.complex128), np.empty(n + 1, np.complex128)
    for point in range(points):
        for k in range(count):
            at = x[point, k]
            value[0], slope[0], derivative = 1.0, 0.0, 0j
            for i in range(n):
                new, more = at * value[i], at * slope[i] + value[i]
                for j in range(i + 1):
                    new -= hessenberg_a[j, i] * value[j]
                    more -= hessenberg_a[j, i] * slope[j]
                value[i + 1], slope[i + 1] = new / hessenberg_a[i + 1, i], more / hessenberg_a[i + 1, i]
                derivative += slope[i + 1] * denominator[point, i + 1]
            # A(x; a) = 0 along the root: dx = - dA / A'
            factor = ds_dx[point, k] / derivative
            for i in range(n):
                sensitivity[point, k, i] = -factor * value[i]
            above = complex(numerator[point, 0])
            for i in range(terms - 1):
                new = at * value[i]
                for j in range(i + 1):
                    new -= hessenberg_b[j, i] * value[j]
                value[i + 1] = new / hessenberg_b[i + 1, i]
                above += value[i + 1] * numerator[point, i + 1]
            residues[point, k] = above * factor
    return residues, sensitivity


def real_covariance(sensitivity: ComplexArray, parameters: FloatArray) -> FloatArray:
    """(..., k, 2, 2) covariance of (Re, Im) of k quantities from that of the coefficients.

    Parameters
    ----------
    sensitivity : (..., k, p) complex
    parameters : (..., n, n) float
        Of which the first p belong to the sensitivity.
    """
    p = sensitivity.shape[-1]
    stacked = real_rows(sensitivity)
    return stacked @ parameters[..., None, :p, :p] @ stacked.swapaxes(-1, -2)


def real_rows(values: ComplexArray) -> FloatArray:
    """(..., 2, p) real and imaginary parts of (..., p)."""
    parts = np.ascontiguousarray(values).view(float).reshape(*values.shape, 2)
    return np.ascontiguousarray(parts.swapaxes(-1, -2))


def _dot(basis: ComplexArray, coefficients: FloatArray) -> ComplexArray:
    """(..., k) of basis (..., k, terms) and coefficients (..., terms)."""
    return (basis @ coefficients[..., None])[..., 0]
