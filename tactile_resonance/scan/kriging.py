# SPDX-License-Identifier: Apache-2.0
"""A quantity between its points: Gaussian process regression (kriging) with the noise of each point.

Ordinary kriging: an unknown constant mean and a Matern covariance of smoothness 5/2, whose length and size
are those of greatest restricted likelihood (Rasmussen and Williams, Gaussian Processes for Machine Learning,
2006, chapters 2, 4 and 5). Few points determine these badly: there what is known is a mixture over the lengths
and sizes that they allow, each with its likelihood, no logarithm of either preferred beforehand (Handcock and
Stein, Technometrics 35, 1993).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, lapack, solve_triangular
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.fields import require

LEAST_POINTS = 5
# Length and size are fitted to so many points together: the cost grows with the third power. Of more, the
# likelihood is that of so many, evenly picked, times those of all points in blocks of about `_BLOCK` neighbours
# (composite likelihood: Eidsvik et al., J. Comput. Graph. Stat. 23, 2014), so that no point is without a say:
# something small between points that were picked would else be smoothed away, and the surface sure of it.
FIT_POINTS = 100
_BLOCK = 40
# So many points count together; of more, those next to each tile of the places asked for: time and memory then
# grow with their number. Neighbours screen what is farther away (Chiles and Delfiner, Geostatistics, 2012,
# section 3.6, moving neighbourhood).
MOST_JOINT = 1000
_NEIGHBOURS, _ALONG = 300, 12  # of a tile; tiles along the longer side
MIXED_POINTS = 40
"""Up to so many points the uncertainty of length and size counts: of more it adds less than a tenth."""
# Of the mixture: steps of the logarithm of the length; sizes in standard deviations of theirs; least share of
# the largest.
_LENGTH_STEP, _SIZE_STEPS, _LEAST_SHARE = 0.7, (-1.3, 0, 1.3, 2.6), 0.1
# Of the variance of the process; below it neighbours are too much alike to invert their covariance.
_JITTER = 1e-10


class Process(NamedTuple):
    """A process of one length and size, with the points known.

    Attributes
    ----------
    xy_m : (n, 2) float
    length_m, std : float
    lower : (n, n) float
        Cholesky factor of the covariance of the values.
    mean : float
        Of the process, by generalised least squares.
    weights : (n,) float
        The inverse of that covariance, times the values less their mean.
    of_mean : (n,) float
        `lower` solved for ones, times the deviation of the mean.
    mean_std : float
    """

    xy_m: FloatArray
    length_m: float
    std: float
    lower: FloatArray
    mean: float
    weights: FloatArray
    of_mean: FloatArray
    mean_std: float

    @classmethod
    def of(
        cls, xy_m: FloatArray, y: FloatArray, noise: FloatArray, length_m: float, std: float
    ) -> Process:
        """Of values (n,) with noise."""
        covariance = std**2 * _matern(cdist(xy_m, xy_m) / length_m)
        lower = np.asarray(cholesky(covariance + np.diag(noise**2 + _JITTER * std**2), lower=True), np.float64)
        ones, values = _solved(lower, np.stack([np.ones(len(y)), y], axis=1)).T
        known = float(ones @ ones)
        mean = float(ones @ values) / known
        weights = solve_triangular(lower, values - mean * ones, lower=True, trans="T")
        return cls(xy_m, length_m, std, lower, mean, weights, ones / np.sqrt(known), 1 / np.sqrt(known))

    def before(self, a_m: FloatArray, b_m: FloatArray) -> FloatArray:
        """(p, q) covariance between (p, 2) and (q, 2) positions while no value is known."""
        return np.asarray(self.std**2 * _matern(cdist(a_m, b_m) / self.length_m))

    def at(self, at_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """At (q, 2) positions: value (q,), (n, q) whose products are the covariance that points take off, (q,).

        The last is what the mean's uncertainty adds, as a standard deviation with a sign.
        """
        cross = self.before(self.xy_m, at_m)
        solved = _solved(self.lower, cross)
        return self.mean + self.weights @ cross, solved, self.mean_std - self.of_mean @ solved

    def moments(self, at_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(q,) value and its variance at (q, 2) positions."""
        value, solved, of_mean = self.at(at_m)
        known = np.einsum("nq,nq->q", solved, solved)
        return value, np.maximum(self.std**2 - known + of_mean**2, 0)

    def covariance(self, a_m: FloatArray, b_m: FloatArray) -> FloatArray:
        """(p, q) covariance of the quantity between (p, 2) and (q, 2) positions, as `moments` knows it."""
        (_, solved_a, of_a), (_, solved_b, of_b) = self.at(a_m), self.at(b_m)
        return self.before(a_m, b_m) - solved_a.T @ solved_b + np.outer(of_a, of_b)


@dataclass(frozen=True, eq=False)
class KrigedSurface:
    """What is known of the quantity everywhere.

    Attributes
    ----------
    processes : tuple of k
        Of lengths and sizes that the points allow; one where many points determine these.
    shares : (k,) float
        Their probabilities.
    """

    processes: tuple[Process, ...]
    shares: FloatArray

    @property
    def likeliest(self) -> Process:
        """The process of the largest share."""
        return self.processes[int(np.argmax(self.shares))]

    def predict(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(...) value and its standard deviation at (..., 2) positions.

        The standard deviation is that of the quantity itself, not of a new measurement of it; it
        includes that of the mean and, of up to `MIXED_POINTS` points, of length and size.
        """
        at = np.asarray(xy_m, float)
        moments = np.array([process.moments(at.reshape(-1, 2)) for process in self.processes])
        values, variances = moments.swapaxes(0, 1)  # (k, q)
        value = self.shares @ values
        variance = self.shares @ (variances + (values - value) ** 2)
        return value.reshape(at.shape[:-1]), np.sqrt(variance).reshape(at.shape[:-1])


@dataclass(frozen=True, eq=False)
class TiledSurface:
    """A quantity known at many points: `KrigedSurface` tile by tile, of one length and size.

    Attributes
    ----------
    xy_m : (n, 2) float
    values, noise_std : (n,) float
    length_m, process_std : float
    """

    xy_m: FloatArray
    values: FloatArray
    noise_std: FloatArray
    length_m: float
    process_std: float

    def predict(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """As `KrigedSurface.predict`; the mean is that of each tile's neighbours."""
        at = np.asarray(xy_m, float)
        flat = at.reshape(-1, 2)
        found = np.empty((2, len(flat)))
        low_m, side_m = flat.min(axis=0), max(float(np.max(np.ptp(flat, axis=0))), 1e-9) / _ALONG
        tiles, tile_of = np.unique(
            np.floor((flat - low_m) / side_m).astype(int), axis=0, return_inverse=True
        )
        points = cKDTree(self.xy_m)
        for k in range(len(tiles)):
            own = tile_of.ravel() == k
            _, near = points.query(flat[own].mean(axis=0), k=_NEIGHBOURS)
            known = self.xy_m[near], self.values[near], self.noise_std[near]
            part = Process.of(*known, self.length_m, self.process_std)
            found[:, own] = part.moments(flat[own])
        value, variance = found.reshape(2, *at.shape[:-1])
        return value, np.sqrt(variance)


def krige_many(
    xy_m: npt.ArrayLike, values: npt.ArrayLike, noise_std: npt.ArrayLike
) -> KrigedSurface | TiledSurface:
    """`krige` of any number of points; beyond `MOST_JOINT` of them tile by tile.

    Length and size are those of all points.

    Raises
    ------
    ValueError
        As `krige`.
    """
    xy, y, noise = (np.asarray(v, float) for v in (xy_m, values, noise_std))
    if len(xy) <= MOST_JOINT:
        return krige(xy, y, noise)
    _check_values(xy, y, noise)
    extent = float(np.linalg.norm(np.ptp(xy, axis=0)))
    require(extent > 0, "xy_m", "one place", "places apart from each other")
    rounded = np.round(xy / (1e-9 * extent))
    exact = rounded[noise == 0]
    alone = len(np.unique(exact, axis=0)) == len(exact)
    require(alone, "xy_m", "one place twice, without noise", "one exact value a place")
    places = np.unique(rounded, axis=0) * (1e-9 * extent)
    nearest = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))
    scale = _scale(y)
    lowest, highest = np.log(0.3 * nearest), np.log(10 * extent)
    best = _fitted(
        xy,
        y,
        noise,
        np.linspace(lowest, np.log(extent), 4)[1:3],
        np.log(scale),
        (lowest, highest),
        (np.log(1e-4 * scale), np.log(100 * scale)),
    )
    return TiledSurface(xy, y, noise, *np.exp(best).tolist())


def krige(
    xy_m: npt.ArrayLike,
    values: npt.ArrayLike,
    noise_std: npt.ArrayLike,
    most_length_m: float = np.inf,
    least_std: float = 0.0,
) -> KrigedSurface:
    """Fit length, size and mean.

    Parameters
    ----------
    xy_m : (n, 2) float
        Positions, n at least `LEAST_POINTS`, not all in one place.
    values : (n,) float
    noise_std : (n,) float
        Of each value; 0 means exact.
    most_length_m, least_std : float
        What is known beforehand of length and size, which few points do not determine.

    Raises
    ------
    ValueError
        If there are too few points, or two exact ones in one place.
    """
    xy, y, noise = (np.asarray(v, float) for v in (xy_m, values, noise_std))
    require(len(xy) >= LEAST_POINTS, "xy_m", len(xy), f"{LEAST_POINTS} points or more")
    _check_values(xy, y, noise)
    distances = cdist(xy, xy)
    apart = distances + np.diag(np.full(len(xy), np.inf))
    extent = float(distances.max())
    require(extent > 0, "xy_m", "one place", "places apart from each other")
    twice = (apart < 1e-9 * extent) & (noise[:, None] == 0) & (noise == 0)
    require(not twice.any(), "xy_m", "one place twice, without noise", "one exact value a place")
    scale = _scale(y)
    other = np.where(apart < 1e-9 * extent, np.inf, apart)  # places, not points
    nearest = float(np.median(other.min(axis=1)))
    longest = min(10 * extent, most_length_m)
    lowest, highest = np.log(min(0.3 * nearest, longest)), np.log(longest)
    least, most = np.log(max(1e-4 * scale, least_std)), np.log(max(100 * scale, least_std))
    first = min(max(np.log(scale), least), most)
    # starts over the lengths that the points resolve: a likelihood may have several maxima
    starts = np.linspace(lowest, min(np.log(extent), highest), 4)
    best = _fitted(xy, y, noise, starts, first, (lowest, highest), (least, most))
    at, shares = best[None], np.ones(1)
    if len(y) <= MIXED_POINTS:
        lengths = lowest, min(highest, np.log(3 * extent))
        at, shares = _spread(best, lengths, (least, most), distances, y, noise)
    processes = tuple(Process.of(xy, y, noise, *each) for each in np.exp(at).tolist())
    return KrigedSurface(processes, shares)


def _check_values(xy: FloatArray, y: FloatArray, noise: FloatArray) -> None:
    good = bool(np.all(np.isfinite(xy)) and np.all(np.isfinite(y)))
    require(good, "xy_m, values", "some that are not finite", "finite numbers")
    wrong = noise[~((noise >= 0) & np.isfinite(noise))]
    require(not wrong.size, "noise_std", wrong.tolist()[:1], "finite numbers, 0 or above")


def _scale(y: FloatArray) -> float:
    """Above 0: how far values scatter."""
    return float(np.std(y)) or 1e-9 * (abs(float(y[0])) or 1.0)


def _parts(xy: FloatArray) -> list[IntArray]:
    """Indices of points that are fitted together: all; of many, some of all over, and blocks of neighbours."""
    n = len(xy)
    picked = np.unique(np.linspace(0, n - 1, min(n, FIT_POINTS)).astype(int))
    if n <= FIT_POINTS:
        return [picked]
    count = math.ceil(math.sqrt(n / _BLOCK))
    strips = np.array_split(np.argsort(xy[:, 0], kind="stable"), count)
    along = (strip[np.argsort(xy[strip, 1], kind="stable")] for strip in strips)
    return [picked, *(block for strip in along for block in np.array_split(strip, count))]


def _fitted(
    xy: FloatArray,
    y: FloatArray,
    noise: FloatArray,
    starts: FloatArray,
    first: float,
    lengths: tuple[float, float],
    sizes: tuple[float, float],
) -> FloatArray:
    """Logarithms (2,) of length and size of greatest likelihood within bounds, from lengths and a size on."""
    parts = [(cdist(xy[own], xy[own]), y[own], noise[own]) for own in _parts(xy)]

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        costs, slopes = zip(*(_cost(x, *part) for part in parts), strict=True)
        return sum(costs), np.sum(slopes, axis=0)

    found = (
        minimize(cost, np.array([start, first]), jac=True, method="L-BFGS-B", bounds=[lengths, sizes])
        for start in starts
    )
    return np.asarray(min(found, key=lambda each: each.fun).x)


def _spread(
    best: FloatArray,
    lengths: tuple[float, float],
    sizes: tuple[float, float],
    distances: FloatArray,
    y: FloatArray,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Logarithms (k, 2) of length and size about the best, within bounds, and their probabilities (k,)."""
    steps = np.arange(-20, 21) * _LENGTH_STEP + best[0]
    inside = (steps >= lengths[0]) & (steps <= lengths[1])
    inside[20] = True  # the best itself
    at, log_share = [], []
    for log_length in steps[inside]:

        def cost(log_size: float, log_length: float = log_length) -> tuple[float, FloatArray]:
            return _cost(np.array([log_length, log_size]), distances, y, noise)

        found = minimize_scalar(
            lambda size, cost=cost: cost(size)[0], bounds=sizes, method="bounded", options={"xatol": 0.05}
        )
        middle = float(found.x)
        # half of the chi-square of the values where they are exact, wider where noise hides the size
        step = 1 / np.sqrt(2 * (len(y) - 1))
        bend = (cost(middle + step)[1][1] - cost(middle - step)[1][1]) / (2 * step)
        std = 1 / np.sqrt(min(max(bend, 1.0), 1 / step**2))
        for k in _SIZE_STEPS:
            log_size = middle + k * std
            if sizes[0] <= log_size <= sizes[1]:
                at.append((log_length, log_size))
                log_share.append(np.log(std) - cost(log_size)[0])
    share = np.exp(np.array(log_share) - max(log_share))
    kept = share > _LEAST_SHARE
    return np.array(at)[kept], share[kept] / share[kept].sum()


def _cost(
    x: FloatArray, distances: FloatArray, y: FloatArray, noise: FloatArray
) -> tuple[float, FloatArray]:
    """Minus the logarithm of the restricted likelihood, but for a constant, and its (2,) derivatives.

    By a parameter that changes the covariance C by C' they are half the sum of ``G C'`` over all elements, with
    ``G = C^-1 - w w^T / (1^T w) - a a^T``, ``w = C^-1 1`` and ``a = C^-1 (y - mean)``.
    """
    length, size = np.exp(x).tolist()
    scaled = np.sqrt(5) * distances / length
    decay = size**2 * np.exp(-scaled)
    process = (1 + scaled + scaled**2 / 3) * decay + np.diag(np.full(len(y), _JITTER * size**2))
    lower, failed = lapack.dpotrf(process + np.diag(noise**2), lower=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the values is not positive definite")
    solved, _ = lapack.dpotrs(lower, np.stack([np.ones(len(y)), y], axis=1), lower=True)
    weights, known = solved[:, 0], solved[:, 0].sum()
    mean = weights @ y / known
    gap = solved[:, 1] - mean * weights
    log_volume = 2 * np.sum(np.log(np.diag(lower))) + np.log(known)
    half = np.tril(lapack.dpotri(lower, lower=True)[0])
    inverse = half + np.tril(half, -1).T
    slope = inverse - np.outer(weights, weights) / known - np.outer(gap, gap)
    by_length = np.sum(slope * scaled**2 * (1 + scaled) / 3 * decay)
    by_size = 2 * np.sum(slope * process)
    cost = 0.5 * ((y - mean) @ gap + log_volume)
    return float(cost), np.array([by_length, by_size]) / 2


def _solved(lower: FloatArray, right: FloatArray) -> FloatArray:
    """(n, k) the factor (n, n), solved for (n, k)."""
    return np.asarray(solve_triangular(lower, right, lower=True, check_finite=False))


def _matern(ratio: FloatArray) -> FloatArray:
    """Correlation at distances over length."""
    scaled = np.sqrt(5) * ratio
    return (1 + scaled + scaled**2 / 3) * np.exp(-scaled)
