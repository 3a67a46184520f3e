# SPDX-License-Identifier: Apache-2.0
"""Whether residuals of neighbouring lines act together: what a model leaves out is smooth, noise not.

Noise and stochastic distortion are independent from line to line. What a model leaves out is a smooth
function of frequency: the cosine transform over the lines gathers it in its first coefficients, where
it stands out long before the total cost shows it. How smooth is not known beforehand, so several
numbers of coefficients are tried (Neyman's smooth test with a number of components taken from the
data: Fan, *Test of significance based on wavelet thresholding and Neyman's truncation*, J. Am. Stat.
Assoc. 91 (1996) 674-688).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.compiled import entry

# Residuals of noise alone are smoother than this once in a thousand fits.
SMOOTH_RESIDUAL = 3.09
# No more coefficients than this count as smooth.
MOST_COMPONENTS = 128


@lru_cache(maxsize=64)
def components(lines: int, parameters: int) -> tuple[IntArray, FloatArray]:
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
    counts, cosines = components(lines, parameters)
    scores = _scores(np.asarray(residual, complex).reshape(-1, lines), counts, cosines)
    return scores.reshape(residual.shape[:-1]), counts.size


@entry
def _scores(residual, counts, cosines):
    """(points,) score of residuals (points, F) for numbers of cosines (levels,), of cosines (J, F)."""
    points, lines = residual.shape
    filled = cosines.shape[1]
    re, im, scores = np.zeros(filled), np.zeros(filled), np.empty(points)
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
    return scores
