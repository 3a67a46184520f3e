# SPDX-License-Identifier: Apache-2.0
"""Which points of a map differ, from the rest and from one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special, stats

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.fields import require

_ROUNDS = 50
_CANDIDATES = 500  # among which the point in the middle of all is looked for


@dataclass(frozen=True, eq=False)
class Differences:
    """Points against the rest.

    Attributes
    ----------
    rest : (2,) float
        Mean f0 [Hz] and damping ratio of the points that do not differ.
    p : (n,) float
        Probability of lying as far from the rest as each point does, or farther, if it belonged to it.
    adjusted : (n,) float
        The false discovery rate at which each point would just be said to differ.
    differs : (n,) bool
        At the rate asked for.
    """

    rest: FloatArray
    p: FloatArray
    adjusted: FloatArray
    differs: BoolArray


def differences_from_rest(
    estimates: npt.ArrayLike, covariances: npt.ArrayLike, spread: npt.ArrayLike, rate: float = 0.05
) -> Differences:
    """Points that are not of the largest group of alike points.

    Parameters
    ----------
    estimates : (n, 2) float
        f0 [Hz] and damping ratio.
    covariances : (n, 2, 2) float
        Of the measurements.
    spread : (2, 2) float
        Of points of one tissue about each other beside that; 0: whatever is more than noise differs.
    rate : float
        Part of the points said to differ that do not, as expected (Benjamini and Hochberg, J. R. Stat. Soc.
        B 57 (1995) 289).

    Raises
    ------
    ValueError
        If a shape does not fit, or something is not finite.

    Notes
    -----
    The rest is found from the point whose median distance to all others is least: those alike to it, then, in
    turn, the mean of the rest and what does not differ from it. A point is compared with the mean of the
    others.
    """
    x, total = _checked(estimates, covariances, spread)
    require(0 < rate < 1, "rate", rate, "between 0 and 1")
    precision = np.asarray(np.linalg.inv(total), np.float64)
    rest = _alike(x, total, precision)
    for _ in range(_ROUNDS):
        weighted = np.einsum("kij,kj->ki", precision, x)
        own = rest[:, None]
        sums = weighted[rest].sum(axis=0) - own * weighted
        information = precision[rest].sum(axis=0) - own[:, None] * precision
        alone = rest & (rest.sum() == 1)
        information[alone] = precision[alone]  # nothing to compare with: itself
        sums[alone] = weighted[alone]
        of_mean = np.linalg.inv(information)
        off = x - np.einsum("kij,kj->ki", of_mean, sums)
        p = special.chdtrc(2, _squared(off, total + of_mean))
        adjusted = stats.false_discovery_control(p)
        now = adjusted > rate
        if not now.any() or np.array_equal(now, rest):
            break
        rest = now
    mean = np.linalg.solve(precision[rest].sum(axis=0), weighted[rest].sum(axis=0))
    return Differences(mean, p, adjusted, adjusted <= rate)


def pairs_that_differ(
    estimates: npt.ArrayLike, covariances: npt.ArrayLike, spread: npt.ArrayLike, rate: float = 0.05
) -> BoolArray:
    """(n, n) which points differ from which, at a false discovery rate over all pairs.

    Parameters are those of `differences_from_rest`. Pairs that share a point depend on each other in a way
    under which the rate of Benjamini and Hochberg is not proven, though simulated it holds.
    """
    x, total = _checked(estimates, covariances, spread)
    first, second = np.triu_indices(len(x), 1)
    pairs = np.zeros((len(x), len(x)), bool)
    if first.size:
        squared = _squared(x[first] - x[second], total[first] + total[second])
        differ = stats.false_discovery_control(special.chdtrc(2, squared)) <= rate
        pairs[first, second] = pairs[second, first] = differ
    return pairs


def _checked(
    estimates: npt.ArrayLike, covariances: npt.ArrayLike, spread: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Estimates, and covariances with the spread."""
    x, c, w = (np.asarray(each, float) for each in (estimates, covariances, spread))
    n = len(x)
    for name, array, shape in (
        ("estimates", x, (n, 2)),
        ("covariances", c, (n, 2, 2)),
        ("spread", w, (2, 2)),
    ):
        good = array.shape == shape and n > 0 and bool(np.all(np.isfinite(array)))
        require(good, name, array.shape, f"shape {shape}, finite, of one point or more")
    return x, c + w


def _squared(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """(n,) squared Mahalanobis distances."""
    return np.einsum("...i,...i->...", off, np.linalg.solve(covariance, off[..., None])[..., 0])


def _alike(x: FloatArray, total: FloatArray, precision: FloatArray) -> BoolArray:
    """(n,) points within the median distance of members of the point in the middle of all."""
    some = np.unique(np.linspace(0, len(x) - 1, _CANDIDATES).astype(int))
    medians = [np.median(_squared(x - x[k], total + total[k])) for k in some]
    middle = some[int(np.argmin(medians))]
    alike = _squared(x - x[middle], total + total[middle]) <= special.chdtri(2, 0.5)
    alike[middle] = True
    return alike
