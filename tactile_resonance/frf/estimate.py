# SPDX-License-Identifier: Apache-2.0
"""The FRF of a whole record: which estimator serves which record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.distortion import Distortion, nonlinear_distortion
from tactile_resonance.frf.fast import fast_frf
from tactile_resonance.frf.local_polynomial import LocalPolynomialPlan
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.robust import robust_frf
from tactile_resonance.frf.spectra import IntArray, PeriodicSpectra, averaged_spectra

METHODS = ("local polynomial", "average")


def estimate_frf(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    *,
    sample_rate_hz: float,
    harmonics: npt.ArrayLike,
    method: str = "local polynomial",
    order: int = 2,
    dof: int = 6,
) -> FRF:
    """FRF with the covariances that the record allows.

    Parameters
    ----------
    u, y : (..., M, P, N) float
        Actuator and sensor [V]: M realisations of P consecutive periods of N samples.
    sample_rate_hz : float
    harmonics : (F,) int
        Excited lines.
    method : {"local polynomial", "average"}
        How the transient is dealt with: estimated and removed, or waited for: ``average`` drops the
        first of three periods or more. A single period is taken as settled by either.
    order, dof : int
        See `local_polynomial.LocalPolynomialPlan`.

    Returns
    -------
    FRF
        ``variance_noise`` needs two periods used, ``variance_total`` two realisations; what is
        missing is None and said in the status. Mean spectra are given for one realisation only:
        those of several have different phases and no mean.

    Raises
    ------
    ValueError
        For another method, or shapes that do not fit.
    """
    spectra = _spectra(u, y, np.asarray(harmonics, np.int64), method, order, dof)
    if u.shape[-3] > 1:
        return robust_frf(spectra, sample_rate_hz=sample_rate_hz).frf
    return fast_frf(_only_realisation(spectra), sample_rate_hz=sample_rate_hz)


def estimate_distortion(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    *,
    sample_rate_hz: float,
    harmonics: npt.ArrayLike,
    method: str = "local polynomial",
    order: int = 2,
    dof: int = 6,
) -> Distortion:
    """Even and odd distortion at the lines of the excited band that are not excited.

    Parameters are those of `estimate_frf`; see `distortion.nonlinear_distortion`.

    Raises
    ------
    ValueError
        If an even line is excited or none is left out.
    """
    excited = np.asarray(harmonics, np.int64)
    band = np.arange(excited.min(), excited.max() + 1)
    spectra = _spectra(u, y, band, method, order, dof)
    return nonlinear_distortion(spectra, excited, sample_rate_hz=sample_rate_hz)


def _spectra(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    harmonics: IntArray,
    method: str,
    order: int,
    dof: int,
) -> PeriodicSpectra:
    """Mean spectra (..., M, 2, F) of each realisation."""
    if method not in METHODS:
        raise ValueError(f"method: {method!r}, accepted are {', '.join(METHODS)}")
    if u.ndim < 3 or u.shape != y.shape:
        raise ValueError(f"u, y: shapes {u.shape}, {y.shape}, expected the same (..., M, P, N)")
    periods, samples = u.shape[-2:]
    if periods > 1 and method == "local polynomial":
        return LocalPolynomialPlan(harmonics, samples, periods, order, dof)(u, y)
    unsettled = 1 if periods > 2 else 0
    return averaged_spectra(u, y, harmonics, unsettled_periods=unsettled)


def _only_realisation(spectra: PeriodicSpectra) -> PeriodicSpectra:
    covariance = spectra.covariance
    return replace(
        spectra,
        spectra=spectra.spectra[..., 0, :, :],
        covariance=None if covariance is None else covariance[..., 0, :, :, :],
    )
