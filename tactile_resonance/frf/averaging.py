# SPDX-License-Identifier: Apache-2.0
"""FRF by averaging settled periods: the plainest estimate, and the one for records without transient."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft

from tactile_resonance.frf.result import FRF, ComplexArray, FloatArray, FrfStatus


def period_spectra(
    samples: npt.NDArray[np.floating], harmonics: npt.NDArray[np.int64]
) -> ComplexArray:
    """Spectrum of each period at the given harmonics.

    Parameters
    ----------
    samples : (..., N) float
    harmonics : (F,) int

    Returns
    -------
    (..., F) complex
        ``X[k] = (1/N) sum_n x[n] exp(-j 2 pi k n / N)``; single precision stays single.
    """
    return scipy.fft.rfft(samples, axis=-1, norm="forward")[..., harmonics]


def average_periods(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    *,
    sample_rate_hz: float,
    harmonics: npt.NDArray[np.int64],
    unsettled_periods: int = 1,
) -> FRF:
    """FRF from the mean spectra over the settled periods of each realisation.

    Parameters
    ----------
    u, y : (..., M, P, N) float
        Actuator and sensor [V]: M realisations of P consecutive periods of N samples.
    sample_rate_hz : float
    harmonics : (F,) int
        Excited lines.
    unsettled_periods : int
        Periods dropped at the start of each realisation because the transient has not died out.

    Returns
    -------
    FRF
        ``variance_noise`` needs two settled periods, ``variance_total`` two realisations; what is missing
        is None and said in the status. Mean spectra are given for one realisation only: those of several
        have different phases and no mean.

    Raises
    ------
    ValueError
        If nothing is left after dropping `unsettled_periods`.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    sections 2.5 (variance of the FRF) and 4.3.1 (robust method).
    """
    realisations, periods = u.shape[-3:-1]
    if not 0 <= unsettled_periods < periods:
        raise ValueError(
            f"unsettled_periods: {unsettled_periods}, accepted is 0..{periods - 1} "
            f"({periods} periods were recorded)"
        )
    used = periods - unsettled_periods
    per_period = np.stack(
        [period_spectra(x[..., unsettled_periods:, :], harmonics) for x in (y, u)], axis=-3
    )  # (..., M, 2, P', F), rows [Y; U]
    mean = per_period.mean(axis=-2)  # (..., M, 2, F)
    covariance = None
    noise_dof = 0
    if used > 1:
        deviation = per_period - mean[..., None, :]  # (..., M, 2, P', F)
        covariance = np.einsum(
            "...ipf,...jpf->...ijf", deviation, deviation.conj(), optimize=True
        ) / (used * (used - 1))  # (..., M, 2, 2, F), covariance of the mean
        noise_dof = realisations * (used - 1)
    g, variance_noise, variance_total = combine_realisations(mean, covariance)
    single = realisations == 1
    return FRF(
        frequency_hz=harmonics * (sample_rate_hz / u.shape[-1]),
        g=g,
        variance_noise=variance_noise,
        variance_total=variance_total,
        noise_dof=noise_dof,
        total_dof=realisations - 1,
        spectra=mean[..., 0, :, :] if single else None,
        spectra_covariance=covariance[..., 0, :, :, :]
        if single and covariance is not None
        else None,
        periods=used,
        realisations=realisations,
        method=f"mean of {used} settled of {periods} periods",
        **_status(used, realisations),
    )


def combine_realisations(
    mean: ComplexArray, covariance: ComplexArray | None
) -> tuple[ComplexArray, FloatArray | None, FloatArray | None]:
    """FRF of several realisations from their mean spectra.

    Parameters
    ----------
    mean : (..., M, 2, F) complex
        Mean spectra [Y; U] of each realisation.
    covariance : (..., M, 2, 2, F) complex or None
        Noise covariance of these means.

    Returns
    -------
    g : (..., F) complex
        Mean over realisations of Y/U.
    variance_noise, variance_total : (..., F) float or None
        Of `g`; the first needs `covariance`, the second two realisations.
    """
    realisations = mean.shape[-3]
    g_each = mean[..., 0, :] / mean[..., 1, :]  # (..., M, F)
    g = g_each.mean(axis=-2)
    variance_noise = None
    if covariance is not None:
        variance_noise = ratio_variance(mean, covariance).mean(axis=-2) / realisations
    variance_total = None
    if realisations > 1:
        variance_total = np.var(g_each, axis=-2, ddof=1) / realisations
    return g, variance_noise, variance_total


def ratio_variance(mean: ComplexArray, covariance: ComplexArray) -> FloatArray:
    """Variance of Y/U, to first order in the noise.

    Parameters
    ----------
    mean : (..., 2, F) complex
        [Y; U].
    covariance : (..., 2, 2, F) complex

    Returns
    -------
    (..., F) float
        ``|Y/U|^2 (C_YY/|Y|^2 + C_UU/|U|^2 - 2 Re(C_YU / (Y conj U)))``, written without dividing by Y
        (Pintelon & Schoukens 2012, eq. 2-31).
    """
    u = mean[..., 1, :]
    g = mean[..., 0, :] / u
    return (
        covariance[..., 0, 0, :].real
        + np.abs(g) ** 2 * covariance[..., 1, 1, :].real
        - 2 * np.real(covariance[..., 0, 1, :] * g.conj())
    ) / np.abs(u) ** 2


def _status(used: int, realisations: int) -> dict:
    if used > 1:
        return {"status": FrfStatus.OK, "message": ""}
    if realisations > 1:
        return {
            "status": FrfStatus.OK,
            "message": "one settled period per realisation: noise cannot be told from distortion, "
            "the variance over realisations holds both",
        }
    return {
        "status": FrfStatus.NO_COVARIANCE,
        "message": "one settled period of one realisation: no covariance",
    }
