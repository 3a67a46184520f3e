# SPDX-License-Identifier: Apache-2.0
"""Weighted least-squares fit of a rational function to a frequency response.

With the sample variance as weight this is the sample maximum likelihood estimate for an FRF (Pintelon &
Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012), chapter 12).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.basis import PolynomialBasis
from tactile_resonance.identification.structure import ModelStructure

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

START_ITERATIONS = 20
MAX_ITERATIONS = 100
STEP_TOLERANCE = 1e-9


@dataclass(frozen=True)
class RationalFit:
    """``B / A`` on scaled ``x = s / scale_rad_s``, coefficients over orthonormal bases.

    Attributes
    ----------
    denominator : (n + 1,) float
        Over `denominator_basis`; the last one is 1.
    numerator : (m + 1,) float
        Over `numerator_basis`.
    scale_rad_s : float
    denominator_basis, numerator_basis : PolynomialBasis
    jacobian : (2 F, n + m + 1) float
        Real and imaginary part of the derivative of the weighted model by [denominator, numerator].
    weight : (F,) float
        One over the standard deviation.
    cost : float
    converged : bool
    iterations : int
    """

    denominator: FloatArray
    numerator: FloatArray
    scale_rad_s: float
    denominator_basis: PolynomialBasis
    numerator_basis: PolynomialBasis
    jacobian: FloatArray
    weight: FloatArray
    cost: float
    converged: bool
    iterations: int

    def poles_rad_s(self) -> ComplexArray:
        """(n,) all poles [rad/s]."""
        return self.denominator_basis.roots(self.denominator) * self.scale_rad_s

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """(F,) the model at any frequencies."""
        x = 2j * np.pi * frequency_hz / self.scale_rad_s
        a = self.denominator_basis.at(x)[0] @ self.denominator
        return (self.numerator_basis.at(x)[0] @ self.numerator) / a

    def residues(self, poles_rad_s: ComplexArray) -> ComplexArray:
        """Residue of ``B / A`` at simple poles [rad/s]."""
        x = poles_rad_s / self.scale_rad_s
        _, slope = self.denominator_basis.at(x)
        values, _ = self.numerator_basis.at(x)
        return self.scale_rad_s * (values @ self.numerator) / (slope @ self.denominator)

    def pole_sensitivity(self, poles_rad_s: ComplexArray) -> ComplexArray:
        """(n_poles, n + m + 1) derivative of simple poles by [denominator, numerator]."""
        x = poles_rad_s / self.scale_rad_s
        values, slopes = self.denominator_basis.at(x)
        order = self.denominator.size - 1
        sensitivity = np.zeros((x.size, order + self.numerator.size), complex)
        # A(x; a) = 0 along the root: dx = - dA / A'
        sensitivity[:, :order] = -values[:, :order] / (slopes @ self.denominator)[:, None]
        return sensitivity * self.scale_rad_s


def fit_rational(
    frequency_hz: FloatArray,
    g: ComplexArray,
    std: FloatArray,
    structure: ModelStructure,
) -> RationalFit:
    """Minimise ``sum_k |G_k - B_k / A_k|^2 / std_k^2`` over real coefficients.

    Start values come from Sanathanan-Koerner iterations (IEEE Trans. Autom. Control 8 (1963) 56-58), the
    minimum from Levenberg-Marquardt.

    Parameters
    ----------
    frequency_hz : (F,) float
    g : (F,) complex
    std : (F,) float
        Standard deviation of each line, ``sqrt(E|dG|^2)``; any common factor leaves the result alone.
    structure : ModelStructure
        With ``2 F`` at least the number of parameters.
    """
    scale = 2 * np.pi * float(frequency_hz.max())
    x = 2j * np.pi * frequency_hz / scale
    denominator_basis = PolynomialBasis.on_lines(x, structure.order)
    numerator_basis = PolynomialBasis.on_lines(x, structure.numerator_order)
    weight = 1 / std
    p = denominator_basis.values  # (F, n + 1)
    q = numerator_basis.values  # (F, m + 1)
    theta = _start_values(p, q, g, weight)
    order = structure.order

    def linearise(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        a = p[:, :order] @ parameters[:order] + p[:, order]
        b = q @ parameters[order:]
        residual = _stack(weight * (g - b / a))
        derivative = np.concatenate(
            [-(b / a**2)[:, None] * p[:, :order], q / a[:, None]], axis=1
        )  # (F, n + m + 1)
        return residual, _stack(weight[:, None] * derivative)

    residual, jacobian = linearise(theta)
    cost = float(residual @ residual)
    damping = 0.0
    converged = False
    iterations = 0
    for iterations in range(1, MAX_ITERATIONS + 1):
        column = np.linalg.norm(jacobian, axis=0)
        column[column == 0] = 1.0
        step, small = _step(jacobian / column, residual, damping)
        trial = theta + step / column
        trial_residual, trial_jacobian = linearise(trial)
        trial_cost = float(trial_residual @ trial_residual)
        # rounding of the cost itself must not count as an increase
        if trial_cost <= cost * (1 + 1e-12):
            theta, residual, jacobian, cost = trial, trial_residual, trial_jacobian, trial_cost
            damping *= 0.1
            if small < STEP_TOLERANCE * max(1.0, np.linalg.norm(theta * column)):
                converged = True
                break
        else:
            damping = max(10 * damping, 1e-6)
            if damping > 1e12:
                break
    return RationalFit(
        denominator=np.append(theta[:order], 1.0),
        numerator=theta[order:],
        scale_rad_s=scale,
        denominator_basis=denominator_basis,
        numerator_basis=numerator_basis,
        jacobian=jacobian,
        weight=weight,
        cost=cost,
        converged=converged,
        iterations=iterations,
    )


def _start_values(
    p: ComplexArray, q: ComplexArray, g: ComplexArray, weight: FloatArray
) -> FloatArray:
    """Sanathanan-Koerner: linear least squares, reweighted with the last denominator; the best of all."""
    order = p.shape[1] - 1
    previous = np.ones(g.size, complex)
    best = np.zeros(order + q.shape[1])
    best_cost = np.inf
    for _ in range(START_ITERATIONS):
        w = weight / np.abs(previous)
        # A G - B = 0 with A = p_n + sum a_k p_k
        design = _stack(w[:, None] * np.concatenate([-g[:, None] * p[:, :order], q], axis=1))
        theta = np.linalg.lstsq(design, _stack(w * g * p[:, order]), rcond=None)[0]
        a = p[:, :order] @ theta[:order] + p[:, order]
        error = weight * (g - (q @ theta[order:]) / a)
        cost = float(np.sum(np.abs(error) ** 2))
        if cost < best_cost * (1 - 1e-3):
            best, best_cost, previous = theta, cost, a
        else:
            break
    return best


def _step(jacobian: FloatArray, residual: FloatArray, damping: float) -> tuple[FloatArray, float]:
    """Levenberg-Marquardt step for unit columns, and its length."""
    if damping > 0:
        n = jacobian.shape[1]
        jacobian = np.concatenate([jacobian, np.sqrt(damping) * np.eye(n)])
        residual = np.concatenate([residual, np.zeros(n)])
    step = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    return step, float(np.linalg.norm(step))


def _stack(values: ComplexArray) -> FloatArray:
    """Real part over imaginary part."""
    return np.concatenate([values.real, values.imag])
