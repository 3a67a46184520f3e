# SPDX-License-Identifier: Apache-2.0
"""FRF of one realisation from its mean spectra."""

from __future__ import annotations

import numpy as np

from tactile_resonance.frf.result import FRF, ComplexArray, FrfStatus
from tactile_resonance.frf.spectra import PeriodicSpectra, ratio_variance

WEAK_INPUT_DB = 10.0
"""Input signal-to-noise ratio of a mean spectrum below which Y/U is biased [dB]."""


def fast_frf(spectra: PeriodicSpectra, *, sample_rate_hz: float) -> FRF:
    """FRF and its noise variance from the mean spectra of one realisation.

    Parameters
    ----------
    spectra : PeriodicSpectra
        From `local_polynomial.LocalPolynomialPlan` (transient removed) or
        `spectra.averaged_spectra`.
    sample_rate_hz : float

    Returns
    -------
    FRF
        Status NO_COVARIANCE for a single period; SUSPECT where the input is too weak at a line for
        the ratio Y/U to be unbiased.

    Notes
    -----
    With noise on the input the ratio is biased and its variance formula too small where the mean
    input is not well above its noise: the relative bias is ``-exp(-|U|^2 / var U)`` for
    Gaussian noise, below 5e-5 at 10 dB (Pintelon & Schoukens 2012, chapter 2).
    """
    if spectra.spectra.shape[-1] != spectra.harmonics.size:
        raise ValueError(
            f"spectra: shape {spectra.spectra.shape}, expected (..., 2, {spectra.harmonics.size})"
        )
    variance = None
    if spectra.covariance is not None:
        variance = ratio_variance(spectra.spectra, spectra.covariance)
    status, message = response_status(spectra.spectra, spectra.covariance)
    return FRF(
        frequency_hz=spectra.frequency_hz(sample_rate_hz),
        g=response(spectra.spectra),
        variance_noise=variance,
        noise_dof=spectra.noise_dof,
        spectra=spectra.spectra,
        spectra_covariance=spectra.covariance,
        periods=spectra.periods,
        method=spectra.method,
        status=status,
        message=message,
    )


def response(spectra: ComplexArray) -> ComplexArray:
    """(..., F) Y/U of mean spectra (..., 2, F); NaN where there is no input."""
    u = spectra[..., 1, :]
    return spectra[..., 0, :] / np.where(u == 0, np.nan, u)


def response_status(
    spectra: ComplexArray, covariance: ComplexArray | None
) -> tuple[FrfStatus, str]:
    """Whether the ratio Y/U of mean spectra can be relied on.

    Parameters
    ----------
    spectra : (..., 2, F) complex
        [Y; U].
    covariance : (..., 2, 2, F) complex or None
        Noise covariance of these.
    """
    if covariance is None:
        return FrfStatus.NO_COVARIANCE, "one period of one realisation: no covariance"
    power = np.abs(spectra[..., 1, :]) ** 2  # (..., F)
    silent = int(np.count_nonzero(power == 0))
    if silent:
        return FrfStatus.SUSPECT, f"no input at {silent} of {power.size} lines: no response there"
    weak = power < 10 ** (WEAK_INPUT_DB / 10) * covariance[..., 1, 1, :].real
    if np.any(weak):
        return (
            FrfStatus.SUSPECT,
            f"input less than {WEAK_INPUT_DB:g} dB above its noise at {np.count_nonzero(weak)} of "
            f"{weak.size} lines: their response is biased",
        )
    return FrfStatus.OK, ""
