# SPDX-License-Identifier: Apache-2.0
"""Covariance of the coefficients, and of the poles, zeros and residues that follow from them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.poles.model import RationalModel
from tactile_resonance.poles.result import (
    natural_frequency_and_damping,
    natural_frequency_and_damping_jacobian,
)

# A mode this fraction of the band outside of it is still one that the lines show.
BAND_MARGIN = 0.1


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
    places = poles_rad_s.shape[-1] // 2
    margin = BAND_MARGIN * (band_hz[1] - band_hz[0])
    f0_hz = np.abs(poles_rad_s) / (2 * np.pi)
    inside = (
        (poles_rad_s.imag > 0) & (f0_hz >= band_hz[0] - margin) & (f0_hz <= band_hz[1] + margin)
    )
    if poles_rad_s.shape[-1] == 2:
        first = inside[..., :1]
        taken = np.where(first, poles_rad_s[..., :1], poles_rad_s[..., 1:])
        return np.where(first | inside[..., 1:], taken, np.nan)
    order = np.argsort(np.where(inside, f0_hz, np.inf), axis=-1)[..., :places]
    return np.take_along_axis(np.where(inside, poles_rad_s, np.nan), order, axis=-1)


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


def f0_damping_covariance(poles_rad_s: ComplexArray, covariance: FloatArray) -> FloatArray:
    """(..., 2, 2) covariance of (f0_hz, damping_ratio) from that of (Re, Im) of poles (...)."""
    jacobian = natural_frequency_and_damping_jacobian(poles_rad_s)
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


def pole_quantities(
    model: RationalModel,
    band_hz: tuple[float, float],
    parameters: FloatArray,
    total: FloatArray | None = None,
) -> dict[str, npt.NDArray]:
    """Poles in the band and what follows from them, by the names that `PolesBatch` gives them.

    Parameters
    ----------
    model : RationalModel
        Leading axes (...).
    band_hz : (low, high)
    parameters : (..., n, n) float
        Covariance of the free coefficients, those of the denominator first.
    total : (..., n, n) float, optional
        The total one: ``total_covariance`` follows from it.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        poles = modes_in_band(model.poles_rad_s(), band_hz)
        f0_hz, damping_ratio = natural_frequency_and_damping(poles)
        residues, sensitivity = model.residues_and_sensitivity(poles)
        covariance = real_covariance(sensitivity, parameters)
        quantities = {
            "poles_rad_s": poles,
            "f0_hz": f0_hz,
            "damping_ratio": damping_ratio,
            "residues": residues,
            "pole_covariance": covariance,
            "covariance": f0_damping_covariance(poles, covariance),
        }
        if total is not None:
            in_poles = real_covariance(sensitivity, total)
            quantities["total_covariance"] = f0_damping_covariance(poles, in_poles)
    return quantities
