# SPDX-License-Identifier: Apache-2.0
"""FRF smoothed over neighbouring excited lines: total variance from a single realisation."""

from __future__ import annotations

import numpy as np

from tactile_resonance.frf.fast import response_status
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import PeriodicSpectra


def smoothed_frf(
    spectra: PeriodicSpectra, *, sample_rate_hz: float, order: int = 2, dof: int = 6
) -> FRF:
    """FRF from a polynomial in frequency over the nearest excited lines, for each line.

    Around each line ``Y = U (g_0 + g_1 r + ... + g_R r^R)`` is fitted by least squares, r the
    offset in harmonics. Its residuals hold noise and, with random phases, stochastic nonlinear
    distortion: their variance gives the total variance without a second realisation. The price is
    a bias where the response is no polynomial over the window (resonances sharper than some ten
    lines): the robust method has none.

    Parameters
    ----------
    spectra : PeriodicSpectra
        Of random-phase multisines, transient removed; spectra (..., 2, F).
    sample_rate_hz : float
    order : int
        Order R of the polynomial.
    dof : int
        Degrees of freedom of the total variance, at least.

    Returns
    -------
    FRF
        With `variance_noise` (None where the noise is unknown) and `variance_total` of the
        smoothed response; lines nearer than the window are correlated. `spectra` are not smoothed
        and therefore not given.

    Raises
    ------
    ValueError
        If there are fewer lines than one window needs.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 7 (local polynomial method over the excited lines).
    """
    lines = spectra.harmonics.size
    half = -(-(dof + order) // 2)  # 2 half + 1 lines, order + 1 of them spent on the polynomial
    width = 2 * half + 1
    if order < 0 or dof < 1 or lines < width:
        raise ValueError(
            f"order, dof: {order}, {dof} need {width} excited lines, there are {lines}"
        )
    first = np.clip(np.arange(lines) - half, 0, lines - width)
    window = first[:, None] + np.arange(width)  # (F, W)
    offset = (spectra.harmonics[window] - spectra.harmonics[:, None]) / half
    powers = offset[..., None] ** np.arange(order + 1)  # (F, W, R + 1)
    y, u = spectra.spectra[..., 0, :], spectra.spectra[..., 1, :]  # (..., F)
    regressor = u[..., window][..., None] * powers  # (..., F, W, R + 1)
    q, r = np.linalg.qr(regressor)
    projected = q.conj().swapaxes(-1, -2) @ y[..., window][..., None]  # (..., F, R + 1, 1)
    inverse = np.linalg.inv(r)  # (..., F, R + 1, R + 1)
    g = (inverse[..., :1, :] @ projected)[..., 0, 0]  # (..., F)
    gain = np.sum(np.abs(inverse[..., 0, :]) ** 2, axis=-1)  # (..., F) var G for unit noise on Y
    residual = y[..., window] - (q @ projected)[..., 0]  # (..., F, W)
    residual_dof = width - order - 1
    total = np.sum(np.abs(residual) ** 2, axis=-1) / residual_dof
    noise = None
    if spectra.covariance is not None:
        c = spectra.covariance
        noise = gain * (
            c[..., 0, 0, :].real
            + np.abs(g) ** 2 * c[..., 1, 1, :].real
            - 2 * np.real(c[..., 0, 1, :] * g.conj())
        )
    status, message = response_status(spectra.spectra, spectra.covariance)
    return FRF(
        frequency_hz=spectra.frequency_hz(sample_rate_hz),
        g=g,
        variance_noise=noise,
        variance_total=gain * total,
        noise_dof=spectra.noise_dof,
        total_dof=residual_dof,
        periods=spectra.periods,
        method=f"{spectra.method}, smoothed over {width} lines",
        status=status,
        message=message,
    )
