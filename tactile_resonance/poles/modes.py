# SPDX-License-Identifier: Apache-2.0
"""Modes that follow from coefficients: poles and residues, their covariance, and which are more than noise."""

from __future__ import annotations

from math import comb

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.compiled import entry
from tactile_resonance.poles.model import RationalModel, real_covariance
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


# A mode that noise makes is taken for one this often.
NOISE_PASSES_FOR_A_MODE = 1e-4
# Of a mode: natural frequency, damping ratio, and a residue.
PARAMETERS_OF_A_MODE = 4
# Squared distance of a residue from zero, in its deviations, beyond which linear propagation is exact enough.
LINEAR = 100.0
# A single mode whose damping ratio is known to this part is none of noise's making: its residue is known
# about as well, ten times better than the test below asks for.
CERTAIN = 0.02


def significant_modes(
    model: RationalModel,
    quantities: dict[str, npt.NDArray],
    coefficients: FloatArray,
    lines: IntArray,
    dof: npt.ArrayLike = np.inf,
) -> tuple[BoolArray, FloatArray]:
    """Modes that noise alone would not make; those whose covariance is not known are kept.

    A fit to noise finds the line or bin that stands out most: the residue's Mahalanobis distance from zero,
    chi-square with two degrees of freedom, is the largest of about as many as there are lines (Bonferroni).
    Of `pole_quantities`, with a covariance (batch, n, n) of the free coefficients, NaN where it is not known,
    and complex `dof` (batch,) where the level is that of the residuals; infinite elsewhere.

    Returns
    -------
    found : (batch, k) bool
    distance : (batch, k) float
        The squared distance; NaN where none was needed.
    """
    poles, residues = quantities["poles_rad_s"], quantities["residues"]
    there = np.isfinite(poles)
    found, distances = there.copy(), np.full(poles.shape, np.nan)
    modes = poles.shape[-1]
    tested = there & np.isfinite(coefficients[:, :1, 0])
    if modes == 1:
        variance = quantities["covariance"][..., 1, 1]
        tested &= ~(variance < (CERTAIN * quantities["damping_ratio"]) ** 2)
    rows = np.flatnonzero(tested.any(axis=-1))
    if rows.size == 0:
        return found, distances
    with np.errstate(all="ignore"):
        sensitivity = model.at((rows,)).residue_sensitivity(poles[rows])  # (rows, k, p)
        distance = squared_distance(
            residues[rows], real_covariance(sensitivity, coefficients[rows])
        )
    distances[rows] = distance
    dof = np.broadcast_to(dof, lines.shape)
    limit = _farthest_of_noise(2, NOISE_PASSES_FOR_A_MODE / np.maximum(lines[rows], 1), dof[rows])
    found[rows] &= ~(distance < limit[:, None])
    if modes > 1:
        for k, row in enumerate(rows):
            if found[row].any():
                continue
            for near in _neighbours(poles[row], there[row]):
                # nearer than their widths: neither is certain alone, both together are
                found[row, near] = _significant_together(
                    residues[row, near],
                    sensitivity[k, near],
                    coefficients[row],
                    int(lines[row]),
                    float(dof[row]),
                )
    return found, distances


def _farthest_of_noise(size: int, chance: npt.ArrayLike, dof: npt.ArrayLike) -> FloatArray:
    """Squared distance of so many values from zero that noise exceeds by chance.

    Where the level is that of residuals, of complex `dof`, their covariance is that of the level times
    `noise_level.student_variance`.
    """
    dof, chance = np.asarray(dof), np.asarray(chance)
    limit = special.chdtri(size, chance)
    if np.isfinite(dof).any():
        of_level = size * special.fdtri(size, 2 * dof, 1 - chance) * (1 - 1 / dof)
        limit = np.where(np.isfinite(dof), of_level, limit)
    return np.asarray(limit)


def fall_of_noise(lines: npt.ArrayLike) -> FloatArray:
    """Largest fall of the cost by one mode more that noise makes, of fits to so many lines.

    Twice the fall is chi-square (Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*,
    2nd ed. (2012), section 11.3), at any of the lines (Bonferroni).
    """
    return np.asarray(special.chdtri(PARAMETERS_OF_A_MODE, NOISE_PASSES_FOR_A_MODE / np.asarray(lines)) / 2)


def beside_others(poles: ComplexArray, found: BoolArray) -> BoolArray:
    """(batch, k) modes that are not found, nearer to one that is than their widths; poles (batch, k)."""
    return np.asarray(~found & (_near(poles) & found[:, None, :]).any(axis=-1))


@np.errstate(invalid="ignore", divide="ignore")
def second_order(poles: ComplexArray, found: BoolArray, distance: FloatArray) -> FloatArray:
    """(batch, k, 2, 2) covariance of (f0_hz, damping_ratio) that linear propagation leaves out; 0 mostly.

    Two modes nearer than their widths are known by their sum; how it is shared is as uncertain as the residue
    that is known less. That moves both poles, by up to their distance: to first order within their
    covariance, to second order by the square of the residue's relative deviation. `found` and `distance`
    (batch, k) are those of `significant_modes`.
    """
    pairs = _near(poles) & found[:, :, None] & found[:, None, :] & ~np.eye(found.shape[-1], dtype=bool)
    least = np.minimum(distance[:, :, None], distance[:, None, :])
    pairs &= least < LINEAR
    apart = np.abs(poles[:, :, None] - poles[:, None, :]) / np.maximum(least, 1)
    both = np.linalg.norm(np.where(pairs, apart, 0.0), axis=-1)
    return np.nan_to_num(in_any_direction(both, poles))


def in_any_direction(std: FloatArray, poles: ComplexArray) -> FloatArray:
    """(..., 2, 2) covariance of (f0_hz, damping_ratio) of poles (...) as uncertain [rad/s] in any direction."""
    out = np.zeros((*poles.shape, 2, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        out[..., 0, 0], out[..., 1, 1] = (std / (2 * np.pi)) ** 2, (std / np.abs(poles)) ** 2
    return out


def _near(poles: ComplexArray) -> BoolArray:
    """(batch, k, k) which of poles (batch, k) are nearer to each other than their widths."""
    width = np.abs(poles.real)
    near = np.abs(poles[:, :, None] - poles[:, None, :]) < width[:, :, None] + width[:, None, :]
    return np.asarray(near)


def _neighbours(poles: ComplexArray, there: BoolArray) -> list[IntArray]:
    """Places of two or more poles (k,) each, in ascending order, that are nearer than their widths."""
    places = np.flatnonzero(there)
    width = np.abs(poles[places].real)
    far = np.abs(np.diff(poles[places])) >= width[:-1] + width[1:]
    groups = np.split(places, np.flatnonzero(far) + 1)
    return [group for group in groups if group.size > 1]


def squared_distance(values: ComplexArray, covariance: FloatArray) -> FloatArray:
    """(...) squared Mahalanobis distance from zero; covariance (..., 2, 2) of (Re, Im)."""
    std = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))  # (..., 2)
    re, im = values.real / std[..., 0], values.imag / std[..., 1]
    correlation = covariance[..., 0, 1] / (std[..., 0] * std[..., 1])
    return np.asarray((re**2 - 2 * correlation * re * im + im**2) / (1 - correlation**2))


def _significant_together(
    residues: ComplexArray, sensitivity: ComplexArray, coefficients: FloatArray, lines: int, dof: float
) -> bool:
    """Whether noise alone would not make all of them: as above, over the choices of lines."""
    stacked = np.concatenate([sensitivity.real, sensitivity.imag])  # (2 n, p)
    p = stacked.shape[-1]
    covariance = stacked @ coefficients[:p, :p] @ stacked.T
    vector = np.concatenate([residues.real, residues.imag])
    try:
        distance = vector @ np.linalg.solve(covariance, vector)
    except np.linalg.LinAlgError:
        return True
    chance = NOISE_PASSES_FOR_A_MODE / comb(max(lines, residues.size), residues.size)
    return not distance < _farthest_of_noise(vector.size, chance, dof)
