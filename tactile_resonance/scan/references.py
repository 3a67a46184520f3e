# SPDX-License-Identifier: Apache-2.0
"""Poles in free air before and after a scan: what points are compared with, and the sensor's health."""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.calibration.model import Calibration
from tactile_resonance.calibration.validity import Validity, check_in_air
from tactile_resonance.poles.result import MainMode, Poles
from tactile_resonance.recording.messages import poles_from_message
from tactile_resonance.scan.point_result import POLES_TYPE
from tactile_resonance.scan.recorded import last_poles
from tactile_resonance.scan.run_content import RunContent
from tactile_resonance.scan.scene import DriftLimits

SILENT, BEFORE, AFTER = "silent", "air-before", "air-after"
# A difference beyond so many of its standard deviations is no noise: once in 16 000.
_SIGNIFICANT = 4.0


class SensorHealth(str, Enum):
    """Whether the sensor has drifted between references."""

    UNKNOWN = "unknown"
    STEADY = "steady"
    DRIFTED = "drifted"


def relative_to_air(
    estimate: FloatArray, covariance: FloatArray, air: MainMode
) -> dict[str, Any]:
    """Compare f0 [Hz] and damping ratio (2,) of covariance (2, 2) with those in air.

    The two measurements are independent: variances add, those of the ratio to first order.

    Returns
    -------
    dict
        By the names of their fields in `PointResult`.
    """
    shift = estimate - air.estimate
    std = np.sqrt(np.diag(covariance) + np.diag(air.covariance))
    ratio = estimate[0] / air.estimate[0]
    relative = np.sqrt(
        covariance[0, 0] / estimate[0] ** 2 + air.covariance[0, 0] / air.estimate[0] ** 2
    )
    return {
        "f0_shift_hz": float(shift[0]),
        "f0_shift_std_hz": float(std[0]),
        "f0_over_air": float(ratio),
        "f0_over_air_std": float(ratio * relative),
        "damping_shift": float(shift[1]),
        "damping_shift_std": float(std[1]),
    }


def judge_drift(
    before: MainMode | None, after: MainMode | None, limits: DriftLimits
) -> tuple[SensorHealth, str]:
    """Whether the poles in air moved during the scan: beyond their uncertainty and beyond the limits.

    Returns
    -------
    health : SensorHealth
    sentence : str
        For people, with the figures.
    """
    missing = [name for name, r in (("before", before), ("after", after)) if r is None]
    if before is None or after is None:
        return (
            SensorHealth.UNKNOWN,
            f"sensor health unknown: no poles in air {' and '.join(missing)}",
        )
    change = after.estimate - before.estimate
    std = np.sqrt(np.diag(before.covariance) + np.diag(after.covariance))
    most = np.array([limits.f0_hz, limits.damping_ratio])
    figures = (
        f"f0 in air {before.estimate[0]:.3f} Hz before, changed by {change[0]:+.4f} +- {std[0]:.2g} Hz; "
        f"damping ratio {before.estimate[1]:.5f} before, changed by {change[1]:+.2g} +- {std[1]:.2g} "
        f"(limits {most[0]:g} Hz, {most[1]:g})"
    )
    if not np.all(np.isfinite(std)):
        return SensorHealth.UNKNOWN, f"sensor health unknown, no uncertainty in air: {figures}"
    if np.any((np.abs(change) > _SIGNIFICANT * std) & (np.abs(change) > most)):
        return (
            SensorHealth.DRIFTED,
            f"warning: the sensor drifted, poles relative to air are off by as much: {figures}",
        )
    return SensorHealth.STEADY, f"sensor steady: {figures}"


def read_reference(run: RunContent, name: str) -> MainMode | None:
    """Mode in air of a run's reference of a name, from the last poles of its file; None where there is none.

    Raises
    ------
    ValueError
        If its file is damaged.
    """
    found = _poles_of(run, name)
    return found.main if found is not None and found.main.found else None


def _poles_of(run: RunContent, name: str) -> Poles | None:
    found = None
    for path in run.paths(POLES_TYPE, reference=name):
        if (message := last_poles(path)) is not None:
            found, _ = poles_from_message(message)
    return found


def calibration_in_air(run: RunContent, calibration: Calibration) -> Validity:
    """A calibrated sensor against the poles in air that a run began with, in all its bands.

    Raises
    ------
    ValueError
        If the file of the reference is damaged.
    """
    found = _poles_of(run, BEFORE)
    modes = [] if found is None else [band.main for band in found.bands]
    return check_in_air(
        calibration, [mode.estimate for mode in modes], [mode.covariance for mode in modes]
    )


def sensor_health(run: RunContent, limits: DriftLimits) -> tuple[SensorHealth, str]:
    """Whether the sensor has drifted between the references of a run."""
    return judge_drift(read_reference(run, BEFORE), read_reference(run, AFTER), limits)
