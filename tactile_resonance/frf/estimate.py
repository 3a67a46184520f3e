# SPDX-License-Identifier: Apache-2.0
"""The FRF of a record: mean spectra, their ratio, its covariances, and whether it can be relied on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.ndimage
from scipy import special

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.frf.local_polynomial import transient_free_spectra
from tactile_resonance.frf.realisations import Agreement, transient_lines
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.frf.spectra import (
    PeriodicSpectra,
    Spectrum,
    averaged_spectra,
    conditional_variance,
    error_variance,
    power,
    ratio,
)

METHODS = ("local polynomial", "average")

FEWEST_AROUND = 21
"""Lines whose median of the noise one of them is compared with."""
FALSE_ALARM = 1e-4

WEAK_INPUT_DB = 10.0
"""Input signal-to-noise ratio of a mean spectrum below which Y/U is biased [dB]."""


def frf_of_record(
    record: Spectrum,
    harmonics: npt.ArrayLike,
    *,
    sample_rate_hz: float,
    method: str = "local polynomial",
    order: int = 2,
    dof: int = 6,
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
    order, dof : int
        See `local_polynomial.transient_free_spectra`.

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
    spectra = mean_spectra(record, harmonics, method=method, order=order, dof=dof)
    return frf_of_realisations(spectra, sample_rate_hz=sample_rate_hz)


def mean_spectra(
    record: Spectrum,
    harmonics: npt.ArrayLike,
    *,
    method: str = "local polynomial",
    order: int = 2,
    dof: int = 6,
) -> PeriodicSpectra:
    """Mean spectra (..., 2, F) of a record; parameters are those of `frf_of_record`."""
    if method not in METHODS:
        raise ValueError(f"method: {method!r}, accepted are {', '.join(METHODS)}")
    if record.periods > 1 and method == "local polynomial":
        return transient_free_spectra(record, harmonics, order=order, dof=dof)
    return averaged_spectra(record, harmonics, unsettled_periods=1 if record.periods > 2 else 0)


def frf_of_realisations(spectra: PeriodicSpectra, *, sample_rate_hz: float) -> FRF:
    """FRF from the mean spectra of one realisation, or best linear approximation from those of several.

    Each gives its own FRF, ``G_m = Y_m / U_m``; G is their mean. Several phase realisations
    distinguish stochastic nonlinear distortion from noise: `FRF.variance_distortion`.

    Parameters
    ----------
    spectra : PeriodicSpectra
        With spectra (..., M, 2, F), from `local_polynomial.transient_free_spectra` or
        `averaged_spectra` (steady state; of several realisations a single period is enough).
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
    Random phases and equal amplitude spectra of all realisations are presumed. `total_dof` is M - 1: the
    total variance of few realisations is itself uncertain.

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
    if spectra.covariance is not None:
        noise = spectra.covariance.mean(axis=-4) / realisations  # (..., 2, 2, F)
        given = conditional_variance(noise)
        variance_noise = error_variance(g, noise) / input_power.mean(axis=-2)
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
        noise_dof=realisations * spectra.noise_dof,
        total_dof=realisations - 1,
        actuator_amplitude=None if several else np.abs(each[..., 0, 1, :]),
        sensor_variance_given_actuator=given,
        periods=spectra.periods,
        realisations=realisations,
        method=f"robust method, {spectra.method}" if several else spectra.method,
        status=status,
        message=message,
    )


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
            f"a transient at {ends_hz[0]:g} to {ends_hz[1]:g} Hz, or a drift, or a tone between lines: what "
            "the realisations differ by is alike on neighbouring lines, which noise and distortion are not; "
            "record two periods or more of each, or wait before the record"
        )
    g_each, u = (x.reshape(-1, *g_each.shape[-2:]) for x in (g_each, each[..., 1, :]))
    return next(filter(None, Agreement.of(g_each, u, differ).remarks()), "")
