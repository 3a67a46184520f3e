# SPDX-License-Identifier: Apache-2.0
"""Covariance of the coefficients, and of the poles, zeros and residues that follow from them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.poles.compiled import entry, rehearsal
from tactile_resonance.poles.model import RationalModel
from tactile_resonance.poles.result import natural_frequency_and_damping

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


def propagated(
    poles_rad_s: ComplexArray, sensitivity: ComplexArray, parameters: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances (..., k, 2, 2) of (Re, Im) of poles (..., k), and of (f0_hz, damping_ratio).

    Parameters
    ----------
    poles_rad_s : (..., k) complex
    sensitivity : (..., k, p) complex
        Derivatives of the poles by coefficients.
    parameters : (..., n, n) float
        Covariance of coefficients, of which the first p belong to the sensitivity.
    """
    shape = poles_rad_s.shape
    points = math.prod(shape[:-1])
    of_poles, in_f0 = _propagated(
        poles_rad_s.reshape(points, shape[-1]),
        sensitivity.reshape(points, *sensitivity.shape[-2:]),
        parameters.reshape(points, *parameters.shape[-2:]),
    )
    return of_poles.reshape(*shape, 2, 2), in_f0.reshape(*shape, 2, 2)


@entry
def _propagated(poles, sensitivity, parameters):
    points, count, p = sensitivity.shape
    of_poles, in_f0 = np.empty((points, count, 2, 2)), np.empty((points, count, 2, 2))
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
    return of_poles, in_f0


@rehearsal
def _propagate_a_little() -> None:
    one = np.ones((1, 1))
    _propagated(one + 0j, one[..., None] + 0j, one[..., None])


def pole_quantities(
    model: RationalModel, band_hz: tuple[float, float], parameters: FloatArray
) -> tuple[dict[str, npt.NDArray], ComplexArray]:
    """Poles in the band and what follows from them, by the names that `PolesBatch` gives them.

    Parameters
    ----------
    model : RationalModel
        Leading axes (...).
    band_hz : (low, high)
    parameters : (..., n, n) float
        Covariance of the free coefficients, those of the denominator first.

    Returns
    -------
    dict
    sensitivity : (..., k, n) complex
        Derivatives of the poles by the coefficients of the denominator.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
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
