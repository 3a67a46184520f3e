# SPDX-License-Identifier: Apache-2.0
"""Poles of one point by the joint estimator, from the samples of its records or from bins kept of them.

A disturbance of the generator that is seen in the measured input and moves the output is as good an
excitation as the lines that were meant, on every bin. Taken for noise it costs information, and where
it is coloured and strong the fit does not converge. So are lines that were excited but not listed. Then all
bins are excitation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, IntArray
from tactile_resonance.frf.band_bins import BandBins
from tactile_resonance.poles.drift import poles_with_drift
from tactile_resonance.poles.joint import JointPlan, PoleEstimator, whole_harmonics
from tactile_resonance.poles.noise_level import LEAST_VARIANCE, two_channels
from tactile_resonance.poles.result import Poles, PolesBatch, PolesStatus
from tactile_resonance.poles.single_point import single
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.poles.tones import poles_without_tones

DISTURBED = 1e-2
"""Power of the input between harmonics over that on the excited lines from which all bins are tried: less
holds next to no information."""

EXPLAINED = 100.0
"""Power that the input makes in the output between harmonics over that of the noise there, from which
the fit to all bins is taken. Noise of the voltmeter on the input, which moves no output, fails this."""

FITS = 3
"""To all bins; each after the first with the ratio of the noises that the one before shows."""


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
        Always with a status; raised is only what `JointPlan` raises. All bins are excitation where a
        disturbance moves the input between harmonics; see `drift` for modes that change.
    """
    if np.ndim(u) not in (2, 3):
        raise ValueError(f"u: shape {np.shape(u)}, expected (P, N) or (M, P, N)")
    if np.ndim(u) == 3 and len(u) == 1:
        u, y = u[0], y[0]
    plan = (JointPlan if np.ndim(u) == 2 else PoleEstimator)(
        sample_rate_hz,
        np.shape(u)[-1],
        np.shape(u)[-2],
        harmonics,
        band_hz,
        structure or ModelStructure(),
        input_noise_ratio=input_noise_ratio,
    )
    return _of_plan(plan, *plan.transform(u, y))


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
    plan = _plan(
        bins.sample_rate_hz,
        bins.samples_per_period,
        bins.periods,
        whole_harmonics(bins.harmonics).tobytes(),
        (float(band_hz[0]), float(band_hz[1])),
        structure or ModelStructure(),
        bins.u.shape[0] > 1,
    )
    first = plan.bins[0] - bins.first_bin
    if first < 0 or first + plan.bins.size > bins.count:
        raise ValueError(
            f"band_hz: {band_hz}, the bins cover {bins.band_hz[0]:g} to {bins.band_hz[1]:g} Hz"
        )
    here = slice(first, first + plan.bins.size)
    u, y = bins.u[:, here], bins.y[:, here]
    if u.shape[0] == 1:
        u, y = u[0], y[0]
    return _of_plan(plan, u, y).noting(*notes)


def _of_plan(plan: JointPlan, u: ComplexArray, y: ComplexArray) -> Poles:
    """Poles from bins: by all as excitation, without tones, with drift, as the record asks for."""
    batch = plan.from_bins(u, y)
    poles = _poles_with_all_bins(plan, u, y, batch)
    if poles is not None:
        return poles
    rest, tones = poles_without_tones(plan, u, y, batch)
    if y.ndim == 1 and plan.periods > 1 and plan.other_bins.size:
        found = poles_with_drift(plan, u, y, batch)
        # a drift fills the bins beside a line as tones would: what leaves less noise is right
        if found is not None and (not tones or found[1] < rest.noise_variance[0]):
            return found[0]
    return single(rest, notes=[tone.text("left out") for tone in tones])


@lru_cache(maxsize=32)
def _plan(
    sample_rate_hz: float,
    samples_per_period: int,
    periods: int,
    harmonics: bytes,
    band_hz: tuple[float, float],
    structure: ModelStructure,
    several: bool,
) -> JointPlan:
    return (PoleEstimator if several else JointPlan)(
        sample_rate_hz,
        samples_per_period,
        periods,
        np.frombuffer(harmonics, np.int64),
        band_hz,
        structure,
    )


def _poles_with_all_bins(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, batch: PolesBatch
) -> Poles | None:
    """Poles from all bins of one point where the input between harmonics moves the output.

    Parameters
    ----------
    plan : JointPlan
    u, y : (K,) or (M, K) complex
        At its bins; of M realisations for a plan of these.
    batch : PolesBatch
        Its fit to the excited lines, shape (). A model error found on these by cost or whiteness stays:
        bins that noise alone moves have found it. Unless it took the disturbance for noise: a fit to all
        bins then leaves next to nothing of that. A disturbance looks like terms that the model lacks.

    Returns
    -------
    Poles or None
        None where the excited lines are all there is; see `DISTURBED` and `EXPLAINED`.
    """
    wrong = batch.status() is PolesStatus.MODEL_ERROR and not np.isfinite(batch.lacking[0])
    if batch.status() is PolesStatus.TOO_FEW_LINES or not _disturbed(plan, u):
        return None
    ratio = 0.0
    of_all = _with_all_bins(plan, u, y, ratio)
    for _ in range(FITS - 1):
        ratio = _input_noise_ratio(plan, of_all, ratio)
        of_all = _with_all_bins(plan, u, y, ratio)
    if wrong and not of_all.noise_variance[0] * EXPLAINED < batch.noise_variance[0]:
        return None
    explained = _explained(plan, of_all, u)
    better = of_all.status() is PolesStatus.OK or (
        of_all.status() is PolesStatus.MODEL_ERROR and batch.status() is not PolesStatus.OK
    )
    if not (better and explained >= EXPLAINED):
        return None
    above_db = 10 * np.log10(explained)
    note = (
        f"the input beside the excited lines moves the output {above_db:.0f} dB above its noise, as a "
        "disturbance of the generator does: all bins are taken as excitation"
    )
    if batch.status() is not PolesStatus.OK:
        note += f"; the fit to the excited lines alone: {batch.status().value}"
    poles = single(of_all, notes=[note])
    return replace(poles, method=f"{poles.method}, all bins as excitation")


@np.errstate(all="ignore")  # what exceeds double precision is left to the status of the fit
def _disturbed(plan: JointPlan, u: ComplexArray) -> bool:
    if plan.other_bins.size == 0:
        return False
    power = np.abs(u) ** 2
    lines = np.mean(power[..., plan.excited_at])
    return bool(DISTURBED * lines <= np.mean(power[..., plan.others_at]) < np.inf)


def _with_all_bins(plan: JointPlan, u: ComplexArray, y: ComplexArray, ratio: float) -> PolesBatch:
    return replace(plan, harmonics=None, input_noise_ratio=ratio).from_bins(u, y)


@np.errstate(all="ignore")
def _input_noise_ratio(plan: JointPlan, of_all: PolesBatch, ratio: float) -> float:
    """Variance of the noise on U over that on Y, from residuals whose power is ``a + b |G|^2``.

    Of a fit weighted with another ratio.
    """
    gain = np.abs(of_all.fit.response(plan.frequency_hz(plan.bins))) ** 2
    variance = np.abs(of_all.residual) ** 2 * (1 + ratio * gain)
    curve = two_channels(variance[None], gain[None])[0]
    low, high = np.argmin(gain), np.argmax(gain)
    slope = (curve[high] - curve[low]) / max(gain[high] - gain[low], np.finfo(float).tiny)
    floor = LEAST_VARIANCE * curve.mean()
    found = slope / max(curve[low] - slope * gain[low], floor, np.finfo(float).tiny)
    return float(found) if np.isfinite(found) else 0.0  # of a fit that failed


@np.errstate(all="ignore")  # a fit that failed explains nothing
def _explained(plan: JointPlan, of_all: PolesBatch, u: ComplexArray) -> float:
    """Mean square of ``G U`` between harmonics over the variance of ``Y - G U``."""
    g = of_all.fit.response(plan.frequency_hz(plan.other_bins))
    made = np.mean(np.abs(g * u[..., plan.others_at]) ** 2)
    noise_y, noise_u = of_all.noise_variance
    return float(made / (noise_y + noise_u * np.mean(np.abs(g) ** 2)))
