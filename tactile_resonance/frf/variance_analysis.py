# SPDX-License-Identifier: Apache-2.0
"""Nested groups of unequal size: how means scatter within each level, and what that scatter holds.

Each preparation has its positions, each position its repetitions, and so on. The analysis is that of
unweighted means: at each level a member counts by the mean of its own members, however many they are. In
balanced data this is the analysis of variance (Searle, Casella and McCulloch, Variance Components, 1992,
chapters 3 and 5); in others expectations stay exact, and nothing rests on a distribution.

So the scatter of FRFs is parted too: that of periods, repetitions, positions and preparations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.frf.distortion import decibel

PAPER_AXES = ("preparation", "position", "repetition", "period")
"""Sources of figure 9 of arXiv 1805.00682, outermost first: each against the mean."""


@dataclass(frozen=True, eq=False)
class NestedLevel:
    """Scatter of the members of one level about the means of their groups.

    Attributes
    ----------
    name : str
    deviations : (m, ...) array
        Mean of each member less that of its group.
    dof : int
        Degrees of freedom: members less groups.
    holds : (L,) float
        Expected mean square: so many times the variance of each level, 1 of its own, 0 of outer ones. NaN
        without degrees of freedom, as `holds_noise`.
    holds_noise : (n,) float
        Likewise of the variance of each row.
    """

    name: str
    deviations: npt.NDArray
    dof: int
    holds: FloatArray
    holds_noise: FloatArray

    @property
    def variance(self) -> FloatArray | None:
        """(...) sample variance of the means of the members about that of their group.

        It *holds* what is left of the inner scatter. None without degrees of freedom.
        """
        return np.sum(np.abs(self.deviations) ** 2, axis=0) / self.dof if self.dof else None


@dataclass(frozen=True, eq=False)
class NestedMeans:
    """All levels, and the means of the outermost groups.

    Attributes
    ----------
    levels : tuple of NestedLevel
        Outermost first.
    mean : (G, ...) array
        Of each outermost group, in the order of its sorted labels.
    mean_holds : (G, L) float
        Variance of each mean: so many times the variance of each level.
    weight : (n,) float
        Of each row in the mean of its outermost group.
    """

    levels: tuple[NestedLevel, ...]
    mean: npt.NDArray
    mean_holds: FloatArray
    weight: FloatArray

    def rms_level_db(self, level: NestedLevel, inside: BoolArray) -> float:
        """Mean variance of a level over lines against mean ``|mean G|^2`` [dB]; NaN where unknown.

        It is not ruled by the lines where G is small, as a mean of ratios would be. Both are averaged over the
        lines inside, the latter over the outermost groups too.
        """
        if level.variance is None:
            return float("nan")
        power = np.mean(np.abs(self.mean) ** 2, axis=0)
        return float(decibel(np.mean(level.variance[inside]) / np.mean(power[inside])))


def nested_means(values: npt.ArrayLike, groups: npt.ArrayLike, names: Sequence[str]) -> NestedMeans:
    """Scatter at each of several nested levels.

    Parameters
    ----------
    values : (n, ...) array
        A row for each measurement, real or complex, e.g. FRFs of single periods.
    groups : (n, L) int
        Labels of the groups, outermost first. Column i holds the groups of level i; its members are the groups
        of column i + 1, those of the last level the rows. Equal labels under different parents are different.
        Different outermost groups, such as tissues, are not compared.
    names : sequence of str
        L of them, of the levels: what varies within the groups of that column.

    Raises
    ------
    ValueError
        If shapes do not fit, or a value is missing (not finite).

    Notes
    -----
    With independent sources of variances v_1 (outermost) ... v_n and, in balanced data, A_i members in
    each group the expected sample variance of level i is
    ``v_i + v_(i+1)/A_(i+1) + ... + v_n/(A_(i+1) ... A_n)``: averaging an inner source reduces it, but
    does not remove it. Nothing is subtracted from `NestedLevel.variance`.
    """
    x, labels = np.asarray(values), np.asarray(groups)
    good = x.ndim >= 1 and labels.shape == (len(x), len(names)) and len(x) > 0
    require(good, "groups", labels.shape, f"({len(x)}, {len(names)}): a column for each level")
    require(bool(np.all(np.isfinite(x))), "values", "some that are not finite", "complete rows")
    ids = [np.unique(labels[:, : i + 1], axis=0, return_inverse=True)[1] for i in range(len(names))]
    ids = [column.reshape(-1) for column in ids]
    node = np.arange(len(x))  # of each row: its member at the present level
    weight = np.ones(len(x))  # of each row in the mean of its member
    held = np.zeros((len(x), len(names)))  # by the variance of the mean of each member
    levels: list[NestedLevel] = []
    for i in reversed(range(len(names))):
        parent = np.zeros(len(x), np.int64)  # of each member
        parent[node] = ids[i]
        size = np.bincount(parent).astype(float)
        of_own = held.copy()
        of_own[:, i] += 1
        total = np.zeros((len(size), *x.shape[1:]), x.dtype if x.dtype.kind == "c" else float)
        np.add.at(total, parent, x)
        mean = total / size.reshape(-1, *([1] * (x.ndim - 1)))
        dof, free = len(parent) - len(size), 1 - 1 / size[parent]
        over = np.divide(1.0, dof) if dof else np.nan
        levels.insert(
            0,
            NestedLevel(
                names[i],
                x - mean[parent],
                dof,
                over * (free @ of_own),
                over * free[node] * weight**2,
            ),
        )
        held = np.zeros((len(size), len(names)))
        np.add.at(held, parent, of_own)
        held /= size[:, None] ** 2
        weight = weight / size[ids[i]]
        x, node = mean, ids[i]
    return NestedMeans(tuple(levels), x, held, weight)
