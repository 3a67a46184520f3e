# SPDX-License-Identifier: Apache-2.0
"""Poles of one record by the joint estimator, from its samples or from bins kept of it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.band_bins import BandBins
from tactile_resonance.identification.joint import JointPlan
from tactile_resonance.identification.joint_layout import whole_harmonics
from tactile_resonance.identification.result import Poles
from tactile_resonance.identification.single_point import single
from tactile_resonance.identification.structure import ModelStructure

IntArray = npt.NDArray[np.int64]


def identify_poles_from_records(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    *,
    sample_rate_hz: float,
    harmonics: IntArray | None,
    band_hz: tuple[float, float],
    structure: ModelStructure | None = None,
    input_noise_ratio: float | None = None,
) -> Poles:
    """Poles from the samples of one record; many want a `JointPlan`, which this makes every time.

    Parameters
    ----------
    u, y : (P, N) float
        Actuator and sensor: P consecutive periods of N samples, from any initial state.
    sample_rate_hz, harmonics, band_hz, structure, input_noise_ratio
        See `JointPlan`.

    Returns
    -------
    Poles
        Always with a status; raised is only what `JointPlan` raises.
    """
    if np.ndim(u) != 2:
        raise ValueError(f"u: shape {np.shape(u)}, expected (P, N)")
    plan = JointPlan(
        sample_rate_hz,
        np.shape(u)[1],
        np.shape(u)[0],
        harmonics,
        band_hz,
        structure or ModelStructure(),
        input_noise_ratio=input_noise_ratio,
    )
    return single(plan(u, y))


def identify_poles_from_bins(
    bins: BandBins,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
    *,
    input_noise_ratio: float | None = None,
    notes: Sequence[str] = (),
) -> Poles:
    """Poles from the bins that a stream of periods keeps; plans of the latest kinds are kept.

    Parameters
    ----------
    bins : BandBins
    band_hz : (low, high), optional
        Within that of the bins, which is taken when absent.
    structure, input_noise_ratio
        See `JointPlan`.
    notes : sequence of str
        Added to the message.

    Raises
    ------
    ValueError
        If the bins do not cover the band, or as `JointPlan`.
    """
    if band_hz is None:
        band_hz = bins.band_hz
    plan = _plan(
        bins.sample_rate_hz,
        bins.samples_per_period,
        bins.periods,
        whole_harmonics(bins.harmonics).tobytes(),
        (float(band_hz[0]), float(band_hz[1])),
        structure or ModelStructure(),
        input_noise_ratio,
    )
    first = plan.bins[0] - bins.first_bin
    if first < 0 or first + plan.bins.size > bins.u.size:
        raise ValueError(
            f"band_hz: {band_hz}, the bins cover {bins.band_hz[0]:g} to {bins.band_hz[1]:g} Hz"
        )
    here = slice(first, first + plan.bins.size)
    return single(plan.from_bins(bins.u[here], bins.y[here]), notes=notes)


@lru_cache(maxsize=32)
def _plan(
    sample_rate_hz: float,
    samples_per_period: int,
    periods: int,
    harmonics: bytes,
    band_hz: tuple[float, float],
    structure: ModelStructure,
    input_noise_ratio: float | None,
) -> JointPlan:
    return JointPlan(
        sample_rate_hz,
        samples_per_period,
        periods,
        np.frombuffer(harmonics, np.int64),
        band_hz,
        structure,
        input_noise_ratio=input_noise_ratio,
    )
