# SPDX-License-Identifier: Apache-2.0
"""The identified transfer function: poles, zeros, residues, response, their derivatives and covariance.

Its polynomials have real coefficients over bases that are orthonormal on the lines of the band: powers of s
over a narrow band are all but parallel; a basis orthonormal on the data makes the same polynomials well
conditioned (Forsythe 1957; Brubeck, Nakatsukasa, Trefethen, *Vandermonde with Arnoldi*, SIAM Review 63 (2021)
405-415). The inner product is the real part, so that coefficients stay real.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.poles.compiled import entry
from tactile_resonance.poles.result import natural_frequency_and_damping
from tactile_resonance.poles.structure import ModelStructure

# A mode this fraction of the band outside of it is still one that the lines show.
BAND_MARGIN = 0.1


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
            roots = np.empty((*coefficients.shape[:-1], 2), complex)
            _two_roots(coefficients.reshape(-1, 3), self.hessenberg, roots.reshape(-1, 2))
            return roots
        last = self.hessenberg[m, m - 1] * coefficients[..., :m] / coefficients[..., m:]
        comrade = np.broadcast_to(h, (*last.shape[:-1], m, m)).copy()
        comrade[..., :, -1] -= last
        finite = np.isfinite(last).all(axis=-1) & np.isfinite(h).all()
        comrade[~finite] = 0.0
        roots = np.linalg.eigvals(comrade).astype(complex)
        roots[~finite] = np.nan
        return roots


@entry
def _two_roots(coefficients, h, roots):
    """Put roots (points, 2) of coefficients (points, 3) into the last; see `PolynomialBasis.roots`.

    In closed form; of complex ones that above the real axis comes first.
    """
    for point in range(coefficients.shape[0]):
        scale = h[2, 1] / coefficients[point, 2]
        first, second = h[0, 0], h[1, 1] - scale * coefficients[point, 1]
        beside = h[0, 1] - scale * coefficients[point, 0]
        half, under = (first + second) / 2, ((first - second) / 2) ** 2 + beside * h[1, 0]
        if under < 0:
            root = np.sqrt(-under)
            roots[point, 0], roots[point, 1] = complex(half, root), complex(half, -root)
        else:
            # the root of larger modulus first, the other from the product: no cancellation
            large = half - np.sqrt(under) if half < 0 else half + np.sqrt(under)
            roots[point, 0] = large
            roots[point, 1] = 0.0 if large == 0 else (first * second - beside * h[1, 0]) / large


@dataclass(frozen=True, eq=False)
class Variable:
    """The variable x of the polynomials: ``s / scale``, or ``z`` where there is a sample rate."""

    scale_rad_s: float
    sample_rate_hz: float | None = None

    @classmethod
    def for_lines(cls, frequency_hz: FloatArray, structure: ModelStructure) -> Variable:
        """Scaled to the highest line."""
        scale = 2 * np.pi * float(np.max(frequency_hz))
        return cls(scale if scale > 0 else 1.0, structure.sample_rate_hz if structure.domain == "z" else None)

    def of_frequency(self, frequency_hz: FloatArray) -> ComplexArray:
        """The x of lines [Hz]."""
        return self.of_s(np.asarray(2j * np.pi * np.asarray(frequency_hz), complex))

    def of_s(self, s_rad_s: ComplexArray) -> ComplexArray:
        """The x of points of the s-plane."""
        if self.sample_rate_hz is not None:
            return np.asarray(np.exp(s_rad_s / self.sample_rate_hz))
        return s_rad_s / self.scale_rad_s

    def to_s(self, x: ComplexArray) -> ComplexArray:
        """The s [rad/s] of x."""
        if self.sample_rate_hz is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.asarray(self.sample_rate_hz * np.log(x), complex)
        return np.asarray(x * self.scale_rad_s, complex)

    def slope(self, x: ComplexArray) -> ComplexArray:
        """The derivative ds/dx [rad/s]."""
        if self.sample_rate_hz is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.asarray(self.sample_rate_hz / x)
        return np.full(x.shape, self.scale_rad_s, complex)


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
    delay_unit_s : float
        Of the delay as the coefficient that follows those of B; 0 where it is none.
    """

    denominator: FloatArray
    numerator: FloatArray
    transient: FloatArray
    variable: Variable
    denominator_basis: PolynomialBasis
    numerator_basis: PolynomialBasis
    delay_s: FloatArray | float = 0.0
    delay_unit_s: float = 0.0

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
        return self.variable.to_s(self.denominator_basis.roots(self.denominator))

    def zeros_rad_s(self) -> ComplexArray:
        """(..., m) all zeros [rad/s]."""
        if self.numerator.shape[-1] < 2:
            return np.empty((*self.numerator.shape[:-1], 0), complex)
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.variable.to_s(self.numerator_basis.roots(self.numerator))

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
        """Residues (..., k) of G at simple poles (..., k) [rad/s], and derivatives (..., k, n).

        In the z-domain residues are of the s-plane function with the same behaviour close to the pole. The
        derivatives are those of the poles by the free coefficients of A.
        """
        x = self.variable.of_s(poles_rad_s)
        points = math.prod(x.shape[:-1])
        arrays = (x, self.variable.slope(x), self.denominator, self.numerator)
        hessenberg = self.denominator_basis.hessenberg, self.numerator_basis.hessenberg
        k, n = x.shape[-1], hessenberg[0].shape[1]
        residues, sensitivity = np.empty((points, k), complex), np.empty((points, k, n), complex)
        _residues_and_sensitivity(
            *(array.reshape(points, array.shape[-1]) for array in arrays), *hessenberg, residues, sensitivity
        )
        turned = residues.reshape(x.shape) * self._turn(poles_rad_s)
        return turned, sensitivity.reshape(*x.shape, n)

    def _turn(self, poles_rad_s: ComplexArray) -> ComplexArray | float:
        """(..., k) what the delay makes of residues at poles (..., k)."""
        if not self.delay_unit_s:
            return 1.0
        return np.asarray(np.exp(-poles_rad_s * np.asarray(self.delay_s)[..., None]))

    def zero_sensitivity(self, zeros_rad_s: ComplexArray) -> ComplexArray:
        """(..., k, m + 1) derivative of simple zeros (..., k) by the coefficients of B."""
        x = self.variable.of_s(zeros_rad_s)
        values, slopes = self.numerator_basis.at(x)
        factor = -self.variable.slope(x) / _dot(slopes, self.numerator)
        return values * factor[..., None]

    def residue_sensitivity(self, poles_rad_s: ComplexArray) -> ComplexArray:
        """(..., k, n + m + 1) derivative of the residues by the free coefficients of A, B, and then a delay."""
        x = self.variable.of_s(poles_rad_s)
        values, slopes, bends = self.denominator_basis.at(x, 2)
        a1 = _dot(slopes, self.denominator)
        a2 = _dot(bends, self.denominator)
        b_values, b_slopes = self.numerator_basis.at(x)
        b, b1 = _dot(b_values, self.numerator), _dot(b_slopes, self.numerator)
        map_1 = self.variable.slope(x)
        map_2 = -map_1 / x if self.variable.sample_rate_hz is not None else np.zeros_like(map_1)
        dx = -values[..., :-1] / a1[..., None]
        residue = b / a1
        by_x = (b1 - residue * a2) / a1 * map_1 + residue * map_2
        by_alpha = by_x[..., None] * dx - (residue / a1 * map_1)[..., None] * slopes[..., :-1]
        by_beta = b_values * (map_1 / a1)[..., None]
        if not self.delay_unit_s:
            return np.concatenate([by_alpha, by_beta], axis=-1)
        delay = np.asarray(self.delay_s)[..., None]
        by_alpha -= (residue * map_1 * delay * map_1)[..., None] * dx
        by_delay = -residue * map_1 * poles_rad_s * self.delay_unit_s
        together = np.concatenate([by_alpha, by_beta, by_delay[..., None]], axis=-1)
        return np.asarray(together * np.asarray(self._turn(poles_rad_s))[..., None])

    def residue_covariance(self, poles_rad_s: ComplexArray, coefficients: FloatArray) -> FloatArray:
        """(..., k, 2, 2) of (Re, Im) of the residues at simple poles (..., k).

        Of `coefficients` (..., p, p), the covariance of the free ones of A, then B, then a delay.
        """
        return real_covariance(self.residue_sensitivity(poles_rad_s), coefficients)

    def zero_covariance(self, zeros_rad_s: ComplexArray, coefficients: FloatArray) -> FloatArray:
        """(..., k, 2, 2) of (Re, Im) of simple zeros (..., k); see `residue_covariance`."""
        first = self.denominator.shape[-1] - 1
        return real_covariance(self.zero_sensitivity(zeros_rad_s), coefficients[..., first:, first:])


@entry
def _residues_and_sensitivity(
    x, ds_dx, denominator, numerator, hessenberg_a, hessenberg_b, residues, sensitivity
):
    """Of models (points, terms) at their poles x (points, k), into the last, (points, k) and (points, k, n)."""
    (points, count), n, terms = x.shape, hessenberg_a.shape[1], hessenberg_b.shape[1] + 1
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


def modes_in_band(poles_rad_s: ComplexArray, band_hz: tuple[float, float]) -> ComplexArray:
    """Of each complex pair near the band the pole above the real axis, by natural frequency.

    Parameters
    ----------
    poles_rad_s : (..., n) complex
    band_hz : (low, high)

    Returns
    -------
    (..., n // 2) complex
        NaN from the last mode on.
    """
    margin = BAND_MARGIN * (band_hz[1] - band_hz[0])
    n = poles_rad_s.shape[-1]
    poles = poles_rad_s.reshape(-1, n)
    found = np.full((len(poles), n // 2), complex(np.nan, np.nan))
    _in_band(poles, band_hz[0] - margin, band_hz[1] + margin, found)
    return found.reshape(*poles_rad_s.shape[:-1], n // 2)


@entry
def _in_band(poles, low_hz, high_hz, found):
    """Of poles (points, n) those above the real axis in a band, by natural frequency, into (points, n // 2)."""
    points, n = poles.shape
    f0_hz = np.empty(n // 2)
    for point in range(points):
        count = 0
        for pole in poles[point]:
            size_hz = np.abs(pole) / (2 * np.pi)
            if pole.imag > 0 and low_hz <= size_hz <= high_hz and count < n // 2:
                k = count
                while k > 0 and f0_hz[k - 1] > size_hz:
                    f0_hz[k], found[point, k] = f0_hz[k - 1], found[point, k - 1]
                    k -= 1
                f0_hz[k], found[point, k] = size_hz, pole
                count += 1


def propagated(
    poles: ComplexArray, sensitivity: ComplexArray, parameters: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances (points, k, 2, 2) of (Re, Im) of poles (points, k), and of (f0_hz, damping_ratio).

    From derivatives of the poles (points, k, p) by the first p coefficients, of covariance (points, n, n).
    """
    of_poles, in_f0 = np.empty((2, *poles.shape, 2, 2))
    _propagate(poles, sensitivity, parameters, of_poles, in_f0)
    return of_poles, in_f0


@entry
def _propagate(poles, sensitivity, parameters, of_poles, in_f0):
    """Put what `propagated` gives into the last two."""
    points, count, p = sensitivity.shape
    for point in range(points):
        for k in range(count):
            rr = ri = ii = 0.0
            for i in range(p):
                to_re = to_im = 0.0
                for j in range(p):
                    value = sensitivity[point, k, j]
                    to_re += parameters[point, i, j] * value.real
                    to_im += parameters[point, i, j] * value.imag
                value = sensitivity[point, k, i]
                rr += value.real * to_re
                ri += value.real * to_im
                ii += value.imag * to_im
            of_poles[point, k, 0, 0], of_poles[point, k, 1, 1] = rr, ii
            of_poles[point, k, 0, 1] = of_poles[point, k, 1, 0] = ri
            # rows of `natural_frequency_and_damping_jacobian`
            re, im = poles[point, k].real, poles[point, k].imag
            size = np.sqrt(re * re + im * im)
            a, b = re / (2 * np.pi * size), im / (2 * np.pi * size)
            c, d = -im * im / size**3, re * im / size**3
            in_f0[point, k, 0, 0] = a * a * rr + 2 * a * b * ri + b * b * ii
            in_f0[point, k, 1, 1] = c * c * rr + 2 * c * d * ri + d * d * ii
            both = a * c * rr + (a * d + b * c) * ri + b * d * ii
            in_f0[point, k, 0, 1] = in_f0[point, k, 1, 0] = both


def pole_quantities(
    model: RationalModel, band_hz: tuple[float, float], parameters: FloatArray
) -> tuple[dict[str, npt.NDArray], ComplexArray]:
    """Poles in the band and what follows from them, by the names that `PolesBatch` gives them.

    With a covariance (points, n, n) of the free coefficients, those of the denominator first. And the
    derivatives (points, k, n) of the poles by these.
    """
    poles = modes_in_band(model.poles_rad_s(), band_hz)
    f0_hz, damping_ratio = natural_frequency_and_damping(poles)
    residues, sensitivity = model.residues_and_sensitivity(poles)
    of_poles, in_f0 = propagated(poles, sensitivity, parameters)
    quantities = {
        "poles_rad_s": poles,
        "f0_hz": f0_hz,
        "damping_ratio": damping_ratio,
        "residues": residues,
        "pole_covariance": of_poles,
        "covariance": in_f0,
    }
    return quantities, sensitivity


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
