# SPDX-License-Identifier: Apache-2.0
"""Groups of points of a map, without references: a mixture of normal distributions behind known noise.

Each point has a noise covariance of its own, which the groups must not take for theirs. This is extreme
deconvolution (Bovy, Hogg and Roweis, Annals of Applied Statistics 5 (2011) 1657), a page of expectation and
maximisation. scikit-learn's GaussianMixture knows no noise of points: it takes that of bad points for the
spread of a group, and is not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.fields import require

_STARTS, _ROUNDS, _CONVERGED = 6, 1000, 1e-6


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
        With which each point belongs to each.
    log_likelihood : float
    parameters : int
    bic : (Kmost,) float
        Bayesian information criterion of one group, two groups and so on; the number chosen has the least.
    """

    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray
    probability: FloatArray
    log_likelihood: float
    parameters: int
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
) -> Clusters:
    """The mixture of one to `most` groups with the least Bayesian information criterion.

    Parameters
    ----------
    estimates : (n, 2) float
        f0 [Hz] and damping ratio.
    covariances : (n, 2, 2) float
        Noise of each, above 0.
    spread : (2, 2) float, optional
        Of each group where it is known; when absent each has its own, which is estimated.
    most : int
    seed : int
        Of the starts.

    Raises
    ------
    ValueError
        If a shape does not fit, or something is not finite.
    """
    x, noise = np.asarray(estimates, float), np.asarray(covariances, float)
    n = len(x)
    for name, array, shape in (("estimates", x, (n, 2)), ("covariances", noise, (n, 2, 2))):
        good = array.shape == shape and n > 0 and bool(np.all(np.isfinite(array)))
        require(good, name, array.shape, f"shape {shape}, finite, of one point or more")
    require(most >= 1, "most", most, "1 or above")
    unit = np.sqrt(np.var(x, axis=0) + np.mean(noise, axis=0).diagonal())
    scale = np.outer(unit, unit)
    known = None if spread is None else np.asarray(spread, float) / scale
    rng, tried = np.random.default_rng(seed), []
    for count in range(1, min(most, n) + 1):
        starts = [
            _Mixture(x / unit, noise / scale, known, _seeds(x / unit, count, rng))
            for _ in range(_STARTS if count > 1 else 1)
        ]
        tried.append(max(starts, key=lambda mixture: mixture.log_likelihood))
    # the likelihood of x has the units of 1 / x; it is that of the scaled points here, alike for all counts
    parameters = [
        (k - 1) + 2 * k + (0 if spread is not None else 3 * k) for k in range(1, len(tried) + 1)
    ]
    bic = np.array(
        [p * np.log(n) - 2 * m.log_likelihood for p, m in zip(parameters, tried, strict=True)]
    )
    chosen = int(np.argmin(bic))
    best = tried[chosen]
    order = np.argsort(best.mean[:, 0])
    return Clusters(
        best.weight[order],
        best.mean[order] * unit,
        best.covariance[order] * scale,
        best.probability[:, order],
        best.log_likelihood,
        parameters[chosen],
        bic,
    )


class _Mixture:
    """Expectation and maximisation from given means on, until the likelihood stands."""

    def __init__(
        self, x: FloatArray, noise: FloatArray, known: FloatArray | None, mean: FloatArray
    ) -> None:
        count = len(mean)
        wide = np.cov(x.T, ddof=0).reshape(2, 2) / count if known is None else known
        self.weight, self.mean = np.full(count, 1 / count), mean
        self.covariance = np.broadcast_to(wide, (count, 2, 2)).copy()
        self.log_likelihood = -np.inf
        for _ in range(_ROUNDS):
            # (n, K, ...): noise and group together, and what is known of each point's own place in the group
            total = noise[:, None] + self.covariance
            off = x[:, None] - self.mean
            inverse = np.linalg.inv(total)
            squared = np.einsum("nki,nkij,nkj->nk", off, inverse, off)
            log = np.log(self.weight) - np.log(2 * np.pi)
            log = log - 0.5 * (squared + np.log(np.linalg.det(total)))
            largest = log.max(axis=1, keepdims=True)
            density = np.exp(log - largest)
            sums = density.sum(axis=1, keepdims=True)
            self.probability = density / sums
            before, self.log_likelihood = self.log_likelihood, float(np.sum(np.log(sums) + largest))
            if self.log_likelihood - before < _CONVERGED * len(x):
                break
            gain = self.covariance @ inverse
            place = self.mean + np.einsum("nkij,nkj->nki", gain, off)
            left = self.covariance - gain @ self.covariance
            members = self.probability.sum(axis=0) + np.finfo(float).tiny
            self.weight = np.maximum(members / members.sum(), np.finfo(float).tiny)
            if (
                known is not None
            ):  # the best mean is that of the points, weighted by their precisions
                weighted = self.probability[..., None, None] * inverse
                pull = np.einsum("nkij,nj->ki", weighted, x)
                self.mean = np.linalg.solve(weighted.sum(axis=0), pull[..., None])[..., 0]
                continue
            self.mean = np.einsum("nk,nki->ki", self.probability, place) / members[:, None]
            about = place - self.mean
            scatter = about[..., :, None] * about[..., None, :] + left
            self.covariance = np.einsum("nk,nkij->kij", self.probability, scatter)
            self.covariance /= members[:, None, None]


def _seeds(x: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Means to begin with, apart from one another (k-means++: Arthur and Vassilvitskii, 2007)."""
    chosen = [x[rng.integers(len(x))]]
    while len(chosen) < count:
        far = np.min([np.sum((x - each) ** 2, axis=1) for each in chosen], axis=0)
        probability = far / far.sum() if far.sum() > 0 else None
        chosen.append(x[rng.choice(len(x), p=probability)])
    return np.array(chosen)
