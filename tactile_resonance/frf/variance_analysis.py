# SPDX-License-Identifier: Apache-2.0
"""Where the scatter of FRFs comes from: periods, repetitions, positions, preparations.

The analysis is that of a balanced nested experiment: each preparation has its positions, each
position its repetitions, each repetition its periods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.distortion import decibel
from tactile_resonance.frf.spectra import ComplexArray, FloatArray

PAPER_AXES = ("preparation", "position", "repetition", "period")
"""Sources of figure 9 of arXiv 1805.00682, outermost first."""


@dataclass(frozen=True, eq=False)
class VarianceSource:
    """Scatter over one axis.

    Attributes
    ----------
    name : str
    size : int
        How many members each group has.
    dof : int
        Degrees of freedom: ``(size - 1)`` times the number of groups.
    variance : (F,) float or None
        Sample variance over this axis of the means over all inner axes, averaged over all outer
        ones. It *holds* what is left of the inner scatter. None if the size is 1.
    mean_power : (F,) float
        ``|G|^2`` of the mean over everything.
    """

    name: str
    size: int
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
    mean : (F,) complex
        Mean FRF over everything.
    sources : tuple of VarianceSource
        Outermost first, as the axes were given.
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
    g: npt.ArrayLike, frequency_hz: npt.ArrayLike, *, axes: Sequence[str] = PAPER_AXES
) -> VarianceAnalysis:
    """Sample variance of FRFs over each of several nested axes.

    Parameters
    ----------
    g : (A1, ..., An, F) complex
        FRFs; leading axes outermost first, e.g. preparations, positions, repetitions, periods.
    frequency_hz : (F,) float
    axes : sequence of str
        A name per leading axis.

    Raises
    ------
    ValueError
        If shapes and names do not fit, or an FRF is missing (not finite): the analysis needs as
        many members in every group.

    Notes
    -----
    With independent sources of variances v_1 (outermost) ... v_n and sizes A_i the expected sample
    variance over axis i is ``v_i + v_(i+1)/A_(i+1) + ... + v_n/(A_(i+1) ... A_n)``: averaging an
    inner source reduces it, but does not remove it. Nothing is subtracted from `variance`.

    References
    ----------
    Figure 9 of arXiv 1805.00682 (variance over periods, repetitions, positions and preparations,
    each against the mean); Searle, Casella & McCulloch, *Variance Components* (1992), nested
    classification.
    """
    g = np.asarray(g, complex)
    frequency = np.asarray(frequency_hz, float)
    if g.ndim != len(axes) + 1 or g.shape[-1:] != frequency.shape or g.size == 0:
        raise ValueError(
            f"g: shape {g.shape}, expected {len(axes)} leading axes ({', '.join(axes)}) and "
            f"{frequency.size} lines"
        )
    if not np.all(np.isfinite(g)):
        raise ValueError("g: an FRF is not finite, expected a complete one in every place")
    mean = g.mean(axis=tuple(range(g.ndim - 1)))
    power = np.abs(mean) ** 2
    sources: list[VarianceSource] = []
    group_means = g  # means over all axes inside the present one
    for axis in reversed(range(len(axes))):
        size = g.shape[axis]
        variance = None
        if size > 1:
            # |x - mean|^2 / (size - 1), averaged over the outer axes
            scatter = np.var(group_means, axis=axis, ddof=1)
            variance = scatter.reshape(-1, frequency.size).mean(axis=0)
        groups = int(np.prod(g.shape[:axis]))
        source = VarianceSource(
            name=axes[axis],
            size=size,
            dof=(size - 1) * groups,
            variance=variance,
            mean_power=power,
        )
        sources.insert(0, source)
        group_means = group_means.mean(axis=axis)
    return VarianceAnalysis(frequency, mean, tuple(sources))
