# SPDX-License-Identifier: Apache-2.0
"""Which estimator of the poles the data at hand allow, and how many poles the lines speak for.

Of bins, a disturbance of the generator that is seen in the measured input and moves the output is as good an
excitation as the lines that were meant, on every bin. Taken for noise it costs information, and where
it is coloured and strong the fit does not converge. So are lines that were excited but not listed. Then all
bins are excitation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, IntArray
from tactile_resonance.frf.result import FRF, BandBins, FrfStatus
from tactile_resonance.poles.drift import Drifted, poles_with_drift
from tactile_resonance.poles.identify import identify_frf
from tactile_resonance.poles.joint import JointPlan, PoleEstimator, whole_harmonics
from tactile_resonance.poles.knocks import instant_of_knock
from tactile_resonance.poles.noise_level import channels_of, two_channels
from tactile_resonance.poles.result import Poles, PolesBatch, PolesStatus, single
from tactile_resonance.poles.structure import ModelStructure, PoleBand
from tactile_resonance.poles.tones import has_tones, noise_without_one_tone, poles_without_tones

POLES_METHODS = ("auto", "joint", "frf")

DISTURBED = 1e-2
"""Power of the input between harmonics over that on the excited lines from which all bins are tried: less
holds next to no information."""

EXPLAINED = 100.0
"""Power that the input makes in the output between harmonics over that of the noise there, from which
the fit to all bins is taken. Noise of the voltmeter on the input, which moves no output, fails this."""

FITS = 3
"""To all bins; each after the first with the ratio of the noises that the one before shows."""


def poles_of_frf(
    frf: FRF,
    band_hz: tuple[float, float],
    structure: ModelStructure | None = None,
    method: str = "auto",
) -> Poles:
    """Poles from the bins that come with an FRF, else from the FRF itself.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays.
    band_hz : (low, high)
    structure : ModelStructure, optional
        One mode and six residual terms when absent.
    method : {"auto", "joint", "frf"}
        ``auto`` is ``joint`` where the FRF brings bins that cover the band and hold lines enough. A joint
        fit that does not converge is followed by one to the FRF.

    Returns
    -------
    Poles
        Always with a status; its ``method`` says which was taken.

    Raises
    ------
    ValueError
        If the method is unknown, or ``joint`` is not possible.
    """
    if method not in POLES_METHODS:
        raise ValueError(f"method: {method!r}, accepted are {', '.join(POLES_METHODS)}")
    structure = structure or ModelStructure()
    if frf.status is FrfStatus.FAILED or frf.frequency_hz.size == 0:
        return Poles(status=PolesStatus.FAILED, message=frf.message)
    reason = ""
    if method != "frf":
        try:
            joint = _plan_and_bins(frf.bins, band_hz, structure)
        except ValueError as error:
            if method == "joint":
                raise ValueError(f"method: joint, but {error}") from None
            reason = str(error)
    if method == "frf" or reason:
        poles = identify_frf(frf, band_hz, structure)
        return poles.noting(f"from the FRF: {reason}") if reason and frf.bins is not None else poles
    poles = _of_plan(*joint)
    told = poles.status is PolesStatus.MODEL_ERROR or frf.periods == 1  # a transient is estimated here
    if frf.status is not FrfStatus.OK and not (frf.status is FrfStatus.MODEL_ERROR and told):
        poles = poles.noting(frf.message)
    if poles.status is not PolesStatus.NOT_CONVERGED:
        return poles
    again = identify_frf(frf, band_hz, structure)
    if again.status not in (PolesStatus.OK, PolesStatus.MODEL_ERROR, PolesStatus.NO_COVARIANCE):
        return poles.noting(f"from the FRF: {again.status.value}")
    return again.noting("from the FRF: the joint fit did not converge")


def poles_of_bands(frf: FRF, bands: Sequence[PoleBand], method: str = "auto") -> Poles:
    """Poles in several bands of one FRF, each fitted alone; those of the second and so on as `further`.

    Parameters
    ----------
    frf : FRF
        Its bins are those of the bands, in their order, where it brings any.
    bands : sequence of PoleBand
        One or more.
    method : str
        See `poles_of_frf`.
    """
    bins = [frf.bins, *frf.further_bins, *[None] * len(bands)]

    def of_band(k: int, band: PoleBand) -> Poles:
        alone = replace(frf, bins=bins[k], further_bins=())

        def fit(structure: ModelStructure) -> Poles:
            return poles_of_frf(alone, band.ends_hz, structure, method)

        if band.order == 0 and frf.status is not FrfStatus.FAILED:
            return choose_among(fit)
        return fit(ModelStructure.with_residual(band.order or 2, band.residual_terms))

    first, *further = (of_band(k, band) for k, band in enumerate(bands))
    return replace(first, further=tuple(further))


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
    if np.ndim(u) == 2:
        u, y = np.asarray(u)[None], np.asarray(y)[None]
    plan = (PoleEstimator if len(u) > 1 else JointPlan)(
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
    band_hz: tuple[float, float],
    structure: ModelStructure | None = None,
) -> Poles:
    """Poles from the bins that a stream of periods keeps; plans of the latest kinds are kept.

    Parameters
    ----------
    bins : BandBins
    band_hz : (low, high)
        Within that of the bins.
    structure
        See `JointPlan`.

    Raises
    ------
    ValueError
        If the bins do not cover the band, or as `JointPlan`.
    """
    return _of_plan(*_plan_and_bins(bins, band_hz, structure or ModelStructure()))


def _plan_and_bins(
    bins: BandBins | None, band_hz: tuple[float, float], structure: ModelStructure
) -> tuple[JointPlan, ComplexArray, ComplexArray]:
    """What `_of_plan` takes; ``ValueError`` where there can be no joint estimate."""
    if bins is None:
        raise ValueError("the FRF brings no bins: they were not asked for, or too many")
    plan = _plan(
        bins.sample_rate_hz,
        bins.samples_per_period,
        bins.periods,
        whole_harmonics(bins.harmonics).tobytes(),
        (float(band_hz[0]), float(band_hz[1])),
        structure,
        bins.u.shape[0] > 1,
    )
    first = plan.bins[0] - bins.first_bin
    if first < 0 or first + plan.bins.size > bins.count:
        raise ValueError(
            f"band_hz: {band_hz}, the bins cover {bins.band_hz[0]:g} to {bins.band_hz[1]:g} Hz"
        )
    here = slice(first, first + plan.bins.size)
    return plan, bins.u[:, here], bins.y[:, here]


def _of_plan(plan: JointPlan, u: ComplexArray, y: ComplexArray) -> Poles:
    """Poles from bins (M, K): by all as excitation, with drift, without tones, as the record asks for."""
    if len(u) == 1:
        u, y = u[0], y[0]
    batch = plan.from_bins(u, y)
    poles = _poles_with_all_bins(plan, u, y, batch)
    if poles is not None:
        return poles
    drifted, knocks = None, ""
    if y.ndim == 1 and plan.periods > 1 and plan.others_at.size:
        plan, batch, drifted = _with_knocks(plan, u, y, batch)
        if plan.knocks_s:
            instants = ", ".join(f"{instant_s:.2g}" for instant_s in sorted(plan.knocks_s))
            knocks = (
                f"what rings from about {instants} s after the start of the record on is fitted too: a knock, "
                "noise that comes and goes, or beside either end a transient outside of the band"
            )
        # a drift fills the bins beside a line as tones would, for which dozens of fits are made; it takes up a
        # tone beside a narrow mode, too, but leaves more noise than there is without the tone
        if (
            drifted is not None
            and not has_tones(plan, u, drifted.rest, drifted.fit)
            and drifted.fit.noise_variance[0] < noise_without_one_tone(plan, u, y, batch)
        ):
            return drifted.poles.noting(knocks)
    rest, tones = poles_without_tones(plan, u, y, batch)
    # what leaves less noise is right
    if drifted is not None and not (tones and rest.noise_variance[0] <= drifted.fit.noise_variance[0]):
        return drifted.poles.noting(knocks)
    return single(rest, notes=[*(tone.text("left out") for tone in tones), knocks])


def _with_knocks(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, batch: PolesBatch
) -> tuple[JointPlan, PolesBatch, Drifted | None]:
    """The plan with the knocks that are in bins u, y (K,), the fit with them, and the drift beside them."""
    drifted = poles_with_drift(plan, u, y, batch)
    while (knock_s := instant_of_knock(plan, u, y, batch)) is not None:
        with_knock = replace(plan, knocks_s=(*plan.knocks_s, knock_s))
        fit = with_knock.from_bins(u, y)
        # tones, and a mode that changes, stand out at some instants, too: what leaves less noise is right
        of_drift = (batch if drifted is None else drifted.fit).noise_variance[0]
        if not fit.noise_variance[0] < min(of_drift, noise_without_one_tone(plan, u, y, batch)):
            break
        plan, batch, drifted = with_knock, fit, poles_with_drift(with_knock, u, y, fit)
    return plan, batch, drifted


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


@np.errstate(all="ignore")  # what exceeds double precision is left to the status of the fit
def _poles_with_all_bins(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, batch: PolesBatch
) -> Poles | None:
    """Poles from all bins u, y (K,) or (M, K) of one point where the input between harmonics moves the output.

    None where the excited lines are all there is; see `DISTURBED` and `EXPLAINED`. A model error found on these
    by cost or whiteness stays: bins that noise alone moves have found it. Unless it took the disturbance for
    noise: a fit to all bins then leaves next to nothing of that. A disturbance looks like terms that the model
    lacks.
    """
    wrong = batch.status() is PolesStatus.MODEL_ERROR and not np.isfinite(batch.lacking[0])
    if batch.status() is PolesStatus.TOO_FEW_LINES or plan.others_at.size == 0:
        return None
    between, lines = (np.mean(np.abs(u[..., at]) ** 2) for at in (plan.others_at, plan.excited_at))
    if not DISTURBED * lines <= between < np.inf:
        return None
    plan_of_all = replace(plan, harmonics=None, input_noise_ratio=0.0)
    of_all = plan_of_all.from_bins(u, y)
    for _ in range(FITS - 1):
        plan_of_all = replace(plan_of_all, input_noise_ratio=_input_noise_ratio(plan_of_all, of_all))
        of_all = plan_of_all.from_bins(u, y)
    if wrong and not of_all.noise_variance[0] * EXPLAINED < batch.noise_variance[0]:
        return None
    g, (noise_y, noise_u) = of_all.fit.response(plan.frequency_hz[plan.others_at]), of_all.noise_variance
    explained = np.mean(np.abs(g * u[..., plan.others_at]) ** 2) / (noise_y + noise_u * np.mean(np.abs(g) ** 2))
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


def _input_noise_ratio(plan: JointPlan, of_all: PolesBatch) -> float:
    """Variance of the noise on U over that on Y, from residuals whose power is ``a + b |G|^2``.

    Of a fit weighted with the ratio of its plan.
    """
    gain = np.abs(of_all.fit.response(plan.frequency_hz)) ** 2
    variance = np.abs(of_all.residual) ** 2 * (1 + (plan.input_noise_ratio or 0.0) * gain)
    curve = two_channels(variance[None], gain[None], np.zeros(1, bool))
    of_y, of_u = channels_of(curve, gain[None])[0]
    found = of_u / max(of_y, np.finfo(float).tiny)
    return float(found) if np.isfinite(found) else 0.0  # of a fit that failed


CANDIDATES = tuple(ModelStructure.with_residual(n, r) for n in (2, 4, 6) for r in (6, 8, 10))
"""One to three modes, with six to ten residual terms."""


def choose_among(
    fit: Callable[[ModelStructure], Poles], candidates: Sequence[ModelStructure] = CANDIDATES
) -> Poles:
    """Fit several structures to the same data and choose by minimum description length; the message says so.

    Parameters
    ----------
    fit : callable
        May raise a `ValueError` where the data are too few for a structure, which is then left out.
    candidates : sequence of ModelStructure

    Raises
    ------
    ValueError
        If there is no candidate, or none has a result whose noise is known: the cost then says nothing.

    References
    ----------
    De Ridder, Pintelon, Schoukens & Gillikin, *Modified AIC and MDL model selection criteria for
    short data records*, IEEE Trans. Instrum. Meas. 54 (2005) 144-150.
    """
    if not candidates:
        raise ValueError("candidates: none given, expected one structure at least")
    fits, refused = [], None
    for structure in candidates:
        try:
            fits.append(fit(structure))
        except ValueError as error:
            refused = error
    if not fits:
        assert refused is not None
        raise refused
    lengths = [_description_length(poles) for poles in fits]
    best = fits[int(np.argmin(lengths))]
    if not np.isfinite(min(lengths)):
        raise ValueError(
            "candidates: none has a result with a known level of noise, more lines or smaller orders "
            "are needed"
        )
    orders = f"{best.structure.order} and {best.structure.numerator_order}"
    return best.noting(f"orders {orders} chosen by description length from {len(fits)}")


def _description_length(poles: Poles) -> float:
    """``(cost / F) exp(n log(2 F) / (2 F - n - 2))``, corrected for few lines; infinite without a result."""
    usable = (PolesStatus.OK, PolesStatus.MODEL_ERROR, PolesStatus.NO_RESONANCE)
    data, n = 2 * poles.lines, poles.structure.parameters
    if poles.status not in usable or data <= n + 2 or not np.isfinite(poles.cost):
        return float("inf")
    return poles.cost / poles.lines * float(np.exp(n * np.log(data) / (data - n - 2)))
