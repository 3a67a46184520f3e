# SPDX-License-Identifier: Apache-2.0
"""What is known of one sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.calibration.model import FloatArray, SensorModel, parameter_names


@dataclass(frozen=True, eq=False)
class Calibration:
    """Parameters of one sensor, with what is known of them.

    Attributes
    ----------
    model : SensorModel
    covariance : (p, p) float
        Of `SensorModel.values`.
    determined : (p,) bool
        Which the records determine; the others keep a value and a wide deviation.
    band_hz : (float, float)
        First and last line in air.
    noise_v_per_root_hz : float
        Of the sensor channel, one-sided; NaN where unknown.
    excess : float
        Mean square of the residuals over that of noise, of the record where it is largest; 1 where none is
        larger.
    message : str
        What a reader should know; empty where there is nothing to say.
    """

    model: SensorModel
    covariance: FloatArray
    determined: npt.NDArray[np.bool_]
    band_hz: tuple[float, float]
    noise_v_per_root_hz: float
    excess: float
    message: str = ""

    @property
    def std(self) -> FloatArray:
        """(p,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) of the parameters."""
        return parameter_names(self.model.modes)

    def knows_tip(self, modes: int = 2) -> bool:
        """Whether the first mode shapes at the tip are determined, without which no contact is."""
        n = self.model.modes
        return bool(self.determined[3 * n : 3 * n + min(modes, n)].all())
