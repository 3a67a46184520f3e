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

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.frf.distortion import decibel


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


def nested_means(values: npt.ArrayLike, groups: npt.ArrayLike, names: Sequence[str]) -> NestedMeans:
    """Scatter at each of several nested levels.

    Parameters
    ----------
    values : (n, ...) array
        A row for each measurement, real or complex.
    groups : (n, L) int
        Labels of the groups, outermost first. Column i holds the groups of level i; its members are the groups
        of column i + 1, those of the last level the rows. Equal labels under different parents are different.
    names : sequence of str
        L of them, of the levels: what varies within the groups of that column.

    Raises
    ------
    ValueError
        If shapes do not fit, or a value is missing (not finite).
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


PAPER_AXES = ("preparation", "position", "repetition", "period")
"""Sources of figure 9 of arXiv 1805.00682, outermost first."""


@dataclass(frozen=True, eq=False)
class VarianceSource:
    """Scatter over one axis.

    Attributes
    ----------
    name : str
    dof : int
        Degrees of freedom: members less groups.
    variance : (F,) float or None
        Sample variance of the means of the members about that of their group. It *holds* what is
        left of the inner scatter. None without degrees of freedom.
    mean_power : (F,) float
        ``|G|^2`` of the mean over everything, averaged over the outermost groups.
    """

    name: str
    dof: int
    variance: FloatArray | None
    mean_power: FloatArray

    @property
    def rms_level_db(self) -> float:
        """Mean variance over lines against mean ``|mean G|^2`` [dB]; NaN where unknown.

        It is not ruled by the lines where G is small, as a mean of ratios would be.
        """
        if self.variance is None:
            return float("nan")
        return float(decibel(np.mean(self.variance) / np.mean(self.mean_power)))


@dataclass(frozen=True, eq=False)
class VarianceAnalysis:
    """Scatter per source.

    Attributes
    ----------
    frequency_hz : (F,) float
    mean : (G, F) complex
        Mean FRF of each outermost group.
    sources : tuple of VarianceSource
        Outermost first, as the levels were given.
    """

    frequency_hz: FloatArray
    mean: ComplexArray
    sources: tuple[VarianceSource, ...]

    def source(self, name: str) -> VarianceSource:
        """One source by name.

        Raises
        ------
        ValueError
            If there is none of that name.
        """
        for source in self.sources:
            if source.name == name:
                return source
        known = ", ".join(source.name for source in self.sources)
        raise ValueError(f"name: {name!r}, accepted are {known}")


def analyse_variance(
    g: npt.ArrayLike,
    frequency_hz: npt.ArrayLike,
    groups: npt.ArrayLike,
    names: Sequence[str] = PAPER_AXES,
) -> VarianceAnalysis:
    """Sample variance of FRFs over each of several nested levels.

    Parameters
    ----------
    g : (n, F) complex
        FRFs, e.g. of single periods.
    frequency_hz : (F,) float
    groups : (n, L) int
        Labels of the groups, outermost first, as `nested_means` takes them: for the paper's figure
        those of everything, preparation, position and repetition. Different outermost groups, such as
        tissues, are not compared.
    names : sequence of str
        What varies within the groups of each column.

    Raises
    ------
    ValueError
        If shapes do not fit, or an FRF is missing (not finite).

    Notes
    -----
    With independent sources of variances v_1 (outermost) ... v_n and, in balanced data, A_i members in
    each group the expected sample variance of level i is
    ``v_i + v_(i+1)/A_(i+1) + ... + v_n/(A_(i+1) ... A_n)``: averaging an inner source reduces it, but
    does not remove it. Nothing is subtracted from `variance`.

    References
    ----------
    Figure 9 of arXiv 1805.00682 (variance over periods, repetitions, positions and preparations,
    each against the mean); Searle, Casella & McCulloch, *Variance Components* (1992), nested
    classification.
    """
    g = np.asarray(g, complex)
    frequency = np.asarray(frequency_hz, float)
    good = g.ndim == 2 and g.shape[1:] == frequency.shape
    require(good, "g", g.shape, f"(n, {frequency.size}): an FRF in each row")
    require(bool(np.all(np.isfinite(g))), "g", "some that are not finite", "complete FRFs")
    found = nested_means(g, groups, names)
    power = np.mean(np.abs(found.mean) ** 2, axis=0)
    sources = tuple(
        VarianceSource(
            level.name,
            level.dof,
            np.sum(np.abs(level.deviations) ** 2, axis=0) / level.dof if level.dof else None,
            power,
        )
        for level in found.levels
    )
    return VarianceAnalysis(frequency, found.mean, sources)
