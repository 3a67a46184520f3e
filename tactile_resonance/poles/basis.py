# SPDX-License-Identifier: Apache-2.0
"""Real-coefficient polynomials that are orthonormal on the lines of the band, and those of transients.

Powers of s over a narrow band are all but parallel; a basis orthonormal on the data makes the same
polynomials well conditioned (Forsythe 1957; Brubeck, Nakatsukasa, Trefethen, *Vandermonde with
Arnoldi*, SIAM Review 63 (2021) 405-415). The inner product is the real part, so that coefficients
stay real.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.poles.structure import ModelStructure


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
    def on_lines(
        cls, x: ComplexArray, degree: int, weight: FloatArray | None = None
    ) -> PolynomialBasis:
        """Basis up to `degree` on the points `x` (F,).

        Orthonormal in the mean of ``weight |p_k|^2``, with weights (F,) of mean 1 (all 1 when
        absent). A degree that the points cannot distinguish from lower ones has values of no meaning but
        finite ones.
        """
        w = np.ones(x.size) if weight is None else weight
        values = np.zeros((x.size, degree + 1), complex)
        hessenberg = np.zeros((degree + 1, degree))
        values[:, 0] = 1.0
        for k in range(degree):
            new = x * values[:, k]
            for _ in range(2):  # twice is enough: the second pass removes what rounding left
                projection = np.real(values[:, : k + 1].conj().T @ (w * new)) / x.size
                new = new - values[:, : k + 1] @ projection
                hessenberg[: k + 1, k] += projection
            norm = np.sqrt(np.mean(w * np.abs(new) ** 2))
            hessenberg[k + 1, k] = norm if norm > 0 else 1.0
            values[:, k + 1] = new / hessenberg[k + 1, k]
        return cls(values, hessenberg)

    def at(self, x: ComplexArray, derivatives: int = 1) -> ComplexArray:
        """Values and derivatives at other points.

        Parameters
        ----------
        x : (...,) complex
        derivatives : int

        Returns
        -------
        (1 + derivatives, ..., n + 1) complex
            Values, first derivatives, and so on.
        """
        degree = self.hessenberg.shape[1]
        out = np.zeros((1 + derivatives, *np.shape(x), degree + 1), complex)
        out[0, ..., 0] = 1.0
        for k in range(degree):
            new = x * out[..., k] - out[..., : k + 1] @ self.hessenberg[: k + 1, k]
            for order in range(1, 1 + derivatives):
                new[order] += order * out[order - 1, ..., k]
            out[..., k + 1] = new / self.hessenberg[k + 1, k]
        return out

    def roots(self, coefficients: FloatArray) -> ComplexArray:
        """Roots of ``sum_k coefficients[k] p_k``, by the eigenvalues of its comrade matrix.

        Parameters
        ----------
        coefficients : (..., m + 1) float
            With m from 1 to the basis' degree, and a last coefficient other than zero.

        Returns
        -------
        (..., m) complex
            NaN where a coefficient is not finite.
        """
        m = coefficients.shape[-1] - 1
        h = self.hessenberg[:m, :m]
        if m == 2:  # an eigenvalue solver costs more than the fit
            # nodes that carry poles and fit none load no compiler
            from tactile_resonance.poles.modes import two_roots

            return two_roots(coefficients.reshape(-1, 3), self.hessenberg).reshape(*coefficients.shape[:-1], 2)
        last = self.hessenberg[m, m - 1] * coefficients[..., :m] / coefficients[..., m:]
        comrade = np.broadcast_to(h, (*last.shape[:-1], m, m)).copy()
        comrade[..., :, -1] -= last
        finite = np.isfinite(last).all(axis=-1) & np.isfinite(h).all()
        comrade[~finite] = 0.0
        roots = np.linalg.eigvals(comrade).astype(complex)
        roots[~finite] = np.nan
        return roots


def default_transient_terms(structure: ModelStructure) -> int:
    """Length of the transient's numerator that suits a structure.

    A transient of the model's own poles alone has `order` terms; every residual term beyond the
    constant stands for modes outside the band, whose transients are as smooth as their responses.
    Several modes have two more at least, for they need not lie where `transient_basis` takes them.
    """
    residual = min(structure.numerator_order - structure.order, 4)
    return structure.order + max(residual, 2 if structure.order > 2 else 0)


def transient_basis(
    frequency_hz: FloatArray,
    terms: int,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    structure: ModelStructure,
) -> ComplexArray:
    """(K, terms) basis of the transient's numerator.

    Samples of ``exp(p t)`` have the spectrum ``T / (1 - exp((p - s) T))``, aliases of ``1 / (s -
    p)`` included: for n poles a polynomial of order n - 1 in 1/z over ``A(z)``, and ``A(s) / A(z)``
    hardly depends on the poles. It is taken at pairs +-j w spread evenly over the band, one for each
    two poles, and at 0 for a last single one.
    """
    interval_s = 1 / sample_rate_hz
    s = 2j * np.pi * frequency_hz
    basis = PolynomialBasis.on_lines(np.exp(-s * interval_s), terms - 1).values
    if structure.domain == "z":
        return basis * np.exp(s * interval_s * structure.order)[:, None]
    pairs = structure.order // 2
    low, high = band_hz
    w = 2 * np.pi * (low + (high - low) * (np.arange(pairs) + 0.5) / max(pairs, 1))
    factor = np.ones(s.shape, complex)
    for pole in (*(1j * w), *(-1j * w), *[0.0] * (structure.order % 2)):
        step = (s - pole) * interval_s
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = -step / np.expm1(-step)
        factor *= np.where(np.abs(step) < 1e-12, 1.0, ratio)
    return basis * factor[:, None]
