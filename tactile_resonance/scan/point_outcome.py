# SPDX-License-Identifier: Apache-2.0
"""From what happened at a point to its result."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from tactile_resonance.scan.decision import Decision
from tactile_resonance.scan.hands import Measured
from tactile_resonance.scan.point_result import NAN, PointOutcome, PointResult
from tactile_resonance.scan.pole_map import MapPoint, map_point
from tactile_resonance.scan.references import AirReference, relative_to_air
from tactile_resonance.scan.scan_point import ScanPoint
from tactile_resonance.scan.scene import ScanScene


def air_point(index: int) -> ScanPoint:
    """What is attempted for a reference in free air: at no place of the surface."""
    nowhere = (NAN, NAN, NAN)
    return ScanPoint(index, nowhere, nowhere, (0.0, 0.0, 0.0, 1.0), "air")


def measured_result(
    point: ScanPoint,
    attempt: int,
    scene: ScanScene,
    measured: Measured,
    decision: Decision,
    *,
    time_ns: int,
    duration_s: float,
    air: AirReference | None = None,
    notes: str = "",
) -> PointResult:
    """Result of a point that was measured; `FAILED` where there is no pole.

    Parameters
    ----------
    measured : Measured
        Its origin must state where the tip was.
    decision : Decision
        That ended the measurement.
    air : AirReference or None
        What the poles are compared with.
    time_ns : int
        When the point was finished (UNIX time) [ns].
    duration_s : float
        From the move to the point until the tip was free again [s].
    """
    poles, origin = measured.poles, measured.origin
    found = map_point(
        poles,
        origin,
        scene.tissue_classes,
        nominal=scene.nominal_contact,
        age_s=measured.contact_age_s,
    )
    mode = poles.main
    std = found.std
    relative = {} if air is None else asdict(relative_to_air(found.estimate, found.covariance, air))
    blank = unmeasured_result(
        point,
        attempt,
        scene,
        PointOutcome.FAILED if found.failed else PointOutcome.DONE,
        poles.message,
        time_ns=time_ns,
        duration_s=duration_s,
        notes=notes,
    )
    return replace(
        blank,
        force_n=origin.contact.force_n,
        force_std_n=origin.contact.force_std_n,
        force_rms_n=origin.contact.spread.rms_n,
        force_min_n=origin.contact.spread.min_n,
        force_max_n=origin.contact.spread.max_n,
        contact_age_s=measured.contact_age_s,
        f0_hz=float(found.estimate[0]),
        f0_std_hz=float(std[0]),
        damping_ratio=float(found.estimate[1]),
        damping_ratio_std=float(std[1]),
        f0_damping_covariance_hz=float(found.covariance[0, 1]),
        **_nominal(found),
        **relative,
        f0_drift_hz_per_s=float(mode.drift[0]),
        f0_drift_std_hz_per_s=float(mode.drift_std[0]),
        damping_drift_per_s=float(mode.drift[1]),
        damping_drift_std_per_s=float(mode.drift_std[1]),
        pole_real_rad_s=mode.pole_rad_s.real,
        pole_imag_rad_s=mode.pole_rad_s.imag,
        cost=float(poles.cost),
        expected_cost=float(poles.expected_cost),
        poles_status=poles.status.value,
        tissue_class=found.tissue_class,
        tissue_probability=found.tissue_probability,
        tissue_reason=found.tissue_reason,
        blocks=decision.blocks,
        blocks_saved=decision.blocks_saved,
        verdict=decision.verdict.value,
        saved_s=decision.saved_s,
        measurement_id=origin.measurement_id,
        simulated=origin.simulated,
    )


def _nominal(found: MapPoint) -> dict[str, Any]:
    """Fields of the pole at the nominal force and age; none where it could not be referred to them."""
    at = found.for_tissue
    if at is None or not at.referred:
        return {}
    std = np.sqrt(np.diag(at.covariance))
    return {
        "nominal_f0_hz": float(at.compared[0]),
        "nominal_f0_std_hz": float(std[0]),
        "nominal_damping_ratio": float(at.compared[1]),
        "nominal_damping_ratio_std": float(std[1]),
        "nominal_f0_damping_covariance_hz": float(at.covariance[0, 1]),
    }


def unmeasured_result(
    point: ScanPoint,
    attempt: int,
    scene: ScanScene,
    outcome: PointOutcome,
    reason: str,
    *,
    time_ns: int,
    duration_s: float,
    notes: str = "",
) -> PointResult:
    """Result of an attempt without poles that count: it failed, was skipped or is discarded."""
    x_m, y_m, z_m = point.position_m
    normal_x, normal_y, normal_z = point.normal
    return PointResult(
        point.index,
        attempt,
        point.label,
        outcome,
        reason,
        *(x_m, y_m, z_m, normal_x, normal_y, normal_z),
        duration_s=duration_s,
        notes=notes,
        time_ns=time_ns,
        frame_id=scene.frame_id,
    )
