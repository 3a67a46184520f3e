# SPDX-License-Identifier: Apache-2.0
"""The file of a calibrated sensor, which `tactile_resonance calibrate` writes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.calibration.model import PER_MODE, SINGLE, Calibration, SensorModel
from tactile_resonance.fields import (
    check_above_zero,
    check_not_negative,
    known,
    read_dataclass,
    read_yaml,
    require,
)
from tactile_resonance.strict_yaml import dump_yaml

FORMAT = "tactile_resonance sensor calibration 1"
_HEADER = """\
# A calibrated sensor: `tactile_resonance calibrate` wrote this. Rows of `covariance`, entries of `determined`:
# those of natural_rad_s, damping_ratio, coupling_rad_s, tip_deflection (a mode each), feedthrough,
# leak_rad_s, gain, delay_s. What the records do not determine has a wide deviation, and is no statement.
"""


@dataclass(frozen=True, eq=False)
class CalibratedSensor:
    """Content of a file.

    Attributes
    ----------
    calibration : Calibration
    tip_radius_m : float
        Of the ball.
    tip_mass_kg, tip_mass_std_kg : float
        NaN where not determined.
    about : dict
        What else a reader should know: sensor, date, records.
    """

    calibration: Calibration
    tip_radius_m: float
    tip_mass_kg: float
    tip_mass_std_kg: float
    about: dict[str, Any]

    def as_text(self) -> str:
        """Content of the file."""
        made, model = self.calibration, self.calibration.model
        content = {
            "format": FORMAT,
            **self.about,
            "tip_radius_m": self.tip_radius_m,
            "tip_mass_kg": known(self.tip_mass_kg),
            "tip_mass_std_kg": known(self.tip_mass_std_kg),
            "band_hz": list(made.band_hz),
            "noise_v_per_root_hz": known(made.noise_v_per_root_hz),
            "excess": made.excess,
            "message": made.message,
            **{name: getattr(model, name).tolist() for name in (*PER_MODE, *SINGLE)},
            "determined": made.determined.tolist(),
            "covariance": made.covariance.tolist(),
        }
        return _HEADER + dump_yaml(content)


def read_calibration(path: Path) -> CalibratedSensor:
    """Read a file that `tactile_resonance calibrate` wrote.

    Parameters
    ----------
    path : path

    Raises
    ------
    ValueError
        If it cannot be read, or is something else; names field, value and what is accepted.
    """
    content = read_yaml(path)
    form = content.get("format")
    accepted = f"{FORMAT!r}, as tactile_resonance calibrate writes it"
    require(form == FORMAT, f"{path}: format", form, accepted)
    own = set(_File.__dataclass_fields__)
    file = read_dataclass(_File, {k: v for k, v in content.items() if k in own}, f"{path.name}:")
    about = {k: v for k, v in content.items() if k not in own and k != "format"}
    noise, mass_kg, mass_std_kg = (
        math.nan if value is None else value
        for value in (file.noise_v_per_root_hz, file.tip_mass_kg, file.tip_mass_std_kg)
    )
    calibration = Calibration(
        SensorModel(*(np.asarray(getattr(file, name)) for name in (*PER_MODE, *SINGLE))),
        file.covariance,
        np.array(file.determined),
        file.band_hz,
        noise,
        file.excess,
        file.message,
    )
    return CalibratedSensor(calibration, file.tip_radius_m, mass_kg, mass_std_kg, about)


@dataclass(frozen=True, eq=False)
class _File:
    tip_radius_m: float
    band_hz: tuple[float, float]
    noise_v_per_root_hz: float | None
    excess: float
    message: str
    natural_rad_s: FloatArray
    damping_ratio: FloatArray
    coupling_rad_s: FloatArray
    tip_deflection: FloatArray
    feedthrough: float
    leak_rad_s: float
    gain: float
    delay_s: float
    determined: tuple[bool, ...]
    covariance: FloatArray
    tip_mass_kg: float | None = None
    tip_mass_std_kg: float | None = None

    def __post_init__(self) -> None:
        check_above_zero(self, "tip_radius_m", "noise_v_per_root_hz", "excess", "gain")
        check_not_negative(self, "leak_rad_s")
        modes = self.natural_rad_s.size
        require(modes > 0, "natural_rad_s", [], "a list of one mode or more")
        for name in PER_MODE:
            of = getattr(self, name)
            require(of.shape == (modes,), name, of.tolist(), f"a list of {modes} numbers")
            good = name == "tip_deflection" or bool(np.all(of > 0))
            require(good, name, of.tolist(), "numbers above 0")
        rising = bool(np.all(np.diff(self.natural_rad_s) > 0))
        require(rising, "natural_rad_s", self.natural_rad_s.tolist(), "ascending frequencies")
        size = 4 * modes + 4
        require(len(self.determined) == size, "determined", len(self.determined), f"{size} entries")
        shape = self.covariance.shape
        require(shape == (size, size), "covariance", shape, f"{size} rows of {size} numbers")
        variances = np.diag(self.covariance)
        # what is all but uncorrelated differs by the rounding of an inverse
        rounding = 1e-6 * np.sqrt(np.outer(variances, variances))
        good = bool(np.all(variances >= 0))
        good = good and bool(np.all(np.abs(self.covariance - self.covariance.T) <= rounding))
        require(good, "covariance", "another matrix", "a symmetric one with variances, 0 or above")
