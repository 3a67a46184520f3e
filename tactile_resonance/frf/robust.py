# SPDX-License-Identifier: Apache-2.0
"""Robust method: several phase realisations tell stochastic nonlinear distortion from noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_resonance.frf.fast import response, response_status
from tactile_resonance.frf.result import FRF, ComplexArray, FloatArray, FrfStatus
from tactile_resonance.frf.spectra import PeriodicSpectra, ratio_variance

# Chance alone makes realisations of one period look like a transient once in ten thousand times.
TRANSIENT_SCORE = 3.7


@dataclass(frozen=True, eq=False)
class RobustFrf:
    """Best linear approximation with noise and stochastic nonlinear distortion apart.

    Attributes
    ----------
    frf : FRF
        Best linear approximation; its `variance_noise` (None for single periods) and
        `variance_total` are those of the mean over realisations. `spectra` are given only where a
        reference was.
    variance_distortion : (..., F) float or None
        Variance of the stochastic nonlinear distortion of the FRF of *one* realisation, ``M (total
        - noise)``. Unbiased, hence negative at some lines where distortion is lost in noise:
        average over lines before taking a root. None where noise is unknown.
    spectra_total_covariance : (..., 2, 2, F) complex or None
        Total covariance of the mean spectra [Y; U]; only with a reference.
    """

    frf: FRF
    variance_distortion: FloatArray | None
    spectra_total_covariance: ComplexArray | None


def robust_frf(
    spectra: PeriodicSpectra, *, sample_rate_hz: float, reference: ComplexArray | None = None
) -> RobustFrf:
    """Best linear approximation from the mean spectra of M realisations.

    Without a reference each realisation gives its own FRF, ``G_m = Y_m / U_m``, and G is their
    mean. With the reference phases (the signal in the generator's memory) the spectra are first
    turned by them, ``Y_m conj(R_m) / |R_m|``, then averaged, and G is the ratio of these means:
    input noise is averaged before the division, which removes most of its bias, and the result
    holds mean spectra with noise and total covariance for errors-in-variables estimators. Both are
    the same for noise-free inputs of equal amplitude.

    Parameters
    ----------
    spectra : PeriodicSpectra
        With spectra (..., M, 2, F), M >= 2, from `local_polynomial.LocalPolynomialPlan` (transient
        removed) or `spectra.averaged_spectra` (steady state; a single period is enough).
    sample_rate_hz : float
    reference : (..., M, F) complex, optional
        Reference spectrum of each realisation; only its phases count.

    Raises
    ------
    ValueError
        For fewer than two realisations, or a reference that does not fit.

    Notes
    -----
    The noise variance is that of the mean noise covariance over realisations, at the mean G, over
    the mean input power, ``(C_YY + |G|^2 C_UU - 2 Re(C_YU conj G)) / (M^2 mean |U|^2)``, sums over
    m understood; the total variance is the sample variance over realisations. Random phases and
    equal amplitude spectra of all realisations are presumed. `total_dof` is M - 1: the total
    variance of few realisations is itself uncertain.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 4; Pintelon, Barbe, Vandersteen & Schoukens, MSSP 25 (2011) 2683-2704 (with
    transients).
    """
    each = spectra.spectra  # (..., M, 2, F)
    if each.ndim < 3 or each.shape[-3] < 2:
        raise ValueError(
            f"spectra: shape {each.shape}, expected (..., M, 2, F) with M >= 2 realisations; "
            "one realisation cannot tell distortion from the system"
        )
    realisations = each.shape[-3]
    if reference is not None:
        return _with_reference(spectra, sample_rate_hz, np.asarray(reference))
    g_each = response(each)  # (..., M, F)
    g = g_each.mean(axis=-2)
    variance_total = np.var(g_each, axis=-2, ddof=1) / realisations
    variance_noise = None
    if spectra.covariance is not None:
        noise = spectra.covariance.mean(axis=-4) / realisations  # (..., 2, 2, F)
        output = (
            noise[..., 0, 0, :].real
            + np.abs(g) ** 2 * noise[..., 1, 1, :].real
            - 2 * np.real(noise[..., 0, 1, :] * g.conj())
        )
        variance_noise = output / np.mean(np.abs(each[..., 1, :]) ** 2, axis=-2)
    status, message = _robust_status(each, spectra.covariance, g)
    frf = FRF(
        frequency_hz=spectra.frequency_hz(sample_rate_hz),
        g=g,
        variance_noise=variance_noise,
        variance_total=variance_total,
        noise_dof=realisations * spectra.noise_dof,
        total_dof=realisations - 1,
        periods=spectra.periods,
        realisations=realisations,
        method=f"robust method, {spectra.method}",
        status=status,
        message=message,
    )
    return RobustFrf(frf, _distortion(frf), None)


def _with_reference(
    spectra: PeriodicSpectra, sample_rate_hz: float, reference: ComplexArray
) -> RobustFrf:
    each = spectra.spectra  # (..., M, 2, F)
    expected = (*each.shape[:-2], each.shape[-1])
    if reference.shape != expected:
        raise ValueError(f"reference: shape {reference.shape}, expected {expected}")
    amplitude = np.abs(reference)
    if not np.all(amplitude > 0):
        raise ValueError("reference: zero at an excited line, expected a phase at each")
    realisations = each.shape[-3]
    turned = each * (reference.conj() / amplitude)[..., None, :]  # (..., M, 2, F)
    mean = turned.mean(axis=-3)  # (..., 2, F)
    deviation = turned - mean[..., None, :, :]
    total = np.einsum("...mif,...mjf->...ijf", deviation, deviation.conj())
    total /= realisations * (realisations - 1)  # (..., 2, 2, F), of the mean
    noise = None  # turning both channels by one phase leaves covariances alone
    if spectra.covariance is not None:
        noise = spectra.covariance.mean(axis=-4) / realisations
    status, message = response_status(mean, noise if noise is not None else total)
    frf = FRF(
        frequency_hz=spectra.frequency_hz(sample_rate_hz),
        g=mean[..., 0, :] / mean[..., 1, :],
        variance_noise=None if noise is None else ratio_variance(mean, noise),
        variance_total=ratio_variance(mean, total),
        noise_dof=realisations * spectra.noise_dof,
        total_dof=realisations - 1,
        spectra=mean,
        spectra_covariance=noise,
        periods=spectra.periods,
        realisations=realisations,
        method=f"robust method with reference, {spectra.method}",
        status=status,
        message=message,
    )
    return RobustFrf(frf, _distortion(frf), total)


def _distortion(frf: FRF) -> FloatArray | None:
    if frf.variance_noise is None or frf.variance_total is None:
        return None
    return frf.realisations * (frf.variance_total - frf.variance_noise)


def _robust_status(
    each: ComplexArray, covariance: ComplexArray | None, g: ComplexArray
) -> tuple[FrfStatus, str]:
    if covariance is not None:
        return response_status(each, covariance)
    if transient_score(each, g) > TRANSIENT_SCORE:
        return (
            FrfStatus.SUSPECT,
            "a transient: what the realisations differ by is alike on neighbouring lines, which noise "
            "and distortion are not; record two periods or more of each, or wait before the record",
        )
    return (
        FrfStatus.OK,
        "one period per realisation: noise cannot be told from distortion, the variance over "
        "realisations holds both",
    )


def transient_score(each: ComplexArray, g: ComplexArray) -> float:
    """How alike neighbouring lines of ``Y_m - G U_m`` are, in standard deviations of chance.

    Noise and stochastic distortion are independent from line to line, the spectrum of a transient is
    smooth. Every product of neighbours has mean zero then and brings its own variance, so that lines
    may differ in noise.

    Parameters
    ----------
    each : (..., M, 2, F) complex
        Spectra [Y; U] of the realisations.
    g : (..., F) complex
        Mean response.

    Returns
    -------
    float
        The largest over the leading axes; NaN for fewer than two lines.
    """
    error = each[..., 0, :] - g[..., None, :] * each[..., 1, :]  # (..., M, F)
    product = np.real(error[..., 1:] * error[..., :-1].conj())
    with np.errstate(divide="ignore", invalid="ignore"):
        score = product.sum(axis=(-2, -1)) / np.sqrt(np.sum(product**2, axis=(-2, -1)))
    return float(np.max(score))
