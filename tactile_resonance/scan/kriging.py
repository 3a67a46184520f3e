# SPDX-License-Identifier: Apache-2.0
"""A quantity between its points: Gaussian process regression (kriging) with the noise of each point.

Ordinary kriging: an unknown constant mean, a Matern covariance of smoothness 5/2, and a scatter from place to
place, independent at any two, that is part of the quantity and not of the noise (nugget effect: Chiles and
Delfiner, Geostatistics, 2012). Length, size and scatter are those of greatest restricted likelihood (Rasmussen
and Williams, Gaussian Processes for Machine Learning, 2006, chapters 2, 4 and 5). Few points determine these
badly: there what is known is a mixture over those that they allow, each with its likelihood; no logarithm of
length, size or scatter is preferred beforehand (Handcock and Stein, Technometrics 35, 1993).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy  # its parts are loaded where they are used first: scipy.optimize takes a node 0.15 s
from scipy.linalg import cholesky, eigh, lapack, solve_triangular
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist, pdist

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
"""Up to so many places length, size and scatter count as uncertain."""
# Of the mixture: steps of the logarithms of length and size; sizes in standard deviations of theirs; least
# share of the largest; scatters over that of the values.
_LENGTH_STEP, _SIZE_STEP, _SIZE_STEPS, _LEAST_SHARE = 0.7, 0.25, (-1.3, 0, 1.3, 2.6), 0.1
_SCATTERS = np.exp(-0.5 - np.arange(5))
_LEAST_SCATTER = 0.3  # of the median noise; less is not looked for
# Of the variance of the process; below it neighbours are too much alike to invert their covariance.
_JITTER = 1e-10


class Process(NamedTuple):
    """A process of one length, size and scatter, with the points known.

    Attributes
    ----------
    xy_m : (n, 2) float
    length_m, std : float
    scatter : float
        Standard deviation of what each place has for itself.
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
    scatter: float
    lower: FloatArray
    mean: float
    weights: FloatArray
    of_mean: FloatArray
    mean_std: float

    @classmethod
    def of(
        cls, xy_m: FloatArray, y: FloatArray, noise: FloatArray, length_m: float, std: float, scatter: float
    ) -> Process:
        """Of values (n,) with noise (n,)."""
        covariance = std**2 * _matern(cdist(xy_m, xy_m) / length_m)
        alone = noise**2 + scatter**2 + _JITTER * std**2
        lower = np.asarray(cholesky(covariance + np.diag(alone), lower=True), np.float64)
        ones, values = _solved(lower, np.stack([np.ones(len(y)), y], axis=1)).T
        known = float(ones @ ones)
        mean = float(ones @ values) / known
        weights = solve_triangular(lower, values - mean * ones, lower=True, trans="T")
        of_mean = ones / np.sqrt(known)
        return cls(xy_m, length_m, std, scatter, lower, mean, weights, of_mean, 1 / np.sqrt(known))

    def before(self, a_m: FloatArray, b_m: FloatArray) -> FloatArray:
        """(p, q) covariance between (p, 2) and (q, 2) other positions while no value is known."""
        return np.asarray(self.std**2 * _matern(cdist(a_m, b_m) / self.length_m))

    def at(self, cross: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Where the covariance with the points is (n, q) as `before` gives it: what these tell.

        Value (q,), (n, q) whose products are the covariance that points take off, and (q,) what the mean's
        uncertainty adds, as a standard deviation with a sign.
        """
        solved = _solved(self.lower, cross)
        return self.mean + self.weights @ cross, solved, self.mean_std - self.of_mean @ solved

    def moments(self, cross: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(q,) value and its variance, with the scatter, where the covariance with the points is (n, q)."""
        value, solved, of_mean = self.at(cross)
        known = np.einsum("nq,nq->q", solved, solved)
        return value, np.maximum(self.std**2 - known + of_mean**2, 0) + self.scatter**2

    def covariance(self, a_m: FloatArray, b_m: FloatArray) -> FloatArray:
        """(p, q) covariance of the quantity between (p, 2) and (q, 2) other positions, as known now."""
        (_, solved_a, of_a), (_, solved_b, of_b) = (self.at(self.before(self.xy_m, at)) for at in (a_m, b_m))
        return self.before(a_m, b_m) - solved_a.T @ solved_b + np.outer(of_a, of_b)


@dataclass(frozen=True, eq=False)
class KrigedSurface:
    """What is known of the quantity everywhere.

    Attributes
    ----------
    xy_m : (n, 2) float
        Places.
    values, noise_std : (n,) float
        Of several values in a place their weighted mean.
    constants : (k, 3) float
        Lengths [m], sizes and scatters that the points allow; one row where many points determine these.
    shares : (k,) float
        Their probabilities.
    """

    xy_m: FloatArray
    values: FloatArray
    noise_std: FloatArray
    constants: FloatArray
    shares: FloatArray

    @cached_property
    def processes(self) -> tuple[Process, ...]:
        """(k,) of the constants, each with all points known."""
        known = self.xy_m, self.values, self.noise_std
        return tuple(Process.of(*known, *each) for each in self.constants.tolist())

    @property
    def likeliest(self) -> Process:
        """The process of the largest share."""
        return self.processes[int(np.argmax(self.shares))]

    def predict(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(...) value and its standard deviation at (..., 2) positions.

        The standard deviation is that of the quantity at the place, with its scatter, not of a new measurement
        of it; it includes that of the mean and, of up to `MIXED_POINTS` places, of length, size and scatter.
        Beyond `MOST_JOINT` points both, and the mean, are those of the neighbours of tiles of the places.
        """
        at = np.asarray(xy_m, float)
        flat = at.reshape(-1, 2)
        if len(self.xy_m) > MOST_JOINT:
            value, std = self._by_tiles(flat)
        else:
            # many of the processes are of one length
            apart_m, lengths_m = cdist(flat, self.xy_m).T, np.unique(self.constants[:, 0])
            alike = {length_m: _matern(apart_m / length_m) for length_m in lengths_m.tolist()}
            moments = np.array([p.moments(p.std**2 * alike[p.length_m]) for p in self.processes])
            values, variances = moments.swapaxes(0, 1)  # (k, q)
            value = self.shares @ values
            std = np.sqrt(self.shares @ (variances + (values - value) ** 2))
        return value.reshape(at.shape[:-1]), std.reshape(at.shape[:-1])

    def _by_tiles(self, at: FloatArray) -> FloatArray:
        """(2, q) values and standard deviations at (q, 2) positions."""
        found, points = np.empty((2, len(at))), cKDTree(self.xy_m)
        low_m, side_m = at.min(axis=0), max(float(np.max(np.ptp(at, axis=0))), 1e-9) / _ALONG
        tiles, tile_of = np.unique(np.floor((at - low_m) / side_m).astype(int), axis=0, return_inverse=True)
        for k in range(len(tiles)):
            own = tile_of.ravel() == k
            _, near = points.query(at[own].mean(axis=0), k=_NEIGHBOURS)
            known = self.xy_m[near], self.values[near], self.noise_std[near]
            found[:, own] = KrigedSurface(*known, self.constants, self.shares).predict(at[own])
        return found


def krige(
    xy_m: npt.ArrayLike,
    values: npt.ArrayLike,
    noise_std: npt.ArrayLike,
    most_length_m: float = np.inf,
    least_std: float = 0.0,
) -> KrigedSurface:
    """Fit length, size, scatter and mean.

    Parameters
    ----------
    xy_m : (n, 2) float
        Positions, finite as the rest, n at least `LEAST_POINTS`, not all in one place.
    values : (n,) float
    noise_std : (n,) float
        Of each value, 0 or above; 0 means exact, and where one is, a scatter is not looked for.
    most_length_m, least_std : float
        What is known beforehand of length and size, which few points do not determine.

    Raises
    ------
    ValueError
        If there are two exact ones in one place.
    """
    xy, y, noise = (np.asarray(v, float) for v in (xy_m, values, noise_std))
    # of many points the diagonal of all: their distances would take too much memory
    extent = float(np.linalg.norm(np.ptp(xy, axis=0)) if len(xy) > MOST_JOINT else pdist(xy).max())
    unit_m = 1e-9 * extent  # what is nearer is one place
    places, first, at = np.unique(np.round(xy / unit_m), axis=0, return_index=True, return_inverse=True)
    exact = at.ravel()[noise == 0]
    alone = len(np.unique(exact)) == len(exact)
    require(alone, "xy_m", "one place twice, without noise", "one exact value a place")
    if len(places) < len(y):  # what scatters from place to place is the same in all values of one
        weight = 1 / np.maximum(noise, 1e-9 * _scale(y)) ** 2
        known = np.bincount(at.ravel(), weight)
        xy, y, noise = xy[first], np.bincount(at.ravel(), weight * y) / known, known**-0.5
        noise[exact] = 0.0
    nearest = float(np.median(unit_m * cKDTree(places).query(places, k=2)[0][:, 1]))
    scale, longest = _scale(y), min(10 * extent, most_length_m)
    lowest, highest = np.log(min(0.3 * nearest, longest)), np.log(longest)
    sizes = np.log(max(1e-4 * scale, least_std)), np.log(max(100 * scale, least_std))
    if len(y) <= MIXED_POINTS:
        lengths = lowest, max(lowest, min(highest, np.log(3 * extent)))
        constants, shares = _spread(lengths, sizes, xy, y, noise)
    else:
        starts = np.linspace(lowest, min(np.log(extent), highest), 4)[1:3]
        constants = _fitted(xy, y, noise, starts, (lowest, highest), sizes)[None]
        shares = np.ones(1)
    return KrigedSurface(xy, y, noise, constants, shares)


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
    lengths: tuple[float, float],
    sizes: tuple[float, float],
) -> FloatArray:
    """Length, size and scatter (3,) of greatest likelihood, from logarithms of lengths on.

    Bounds of length and size are logarithms too.
    """
    parts = [(cdist(xy[own], xy[own]), y[own], noise[own]) for own in _parts(xy)]
    scale = _scale(y)
    size = np.clip(np.log(scale), *sizes)
    # where a value is exact there is none; else between what noise hides and the whole
    hidden = max(0.01 * float(np.median(noise)), 1e-6 * scale)
    most = max(scale, hidden) if noise.all() else hidden
    scatters, first = np.log([hidden, most]), np.log(np.sqrt(hidden * most))

    def cost(x: FloatArray) -> float:
        return sum(_cost(x, *part) for part in parts)

    bounds = [lengths, sizes, scatters]
    minimize = partial(scipy.optimize.minimize, method="L-BFGS-B", bounds=bounds)
    found = (minimize(cost, np.array([start, size, first])) for start in starts)
    return np.exp(min(found, key=lambda each: each.fun).x)


def _spread(
    lengths: tuple[float, float],
    sizes: tuple[float, float],
    xy: FloatArray,
    y: FloatArray,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Lengths, sizes and scatters (k, 3) that points allow, and their probabilities (k,).

    Bounds of length and size are logarithms. No scatter, and each that is looked for, are as probable
    beforehand.
    """
    scale, distances = _scale(y), cdist(xy, xy)
    scatters = np.append(0.0, scale * _SCATTERS)
    looked_for = noise.all() & (scatters > _LEAST_SCATTER * np.median(noise))
    looked_for[0] = True
    log_size, step = np.linspace(*sizes, max(3, math.ceil((sizes[1] - sizes[0]) / _SIZE_STEP)), retstep=True)
    least_std = 1 / np.sqrt(2 * (len(y) - 1))
    at, log_share = [], []
    for log_length in np.linspace(*lengths, math.ceil((lengths[1] - lengths[0]) / _LENGTH_STEP) + 1):
        correlation = _matern(distances / np.exp(log_length))
        for scatter in scatters[looked_for]:
            likelihood = _log_likelihoods(np.exp(log_size), correlation, y, np.hypot(noise, scatter))
            middle = int(np.argmax(likelihood))
            inner = min(max(middle, 1), len(log_size) - 2)
            # half of the chi-square of the values where they are exact, wider where noise hides the size
            bend = -np.diff(likelihood[inner - 1 : inner + 2], 2)[0] / step**2 if step else 0.0
            std = 1 / np.sqrt(min(max(bend, 1.0), 1 / least_std**2))
            for k in _SIZE_STEPS:
                size = log_size[middle] + k * std
                if sizes[0] <= size <= sizes[1]:
                    at.append((np.exp(log_length), np.exp(size), scatter))
                    log_share.append(np.log(std) + np.interp(size, log_size, likelihood))
    share = np.exp(np.array(log_share) - max(log_share))
    kept = share > _LEAST_SHARE
    return np.array(at)[kept], share[kept] / share[kept].sum()


def _log_likelihoods(
    sizes: FloatArray, correlation: FloatArray, y: FloatArray, noise: FloatArray
) -> FloatArray:
    """(s,) logarithm of the restricted likelihood of sizes (s,), but for a constant.

    All from the eigenvalues of the correlation over noise.
    """
    weight = 1 / np.maximum(noise, np.sqrt(_JITTER) * _scale(y))
    value, vector = eigh(weight[:, None] * correlation * weight, check_finite=False, driver="evd")
    ones, values = vector.T @ weight, vector.T @ (weight * (y - y.mean()))
    variance = 1 + sizes[:, None] ** 2 * np.maximum(value, 0)
    known, cross, square = (np.sum(v / variance, axis=1) for v in (ones**2, ones * values, values**2))
    log_volume = np.sum(np.log(variance), axis=1) - 2 * np.sum(np.log(weight)) + np.log(known)
    return np.asarray(-0.5 * (square - cross**2 / known + log_volume))


def _cost(x: FloatArray, distances: FloatArray, y: FloatArray, noise: FloatArray) -> float:
    """Minus the logarithm of the restricted likelihood, but for a constant.

    At logarithms (3,) of length, size and scatter.
    """
    length, size, scatter = np.exp(x).tolist()
    alone = noise**2 + scatter**2 + _JITTER * size**2
    lower, failed = lapack.dpotrf(size**2 * _matern(distances / length) + np.diag(alone), lower=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the values is not positive definite")
    solved, _ = lapack.dpotrs(lower, np.stack([np.ones(len(y)), y], axis=1), lower=True)
    weights, known = solved[:, 0], solved[:, 0].sum()
    mean = weights @ y / known
    log_volume = 2 * np.sum(np.log(np.diag(lower))) + np.log(known)
    return 0.5 * float((y - mean) @ (solved[:, 1] - mean * weights) + log_volume)


def _solved(lower: FloatArray, right: FloatArray) -> FloatArray:
    """(n, k) the factor (n, n), solved for (n, k)."""
    return np.asarray(solve_triangular(lower, right, lower=True, check_finite=False))


def _matern(ratio: FloatArray) -> FloatArray:
    """Correlation at distances over length."""
    scaled = np.sqrt(5) * ratio
    found = scaled / 3  # in place: it is asked for at millions of distances
    found += 1
    found *= scaled
    found += 1
    found *= np.exp(np.negative(scaled, out=scaled), out=scaled)
    return found
