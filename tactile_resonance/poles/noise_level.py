# SPDX-License-Identifier: Apache-2.0
"""Which variance to weight lines with: pooled over the band where the data allow it; the level a fit shows.

A sample variance from few periods is a poor weight: with nu degrees of freedom the estimate loses a
factor (nu - 1)/(nu - 2) in variance and has none for nu <= 2. Where the variance is the same on all
lines, or changes slowly, one smooth curve over the band is far better known.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from tactile_resonance._typing import BoolArray, FloatArray, IntArray
from tactile_resonance.poles.compiled import entry, inner
from tactile_resonance.poles.model import real_rows

if TYPE_CHECKING:
    from tactile_resonance.poles.data import BinData
    from tactile_resonance.poles.joint import JointPlan
    from tactile_resonance.poles.likelihood import Solution

# Bartlett's test rejects a flat variance wrongly in one of ten thousand bands.
FALSE_ALARM = 1e-4
REWEIGHTINGS = 3
# Of the mean over the band: below it a fitted variance is taken for an accident.
LEAST_VARIANCE = 1e-3
# Degrees of freedom that a variance known from a piece of the band alone should have, and the fewest.
PIECE_DOF = 24
FEWEST_PIECE_DOF = 8
# Pieces that are wanted before their degrees of freedom are.
WANTED_PIECES = 5
# Bins whose powers are averaged before their variances are compared with each other.
BINS_PER_BAND = 8
TINY = float(np.finfo(float).tiny)
# Mean square of the residuals over that of the data, below which they are rounding.
ROUNDED = 1e-22
KINDS = ("flat", "sloped", "per line")
# What chance makes more often says nothing; the rarer it is, the more it counts. A test that is passed or not
# would pass differences of the size of the noise, and ellipses would hold 80 to 90 %.
CHANCE = 0.5
# A cost that noise alone exceeds once in a thousand fits counts as model error.
MODEL_ERROR_PROBABILITY = 1e-3
# Chance below which what speaks against a fit, not surely, counts in its covariance: in one sound fit in 20.
DOUBT = 0.05


@dataclass(frozen=True, eq=False)
class Pieces:
    """Neighbouring bins, or lines, whose variances are averaged before they are compared with each other.

    Attributes
    ----------
    size : int
        Bins in each, the last one longer.
    starts, counts : (pieces,) int
        First value of each, and how many there are.
    of_bin : (K,) int
        Which piece a bin belongs to.
    dof : int
        Complex degrees of freedom of the variance of a piece.
    """

    size: int
    starts: IntArray
    counts: IntArray
    of_bin: IntArray
    dof: int

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, bins: int, size: int, dof: int, values: int = 1) -> Pieces:
        """Of bins with a sample variance of `dof` degrees of freedom each, from so many values."""
        pieces = max(1, bins // size)
        starts = np.arange(pieces) * (size * values)
        counts = np.diff(np.append(starts, bins * values))
        return cls(size, starts, counts, np.minimum(np.arange(bins) // size, pieces - 1), size * dof)

    def means(self, values: FloatArray) -> FloatArray:
        """(batch, pieces) of (batch, K values)."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=-1) / self.counts)


@dataclass(frozen=True, eq=False)
class VarianceModel:
    """Variance to weight with, for a batch of points.

    Attributes
    ----------
    variance : (batch, F) float
        Infinite on lines that are left out.
    lines : (batch,) int
        Lines that are not.
    dof : int
        Complex degrees of freedom of the variance of each line.
    kind : (batch,) int
        Index into `KINDS`.
    independent_dof : float or None
        Degrees of freedom that a line adds to the pool; `dof` where absent. Fewer where lines share
        the bins between them that their variances are from.
    """

    variance: FloatArray
    lines: IntArray
    dof: int
    kind: IntArray
    independent_dof: float | None = None

    @property
    def pooled_dof(self) -> FloatArray:
        """(batch,) of the whole curve; equals `dof` for ``per line``."""
        each = self.dof if self.independent_dof is None else self.independent_dof
        return np.where(self.kind == 2, float(self.dof), self.lines * float(each))

    @property
    def information_correction(self) -> FloatArray:
        """(batch,) factor by which the plain covariance ``(2 Re J^H J / s^2)^-1`` is too small.

        With weights 1/s^2 of nu complex degrees of freedom each, ``E[1/s^2] = nu / (nu - 1) /
        sigma^2`` and ``E[1/s^4] = nu^2 / ((nu - 1)(nu - 2)) / sigma^4``; the plain covariance
        becomes (nu - 1)/nu of the bound and the estimate's own (nu - 1)/(nu - 2), together nu / (nu
        - 2). NaN for nu <= 2, where the weights have no second moment.

        A level pooled to nu degrees of freedom makes errors over their stated deviation Student
        distributed: with 2 nu real degrees of freedom their variance is ``nu / (nu - 1)``.
        """
        per_line = self.dof / (self.dof - 2) if self.dof > 2 else np.nan
        return np.where(self.kind == 2, per_line, student_variance(self.pooled_dof))

    def expected_cost(self, parameters: int) -> FloatArray:
        """(batch,) expectation of ``sum |e|^2 / s^2`` with noise alone; NaN where it has none."""
        return (self.lines - parameters / 2) * student_variance(self.pooled_dof)

    def chance(self, cost: FloatArray, parameters: int) -> FloatArray:
        """(batch,) how often noise alone exceeds a cost; NaN where that cannot be determined."""
        free = np.maximum(self.lines - parameters / 2, 0.5)
        chance = chance_of_level(cost / free, free, self.pooled_dof)
        by_line = self.kind == 2
        if by_line.any():
            ratio = cost / self.expected_cost(parameters)
            of_lines = chance_of_pieces(ratio, free, 1, self.dof) if self.dof > 2 else np.nan
            chance = np.where(by_line, of_lines, chance)
        return np.asarray(chance)


def chance_of_level(ratio: FloatArray, dof: FloatArray, of_level: FloatArray) -> FloatArray:
    """(batch,) how often noise exceeds a ratio to a level, of so many complex degrees of freedom each.

    1 up to a deviation above 1, which noise exceeds more often than any test asks for.
    """
    chance, rare = np.ones(ratio.shape), (~(ratio <= 1 + np.sqrt(1 / dof + 1 / of_level))).nonzero()[0]
    if rare.size:
        chance[rare] = special.fdtrc(2 * dof[rare], 2 * of_level[rare], ratio[rare])
    return chance


@np.errstate(invalid="ignore")
def at_modes(ratio: FloatArray, dof: FloatArray) -> FloatArray:
    """(batch,) factor of covariances for noise above a curve over the band where the modes are.

    The test for such a curve is one of all lines: it does not see the noise of the few that a pole is known
    from. The rarer chance makes what they show, the more it counts. The ratio (batch, places, 2) of sample
    variances to those of the curve is the mean over lines weighted with their shares in the variance of a pole,
    NaN where there is none; its complex degrees of freedom are those of a line over the sum of the squares of
    these shares.
    """
    more = ratio * student_variance(np.maximum(dof, 2)) - 1
    above = (more > 0) & np.isfinite(more)
    chance = special.gammaincc(dof[above], dof[above] * ratio[above])
    factor = np.ones(ratio.shape)
    factor[above] += np.maximum(1 - chance / CHANCE, 0) * more[above]
    return np.asarray(factor.max(axis=(1, 2), initial=1.0))


def chance_of_pieces(
    ratio: FloatArray, lines: FloatArray | int, size: float, dof: FloatArray | int
) -> FloatArray:
    """(batch,) how often noise alone exceeds a cost over its expectation, weighted by pieces of the band.

    Lines of a piece share the error of its variance: sums over pieces of F(2 size, 2 dof), as a chi-square of
    the same mean and variance.

    Of so many `lines`, `size` in each piece, whose variance has so many complex degrees of freedom.
    """
    spread = (size + dof - 1) / (lines * (dof - 2))
    return np.asarray(special.chdtrc(2 / spread, 2 / spread * ratio))


def not_counted(chance: FloatArray, ratio: FloatArray) -> FloatArray:
    """(batch,) factor of covariances for noise whose variance on lines is `ratio` times what is counted of it.

    Steps of a converter repeat in every period, so that they stand on excited lines alone. What chance makes
    more rarely than `DOUBT` counts, the rarer the more. 1 where chance is NaN.
    """
    more = np.maximum(1 - chance / DOUBT, 0) * np.maximum(ratio - 1, 0)
    return np.where(np.isfinite(more), 1 + more, 1.0)


@np.errstate(divide="ignore", invalid="ignore")
def student_variance(dof: FloatArray) -> FloatArray:
    """Variance of Student's distribution for a level of `dof` complex degrees of freedom; NaN up to 1."""
    return np.where(dof > 1, dof / (dof - 1), np.nan)


def model_variance(variance: FloatArray, dof: int, gain: FloatArray | None = None) -> VarianceModel:
    """Flat where a test lets it pass, else sloped, else line by line.

    Parameters
    ----------
    variance : (batch, F) float
        Sample variance per line; lines where it is not positive and finite are left out.
    dof : int
        Complex degrees of freedom of each.
    gain : (batch, F) float, optional
        ``|G|^2``: flat then means flat noise on both channels, which makes the variance of a response
        ``a + b |G|^2``. At a resonance that matters where a test of few degrees of freedom sees no
        difference, for there is the information on the pole.

    References
    ----------
    Bartlett, *Properties of sufficiency and statistical tests*, Proc. R. Soc. A 160 (1937) 268-282.
    """
    channels = 1 if gain is None else 2
    limits = (_flat_limits(variance.shape[1], dof, n) for n in (channels, 2))
    gain = np.empty((len(variance), 0)) if gain is None else gain
    model = np.empty(variance.shape)
    kind, lines = np.zeros((2, len(variance)), np.int64)
    _modelled(np.asarray(variance, float), gain, *limits, model, kind, lines)
    return VarianceModel(model, lines, dof, kind)


@entry
def _modelled(variance, gain, flat, sloped, model, kind, used):
    """Put variances (points, F) to weight with, their kinds, and how many lines are used into the last three.

    `flat`, `sloped` (F + 1,): limits of the tests for so many lines.
    """
    points, lines = variance.shape
    usable, sample = np.empty(lines), np.empty(lines)
    for point in range(points):
        total = 0.0
        for k in range(lines):
            good = 0 < variance[point, k] < np.inf
            usable[k] = 1.0 if good else 0.0
            sample[k] = variance[point, k] if good else 0.0
            total += sample[k]
            used[point] += good
        if gain.shape[1] > 0:
            _add_channels(sample, gain[point], usable, model[point])
        else:
            model[point] = total / max(used[point], 1)
        if _spread(sample, model[point], usable, used[point]) > flat[used[point]]:
            kind[point] = 1
            _fit_slope(sample, usable, model[point])
            if _spread(sample, model[point], usable, used[point]) > sloped[used[point]]:
                kind[point] = 2
                model[point] = sample
        for k in range(lines):
            if usable[k] == 0:
                model[point, k] = np.inf


@inner
def _spread(sample, model, usable, used):
    """``log mean - mean log`` of samples over their model."""
    total, logarithm, product = 0.0, 0.0, 1.0
    for k in range(sample.size):
        if usable[k] > 0:
            ratio = sample[k] / model[k]
            total += ratio
            product *= ratio
            if not 1e-100 < product < 1e100:  # a logarithm costs as much as all else
                logarithm += np.log(product)
                product = 1.0
    return np.log(total / used) - (logarithm + np.log(product)) / used


@inner
def _add_channels(sample, gain, usable, model):
    """A fit of `two_channels`, to samples (F,) that are 0 where not usable."""
    lines = sample.size
    scale = level = used = 0.0
    for k in range(lines):
        scale += sample[k]
        level += usable[k] * gain[k] if usable[k] > 0 else 0.0
        used += usable[k]
    scale, level = scale / max(used, 1.0), max(level / max(used, 1.0), TINY)
    for k in range(lines):
        model[k] = 1.0
    for _ in range(REWEIGHTINGS):
        s0 = s1 = s2 = t0 = t1 = 0.0
        for k in range(lines):
            weight = usable[k] / (model[k] * model[k])
            x, y = gain[k] / level if usable[k] > 0 else 0.0, sample[k] / scale
            s0 += weight
            s1 += weight * x
            s2 += weight * x * x
            t0 += weight * y
            t1 += weight * x * y
        determinant = s0 * s2 - s1 * s1
        b = (s0 * t1 - s1 * t0) / determinant if determinant > 1e-9 * s0 * s2 else 0.0
        a = (t0 - b * s1) / s0
        if b < 0:
            b = 0.0
        elif a < 0:
            b = t1 / s2
        a = max((t0 - b * s1) / s0, 0.0)
        for k in range(lines):
            model[k] = max(a + b * (gain[k] / level if usable[k] > 0 else 0.0), LEAST_VARIANCE)
    for k in range(lines):
        model[k] *= scale


@inner
def _fit_slope(sample, usable, model):
    """A maximum likelihood fit of ``exp(c_0 + c_1 x)`` by Fisher scoring."""
    lines = sample.size
    used = i01 = i11 = total = 0.0
    for k in range(lines):
        x = 2 * k / (lines - 1) - 1
        used += usable[k]
        i01 += usable[k] * x
        i11 += usable[k] * x * x
        total += sample[k]
    determinant = used * i11 - i01 * i01
    c0, c1 = np.log(total / max(used, 1.0)), 0.0
    for _ in range(50):
        g0 = g1 = 0.0
        for k in range(lines):
            if usable[k] > 0:
                x = 2 * k / (lines - 1) - 1
                excess = sample[k] * np.exp(-c0 - c1 * x) - 1
                g0 += excess
                g1 += excess * x
        step_0, step_1 = (i11 * g0 - i01 * g1) / determinant, (used * g1 - i01 * g0) / determinant
        # some decades at most: the score is far from linear where the ratio is large
        c0 += min(max(step_0, -2.0), 2.0)
        c1 += min(max(step_1, -2.0), 2.0)
        if max(abs(step_0), abs(step_1)) < 1e-10:
            break
    for k in range(lines):
        model[k] = np.exp(c0 + c1 * (2 * k / (lines - 1) - 1))


def two_channels(variance: FloatArray, gain: FloatArray, sloped: BoolArray) -> FloatArray:
    """(batch, F) fit of ``a + b gain``, neither negative, to gamma distributed variances.

    Where `sloped` (batch,) times ``exp(c_0 + c_1 x)``, fitted first. Iteratively reweighted least squares, or
    Fisher scoring, is maximum likelihood here: the variance of a gamma variable is proportional to its squared
    mean.
    """
    model = np.empty(variance.shape)
    _two_channels(variance, gain, sloped, model)
    return model


def channels_of(variance: FloatArray, gain: FloatArray) -> FloatArray:
    """(batch, 2) a and b of variances ``a + b gain`` (batch, F)."""
    ends = np.stack([np.argmin(gain, axis=1), np.argmax(gain, axis=1)], axis=1)
    v, g = np.take_along_axis(variance, ends, 1), np.take_along_axis(gain, ends, 1)
    b = (v[:, 1] - v[:, 0]) / np.maximum(g[:, 1] - g[:, 0], TINY)
    return np.stack([np.maximum(v[:, 0] - b * g[:, 0], LEAST_VARIANCE * variance.mean(axis=1)), b], axis=1)


@entry
def _two_channels(variance, gain, sloped, model):
    """Put what `two_channels` gives into the last."""
    usable, curve = np.ones(variance.shape[1]), np.ones(variance.shape[1])
    for point in range(variance.shape[0]):
        curve[:] = 1.0
        if sloped[point]:
            _fit_slope(variance[point], usable, curve)
        _add_channels(variance[point] / curve, gain[point], usable, model[point])
        model[point] *= curve


def line_pieces(lines: int, dof: int) -> Pieces:
    """Pieces of lines with a sample variance of `dof` degrees of freedom each."""
    size = min(-(-PIECE_DOF // dof), max(1, lines // WANTED_PIECES))
    return Pieces.of(lines, max(size, -(-FEWEST_PIECE_DOF // dof)), dof)


def smooth_variance(
    sample: FloatArray, gain: FloatArray, pieces: Pieces
) -> tuple[FloatArray, IntArray]:
    """Variance on each line from sample variances, and its kind as index into `KINDS`.

    From samples (batch, K) and a `gain` ``|G|^2``: flat on both channels unless a test says otherwise, then
    sloped, then piece by piece.
    """
    kind = model_variance(pieces.means(sample), pieces.dof, pieces.means(gain)).kind
    variance, each = two_channels(sample, gain, kind == 1), kind == 2
    if each.any():
        variance[each] = pieces.means(sample[each])[:, pieces.of_bin]
    return variance, kind


def are_flat(variance: FloatArray, dof: int) -> BoolArray:
    """(...) whether the test of `model_variance` finds variances (..., F) flat."""
    lines = variance.shape[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.log(variance.sum(axis=-1) / lines) - np.log(variance).sum(axis=-1) / lines
    limit = flat_limit(lines, dof)
    return np.asarray(spread <= limit)  # NaN, where a variance is not positive, is not flat


def flat_limit(lines: int, dof: int) -> float:
    """Largest ``log mean - mean log`` that `are_flat` lets pass."""
    return float(_flat_limits(lines, dof, 1)[-1])


@lru_cache(maxsize=256)
def _flat_limits(most: int, dof: int, parameters: int) -> FloatArray:
    """(most + 1,) largest ``log mean - mean log`` of variance ratios of so many lines that passes the test."""
    count = np.maximum(np.arange(most + 1), parameters + 1).astype(float)
    correction = 1 + (count + 1) / (6 * count * dof)
    quantile = special.chdtri(count - parameters, FALSE_ALARM)
    return np.asarray(quantile * correction / (2 * dof * count))


def level_of(
    plan: JointPlan, solution: Solution, noise: FloatArray, by_piece: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray, FloatArray]:
    """Noise level that a fit of points of one record each shows, and whether it contradicts the model.

    Without bins between harmonics it is from the residuals, and a model error hides in it unless they
    are smooth. With such bins these give the level, and the excited ones whether the model holds.

    Weighted with are mean variances of Y and U of `noise` (batch, 2), where `by_piece` (batch,) from each of
    the pieces of the band alone.

    Returns
    -------
    scale : (batch,) float
        Level that covariances are of, in units of the variances weighted with.
    cost, expected, suspect, noise
        See `judgement.Judged`.
    correction : (batch,) float
        Factor of the covariance for a level that is not known exactly, and for noise on excited lines alone.
    """
    batch, _, n = solution.theta.shape
    lines, others = plan.excited_at.size, plan.others_at.size
    if others == 0:
        dof = np.full(batch, max(lines - n / 2, 0.5))
        scale, nothing = solution.cost / dof, np.full(batch, np.nan)
        no = np.zeros(batch, bool)
        return scale, nothing, nothing, no, noise * scale[:, None], student_variance(dof)
    used = solution.leverage[:, 0]
    dof_o = others - used / 2
    dof_e = lines - (n - used) / 2
    dof = dof_e + dof_o
    level = solution.part_cost[:, 0] / dof_o
    cost = solution.part_cost[:, 1] / level
    expected = dof_e * dof_o / (dof_o - 1)
    chance = chance_of_level(cost / dof_e, dof_e, dof_o)
    correction = student_variance(dof)
    if by_piece.any():
        expected = np.where(by_piece, expected * BINS_PER_BAND / (BINS_PER_BAND - 1), expected)
        of_pieces = chance_of_pieces(cost / expected, dof_e, BINS_PER_BAND * lines / others, BINS_PER_BAND)
        chance = np.where(by_piece, of_pieces, chance)
        correction = np.where(by_piece, BINS_PER_BAND / (BINS_PER_BAND - 2), correction)
    suspect = chance < MODEL_ERROR_PROBABILITY
    scale = np.where(suspect, level, solution.part_cost.sum(axis=-1) / dof)
    correction = correction * not_counted(np.where(suspect, np.nan, chance), cost / expected * level / scale)
    return scale, cost, expected, suspect, noise * level[:, None], correction


def noise_at_modes(
    plan: JointPlan, data: BinData, solution: Solution, scale: FloatArray, part: FloatArray | float = 1.0
) -> FloatArray:
    """(batch,) factor of the covariance of points; see `at_modes`.

    Each undriven bin shows the noise there, and those beside a driven one the noise on it. The records of a
    point pool their noise. Its level is `scale` (batch,) in units of the variances of the data; of that of the
    residuals on driven bins `part` (batch, K_e) is noise.
    """
    problem, first = plan.problem, data.undriven
    (a, b, _), theta, inverse = problem.sizes, solution.theta, solution.marginal
    alpha, beta, gamma = problem.split(theta)
    of_a = alpha[:, :1] @ problem.denominator.T  # (batch, 1, K), the undriven bins first
    u, numerator = np.array(data.u[..., data.order]), np.zeros((data.order.size, b), complex)
    u[..., :first], numerator[first:] = 0, problem.numerator
    model = (u * (beta[:, :1] @ numerator.T) + gamma @ problem.transient.T) / of_a
    variance, weighted = data.residual_variance(problem.response(theta[:, 0])), data.variance
    noise = part * variance
    own = problem.transient[:first] / of_a[:, 0, :first, None]
    taken = np.einsum("bki,bmij,bkj->bmk", own.conj(), inverse[..., a + b :, a + b :], own).real
    free = np.maximum(1 - taken / (2 * weighted[:, None, :first]), 0.2)  # less what the transient takes
    sample = np.abs(data.y[..., data.order[:first]] - model[..., :first]) ** 2 / free
    sample = sample.mean(axis=1) / scale[:, None]
    each = first / plan.excited_at.size
    away = np.abs(plan.excited_at[:, None] - plan.others_at)
    beside = np.argsort(away, axis=1, kind="stable")[:, : max(2, 2 * round(each / 2))]
    of_y = weighted[:, first:] - (variance - noise)  # noise on Y alone
    on_lines = 1 + (sample[:, beside].mean(axis=-1) - of_y) / noise
    ratio = np.concatenate([sample / weighted[:, :first], on_lines], axis=-1)
    weighted[:, first:] = variance
    poles = plan.poles_in_band(theta[:, 0])
    sensitivity = plan.model_of(theta[:, 0]).residues_and_sensitivity(poles)[1]
    moved = real_rows(sensitivity)[:, None] @ inverse[:, :, None, :a]  # (batch, M, places, 2, n)
    by_bin = (moved[..., a : a + b] @ numerator.T) * u[:, :, None, None]
    by_bin = by_bin + moved[..., a + b :] @ problem.transient.T
    by_bin = by_bin - (moved[..., :a] @ problem.denominator[:, :a].T) * model[:, :, None, None]
    share = np.sum(np.abs(by_bin) ** 2, axis=1) / (np.abs(of_a) ** 2 * weighted[:, None])[:, :, None]
    share[..., first:] *= (noise / variance)[:, None, None]
    share /= share.sum(axis=-1, keepdims=True)
    squares = (share[..., :first] ** 2).sum(axis=-1) + (share[..., first:] ** 2).sum(axis=-1) / each
    return at_modes((share * ratio[:, None, None]).sum(axis=-1), data.records / squares)
