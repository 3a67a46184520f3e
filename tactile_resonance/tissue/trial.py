# SPDX-License-Identifier: Apache-2.0
"""Classes on trial: calls of points whose tissue is known, by classes that do not rest on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from scipy import stats

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.tissue.classify import UNKNOWN, TissueClass, posteriors
from tactile_resonance.tissue.spread import ReferencePoints, Texts, spreads_of

EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.99, 1.0)
"""Of the bins of stated probability in a reliability diagram."""


@dataclass(frozen=True, eq=False)
class Trial:
    """Calls beside the truth.

    Attributes
    ----------
    tissue : (n,) str
        The truth.
    called : (n,) str
        `UNKNOWN` where none of the classes was called.
    known : (n,) bool
        Whether the true tissue was among the classes.
    probability : (n,) float
        Of the most probable class, given that it is one of them, also where `UNKNOWN` was called.
    likely : (n,) str
        That class.
    tail : (n,) float
        Below the level `UNKNOWN` is called.
    preparation : (n,) str
        Points of one are not independent.
    """

    tissue: Texts
    called: Texts
    known: BoolArray
    probability: FloatArray
    likely: Texts
    tail: FloatArray
    preparation: Texts

    @classmethod
    def joined(cls, trials: Sequence[Trial]) -> Trial:
        """The points of several."""
        return cls(*(np.concatenate([getattr(t, f.name) for t in trials]) for f in fields(cls)))

    def where(self, chosen: BoolArray) -> Trial:
        """Those points alone."""
        return Trial(*(getattr(self, item.name)[chosen] for item in fields(self)))

    def share(self, which: BoolArray) -> str:
        """How many of the points are `which` (n,), with the limits of that share."""
        count, of = int(np.sum(which)), len(which)
        low, high = share_limits(count, of, effective_groups(self.preparation))
        share = f"{count / of:.2%}" if of else "-"
        return f"{count} of {of} ({share}, {low:.2%} to {high:.2%})"


def effective_groups(group: Texts) -> float:
    """Of how many groups of one size a share scatters as of these, whose points (n,) share their fate.

    Their number where they are of one size, fewer where some rule (Kish, Survey Sampling, 1965, section 11.7).
    """
    sizes = np.unique(group, return_counts=True)[1]
    return float(sizes.sum() ** 2 / np.sum(sizes**2)) if len(sizes) else 0.0


def share_limits(
    count: int, of: int, groups: float, confidence: float = 0.95
) -> tuple[float, float]:
    """Clopper and Pearson's interval of points out of points, as if each group had been counted once.

    That is right where points of a group share their fate, and wide where they do not; `groups` as of
    `effective_groups`.
    """
    if not of:
        return 0.0, 1.0
    scaled = count * groups / of
    low, high = (1 - confidence) / 2, (1 + confidence) / 2
    first = stats.beta.ppf(low, scaled, groups - scaled + 1) if scaled > 0 else 0.0
    second = stats.beta.ppf(high, scaled + 1, groups - scaled) if count < of else 1.0
    return float(first), float(second)


@dataclass(frozen=True)
class ReliabilityBin:
    """Calls of about one stated probability.

    Attributes
    ----------
    stated, right : float
        Mean stated probability, and the part of the points that were of the class.
    points : int
    low, high : float
        Between which `right` is expected if the stated probabilities hold, in all bins together.
    """

    stated: float
    right: float
    points: int
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether `right` is within."""
        return self.low <= self.right <= self.high


def call_points(
    points: ReferencePoints, classes: Sequence[TissueClass], unknown_level: float
) -> Trial:
    """Call each point by classes, as `classify` does."""
    names = np.array([each.name for each in classes])
    probability, tails = posteriors(points.estimate, points.covariance, classes)
    likely, tail = names[np.argmax(probability, axis=1)], tails.max(axis=1)
    return Trial(
        points.tissue,
        np.where(tail < unknown_level, UNKNOWN, likely),
        np.isin(points.tissue, names),
        probability.max(axis=1),
        likely,
        tail,
        points.casting,
    )


def leave_out(
    points: ReferencePoints,
    by: Literal["run", "preparation", "tissue"],
    pool: bool,
    unknown_level: float,
) -> Trial:
    """Call the points of each group by classes of all others.

    Groups are runs, preparations, or whole tissues, which ought then to be called `UNKNOWN`. With runs a
    preparation that is in several of them is left out of all. A class with too few others is not made, and
    its points are not called.

    Raises
    ------
    ValueError
        If there is only one group, or no point could be called.
    """
    key = points.casting if by == "preparation" else getattr(points, by)
    groups = np.unique(key)
    require(len(groups) > 1, f"{by}s", groups.tolist(), "two or more, to leave one out")
    trials = []
    for group in groups:
        left = key == group
        rest = ~np.isin(points.casting, points.casting[left])
        if not rest.any():
            continue
        classes = [s.as_class() for s in spreads_of(points.where(rest), pool) if s.usable]
        if by != "tissue":
            left &= np.isin(points.tissue, [each.name for each in classes])
        if classes and left.any():
            trials.append(call_points(points.where(left), classes, unknown_level))
    require(bool(trials), f"{by}s", groups.tolist(), "so many that classes remain without one")
    return Trial.joined(trials)


def reliability(trial: Trial, confidence: float = 0.95) -> tuple[ReliabilityBin, ...]:
    """How often calls are right, by their stated probability, of points of known classes that were called.

    The expected interval is that of a binomial with the stated probability, one draw for each group, and holds
    for all bins together with this confidence (Bonferroni).
    """
    counted = trial.where(trial.known & (trial.called != UNKNOWN))
    right, made = counted.likely == counted.tissue, []
    which = np.digitize(counted.probability, EDGES[1:-1], right=False)
    inside = [which == k for k in range(len(EDGES) - 1)]
    beyond = (1 - confidence) / max(1, sum(bool(each.any()) for each in inside))
    for chosen in inside:
        if not chosen.any():
            continue
        stated = float(counted.probability[chosen].mean())
        groups = max(1, int(effective_groups(counted.preparation[chosen]) + 1e-9))
        low, high = stats.binom.interval(1 - beyond, groups, stated)
        share = float(right[chosen].mean())
        limits = float(low) / groups, float(high) / groups
        made.append(ReliabilityBin(stated, share, int(chosen.sum()), *limits))
    return tuple(made)
