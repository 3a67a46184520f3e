# SPDX-License-Identifier: Apache-2.0
"""Poles of one point by the joint estimator, from the samples of its records or from bins kept of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, IntArray
from tactile_resonance.frf.band_bins import BandBins
from tactile_resonance.poles.disturbed_input import poles_with_all_bins
from tactile_resonance.poles.drift import poles_with_drift
from tactile_resonance.poles.joint import JointPlan, PoleEstimator, whole_harmonics
from tactile_resonance.poles.result import Poles
from tactile_resonance.poles.single_point import single
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.poles.tones import PlanOf, poles_without_tones


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
    """Poles from the samples of one point; many want a `JointPlan`, which this makes every time.

    Parameters
    ----------
    u, y : (P, N) or (M, P, N) float
        Actuator and sensor: P consecutive periods of N samples, from any initial state, of one
        realisation or of M.
    sample_rate_hz, harmonics, band_hz, structure, input_noise_ratio
        See `JointPlan`.

    Returns
    -------
    Poles
        Always with a status; raised is only what `JointPlan` raises. See
        `disturbed_input` for inputs that a disturbance moves between harmonics, `drift` for modes that change.
    """
    if np.ndim(u) not in (2, 3):
        raise ValueError(f"u: shape {np.shape(u)}, expected (P, N) or (M, P, N)")
    if np.ndim(u) == 3 and len(u) == 1:
        u, y = u[0], y[0]

    @lru_cache(maxsize=2)
    def plan_of(left_out: tuple[int, ...]) -> JointPlan:
        return (JointPlan if np.ndim(u) == 2 else PoleEstimator)(
            sample_rate_hz,
            np.shape(u)[-1],
            np.shape(u)[-2],
            harmonics,
            band_hz,
            structure or ModelStructure(),
            input_noise_ratio=input_noise_ratio,
            left_out=left_out,
        )

    return _of_plan(plan_of, *plan_of(()).transform(u, y))


def identify_poles_from_bins(
    bins: BandBins,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
    *,
    notes: Sequence[str] = (),
) -> Poles:
    """Poles from the bins that a stream of periods keeps; plans of the latest kinds are kept.

    Parameters
    ----------
    bins : BandBins
    band_hz : (low, high), optional
        Within that of the bins, which is taken when absent.
    structure
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
    plan_of = partial(
        _plan,
        bins.sample_rate_hz,
        bins.samples_per_period,
        bins.periods,
        whole_harmonics(bins.harmonics).tobytes(),
        (float(band_hz[0]), float(band_hz[1])),
        structure or ModelStructure(),
        None,
        bins.u.shape[0] > 1,
    )
    plan = plan_of(())
    first = plan.bins[0] - bins.first_bin
    if first < 0 or first + plan.bins.size > bins.count:
        raise ValueError(
            f"band_hz: {band_hz}, the bins cover {bins.band_hz[0]:g} to {bins.band_hz[1]:g} Hz"
        )
    here = slice(first, first + plan.bins.size)
    u, y = bins.u[:, here], bins.y[:, here]
    if u.shape[0] == 1:
        u, y = u[0], y[0]
    return _of_plan(plan_of, u, y, notes)


def _of_plan(plan_of: PlanOf, u: ComplexArray, y: ComplexArray, notes: Sequence[str] = ()) -> Poles:
    """Poles from bins: by all as excitation, without tones, with drift, as the record asks for."""
    plan = plan_of(())
    batch = plan.from_bins(u, y)
    poles = poles_with_all_bins(plan, u, y, batch)
    if poles is not None:
        return replace(poles, message="; ".join(filter(None, [poles.message, *notes])))
    rest, tones = poles_without_tones(plan_of, u, y, batch)
    if y.ndim == 1 and plan.periods > 1 and plan.other_bins.size:
        found = poles_with_drift(plan, u, y, batch)
        # a drift fills the bins beside a line as tones would: what leaves less noise is right
        if found is not None and (not tones or found[1] < rest.noise_variance[0]):
            return replace(found[0], message="; ".join(filter(None, [found[0].message, *notes])))
    return single(rest, notes=[*(tone.text("left out") for tone in tones), *notes])


@lru_cache(maxsize=32)
def _plan(
    sample_rate_hz: float,
    samples_per_period: int,
    periods: int,
    harmonics: bytes,
    band_hz: tuple[float, float],
    structure: ModelStructure,
    input_noise_ratio: float | None,
    several: bool,
    left_out: tuple[int, ...],
) -> JointPlan:
    return (PoleEstimator if several else JointPlan)(
        sample_rate_hz,
        samples_per_period,
        periods,
        np.frombuffer(harmonics, np.int64),
        band_hz,
        structure,
        input_noise_ratio=input_noise_ratio,
        left_out=left_out,
    )
