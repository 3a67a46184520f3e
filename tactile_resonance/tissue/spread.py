# SPDX-License-Identifier: Apache-2.0
"""How the poles of one tissue scatter, by source; the class, and the smallest step, that follow from it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.frf.variance_analysis import NestedMeans, nested_means
from tactile_resonance.tissue.classify import TissueClass, predictive_class

Texts = npt.NDArray[np.str_]
LEVELS = ("preparation", "position", "repetition")
"""Sources of spread, outermost first: figure 9 of arXiv 1805.00682, without its periods."""
DEGREES_DIGITS = 2
"""To which degrees of freedom are kept in files."""
FEWEST_DEGREES = 3
"""Of a class, those of four single points: by fewer, calls of more than 99 % would be wrong in 3 to 13 % where
tissues are three deviations apart."""
_PERCENT = re.compile(r"(\d+(?:\.\d+)?)\s*%")
# A correlation beyond is not relied on: what is left across it is rounding and chance.
_LEAST_EIGENVALUE = 1e-4


@dataclass(frozen=True, eq=False)
class ReferencePoints:
    """Measured poles whose tissue is known, at the nominal force and age of contact.

    Attributes
    ----------
    estimate : (n, 2) float
        f0 [Hz] and damping ratio.
    covariance : (n, 2, 2) float
        For tissue: of the measurement, with what force and age add.
    measured : (n, 2, 2) float
        Of the measurement alone.
    blocks : (n,) float
        Periods of the measurement.
    tissue, preparation, position, run : (n,) str
        Preparations of different tissues are different, as positions of different preparations are.
        Measurements at one position are its repetitions.
    """

    estimate: FloatArray
    covariance: FloatArray
    measured: FloatArray
    blocks: FloatArray
    tissue: Texts
    preparation: Texts
    position: Texts
    run: Texts

    def where(self, chosen: BoolArray) -> ReferencePoints:
        """Those chosen."""
        return ReferencePoints(*(getattr(self, item.name)[chosen] for item in fields(self)))

    @property
    def casting(self) -> Texts:
        """(n,) tissue and preparation in one."""
        return np.array([f"{t}, {p}" for t, p in zip(self.tissue, self.preparation, strict=True)])

    def of(self, tissue: str) -> ReferencePoints:
        """Those of one tissue."""
        return self.where(self.tissue == tissue)


@dataclass(frozen=True, eq=False)
class SpreadSource:
    """Spread from one source.

    Attributes
    ----------
    name : str
    covariance : (2, 2) float
        Of f0 [Hz] and damping ratio; NaN where it is not determined.
    degrees_of_freedom : int
        Of the scatter from which it was taken; 0: not determined.
    holds : tuple of str
        Sources within that are not determined alone, and are part of this one.
    """

    name: str
    covariance: FloatArray
    degrees_of_freedom: int = 0
    holds: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class TissueSpread:
    """What the reference points of one tissue say of it.

    Attributes
    ----------
    name : str
    points : int
    mean : (2,) float
        f0 [Hz] and damping ratio.
    covariance : (2, 2) float
        Of the next point's pole about the mean, without the noise of its measurement: all sources that are
        determined, and the uncertainty of the mean.
    degrees_of_freedom : float
        Of that covariance together with the mean noise of the points; 0 where no source is determined.
    sources : tuple of SpreadSource
        By `LEVELS`.
    noise, force, block : (2, 2) float
        Means over the points: covariance of a measurement; what force and age of contact add to it; that
        of one block, which is taken for that of the measurement times its blocks.
    """

    name: str
    points: int
    mean: FloatArray
    covariance: FloatArray
    degrees_of_freedom: float
    sources: tuple[SpreadSource, ...]
    noise: FloatArray
    force: FloatArray
    block: FloatArray

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Sources that the next point has and `covariance` does not."""
        held = {name for source in self.sources for name in source.holds}
        return tuple(
            s.name for s in self.sources if not s.degrees_of_freedom and s.name not in held
        )

    @property
    def usable(self) -> bool:
        """Whether there are points enough for a class."""
        return round(self.degrees_of_freedom, DEGREES_DIGITS) >= FEWEST_DEGREES

    def as_class(self) -> TissueClass:
        """The class, with the predictive distribution of so few samples.

        Raises
        ------
        ValueError
            If it is not `usable`.
        """
        accepted = f"{FEWEST_DEGREES} or more: more preparations, or spreads pooled over tissues"
        degrees = self.degrees_of_freedom
        require(self.usable, f"{self.name}: degrees_of_freedom", degrees, accepted)
        return predictive_class(self.name, self.mean, self.covariance, degrees)


def spreads_of(points: ReferencePoints, pool: bool = False) -> tuple[TissueSpread, ...]:
    """Mean and sources of spread of each tissue, in the order of their first points.

    Parameters
    ----------
    points : ReferencePoints
    pool : bool
        Tissues scatter alike: spreads are estimated from all together, means of each.

    Raises
    ------
    ValueError
        If there is no point.

    Notes
    -----
    The mean squares M_i of the nested levels have the expectation

        E M_i = S_i + sum over inner levels j of a_ij S_j + sum over points k of b_ik C_k

    with the spread S_i of each source and the known covariance C_k of each point, which are taken off from
    inside to outside. A remainder that is not positive has its negative part set to 0. A source with
    one member in each group cannot be distinguished from the next outer one, and is counted there; where that
    is the outermost one it is not determined at all. The mean squares M_i follow approximately Wishart's
    distribution, with n_i degrees of freedom. A sum of t_i M_i beside known covariances then has tr(W) / tr(V
    W) (Satterthwaite), with W the sum of (t_i R_i)^2, V that of (t_i R_i)^2 / n_i and R_i the mean square in
    units of the covariance of the next measurement: a direction counts by how much of it is estimated. For one
    mean square alone that is exact; simulated, points of classes of four preparations lie as far out three to
    twenty times as rarely as stated, the latter where noise is larger than spread.
    """
    names = list(dict.fromkeys(points.tissue.tolist()))
    require(bool(names), "points", 0, "one reference point or more")
    if pool:
        return _spreads(points, names)
    return tuple(spread for name in names for spread in _spreads(points.of(name), [name]))


def _spreads(points: ReferencePoints, names: Sequence[str]) -> tuple[TissueSpread, ...]:
    """Of tissues that share their spreads."""
    columns = (points.tissue, points.preparation, points.position)
    # tissues in the order of `names`
    tissue = np.array([names.index(name) for name in columns[0].tolist()])
    labels = [tissue, *(np.unique(column, return_inverse=True)[1] for column in columns[1:])]
    found = nested_means(points.estimate, np.stack(labels, axis=1), LEVELS)
    squares, sources, parts = _sources(found, points.covariance)
    spread = np.array([np.nan_to_num(source.covariance) for source in sources])
    noise, covariance = points.measured.mean(axis=0), points.covariance.mean(axis=0)
    block = np.mean(points.measured * points.blocks[:, None, None], axis=0)
    made = []
    for k, name in enumerate(names):
        weights = 1 + found.mean_holds[k]  # of each source in the next point less the mean
        own = tissue == k
        of_mean = np.einsum("k,kij->ij", found.weight[own] ** 2, points.covariance[own])
        total = np.einsum("l,lij->ij", weights, spread) + of_mean
        degrees = _degrees_of_freedom(weights @ parts, squares, found, total + covariance)
        count, mean = int(own.sum()), found.mean[k]
        known = noise, covariance - noise, block
        made.append(TissueSpread(name, count, mean, total, degrees, sources, *known))
    return tuple(made)


def _sources(
    found: NestedMeans, covariance: FloatArray
) -> tuple[FloatArray, tuple[SpreadSource, ...], FloatArray]:
    """Mean squares (L, 2, 2), sources, and by how much of each mean square each source is made of (L, L)."""
    count = len(found.levels)
    (squares, spread), parts = np.zeros((2, count, 2, 2)), np.zeros((count, count))
    sources: list[SpreadSource] = []
    held: list[str] = []
    for i in reversed(range(count)):
        level = found.levels[i]
        if not level.dof:
            held.insert(0, level.name)
            sources.insert(0, SpreadSource(level.name, np.full((2, 2), np.nan)))
            continue
        squares[i] = level.deviations.T @ level.deviations / level.dof
        parts[i, i] = 1
        rest = squares[i] - np.einsum("k,kij->ij", level.holds_noise, covariance)
        for j in range(i + 1, count):
            rest = rest - level.holds[j] * spread[j]
            parts[i] -= level.holds[j] * parts[j]
        spread[i] = not_negative(rest, squares[i])
        sources.insert(0, SpreadSource(level.name, spread[i], level.dof, tuple(held)))
        held = []
    return squares, tuple(sources), parts


def _degrees_of_freedom(
    weights: FloatArray, squares: FloatArray, found: NestedMeans, total: FloatArray
) -> float:
    """Of a sum of mean squares with these weights, beside what is known."""
    if not any(level.dof for level in found.levels):
        return 0.0
    variance, estimated = np.zeros((2, 2)), np.zeros((2, 2))
    whiten = np.linalg.inv(np.linalg.cholesky(total))
    for weight, square, level in zip(weights, squares, found.levels, strict=True):
        if level.dof:
            share = weight * whiten @ square @ whiten.T
            estimated += share @ share
            variance += share @ share / level.dof
    known = float(np.trace(variance @ estimated))
    return float(np.trace(estimated)) / known if known > 0 else float("inf")


def within_preparation(tissues: Iterable[Sequence[SpreadSource]]) -> tuple[FloatArray, float]:
    """(2, 2) spread of points of one preparation, mean over the tissues, and its degrees of freedom.

    It is the sum of those by position and by repetition. Degrees of freedom are those of positions, the fewer,
    as of tissues that scatter alike; sources that tissues share, as pooled ones are, count once.

    Raises
    ------
    ValueError
        If that of positions is not determined of a tissue, for repetitions at one place do not show it, or is
        by one degree of freedom in all.
    """
    found, degrees = [], {}
    for sources in tissues:
        inner = {s.name: s for s in sources if s.name != LEVELS[0] and s.degrees_of_freedom}
        accepted = "position among them: two positions of one preparation or more"
        require("position" in inner, "spread", [*inner], accepted)
        found.append(np.sum([s.covariance for s in inner.values()], axis=0))
        degrees[found[-1].tobytes()] = inner["position"].degrees_of_freedom
    each = np.array([*degrees.values()])
    total = float(len(each) ** 2 / np.sum(1 / each))
    require(total > 1, "spread", f"{total:g} degree of freedom of positions", "more than 1")
    return np.mean(found, axis=0), total


def not_negative(matrix: FloatArray, scale: FloatArray) -> FloatArray:
    """The nearest matrix without negative eigenvalues, in units of the diagonal of `scale`."""
    unit = np.sqrt(np.maximum(np.diag(scale), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / np.outer(unit, unit))
    return (vectors * np.maximum(values, 0)) @ vectors.T * np.outer(unit, unit)


@dataclass(frozen=True)
class SmallestStep:
    """Between two tissues whose names hold their concentrations.

    Attributes
    ----------
    first, second : str
    from_percent, to_percent : float
    one_block, limit : dict of str to float
        Step that is separated [%, as the concentrations], by what scatters the points: noise alone, then with
        one source of spread after the other that is determined. After one block, and of any number of blocks,
        without noise.
    """

    first: str
    second: str
    from_percent: float
    to_percent: float
    one_block: dict[str, float]
    limit: dict[str, float]


def percent_of(name: str) -> float | None:
    """Concentration in a name such as ``gelatine 12 %``; None where there is none."""
    found = _PERCENT.search(name)
    return float(found[1]) if found else None


def smallest_steps(
    spreads: Sequence[TissueSpread], probability: float = 0.99
) -> tuple[SmallestStep, ...]:
    """Of each two tissues of neighbouring concentrations; empty where names hold fewer than two.

    The two are separated when either is called wrongly with `1 - probability`: poles 2 z standard deviations
    apart, z the normal quantile. Poles are taken as linear in the concentration between the two, and the
    covariance as the mean of theirs. Sources that are not determined of both are left out.
    """
    named = [(percent_of(spread.name), spread) for spread in spreads]
    known = [(percent, spread) for percent, spread in named if percent is not None]
    known.sort(key=lambda each: each[0])
    needed = 2 * float(special.ndtri(probability))
    return tuple(
        SmallestStep(
            low.name,
            high.name,
            a,
            b,
            *(_steps(low, high, needed * (b - a), noisy) for noisy in (True, False)),
        )
        for (a, low), (b, high) in pairwise(known)
        if a < b
    )


def _steps(low: TissueSpread, high: TissueSpread, step: float, noisy: bool) -> dict[str, float]:
    """By what scatters, from inside to outside; `step` is that of one standard deviation between the two."""
    parts = {"noise": (low.block + high.block) / 2 * noisy, "force": (low.force + high.force) / 2}
    missing = low.undetermined + high.undetermined
    for first, second in zip(low.sources[::-1], high.sources[::-1], strict=True):
        if first.name not in missing and (first.degrees_of_freedom or second.degrees_of_freedom):
            parts[first.name] = np.nan_to_num([first.covariance, second.covariance]).mean(axis=0)
    total, steps, apart = np.zeros((2, 2)), {}, high.mean - low.mean
    for name, part in parts.items():
        total = total + part
        steps[name] = step / _distance(apart, total) if np.diag(total).all() else 0.0
    return steps


def _distance(apart: FloatArray, covariance: FloatArray) -> float:
    """Mahalanobis distance."""
    unit = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    along = vectors.T @ (apart / unit)
    return float(np.sqrt(np.sum(along**2 / np.maximum(values, _LEAST_EIGENVALUE))))
