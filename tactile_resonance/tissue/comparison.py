# SPDX-License-Identifier: Apache-2.0
"""Points of a map without references: which differ, from the rest and from one another, and which are alike.

Groups are a mixture of normal distributions behind known noise: each point has a noise covariance of its own,
which the groups must not take for theirs. This is extreme deconvolution (Bovy, Hogg and Roweis, Annals of
Applied Statistics 5 (2011) 1657), a page of expectation and maximisation. scikit-learn's GaussianMixture knows
no noise of points: it takes that of bad points for the spread of a group, and is not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special, stats

from tactile_resonance._typing import BoolArray, FloatArray, IntArray
from tactile_resonance.fields import require

_ROUNDS = 50
_CANDIDATES = 500  # among which the point in the middle of all is looked for
_STARTS, _MOST_STEPS, _CONVERGED = 6, 1000, 1e-5  # of a mixture
_ALIKE_POINTS = 2  # of the mean spread of all groups, which count in that of each
# The penalty of fewer points is that of so many: by how much two groups fit one tissue better hardly depends on
# their number, and up to a third of maps of 8 to 20 points would be split.
_FEWEST_COUNTED = 25

_Mixture = tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]


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
    estimates: npt.ArrayLike,
    covariances: npt.ArrayLike,
    spread: npt.ArrayLike,
    rate: float = 0.05,
    degrees_of_freedom: float = np.inf,
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
    degrees_of_freedom : float
        Of the spread, above 1; infinite where it is known.

    Raises
    ------
    ValueError
        If a covariance is not positive definite.

    Notes
    -----
    The rest is found from the point whose median distance to all others is least: those alike to it, then, in
    turn, the mean of the rest and what does not differ from it. A point is compared with the mean of the
    others, by Hotelling's distribution where the spread was estimated: exact where it was so behind the same
    noise, or without any.
    """
    x, noise, beside = _checked(estimates, covariances, spread)
    total = noise + beside
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
        p = _tail(_squared(off, total + of_mean), degrees_of_freedom)
        adjusted = stats.false_discovery_control(p)
        now = adjusted > rate
        if not now.any() or np.array_equal(now, rest):
            break
        rest = now
    mean = np.linalg.solve(precision[rest].sum(axis=0), weighted[rest].sum(axis=0))
    return Differences(mean, p, adjusted, adjusted <= rate)


def pairs_that_differ(
    estimates: npt.ArrayLike,
    covariances: npt.ArrayLike,
    spread: npt.ArrayLike,
    rate: float = 0.05,
    degrees_of_freedom: float = np.inf,
) -> BoolArray:
    """(n, n) which points differ from which, at a false discovery rate over all pairs.

    Parameters are those of `differences_from_rest`. Pairs that share a point depend on each other in a way
    under which the rate of Benjamini and Hochberg is not proven, though simulated it holds.
    """
    x, noise, beside = _checked(estimates, covariances, spread)
    total = noise + beside
    first, second = np.triu_indices(len(x), 1)
    pairs = np.zeros((len(x), len(x)), bool)
    if first.size:
        squared = _squared(x[first] - x[second], total[first] + total[second])
        differ = stats.false_discovery_control(_tail(squared, degrees_of_freedom)) <= rate
        pairs[first, second] = pairs[second, first] = differ
    return pairs


def _checked(
    estimates: npt.ArrayLike, covariances: npt.ArrayLike, spread: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Estimates, covariances and spread as arrays."""
    x, c, w = (np.asarray(each, float) for each in (estimates, covariances, spread))
    total = c + w
    above = (total[:, 0, 0] > 0) & (np.linalg.det(total) > 0)
    require(bool(above.all()), "covariances", c[~above][:1].tolist(), "positive definite ones, with the spread")
    return x, c, w


def _squared(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """(n,) squared Mahalanobis distances."""
    return np.einsum("...i,...i->...", off, np.linalg.solve(covariance, off[..., None])[..., 0])


def _tail(squared: FloatArray, degrees_of_freedom: float) -> FloatArray:
    """(n,) probability that Hotelling's T^2, two dimensions, is as large or larger."""
    nu = degrees_of_freedom
    require(nu > 1, "degrees_of_freedom", nu, "a number above 1")
    return np.exp(-squared / 2) if np.isinf(nu) else (1 + squared / nu) ** (-(nu - 1) / 2)


def _alike(x: FloatArray, total: FloatArray, precision: FloatArray) -> BoolArray:
    """(n,) points within the median distance of members of the point in the middle of all."""
    some = np.unique(np.linspace(0, len(x) - 1, _CANDIDATES).astype(int))
    # by the noise of the others: beside its own a point that is hardly known would be near to all
    medians = [np.median(_squared(x - x[k], total)) for k in some]
    middle = some[int(np.argmin(medians))]
    alike = _squared(x - x[middle], total + total[middle]) <= special.chdtri(2, 0.5)
    alike[middle] = True
    return alike


@dataclass(frozen=True, eq=False)
class Clusters:
    """A mixture, and which points belong to which of its groups.

    Attributes
    ----------
    weight : (K,) float
        Part of the points of each group.
    mean : (K, 2) float
        f0 [Hz] and damping ratio; groups by rising f0.
    covariance : (K, 2, 2) float
        Of each group, without noise.
    probability : (n, K) float
        With which each point belongs to each, by what the other points say of the groups; their number is
        taken for true.
    bic : (Kmost,) float
        Bayesian information criterion of one group, two groups and so on, of fewer than 25 points as of 25; the
        number chosen has the least.
    """

    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray
    probability: FloatArray
    bic: FloatArray

    @property
    def of_point(self) -> IntArray:
        """(n,) most probable group of each point."""
        return np.argmax(self.probability, axis=1)


def find_clusters(
    estimates: npt.ArrayLike,
    covariances: npt.ArrayLike,
    spread: npt.ArrayLike | None = None,
    most: int = 6,
    seed: int = 1,
    degrees_of_freedom: float = np.inf,
) -> Clusters:
    """The mixture of one to `most` groups with the least Bayesian information criterion.

    Parameters
    ----------
    estimates : (n, 2) float
        f0 [Hz] and damping ratio.
    covariances : (n, 2, 2) float
        Noise of each, above 0.
    spread : (2, 2) float, optional
        Of each group where it is known; when absent each has its own, which is estimated together with two
        points of the mean spread of all groups (as Friedman, J. Am. Stat. Assoc. 84 (1989) 165), so that a few
        points that lie together by chance are no group of their own.
    most : int
        Without `spread` not more than a quarter of the points, which could not show the spreads of more.
    seed : int
        Of the starts.
    degrees_of_freedom : float
        Of the spread, above 1; infinite where it is known. Else all groups have the one spread that it and
        these points show together: it counts as so many points about a known mean, behind their mean noise.

    Raises
    ------
    ValueError
        If a covariance is not positive definite.
    """
    given = np.zeros((2, 2)) if spread is None else spread
    x, noise, own = _checked(estimates, covariances, given)
    n = len(x)
    require(most >= 1, "most", most, "1 or above")
    unit = np.sqrt(np.var(x, axis=0) + np.mean(noise, axis=0).diagonal())
    scale = np.outer(unit, unit)
    known = None if spread is None else own / scale
    rng, tried = np.random.default_rng(seed), []
    largest = n if spread is not None else max(1, n // 4)  # a mean and a covariance are five numbers
    for count in range(1, min(most, largest) + 1):
        starts = [_seeds(x / unit, count, rng) for _ in range(_STARTS if count > 1 else 1)]
        tried.append(_mixture(x / unit, noise / scale, known, np.array(starts), degrees_of_freedom))
    # the likelihood of x has the units of 1 / x; it is that of the scaled points here, alike for all counts
    parameters = [(k - 1) + 2 * k + (0 if spread is not None else 3 * k) for k in range(1, len(tried) + 1)]
    counted = np.log(max(n, _FEWEST_COUNTED))
    bic = np.array([p * counted - 2 * m[-1] for p, m in zip(parameters, tried, strict=True)])
    weight, mean, covariance, probability, _ = tried[int(np.argmin(bic))]
    if len(mean) > 1:
        degrees = None if spread is None else degrees_of_freedom + n - len(mean) - 1
        probability = _by_others(x / unit, noise / scale, covariance, probability, degrees)
    order = np.argsort(mean[:, 0])
    covariance = covariance[order] * scale
    return Clusters(weight[order], mean[order] * unit, covariance, probability[:, order], bic)


def _mixture(
    x: FloatArray, noise: FloatArray, known: FloatArray | None, mean: FloatArray, degrees: float
) -> _Mixture:
    """The likeliest of several: expectation and maximisation from given means (S, K, 2) on.

    Each goes on until its likelihood stands. All are stepped at once: of few points a step is but calls.

    Returns
    -------
    weight, mean, covariance, probability, log_likelihood
        As of `Clusters`, of scaled points.
    """
    starts, count, _ = mean.shape
    n = len(x)
    wide = np.cov(x.T, ddof=0).reshape(2, 2) / count if known is None else known
    weight = np.full((starts, count), 1 / count)
    covariance = np.broadcast_to(wide, (starts, count, 2, 2)).copy()
    fixed, log_likelihood = known is not None and np.isinf(degrees), np.full(starts, -np.inf)
    mean_noise = noise.mean(axis=0)
    found: list[_Mixture] = []
    for step in range(_MOST_STEPS):
        # (S, n, K, ...): noise and group together, and what is known of each point's own place in the group
        total = noise[:, None] + covariance[:, None]
        off = x[:, None] - mean[:, None]
        inverse = np.linalg.inv(total)
        squared = np.einsum("snki,snkij,snkj->snk", off, inverse, off)
        log = np.log(weight)[:, None] - np.log(2 * np.pi)
        log = log - 0.5 * (squared + np.log(np.linalg.det(total)))
        largest = log.max(axis=-1, keepdims=True)
        density = np.exp(log - largest)
        sums = density.sum(axis=-1, keepdims=True)
        probability = density / sums
        before, log_likelihood = log_likelihood, np.sum(np.log(sums) + largest, axis=(1, 2))
        if known is not None and not fixed:  # and of what the known spread was estimated from
            ratio = np.linalg.inv(covariance[:, 0] + mean_noise) @ (known + mean_noise)
            gap = np.linalg.slogdet(ratio)[1] - np.trace(ratio, axis1=-2, axis2=-1) + 2
            log_likelihood = log_likelihood + degrees / 2 * gap
        stands = log_likelihood - before < _CONVERGED * n
        stands |= step == _MOST_STEPS - 1
        if stands.any():
            now = (weight, mean, covariance, probability, log_likelihood)
            found += zip(*(each[stands] for each in now), strict=True)
            if stands.all():
                break
            weight, mean, covariance, probability, log_likelihood = (each[~stands] for each in now)
            off, inverse = off[~stands], inverse[~stands]
        members = probability.sum(axis=1) + np.finfo(float).tiny
        weight = np.maximum(members / members.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        if fixed:  # the best mean is that of the points, weighted by their precisions
            weighted = probability[..., None, None] * inverse
            pull = np.einsum("snkij,nj->ski", weighted, x)
            mean = np.linalg.solve(weighted.sum(axis=1), pull[..., None])[..., 0]
            continue
        gain = covariance[:, None] @ inverse
        place = mean[:, None] + np.einsum("snkij,snkj->snki", gain, off)
        left = covariance[:, None] - gain @ covariance[:, None]
        mean = np.einsum("snk,snki->ski", probability, place) / members[..., None]
        about = place - mean[:, None]
        scatter = about[..., :, None] * about[..., None, :] + left
        sums_of = np.einsum("snk,snkij->skij", probability, scatter)
        if known is not None:  # of the points behind the known spread, likewise
            kept = np.linalg.solve(covariance[:, 0] + mean_noise, covariance[:, 0])
            its = kept.swapaxes(1, 2) @ (known + mean_noise) @ kept + covariance[:, 0] - covariance[:, 0] @ kept
            one = (sums_of.sum(axis=1) + degrees * its) / (n + degrees)
            covariance = np.broadcast_to(one[:, None], sums_of.shape)
            continue
        # with that of all groups, without which the likelihood of a group about two points has no limit
        alike = _ALIKE_POINTS * sums_of.sum(axis=1, keepdims=True) / n
        covariance = (sums_of + alike) / (members + _ALIKE_POINTS)[..., None, None]
    return max(found, key=lambda mixture: mixture[-1])


def _by_others(
    x: FloatArray, noise: FloatArray, covariance: FloatArray, probability: FloatArray, of_all: float | None
) -> FloatArray:
    """(n, K) probabilities of groups, each group as the other points (n, 2) show it.

    Its mean is as uncertain as these leave it, with a wide distribution about all points before them.
    Deviations are Student's, with `of_all` degrees of freedom where groups share a covariance, else with one
    for each point of a group.
    A point that had a say in the mean it is compared with would be nearer to it than a new one.
    """
    total = noise[:, None] + covariance
    inverse = np.linalg.inv(total)
    own = probability[..., None, None] * inverse
    pull = np.einsum("nkij,nj->nki", own, x - x.mean(axis=0))
    of_mean = np.linalg.inv(own.sum(axis=0) - own + np.eye(2) / 4)
    off = x[:, None] - x.mean(axis=0) - np.einsum("nkij,nkj->nki", of_mean, pull.sum(axis=0) - pull)
    total = total + of_mean
    squared = _squared(off, total)
    members = probability.sum(axis=0) - probability
    degrees = members + _ALIKE_POINTS - 1 if of_all is None else of_all
    shape = -squared / 2 if of_all == np.inf else -(degrees + 2) / 2 * np.log1p(squared / degrees)
    log = np.log(members + 1) + shape - np.linalg.slogdet(total)[1] / 2
    return np.asarray(special.softmax(log, axis=1))


def _seeds(x: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Means to begin with, apart from one another (k-means++: Arthur and Vassilvitskii, 2007)."""
    chosen = [x[rng.integers(len(x))]]
    while len(chosen) < count:
        far = np.min([np.sum((x - each) ** 2, axis=1) for each in chosen], axis=0)
        probability = far / far.sum() if far.sum() > 0 else None
        chosen.append(x[rng.choice(len(x), p=probability)])
    return np.array(chosen)
