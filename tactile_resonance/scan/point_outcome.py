# SPDX-License-Identifier: Apache-2.0
"""From what happened at a point to its result: poles, also against those in free air, tissue, time.

References in free air are taken before and after a scan: points are compared with the first, and both together
tell the sensor's health.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import Any

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.calibration.model import Calibration
from tactile_resonance.calibration.validity import Validity, check_in_air
from tactile_resonance.contact.goal import State
from tactile_resonance.fields import counted
from tactile_resonance.poles.result import MainMode, Poles
from tactile_resonance.record import Origin
from tactile_resonance.recording.messages import poles_from_message
from tactile_resonance.scan.decision import Decision
from tactile_resonance.scan.hands import Measured
from tactile_resonance.scan.point_result import (
    NAN,
    POLES_TYPE,
    PointOutcome,
    PointResult,
    band_results,
    mode_columns,
)
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.recorded import last_poles
from tactile_resonance.scan.run_content import RunContent, file_of
from tactile_resonance.scan.scene import DriftLimits, ScanScene
from tactile_resonance.tissue.classify import TissueClass, classify
from tactile_resonance.tissue.nominal_contact import ContactLoad, NominalContact, refer_to_nominal

SILENT, BEFORE, AFTER = "silent", "air-before", "air-after"
# A difference beyond so many of its standard deviations is no noise: once in 16 000.
_SIGNIFICANT = 4.0


def air_point(index: int) -> ScanPoint:
    """What is attempted for a reference in free air: at no place of the surface."""
    nowhere = (NAN, NAN, NAN)
    return ScanPoint(index, nowhere, nowhere, (0.0, 0.0, 0.0, 1.0), "air")


def attempt_at(point: ScanPoint, attempt: int, frame_id: str) -> PointResult:
    """Result of an attempt at a point, in a frame, of which nothing more is known yet."""
    names = ("x_m", "y_m", "z_m", "normal_x", "normal_y", "normal_z")
    where: dict[str, Any] = dict(zip(names, (*point.position_m, *point.normal), strict=True))
    return PointResult(point.index, attempt, point.label, frame_id=frame_id, **where)


def measured_result(
    attempt: PointResult,
    scene: ScanScene,
    measured: Measured,
    decision: Decision,
    air: MainMode | None = None,
) -> PointResult:
    """Result of an attempt that was measured; `FAILED` where there is no pole.

    Parameters
    ----------
    attempt : PointResult
    scene : ScanScene
        With the tissue classes.
    measured : Measured
    decision : Decision
        That ended the measurement.
    air : MainMode or None
        In free air, with which the poles are compared.
    """
    poles = measured.poles
    result = with_poles(
        replace(attempt, contact_age_s=measured.contact_age_s),
        poles,
        measured.origin,
        scene.tissue_classes,
        scene.unknown_level,
        nominal=scene.nominal_contact,
    )
    if air is not None:
        result = replace(result, **relative_to_air(result.estimate, result.covariance, air))
    return replace(
        result,
        outcome=PointOutcome.DONE if poles.main.found else PointOutcome.FAILED,
        reason=poles.message,
        blocks=decision.blocks,
        blocks_saved=decision.blocks_saved,
        verdict=decision.verdict.value,
        saved_s=decision.saved_s,
        distortion=measured.distortion,
    )


def with_poles(
    result: PointResult,
    poles: Poles,
    origin: Origin,
    classes: Sequence[TissueClass] = (),
    unknown_level: float = 0.01,
    nominal: NominalContact | None = None,
) -> PointResult:
    """The result with what poles say of its point; of several modes the one with the highest peak.

    Parameters
    ----------
    result : PointResult
        With the age of the contact, where that is known.
    poles : Poles
    origin : Origin
        Of the poles, with the force.
    classes : sequence of TissueClass
        Empty: no tissue is called.
    unknown_level : float
        See `classify`.
    nominal : NominalContact or None
        To which the classes refer.
    """
    contact, mode = origin.contact, poles.main
    result = replace(
        result,
        force_n=contact.force_n,
        force_std_n=contact.force_std_n,
        force_rms_n=contact.spread.rms_n,
        force_min_n=contact.spread.min_n,
        force_max_n=contact.spread.max_n,
        **mode_columns(mode.estimate, mode.covariance),
        f0_drift_hz_per_s=float(mode.drift[0]),
        f0_drift_std_hz_per_s=float(mode.drift_std[0]),
        damping_drift_per_s=float(mode.drift[1]),
        damping_drift_std_per_s=float(mode.drift_std[1]),
        pole_real_rad_s=mode.pole_rad_s.real,
        pole_imag_rad_s=mode.pole_rad_s.imag,
        cost=float(poles.cost),
        expected_cost=float(poles.expected_cost),
        poles_status=poles.status.value,
        further=band_results(poles),
        measurement_id=origin.measurement_id,
        simulated=origin.simulated,
    )
    if not (classes and mode.found):
        return result
    pressed = ContactLoad(contact.force_n, contact.force_std_n, result.contact_age_s)
    at = refer_to_nominal(mode.estimate, mode.covariance, pressed, nominal)
    call = classify(at.compared, at.covariance, classes, unknown_level)
    known = bool(np.all(np.isfinite(at.compared)))
    if at.referred:
        result = replace(result, **mode_columns(at.compared, at.covariance, "nominal_"))
    return replace(
        result,
        tissue_class=call.name,
        tissue_probability=call.probability,
        tissue_reason="; ".join(filter(None, [call.reason if known else "", at.note])),
    )


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


class SensorHealth(str, Enum):
    """Whether the sensor has drifted between references."""

    UNKNOWN = "unknown"
    STEADY = "steady"
    DRIFTED = "drifted"


def judge_drift(
    before: MainMode | None, after: MainMode | None, limits: DriftLimits
) -> tuple[SensorHealth, str]:
    """Whether the poles in air moved during the scan: beyond their uncertainty and beyond the limits.

    Steady is what neither changed by more than a limit nor is less certain than one.

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
    if np.any(np.maximum(std, np.abs(change)) > most):
        return SensorHealth.UNKNOWN, f"sensor health unknown, noise hides whether it drifted: {figures}"
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


def is_calibrated(run: RunContent) -> bool | None:
    """Whether poles_node had a calibration when a run began, as the first mode says; None: there is none.

    Poles through it name it as their method, others in their message.

    Raises
    ------
    ValueError
        If a file is damaged.
    """
    for path in run.paths(POLES_TYPE):
        poles = last_poles(path)
        if poles is not None and len(poles.f0_hz):
            return "calibrated sensor" in f"{poles.method}; {poles.message}"
    return None


def sensor_health(run: RunContent, limits: DriftLimits) -> tuple[SensorHealth, str]:
    """Whether the sensor has drifted between the references of a run.

    One that failed, or was damaged, is taken when the run is resumed: of points that were measured before the
    first, or after the last, it says nothing.
    """
    health, sentence = judge_drift(read_reference(run, BEFORE), read_reference(run, AFTER), limits)
    if health is not SensorHealth.STEADY:
        return health, sentence
    # by the order of the files: the clock may have been set meanwhile
    order = {file.name: place for place, file in enumerate(run.files)}
    first, last = (
        next(place for name, place in order.items() if name.endswith(f"-{of}.mcap"))
        for of in (BEFORE, AFTER)
    )
    done = [file_of(run.path, of) for of in run.latest if of.outcome is PointOutcome.DONE]
    if outside := sum(not first < order[file.name] < last for file in done):
        which = counted(outside, "point was", "points were")
        figures = sentence.partition(": ")[2]
        return (
            SensorHealth.UNKNOWN,
            f"sensor health unknown, {which} not measured between the references in air: {figures}",
        )
    return health, sentence


FIELD_OF = {
    State.TRAVEL.value: "travel_s",
    State.TARE.value: "tare_s",
    State.APPROACH.value: "approach_s",
    State.CONTACT.value: "press_s",
    State.SETTLE.value: "press_s",
    State.HOLD.value: "hold_s",
    State.RETRACT.value: "retract_s",
}
"""Of `PointResult`, by the state of a contact whose time it holds."""


class StateTimes:
    """Of one contact, from its states and the times at which each was seen."""

    def __init__(self) -> None:
        self._spent_ns: Counter[str] = Counter()
        self._before, self._since_ns = "", 0

    def take(self, state: str, time_ns: int) -> None:
        """The contact was in a state at a time; until then in the one before."""
        field = FIELD_OF.get(self._before)
        if field is not None and time_ns > self._since_ns:
            self._spent_ns[field] += time_ns - self._since_ns
        self._before, self._since_ns = state, time_ns

    @property
    def fields(self) -> dict[str, float]:
        """As fields of `PointResult` [s]; empty where no state was seen."""
        if not self._spent_ns:
            return {}
        return {name: 1e-9 * self._spent_ns[name] for name in FIELD_OF.values()}


PARTS = {
    "vibration": "vibration_s",
    "waiting in contact": "",
    "contact until ready": "press_s",
    "approach": "approach_s",
    "rest for the tare": "tare_s",
    "travel": "travel_s",
    "drawing back": "retract_s",
    "tests, requests and answers": "",
}
"""What `duration_s` is made of, and the field that holds it; empty: what is left."""
BETWEEN = "between points"


def time_budget(results: Iterable[PointResult]) -> Mapping[str, np.ndarray]:
    """Parts of the time of each measured point whose contact was seen [s], (n,) by their name for people."""
    known = [
        r for r in results if r.outcome is PointOutcome.DONE and np.isfinite(r.travel_s + r.hold_s)
    ]

    def of(field: str) -> np.ndarray:
        return np.array([getattr(result, field) for result in known])

    told = {name: of(field) for name, field in PARTS.items() if field}
    told["waiting in contact"] = of("hold_s") - of("vibration_s")
    in_contact = sum((of(name) for name in dict.fromkeys(FIELD_OF.values())), np.zeros(len(known)))
    told["tests, requests and answers"] = of("duration_s") - in_contact
    return {**{name: told[name] for name in PARTS}, BETWEEN: np.nan_to_num(of("between_s"))}


def budget_sentence(results: Iterable[PointResult]) -> str:
    """Mean time of a point and its parts, the longest first; empty where none is known."""
    budget = time_budget(results)
    mean_s = {name: float(np.mean(each)) for name, each in budget.items() if each.size}
    if not mean_s:
        return ""
    parts = sorted(mean_s.items(), key=lambda part: -part[1])
    named = ", ".join(f"{name} {seconds:.2f}" for name, seconds in parts if seconds >= 0.005)
    return f"A point took {sum(mean_s.values()):.2f} s (mean): {named}."
