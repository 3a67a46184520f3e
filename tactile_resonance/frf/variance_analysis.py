# SPDX-License-Identifier: Apache-2.0
"""Where the scatter of FRFs comes from: periods, repetitions, positions, preparations.

Each preparation has its positions, each position its repetitions, each repetition its periods: as many of each
as there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.frf.distortion import decibel
from tactile_resonance.frf.nested import nested_means

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
