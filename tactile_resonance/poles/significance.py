# SPDX-License-Identifier: Apache-2.0
"""What is more than noise: an error of the model, and what that adds to what poles are off by; modes.

Noise and stochastic distortion are independent from line to line. What a model leaves out is a smooth
function of frequency: the cosine transform over the lines gathers it in its first coefficients, where
it stands out long before the total cost shows it. How smooth is not known beforehand, so several
numbers of coefficients are tried (Neyman's smooth test with a number of components taken from the
data: Fan, *Test of significance based on wavelet thresholding and Neyman's truncation*, J. Am. Stat.
Assoc. 91 (1996) 674-688).

A mode is more than noise makes where its residue is far from zero.
"""

from __future__ import annotations

from functools import lru_cache
from math import comb
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.compiled import entry
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.model import RationalModel, pole_quantities, real_covariance
from tactile_resonance.poles.result import natural_frequency_and_damping

if TYPE_CHECKING:
    from tactile_resonance.poles.tables import FitPlan

# Residuals of noise alone are smoother than this once in a thousand fits.
SMOOTH_RESIDUAL = 3.09
# No more coefficients than this count as smooth.
MOST_COMPONENTS = 128
# A mode that noise makes is taken for one this often.
NOISE_PASSES_FOR_A_MODE = 1e-4
# Of a mode: natural frequency, damping ratio, and a residue.
PARAMETERS_OF_A_MODE = 4
# Squared distance of a residue from zero, in its deviations, beyond which linear propagation is exact enough.
LINEAR = 100.0
# A single mode whose damping ratio is known to this part of itself was not made by noise: its residue is known
# about as well, ten times better than the test below asks for.
CERTAIN = 0.02


@lru_cache(maxsize=64)
def _components(lines: int, parameters: int) -> tuple[IntArray, FloatArray]:
    """(levels,) how many cosine coefficients are compared with the rest, and (J, F) the cosines.

    The fit has taken its own parameters out of the smooth ones, half a coefficient each, so the
    first level has as many as there are parameters; each further one twice those of the last, up to
    half of all.
    """
    most = min(lines // 2, max(MOST_COMPONENTS, parameters))
    levels = np.array([most])
    while levels[0] > 2 * parameters:
        levels = np.append(levels[0] // 2, levels)
    k, line = np.ogrid[:most, : -(-lines // 8) * 8]  # as many as vectors hold
    cosines = np.cos(np.pi * k * (line + 0.5) / lines) * np.sqrt(np.where(k == 0, 1, 2) / lines)
    return levels, cosines


def whiteness(residual: ComplexArray, parameters: int) -> FloatArray:
    """(...) how much smoother residuals (..., F) are than white ones, as a normal score.

    Parameters
    ----------
    residual : (..., F) complex
        Weighted, in the order of their lines; 0 on lines left out.
    parameters : int
        Real parameters of the fit.

    Returns
    -------
    float array
        The score whose chance is that of the most significant level among all levels (Sidak);
        independent circular residuals exceed x no more often than a normal variable does. NaN for
        fewer than three lines.

    Notes
    -----
    The mean power of the first J coefficients over that of the others is F-distributed, with 2 J and
    2 (F - J) degrees of freedom, whatever the level of the noise. What the fit took out of the first
    ones makes the test conservative. F to normal by cube roots: Paulson, *An
    approximate normalization of the analysis of variance distribution*, Ann. Math. Stat. 13 (1942)
    233-235.
    """
    score, levels = _best_level(residual, parameters)
    with np.errstate(divide="ignore", invalid="ignore"):
        among = -np.expm1(levels * np.log1p(-special.ndtr(-score)))
    return np.asarray(-special.ndtri(np.maximum(among, np.finfo(float).tiny)))


def are_smooth(
    residual: ComplexArray, parameters: int, limit: float = SMOOTH_RESIDUAL
) -> BoolArray:
    """(...) whether the `whiteness` of residuals (..., F) is beyond `limit`."""
    score, levels = _best_level(residual, parameters)
    return np.asarray(score > _limit(levels, limit))


@lru_cache(maxsize=64)
def _limit(levels: int, limit: float) -> float:
    """Score of the most significant of so many levels that `limit` stands for."""
    each = -np.expm1(np.log1p(-special.ndtr(-limit)) / levels)
    return float(-special.ndtri(each))


def _best_level(residual: ComplexArray, parameters: int) -> tuple[FloatArray, int]:
    """(...) normal score of the most significant level, and how many levels there are."""
    lines = residual.shape[-1]
    if lines < 3:
        return np.full(residual.shape[:-1], np.nan), 1
    counts, cosines = _components(lines, parameters)
    scores = np.empty(residual.size // lines)
    _scores(np.asarray(residual, complex).reshape(-1, lines), counts, cosines, scores)
    return scores.reshape(residual.shape[:-1]), counts.size


@entry
def _scores(residual, counts, cosines, scores):
    """Put scores (points,) of residuals (points, F), for numbers (levels,) of cosines (J, F), into the last."""
    points, lines = residual.shape
    filled = cosines.shape[1]
    re, im = np.zeros(filled), np.zeros(filled)
    for point in range(points):
        total, used = 0.0, 0
        for k in range(lines):
            x, y = residual[point, k].real, residual[point, k].imag
            total += x * x + y * y
            used += x != 0 or y != 0
            re[k], im[k] = x, y
        smooth, best, first = 0.0, -np.inf, 0
        for count in counts:
            for j in range(first, count):
                x = y = 0.0
                for k in range(filled):
                    x += cosines[j, k] * re[k]
                    y += cosines[j, k] * im[k]
                smooth += x * x + y * y
            first = count
            others = max(used - count, 1)
            root = (smooth / (total - smooth) * others / count) ** (1 / 3)
            a, b = 1 / (9 * count), 1 / (9 * others)
            score = ((1 - b) * root - (1 - a)) / np.sqrt(b * root * root + a)
            best = score if not score <= best else best  # not a number where the first one is none
        scores[point] = best


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
    rows = tested.any(axis=-1).nonzero()[0]
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


def systematic_of(
    plan: FitPlan,
    data: BinData,
    theta: FloatArray,
    wrong: BoolArray,
    plan_of_theta: FitPlan | None = None,
) -> FloatArray:
    """Outer products of what halves of the data, and one mode more, move each pole by where a model is wrong.

    Halves are those of the driven bins and, of several records, the first and the last ones. Where one of
    these fits has no such mode, or does not determine it, half its width stands for all: what lies nearer to
    a mode looks like part of it. (points, places, 2, 2) in (f0_hz, damping_ratio), 0 where the model is not
    `wrong` (points,). Fits to halves begin with theta (points, M, n), over bases of `plan_of_theta`, if not
    `plan`.
    """
    systematic = np.zeros((wrong.size, plan.structure.order // 2, 2, 2))
    if not wrong.any():
        return systematic
    data, theta = data.rows(np.flatnonzero(wrong)), theta[wrong]
    poles_rad_s = (plan_of_theta or plan).poles_in_band(theta[:, 0])
    poles = []
    for parity in (0, 1):
        left_out = np.arange(data.driven) % 2 == parity
        half = data.weighted(variance_y=np.where(left_out, np.inf, data.variance_y))
        determined = half.lines >= plan.structure.fewest_lines
        poles.append(np.where(determined[:, None], plan.compared(half, theta), np.nan))
    moved = difference_of_halves(*poles)
    half_of = data.records // 2
    if half_of > 0:
        first, last = slice(0, half_of), slice(data.records - half_of, None)
        poles = [plan.compared(data.part(which), theta[:, which]) for which in (first, last)]
        moved = moved + difference_of_halves(*poles)
    if plan.richer is not None and data.lines.min() > plan.richer.structure.fewest_lines:
        moved = moved + difference_of_models(poles_rad_s, *_with_covariance(plan.richer, data))
    half_width = in_any_direction(np.abs(poles_rad_s.real), poles_rad_s)
    known = np.isfinite(moved).all(axis=(-2, -1), keepdims=True)
    systematic[wrong] = np.where(known, moved, half_width)
    return systematic


def _with_covariance(plan: FitPlan, data: BinData) -> tuple[ComplexArray, FloatArray]:
    """Poles (points, places) of a fit, in the band or not, and their covariance as its residuals show it.

    That is (points, places, 2, 2) of (f0_hz, damping_ratio); NaN where the data do not determine the mode.
    """
    of_fit, solution = plan.batched(data)
    own, n = of_fit.problem.sizes[2], solution.theta.shape[-1]
    free = data.records * own + n - own
    dof = max(data.records * data.order.size - free / 2, 1)
    covariance = solution.marginal[:, 0] * (solution.cost / (2 * dof))[:, None, None]
    model = of_fit.model_of(solution.theta[:, 0])
    quantities, _ = pole_quantities(model, (0.0, np.inf), covariance)
    poles, in_f0 = quantities["poles_rad_s"], quantities["covariance"]
    lines = np.full(solution.cost.size, int(dof))
    _, distance = significant_modes(model, quantities, covariance, lines)
    in_f0[~((np.linalg.det(in_f0) > 0) & (in_f0[..., 0, 0] > 0))] = np.nan  # lost to rounding
    return poles, in_f0 + second_order(poles, np.isfinite(poles), distance)


def model_error_factor(
    residual: ComplexArray, cost: FloatArray, expected_cost: FloatArray
) -> FloatArray:
    """(batch,) factor from the covariance of noise to that of noise and model error.

    The excess of the cost shows how large the errors are; their correlation from line to line, how
    many of them act together: errors that keep their sign over L lines disturb a coefficient as L
    times fewer lines of independent errors would. Residuals (batch, F) are weighted.
    """
    ratio = np.fmax(cost / expected_cost, 1.0)  # 1 where the level itself is from the residuals
    return ratio * correlation_length(residual)


def correlation_length(residual: ComplexArray) -> FloatArray:
    """(batch,) ``1 + 2 sum rho`` over the correlations of residuals (batch, F).

    Sokal's automatic window: the sum ends at the lag that exceeds five times itself.
    """
    lines = residual.shape[-1]
    padded = np.fft.fft(residual, 2 * lines, axis=-1)
    correlation = np.fft.ifft(np.abs(padded) ** 2, axis=-1).real[:, :lines]
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = correlation / correlation[:, :1]
    length = 2 * np.cumsum(np.nan_to_num(rho), axis=-1) - 1  # (batch, F)
    enough = np.arange(lines) >= 5 * length
    window = np.where(enough.any(axis=-1), np.argmax(enough, axis=-1), lines - 1)
    return np.maximum(np.take_along_axis(length, window[:, None], axis=-1)[:, 0], 1.0)


def difference_of_halves(even_rad_s: ComplexArray, odd_rad_s: ComplexArray) -> FloatArray:
    """Outer product of what even and odd lines differ by in (f0_hz, damping_ratio).

    What one wild line does shows in no residual of its neighbours; it does between halves of the lines.
    (..., places, 2, 2) of poles (..., places) found from either; NaN where one does not have the mode.
    """
    even, odd = (
        np.stack(natural_frequency_and_damping(p), axis=-1) for p in (even_rad_s, odd_rad_s)
    )
    difference = even - odd  # (..., places, 2)
    return np.asarray(difference[..., :, None] * difference[..., None, :])


def difference_of_models(
    poles_rad_s: ComplexArray, richer_rad_s: ComplexArray, covariance: FloatArray
) -> FloatArray:
    """Outer product of what a model with one mode more moves each pole by in (f0_hz, damping_ratio).

    Two modes nearer to each other than their widths are fitted by one between them so well that residuals say
    little about how far it is from either. (..., places, 2, 2), of poles (..., places) and those of the
    richer model, of which the nearest one counts, with its covariance (2, 2); NaN where there is none, or one
    known no better than to half the width of the pole.
    """
    distance = np.abs(richer_rad_s[..., None, :] - poles_rad_s[..., None])  # (..., places, more)
    nearest = np.argmin(np.where(np.isfinite(distance), distance, np.inf), axis=-1)
    other = np.take_along_axis(richer_rad_s, nearest, axis=-1)
    own = np.take_along_axis(covariance, nearest[..., None, None], axis=-3)
    known = own[..., :1, :1] < (poles_rad_s.real / (2 * np.pi))[..., None, None] ** 2
    return np.where(known, difference_of_halves(poles_rad_s, other) + own, np.nan)
