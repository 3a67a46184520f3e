# SPDX-License-Identifier: Apache-2.0
"""Which tissue a pole belongs to, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special  # scipy.stats takes a node most of a second to import

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require

UNKNOWN = "unknown"
_LEAST_SCATTER = 1e-9  # of points across their line, as a part of their variance


@dataclass(frozen=True, eq=False)
class TissueClass:
    """How the poles of one tissue are distributed, from sample to sample.

    Attributes
    ----------
    name : str
    mean : (2,) float
        f0 [Hz] and damping ratio.
    spread : (2, 2) float
        Covariance of (f0, damping ratio) within the class, without the noise of one measurement.
    degrees_of_freedom : float
        Of the spread, where it was itself estimated; infinite where it is given.
    prior : float
        Relative frequency with which the class is met, above 0.
    """

    name: str
    mean: FloatArray
    spread: FloatArray
    degrees_of_freedom: float = float("inf")
    prior: float = 1.0

    def __post_init__(self) -> None:
        good = bool(self.name) and self.name != UNKNOWN
        require(good, "name", self.name, f"a name other than {UNKNOWN!r}")
        require(0 < self.prior < np.inf, "prior", self.prior, "a number above 0")


@dataclass(frozen=True)
class TissueCall:
    """What a pole was taken for.

    Attributes
    ----------
    name : str
        Most probable class; `UNKNOWN` where the pole lies outside of all classes, or is not known.
    probability : float
        Of that class, given that it is one of the classes; NaN for `UNKNOWN`. Too sure where classes of few
        samples lie close together: docs/references.md.
    reason : str
        Why it is `UNKNOWN`.
    """

    name: str
    probability: float
    reason: str = ""


def class_from_samples(name: str, points: npt.ArrayLike, prior: float = 1.0) -> TissueClass:
    """Class of measured reference points.

    Parameters
    ----------
    points : (n, 2) float
        f0 [Hz] and damping ratio of n points of this tissue, n at least 4; their scatter holds the noise
        of those measurements too, which is on the safe side.
    """
    x = np.asarray(points, float)
    good = x.ndim == 2 and x.shape[1] == 2 and len(x) >= 4 and bool(np.all(np.isfinite(x)))
    require(good, "points", x.shape, "shape (n, 2) with n at least 4, finite")
    n, scatter = len(x), np.cov(x.T)
    # equal or rounded figures: no spread was measured, and whatever is not on their line would be unknown
    shown = bool(np.all(np.ptp(x, axis=0) > 0)) and np.linalg.det(np.corrcoef(x.T)) > _LEAST_SCATTER
    require(shown, "points", x[:4].tolist(), "points that scatter in f0 and in damping ratio, not on one line")
    return predictive_class(name, x.mean(axis=0), (1 + 1 / n) * scatter, n - 1.0, prior)


def predictive_class(
    name: str,
    mean: FloatArray,
    covariance: FloatArray,
    degrees_of_freedom: float,
    prior: float = 1.0,
) -> TissueClass:
    """Class whose next member is predicted from an estimated covariance.

    Parameters
    ----------
    mean : (2,) float
    covariance : (2, 2) float
        Estimated, of the next member about the mean; it includes the uncertainty of the mean.
    degrees_of_freedom : float
        Of that estimate, above 1; infinite where it is known.

    Notes
    -----
    With nu degrees of freedom the squared distance of the next member is Hotelling's T^2: the member follows
    Student's distribution with nu - 1 degrees of freedom about the mean and the scale nu / (nu - 1) times the
    covariance (two dimensions; Geisser, Predictive Inference, 1993, section 9.1).
    """
    nu = degrees_of_freedom
    require(nu > 1, "degrees_of_freedom", nu, "a number above 1")
    if np.isinf(nu):
        return TissueClass(name, mean, covariance, prior=prior)
    return TissueClass(name, mean, covariance * nu / (nu - 1), nu - 1, prior)


def classify(
    estimate: npt.ArrayLike,
    covariance: npt.ArrayLike,
    classes: Sequence[TissueClass],
    unknown_level: float = 0.01,
) -> TissueCall:
    """Bayes' rule over the classes, and a test whether the pole fits any of them.

    Parameters
    ----------
    estimate : (2,) float
        f0 [Hz] and damping ratio; NaN where unknown.
    covariance : (2, 2) float
        Of the estimate.
    classes : sequence of TissueClass
        One or more, of different names.
    unknown_level : float
        A pole farther from every class than this fraction of the class's own members is `UNKNOWN`; above 0,
        below 1.
    """
    names = [c.name for c in classes]
    x, noise = np.asarray(estimate, float), np.asarray(covariance, float)
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(noise))):
        return TissueCall(UNKNOWN, float("nan"), "no pole with a covariance")
    posterior, tails = posteriors(x, noise, classes)
    tail = float(tails.max())
    if tail < unknown_level:
        nearest = names[int(np.argmax(tails))]
        reason = f"farther from {nearest}, the nearest, than all but {tail:.2g} of its members"
        return TissueCall(UNKNOWN, float("nan"), reason)
    best = int(np.argmax(posterior))
    return TissueCall(names[best], float(posterior[best]))


def posteriors(
    estimates: FloatArray, noise: FloatArray, classes: Sequence[TissueClass]
) -> tuple[FloatArray, FloatArray]:
    """Bayes' rule over K classes, of any points.

    Parameters
    ----------
    estimates : (..., 2) float
        Finite, as their noise.
    noise : (..., 2, 2) float
    classes : sequence of TissueClass

    Returns
    -------
    probability : (..., K) float
        Of each class, given that it is one of them.
    tail : (..., K) float
        How often a member of each lies as far out.
    """
    found = [_density_and_tail(estimates, noise, each) for each in classes]
    densities, tails = (np.stack(each, axis=-1) for each in zip(*found, strict=True))
    weights = densities + np.log([each.prior for each in classes])
    posterior = np.exp(weights - weights.max(axis=-1, keepdims=True))
    return posterior / posterior.sum(axis=-1, keepdims=True), tails


def log_density(estimates: FloatArray, noise: FloatArray, tissue: TissueClass) -> FloatArray:
    """(...) logarithm of the density of estimates (..., 2) with noise (2, 2), if they are of this tissue."""
    return _density_and_tail(estimates, noise, tissue)[0]


def _density_and_tail(
    estimate: FloatArray, noise: FloatArray, tissue: TissueClass
) -> tuple[FloatArray, FloatArray]:
    """(...) log density, and probability of lying as far out, of (..., 2) with noise (..., 2, 2).

    With an estimated spread the sum of Student's and Gaussian deviations is taken as Student's of the
    summed scale: exact where the noise vanishes, else too wide: fewer lie as far out than is returned.
    """
    scale = tissue.spread + noise
    unit = np.sqrt(np.diagonal(scale, axis1=-2, axis2=-1))
    require(bool(np.all(unit > 0)), "covariance", noise.tolist(), "above 0 with the spread added")
    standard = (estimate - tissue.mean) / unit
    correlation = scale / (unit[..., :, None] * unit[..., None, :])
    solved = np.linalg.solve(correlation, standard[..., None])[..., 0]
    distance2 = np.sum(standard * solved, axis=-1)
    log_volume = 0.5 * np.linalg.slogdet(correlation)[1] + np.sum(np.log(unit), axis=-1)
    dof = tissue.degrees_of_freedom
    if np.isinf(dof):
        log_shape, tail = -0.5 * distance2, special.chdtrc(2, distance2)
    else:
        # two dimensions: the constant of Student's density is that of the Gaussian, 1 / 2 pi
        log_shape, tail = (
            -(dof + 2) / 2 * np.log1p(distance2 / dof),
            special.fdtrc(2, dof, distance2 / 2),
        )
    return np.asarray(log_shape - log_volume - np.log(2 * np.pi)), np.asarray(tail)
