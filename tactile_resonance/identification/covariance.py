# SPDX-License-Identifier: Apache-2.0
"""Covariance of the coefficients, and of the poles, zeros and residues that follow from them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from tactile_resonance.identification import one_mode
from tactile_resonance.identification.model import RationalModel
from tactile_resonance.identification.normal_equations import MANY, solve_positive
from tactile_resonance.identification.result import (
    ComplexArray,
    FloatArray,
    natural_frequency_and_damping,
    natural_frequency_and_damping_jacobian,
)

# A mode this fraction of the band outside of it is still one that the lines show.
BAND_MARGIN = 0.1


def invert_normal(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse of normal matrices, and the condition number of the Jacobian they came from.

    Parameters
    ----------
    normal : (batch, n, n) float

    Returns
    -------
    inverse : (batch, n, n) float
        NaN where the matrix is singular or not finite.
    condition_number : (batch,) float
        Root of the Frobenius condition number with unit diagonal: the true one within a factor n.
    """
    n = normal.shape[-1]
    diagonal = normal.diagonal(axis1=-2, axis2=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.asarray(1 / np.sqrt(diagonal), float)
        both = scale[..., :, None] * scale[..., None, :]
        scaled = normal * both
    # finite as a whole only where every entry is, and every diagonal one above 0
    bad = ~np.isfinite(scaled.sum(axis=(-2, -1)))
    if bad.any():
        scaled[bad] = np.eye(n)
    inverse, singular = _inverse(scaled)
    bad |= singular
    # rounding can leave a negative variance where the matrix is singular to working precision
    bad |= ~(inverse.diagonal(axis1=-2, axis2=-1) > 0).all(axis=-1)
    condition = (_squares(scaled) * _squares(inverse)) ** 0.25
    with np.errstate(invalid="ignore"):
        inverse *= both
    if bad.any():
        inverse[bad], condition[bad] = np.nan, np.inf
    return inverse, condition


def _inverse(matrices: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Inverses of symmetric matrices, and (batch,) which of them have none."""
    batch, n = matrices.shape[:2]
    singular = np.zeros(batch, bool)
    if batch >= MANY:
        inverse, good = solve_positive(matrices, np.broadcast_to(np.eye(n), matrices.shape))
        if good.all():
            return inverse, singular
    elif batch == 1:
        _, inverse, fault = lapack.dposv(matrices[0], np.eye(n))
        if fault == 0:
            return np.ascontiguousarray(inverse)[None], singular
    try:
        return np.asarray(np.linalg.inv(matrices), float), singular
    except np.linalg.LinAlgError:
        singular = np.asarray(np.linalg.matrix_rank(matrices, hermitian=True) < n)
        matrices[singular] = np.eye(n)
        return np.asarray(np.linalg.inv(matrices), float), singular


def _squares(matrices: FloatArray) -> FloatArray:
    """(batch,) sum of the squares of matrices (batch, n, n)."""
    return np.asarray(np.einsum("bij,bij->b", matrices, matrices))


def modes_in_band(
    poles_rad_s: ComplexArray, band_hz: tuple[float, float], places: int | None = None
) -> ComplexArray:
    """Of each complex pair near the band the pole above the real axis, by natural frequency.

    Parameters
    ----------
    poles_rad_s : (..., n) complex
    band_hz : (low, high)
    places : int, optional
        ``n // 2`` when absent.

    Returns
    -------
    (..., places) complex
        NaN from the last mode on.
    """
    places = poles_rad_s.shape[-1] // 2 if places is None else places
    margin = BAND_MARGIN * (band_hz[1] - band_hz[0])
    f0_hz = np.abs(poles_rad_s) / (2 * np.pi)
    inside = (
        (poles_rad_s.imag > 0) & (f0_hz >= band_hz[0] - margin) & (f0_hz <= band_hz[1] + margin)
    )
    if poles_rad_s.shape[-1] == 2 and places == 1:
        first = inside[..., :1]
        taken = np.where(first, poles_rad_s[..., :1], poles_rad_s[..., 1:])
        return np.where(first | inside[..., 1:], taken, np.nan)
    order = np.argsort(np.where(inside, f0_hz, np.inf), axis=-1)[..., :places]
    taken = np.take_along_axis(np.where(inside, poles_rad_s, np.nan), order, axis=-1)
    return taken


def real_covariance(sensitivity: ComplexArray, parameters: FloatArray) -> FloatArray:
    """(..., k, 2, 2) covariance of (Re, Im) of k quantities from that of the coefficients.

    Parameters
    ----------
    sensitivity : (..., k, p) complex
    parameters : (..., n, n) float
        Of which the first p belong to the sensitivity.
    """
    p = sensitivity.shape[-1]
    stacked = np.stack([sensitivity.real, sensitivity.imag], axis=-2)  # (..., k, 2, p)
    return stacked @ parameters[..., None, :p, :p] @ np.swapaxes(stacked, -1, -2)


def f0_damping_covariance(poles_rad_s: ComplexArray, covariance: FloatArray) -> FloatArray:
    """(..., 2, 2) covariance of (f0_hz, damping_ratio) from that of (Re, Im) of poles (...)."""
    jacobian = natural_frequency_and_damping_jacobian(poles_rad_s)
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


def pole_quantities(
    model: RationalModel, band_hz: tuple[float, float], parameters: FloatArray
) -> dict[str, npt.NDArray]:
    """Poles in the band and what follows from them, by the names that `PolesBatch` gives them.

    Parameters
    ----------
    model : RationalModel
        Leading axes (...).
    band_hz : (low, high)
    parameters : (..., n, n) float
        Covariance of the free coefficients, those of the denominator first.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        of_one = _one_mode(model, band_hz, parameters)
        if of_one is not None:
            return of_one
        poles = modes_in_band(model.poles_rad_s(), band_hz)
        f0_hz, damping_ratio = natural_frequency_and_damping(poles)
        residues, sensitivity = model.residues_and_sensitivity(poles)
        covariance = real_covariance(sensitivity, parameters)
        return {
            "poles_rad_s": poles,
            "f0_hz": f0_hz,
            "damping_ratio": damping_ratio,
            "residues": residues,
            "pole_covariance": covariance,
            "covariance": f0_damping_covariance(poles, covariance),
        }


def _one_mode(
    model: RationalModel, band_hz: tuple[float, float], parameters: FloatArray
) -> dict[str, npt.NDArray] | None:
    """`pole_quantities` of one point with one stable mode in the band; None for any other."""
    variable = model.variable
    if model.denominator.shape != (1, 3) or variable.domain != "s":
        return None
    margin = BAND_MARGIN * (band_hz[1] - band_hz[0])
    figures = np.empty(one_mode.FIGURES)
    if not one_mode.pole_in_band(
        model.denominator[0].tolist(),
        model.numerator[0].tolist(),
        parameters[0],
        (model.denominator_basis.hessenberg, model.numerator_basis.hessenberg),
        (variable.scale_rad_s, band_hz[0] - margin, band_hz[1] + margin),
        np.empty(model.numerator.shape[-1], complex),
        figures,
    ):
        return None
    pole, of_pole, of_f0 = one_mode.POLE, one_mode.POLE_COVARIANCE, one_mode.COVARIANCE
    places = figures[pole : pole + 4].view(complex)
    return {
        "poles_rad_s": places[None, :1],
        "f0_hz": figures[None, one_mode.F0_HZ, None],
        "damping_ratio": figures[None, one_mode.DAMPING, None],
        "residues": places[None, 1:],
        "pole_covariance": figures[of_pole : of_pole + 4].reshape(1, 1, 2, 2),
        "covariance": figures[of_f0 : of_f0 + 4].reshape(1, 1, 2, 2),
    }
