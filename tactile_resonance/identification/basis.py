# SPDX-License-Identifier: Apache-2.0
"""Real-coefficient polynomials that are orthonormal on the lines of the band.

Powers of s over a narrow band are all but parallel; a basis orthonormal on the data makes the same
polynomials well conditioned (Forsythe 1957; Brubeck, Nakatsukasa, Trefethen, *Vandermonde with
Arnoldi*, SIAM Review 63 (2021) 405-415). The inner product is the real part, so that coefficients
stay real.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class PolynomialBasis:
    """Polynomials p_0 .. p_n with ``x p_k = sum_j hessenberg[j, k] p_j``.

    Attributes
    ----------
    values : (F, n + 1) complex
        On the lines.
    hessenberg : (n + 1, n) float
    """

    values: ComplexArray
    hessenberg: FloatArray

    @classmethod
    def on_lines(cls, x: ComplexArray, degree: int) -> PolynomialBasis:
        """Basis up to `degree`, orthonormal on the points `x` (F,): mean of ``|p_k|^2`` is 1."""
        values = np.zeros((x.size, degree + 1), complex)
        hessenberg = np.zeros((degree + 1, degree))
        values[:, 0] = 1.0
        for k in range(degree):
            new = x * values[:, k]
            for _ in range(2):  # twice is enough: the second pass removes what rounding left
                projection = np.real(values[:, : k + 1].conj().T @ new) / x.size
                new = new - values[:, : k + 1] @ projection
                hessenberg[: k + 1, k] += projection
            hessenberg[k + 1, k] = np.sqrt(np.mean(np.abs(new) ** 2))
            values[:, k + 1] = new / hessenberg[k + 1, k]
        return cls(values, hessenberg)

    def at(self, x: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Values and derivatives at other points.

        Parameters
        ----------
        x : (n_x,) complex

        Returns
        -------
        values, derivatives : (n_x, n + 1) complex
        """
        degree = self.hessenberg.shape[1]
        values = np.zeros((x.size, degree + 1), complex)
        slopes = np.zeros_like(values)
        values[:, 0] = 1.0
        for k in range(degree):
            column = self.hessenberg[: k + 1, k]
            scale = self.hessenberg[k + 1, k]
            values[:, k + 1] = (x * values[:, k] - values[:, : k + 1] @ column) / scale
            slopes[:, k + 1] = (
                values[:, k] + x * slopes[:, k] - slopes[:, : k + 1] @ column
            ) / scale
        return values, slopes

    def roots(self, coefficients: FloatArray) -> ComplexArray:
        """Roots of ``sum_k coefficients[k] p_k``, by the eigenvalues of its comrade matrix.

        Parameters
        ----------
        coefficients : (m + 1,) float
            With m from 1 to the basis' degree, and a last coefficient other than zero.
        """
        m = coefficients.size - 1
        comrade = self.hessenberg[:m, :m].copy()
        comrade[:, -1] -= self.hessenberg[m, m - 1] * coefficients[:m] / coefficients[m]
        return np.linalg.eigvals(comrade)
