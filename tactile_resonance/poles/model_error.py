# SPDX-License-Identifier: Apache-2.0
"""Whether a model leaves something out, as its residuals show, and what that adds to what poles are off by.

Noise and stochastic distortion are independent from line to line. What a model leaves out is a smooth
function of frequency: the cosine transform over the lines gathers it in its first coefficients, where
it stands out long before the total cost shows it. How smooth is not known beforehand, so several
numbers of coefficients are tried (Neyman's smooth test with a number of components taken from the
data: Fan, *Test of significance based on wavelet thresholding and Neyman's truncation*, J. Am. Stat.
Assoc. 91 (1996) 674-688).
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.compiled import entry
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.modes import in_any_direction
from tactile_resonance.poles.result import natural_frequency_and_damping

if TYPE_CHECKING:
    from tactile_resonance.poles.tables import FitPlan

# A cost that noise alone exceeds once in a thousand fits counts as model error.
MODEL_ERROR_PROBABILITY = 1e-3
# Residuals of noise alone are smoother than this once in a thousand fits.
SMOOTH_RESIDUAL = 3.09
# No more coefficients than this count as smooth.
MOST_COMPONENTS = 128


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
        moved = moved + difference_of_models(poles_rad_s, *plan.richer.with_covariance(data))
    half_width = in_any_direction(np.abs(poles_rad_s.real), poles_rad_s)
    known = np.isfinite(moved).all(axis=(-2, -1), keepdims=True)
    systematic[wrong] = np.where(known, moved, half_width)
    return systematic


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
