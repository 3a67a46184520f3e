# SPDX-License-Identifier: Apache-2.0
"""The mode that a map shows: of several identified ones that with the highest peak."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.result import Poles

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MainMode:
    """One mode.

    Attributes
    ----------
    estimate : (2,) float
        f0 [Hz] and damping ratio; NaN where no pole was found.
    noise, total : (2, 2) float or None
        Covariance of the estimate from noise, and in total; None where unknown.
    pole_rad_s : complex
        With positive imaginary part.
    drift, drift_std : (2,) float
        What f0 [Hz/s] and damping ratio [1/s] change by, and its deviation; NaN where no change shows.
    """

    estimate: FloatArray
    noise: FloatArray | None
    total: FloatArray | None
    pole_rad_s: complex
    drift: FloatArray
    drift_std: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """(2, 2) of the estimate, total where known, else from noise; NaN where neither is."""
        for known in (self.total, self.noise):
            if known is not None and np.all(np.isfinite(known)):
                return known
        return np.full((2, 2), np.nan)

    @property
    def found(self) -> bool:
        """Whether there is a pole."""
        return bool(np.isfinite(self.estimate[0]))


def main_mode(poles: Poles) -> MainMode:
    """Mode with the highest peak, |residue| / |Re pole|."""
    drift, drift_std = np.full(2, np.nan), np.full(2, np.nan)
    if not poles.f0_hz.size:
        return MainMode(np.full(2, np.nan), None, None, complex("nan+nanj"), drift, drift_std)
    k = int(np.argmax(np.abs(poles.residues) / np.abs(poles.poles_rad_s.real)))
    noise, total = (
        None if known is None else known[k] for known in (poles.covariance, poles.total_covariance)
    )
    estimate = np.array([poles.f0_hz[k], poles.damping_ratio[k]])
    drifts = (poles.f0_drift_hz_per_s, poles.damping_drift_per_s)
    if drifts[0] is not None and drifts[1] is not None and poles.drift_covariance is not None:
        drift = np.array([drifts[0][k], drifts[1][k]])
        drift_std = np.sqrt(np.diag(poles.drift_covariance[k]))
    return MainMode(estimate, noise, total, complex(poles.poles_rad_s[k]), drift, drift_std)
