# SPDX-License-Identifier: Apache-2.0
"""The FRF of a record: mean spectra, their ratio, its covariances, and whether it can be relied on.

Of several realisations also whether they are of one system, in steady state: the mean of responses that
contradict each other is the response of none of them. One was recorded with the polarity or the gain changed,
without the sensor, or beside the wrong actuator signal.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.ndimage
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.frf.spectra import (
    PeriodicSpectra,
    Spectrum,
    conditional_variance,
    error_variance,
    mean_spectra,
    power,
    ratio,
)

FEWEST_AROUND = 21
"""Lines whose median of the noise one of them is compared with."""
FALSE_ALARM = 1e-4
"""By chance once in so many records, or sets of them."""

WEAK_INPUT_DB = 10.0
"""Input signal-to-noise ratio of a mean spectrum below which Y/U is biased [dB]."""

LEVELS_ALIKE = 0.1
"""Relative powers of realisations that differ by less are those of one level."""

# Lines above the so-many-th largest count alike: a tone is large on one.
LINES_ALIKE = 5
# Resonators that are slightly nonlinear differ by less.
MOST_PHASE_RAD = np.pi / 4
MOST_GAIN = 1.25
DEVIATIONS = 5.0
# Squared coherence from which a ratio of powers is one of gains, and that of two that are alike.
FOR_GAIN, ALIKE = 0.8, 0.5
ABOVE_NOISE = 10.0
"""What realisations differ by, over the power of the noise, from which noise is no reason for it."""
_UNLIKE = (
    "the responses of the realisations have nothing in common, which noise does not explain: "
    "actuator and sensor are of different records, or distortion is larger than the response"
)
# Lines over which neighbours are compared: a transient is at the modes.
WINDOWS = (8, 32, 128)


def frf_of_record(
    record: Spectrum,
    harmonics: npt.ArrayLike,
    *,
    sample_rate_hz: float,
    method: str = "local polynomial",
) -> FRF:
    """FRF with the covariances that the record allows.

    Parameters
    ----------
    record : Spectrum
        Of M realisations, samples (..., M, 2, P, N).
    harmonics : (F,) int
        Excited lines.
    sample_rate_hz : float
    method : {"local polynomial", "average"}
        How the transient is dealt with: estimated and removed, or waited for: ``average`` drops the
        first of three periods or more. A single period is taken as settled by either.

    Returns
    -------
    FRF
        ``variance_noise`` needs two periods used, ``variance_total`` two realisations; what is
        missing is None and reported by the status.

    Raises
    ------
    ValueError
        For another method, or shapes that do not fit.
    """
    spectra = mean_spectra(record, harmonics, method=method)
    return frf_of_realisations(spectra, sample_rate_hz=sample_rate_hz)


def frf_of_realisations(spectra: PeriodicSpectra, *, sample_rate_hz: float) -> FRF:
    """FRF from the mean spectra of one realisation, or best linear approximation from those of several.

    Each gives its own FRF, ``G_m = Y_m / U_m``; G is their mean. Several phase realisations
    distinguish stochastic nonlinear distortion from noise: `FRF.variance_distortion`.

    Parameters
    ----------
    spectra : PeriodicSpectra
        With spectra (..., M, 2, F), from `spectra.transient_free_spectra` or
        `spectra.averaged_spectra` (steady state; of several realisations a single period is enough).
    sample_rate_hz : float

    Returns
    -------
    FRF
        Status NO_COVARIANCE for a single period of one realisation; SUSPECT where the input is too weak at
        a line for the ratio Y/U to be unbiased.

    Raises
    ------
    ValueError
        For spectra without an axis of realisations.

    Notes
    -----
    The noise variance is that of the mean noise covariance over realisations, at the mean G, over
    the mean input power, ``(C_YY + |G|^2 C_UU - 2 Re(C_YU conj G)) / (M^2 mean |U|^2)``, sums over
    m understood: to first order in the noise. The total variance is the sample variance over realisations.
    Random phases are presumed, and amplitude spectra that are equal but for their level. Where levels differ,
    C and U of each are those of the mean level, and `noise_dof` is that of the sum (Satterthwaite): the weakest
    hold most of the variance. `total_dof` is M - 1: the total variance of few realisations is itself uncertain.

    With noise on the input the ratio is biased and its variance formula too small where the mean
    input is not well above its noise: the relative bias is ``-exp(-|U|^2 / var U)`` for
    Gaussian noise, below 5e-5 at 10 dB.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapters 2 and 4; Pintelon, Barbe, Vandersteen & Schoukens, MSSP 25 (2011) 2683-2704 (with
    transients).
    """
    each = spectra.spectra  # (..., M, 2, F)
    if each.ndim < 3:
        raise ValueError(
            f"spectra: shape {each.shape}, expected (..., M, 2, F) with realisations M"
        )
    realisations = each.shape[-3]
    several = realisations > 1
    g_each, input_power = ratio(each), power(each[..., 1, :])  # (..., M, F)
    g = g_each.mean(axis=-2)
    variance_total = np.var(g_each, axis=-2, ddof=1) / realisations if several else None
    variance_noise = given = differ = None
    weight = _of_level(input_power) if several else np.ones(1)
    if spectra.covariance is not None:
        noise = spectra.covariance.mean(axis=-4) / realisations
        given = conditional_variance(noise)
        if several:
            noise = (spectra.covariance * weight[:, None, None, None]).mean(axis=-4) / realisations
        variance_noise = error_variance(g, noise) / (input_power * weight[:, None]).mean(axis=-2)
        if variance_total is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                differ = np.median(variance_total / variance_noise, axis=-1).reshape(-1)
    frequency_hz = spectra.frequency_hz(sample_rate_hz)
    contradiction = _contradiction(spectra, g, g_each, frequency_hz, differ) if several else ""
    if contradiction:
        status, message = FrfStatus.MODEL_ERROR, contradiction
    else:
        status, message = _response_status(input_power, spectra.covariance)
    return FRF(
        frequency_hz=frequency_hz,
        g=g,
        variance_noise=variance_noise,
        variance_total=variance_total,
        noise_dof=round(weight.sum() ** 2 / (weight @ weight) * spectra.noise_dof),
        total_dof=realisations - 1,
        actuator_amplitude=None if several else np.abs(each[..., 0, 1, :]),
        sensor_variance_given_actuator=given,
        periods=spectra.periods,
        realisations=realisations,
        method=f"robust method, {spectra.method}" if several else spectra.method,
        status=status,
        message=message,
    )


def _of_level(input_power: FloatArray) -> FloatArray:
    """(M,) mean power over that of each realisation, of (..., M, F); 1 where they are alike."""
    power_each = np.moveaxis(input_power, -2, 0).reshape(input_power.shape[-2], -1).mean(axis=-1)
    weight = power_each.mean() / np.where(power_each > 0, power_each, np.inf)
    return weight if np.all(weight > 0) and np.ptp(weight) > LEVELS_ALIKE else np.ones(weight.size)


def _response_status(
    input_power: FloatArray, covariance: ComplexArray | None
) -> tuple[FrfStatus, str]:
    """Whether Y/U of mean spectra of that input power (..., M, F) and noise can be relied on."""
    if covariance is None and input_power.shape[-2] == 1:
        return FrfStatus.NO_COVARIANCE, "one period of one realisation: no covariance"
    if covariance is None:
        return (
            FrfStatus.OK,
            "one period per realisation: noise and distortion are not distinguished, the variance over "
            "realisations holds both",
        )
    silent = int(np.count_nonzero(input_power == 0))
    if silent:
        return (
            FrfStatus.SUSPECT,
            f"no input at {silent} of {input_power.size} lines: no response there",
        )
    weak = input_power < 10 ** (WEAK_INPUT_DB / 10) * covariance[..., 1, 1, :].real
    if np.any(weak):
        return (
            FrfStatus.SUSPECT,
            f"input less than {WEAK_INPUT_DB:g} dB above its noise at {np.count_nonzero(weak)} of "
            f"{weak.size} lines: their response is biased",
        )
    return FrfStatus.OK, ""


def with_narrow_modes_judged(frf: FRF) -> FRF:
    """The FRF; SUSPECT where the transient of a mode narrower than the distance of the lines is left in it.

    What the local polynomials leave of the transient of a mode of half width h bins, h < 1, bends the response
    at its peak by some ``1.6 / h`` times the deviation that it adds to the noise there.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays.
    """
    g, variance, lines = frf.g, frf.sensor_variance_given_actuator, frf.frequency_hz.size
    known = variance is not None and lines >= FEWEST_AROUND and frf.noise_dof >= 2
    if variance is None or not known or frf.status is FrfStatus.MODEL_ERROR:
        return frf
    size, beside = np.abs(g), (g[:-2] + g[2:]) / 2
    peaks = np.zeros(lines, bool)
    peaks[1:-1] = np.abs(g[1:-1] - beside) > size[1:-1] / 2
    peaks[1:-1] &= size[1:-1] > np.minimum(size[:-2], size[2:])
    around = scipy.ndimage.median_filter(variance, FEWEST_AROUND, mode="nearest")
    dof = 2 * frf.noise_dof
    limit = special.fdtri(dof, dof * FEWEST_AROUND / 4, 1 - FALSE_ALARM / lines)
    found = peaks & (variance > limit * around) & (around > 0)
    if not found.any():
        return frf
    names = ", ".join(f"{f:g}" for f in frf.frequency_hz[found][:5])
    return frf.suspected(
        f"noise of the sensor and response stand out from the lines beside at {names} Hz: a mode narrower "
        "than the distance of the lines, whose transient the local polynomials do not follow, or a tone; "
        "of a mode narrower than a bin the response there is off by more than its deviations"
    )


def _contradiction(
    spectra: PeriodicSpectra,
    g: ComplexArray,
    g_each: ComplexArray,
    frequency_hz: FloatArray,
    differ: FloatArray | None,
) -> str:
    """Why the realisations are not of one system in steady state, for people; empty where they are."""
    each = spectra.spectra
    where = transient_lines(each, g) if spectra.covariance is None else None
    if where is not None:
        ends_hz = frequency_hz[where][[0, -1]]
        return (
            f"a transient at {ends_hz[0]:g} to {ends_hz[1]:g} Hz, a drift, jump or knock, or a tone between "
            "lines: what the realisations differ by is alike on neighbouring lines, which noise and distortion "
            "are not; record two periods or more of each, or wait before the record"
        )
    g_each, u = (x.reshape(-1, *g_each.shape[-2:]) for x in (g_each, each[..., 1, :]))
    return next(filter(None, disagreement(g_each, u, differ)[0]), "")


def disagreement(
    response: ComplexArray, u: ComplexArray, differ: FloatArray | None = None
) -> tuple[npt.NDArray[np.object_], BoolArray]:
    """Why the responses of realisations are not of one system.

    Parameters
    ----------
    response : (batch, M, F) complex
        Of each realisation; lines without input, NaN, count as none.
    u : (batch or 1, M, F) complex
        Inputs: a line that is hardly driven shows noise.
    differ : (batch,) float, optional
        Power of what realisations differ by over that of the noise, where that is known.

    Returns
    -------
    remarks : (batch,) str
        What contradicts, for people; empty where nothing does.
    of_no_system : (batch,) bool
        None is coherent with any other, for which noise is no reason, or one is of another phase: the mean of
        the responses says nothing.

    Notes
    -----
    Noise and stochastic distortion of two realisations are independent, so that they lower the
    coherence ``|H_mn|^2 / (H_mm H_nn)``, ``H_mn = sum G_m conj G_n``, but turn no phase.
    """
    drive = np.sqrt(power(u).mean(axis=1, keepdims=True))
    response = np.where(np.isfinite(response), response * drive, 0)
    size = power(response).sum(axis=1)  # (batch, F)
    few = min(LINES_ALIKE, size.shape[-1])
    weight = 1 / np.maximum(size + np.partition(size, -few, axis=-1)[:, [-few]], np.finfo(float).tiny)
    share = weight * size
    lines = np.sum(share, axis=-1) ** 2 / np.maximum(np.sum(share**2, axis=-1), np.finfo(float).tiny)
    lines = np.maximum(lines, 2.0)[:, None, None]
    h = (response * weight[:, None]) @ response.conj().swapaxes(1, 2)  # (batch, M, M)
    diagonal = np.einsum("bmm->bm", h).real
    diagonal = np.where(diagonal > 0, diagonal, np.nan)
    coherence = power(h) / (diagonal[:, :, None] * diagonal[:, None, :])
    records = response.shape[1]
    tests = max(records * (records - 1) // 2, 1)
    coherent = coherence > 1 - (FALSE_ALARM / tests) ** (1 / (lines - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        deviation = np.sqrt((1 - np.minimum(coherence, 1)) / (2 * lines * coherence))
        gain = h / np.abs(h) * np.sqrt(diagonal[:, :, None] / diagonal[:, None, :])
    opposed = coherent & (np.abs(np.angle(h)) > MOST_PHASE_RAD + DEVIATIONS * deviation)
    high = coherent & (coherence > FOR_GAIN)
    unequal = high & (np.abs(np.log(np.abs(gain))) > np.log(MOST_GAIN) + DEVIATIONS * deviation)
    unlike = np.zeros(len(h), bool)
    if differ is not None:
        others = ~np.eye(records, dtype=bool)
        mean = np.mean(coherence, axis=(1, 2), where=others)
        spread = (1 - ALIKE) * np.sqrt(2 * ALIKE / (lines[:, 0, 0] * max(records - 1, 1)))
        low = (mean < ALIKE - 3 * spread) & ~(coherent & others).any(axis=(1, 2))
        unlike = low & (differ > ABOVE_NOISE)
    pairs, apart = opposed | unequal, _apart(h, coherence, coherent, lines)
    remarks = np.full(len(h), "", object)
    for k in np.flatnonzero(pairs.any(axis=(1, 2)) | apart.any(axis=-1) | unlike):
        remarks[k] = _UNLIKE if unlike[k] else _odd_one(gain[k], pairs[k], np.flatnonzero(apart[k]))
    return remarks, opposed.any(axis=(1, 2)) | unlike


def _odd_one(gain: ComplexArray, pairs: BoolArray, apart: IntArray) -> str:
    """Which realisation differs, for people.

    ``gain[m, n]`` (M, M) is the response of m in units of that of n, `pairs` (M, M) are coherent but of another
    phase or gain, `apart` (k,) those of `_apart`.
    """
    if apart.size:
        names = " and ".join(str(m + 1) for m in apart)
        return f"the response of realisation {names} has nothing in common with those of the others"
    records = np.arange(len(pairs))
    for m in records if records.size > 2 else ():
        rest = records[records != m]
        if not pairs[np.ix_(rest, rest)].any():
            return _difference(int(m), gain[m, rest].mean(), "the others")
    m, n = np.argwhere(pairs)[0].tolist()
    return _difference(n, gain[n, m], f"realisation {m + 1}")


def _apart(
    h: ComplexArray, coherence: FloatArray, coherent: BoolArray, lines: FloatArray
) -> BoolArray:
    """(batch, M) without coherence with any other, two of which are coherent.

    It lacks what the two that are most alike have in common, by more than noise may hide.
    """
    batch, records, _ = h.shape
    others = coherent & ~np.eye(records, dtype=bool)
    alike = np.where(others, coherence, 0.0).reshape(batch, records**2)
    rows, place = np.arange(batch), alike.argmax(axis=-1)
    two = np.stack(np.divmod(place, records), axis=-1)  # (batch, 2)
    common = np.abs(h[rows, two[:, 0], two[:, 1]])[:, None]
    size = np.einsum("bmm->bm", h).real
    lacks = np.ones((batch, records), bool)
    for n in two.T:
        noise = np.sqrt(size * size[rows, n][:, None] / lines[..., 0])
        lacks &= common - np.abs(h[rows, :, n]) > DEVIATIONS * noise
    return lacks & ~others.any(axis=-1) & (alike[rows, place] > ALIKE)[:, None]


def _difference(m: int, gain: complex, others: str) -> str:
    turned = abs(np.degrees(np.angle(gain)))
    return (
        f"realisation {m + 1} is not of the same system as {others}: {abs(gain):.2f} times the gain, phase off "
        f"by {turned:.0f} degrees"
    )


def transient_lines(each: ComplexArray, g: ComplexArray) -> slice | None:
    """Lines on which neighbours of ``Y_m - G U_m`` are more alike than chance makes them; None: nowhere.

    Noise and stochastic distortion are independent from line to line, the spectrum of a transient is
    smooth. Products of neighbours have mean 0 and bring their own variance then, so that lines and
    realisations may differ in noise. Of spectra [Y; U] (..., M, 2, F) and the mean response (..., F).
    """
    error = each[..., 0, :] - g[..., None, :] * each[..., 1, :]  # (..., M, F)
    records, size = error.shape[-2], power(error)
    product = np.real(error[..., 1:] * error[..., :-1].conj()).sum(axis=-2)  # (..., F - 1)
    # of M errors that add up to zero M - 1 are free
    variance = (size[..., 1:] * size[..., :-1]).sum(axis=-2) * records / (2 * (records - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = np.nan_to_num(product / np.sqrt(variance))
    count = alike.shape[-1]
    sums = np.cumsum(np.insert(alike, 0, 0.0, axis=-1), axis=-1)  # (..., F)
    found, tests = [], 0
    for window in {min(window, count) for window in (*WINDOWS, count) if count}:
        of_window = (sums[..., window:] - sums[..., :-window]).reshape(-1, count - window + 1)
        score, start = of_window.max(), int(of_window.max(axis=0).argmax())
        found.append((score / np.sqrt(window), slice(start, start + window + 1)))
        tests += of_window.size
    score, where = max(found, key=lambda of: of[0], default=(0.0, slice(0)))
    return where if score > -special.ndtri(FALSE_ALARM / max(tests, 1)) else None
