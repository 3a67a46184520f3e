# SPDX-License-Identifier: Apache-2.0
"""Goals, feedback and results of the actions `scan` and `calibrate_table`, from and to messages."""

from __future__ import annotations

import math

from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.poles.result import Poles
from tactile_resonance.scan.goal import ScanGoal
from tactile_resonance.scan.progress import Progress, Summary
from tactile_resonance.scan.references import SensorHealth
from tactile_resonance.scan.table_calibration import CalibrationRequest, TableCalibration
from tactile_resonance.scan.table_file import NOT_ESTIMATED

CALIBRATION_OPTIONS = (
    *("force_n", "search_m", "flatness_m", "most_tilt_rad"),
    *("heading_rad", "sensor", "file"),
)


def scan_goal(message: Scan.Goal) -> ScanGoal:
    """What a message asks for, not checked yet."""
    poses = tuple(
        (p.position.x, p.position.y, p.position.z)
        + (p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w)
        for p in message.poses.poses
    )
    names = (
        *("scene", "force_n", "f0_std_hz", "damping_ratio_std"),
        *("run_directory", "resume", "seed", "notes"),
    )
    fields = {name: getattr(message, name) for name in names}
    return ScanGoal(poses=poses, frame_id=message.poses.header.frame_id, **fields)


def scan_feedback(progress: Progress, run_directory: str) -> Scan.Feedback:
    """Where a scan is, with the poles so far."""
    feedback = Scan.Feedback(
        run_directory=run_directory,
        waiting_for=progress.waiting_for,
        point=progress.point.index if progress.point else progress.finished,
        finished=progress.finished,
        points=progress.points,
        phase=progress.phase.value,
        blocks=progress.blocks,
        time_left_s=float(progress.time_left_s),
        repeats=progress.repeats,
    )
    mode = Poles().main if progress.poles is None else progress.poles.main
    feedback.f0_hz, feedback.damping_ratio = mode.estimate.tolist()
    feedback.f0_std_hz, feedback.damping_ratio_std = mode.std.tolist()
    return feedback


def fill_scan_result(result: Scan.Result, summary: Summary) -> None:
    """Write how a scan ended."""
    result.outcome = Scan.Result.COMPLETE if summary.complete else Scan.Result.ENDED
    for name in (
        *("message", "done", "failed", "skipped", "blocks", "blocks_saved", "saved_s"),
        "repeats",
    ):
        setattr(result, name, getattr(summary, name))
    result.sensor_drifted = summary.health is SensorHealth.DRIFTED
    result.sensor_health = summary.health_sentence


def calibration_request(message: CalibrateTable.Goal) -> CalibrationRequest:
    """What a goal asks for; ValueError where it is wrong."""
    given = {name: value for name in CALIBRATION_OPTIONS if (value := getattr(message, name))}
    points = tuple((point.x, point.y, point.z) for point in message.points)
    return CalibrationRequest(points, **given)


def no_table(outcome: int, message: str = "") -> CalibrateTable.Result:
    """Result without a table: no figure of it is known."""
    nan = math.nan
    return CalibrateTable.Result(
        outcome=outcome,
        message=message,
        table_in_base=[nan] * 6,
        height_m=nan,
        tilt_x_rad=nan,
        tilt_y_rad=nan,
        covariance=[nan] * 9,
        reduced_chi_square=nan,
    )


def fill_calibration_result(result: CalibrateTable.Result, made: TableCalibration) -> None:
    """Write a table that was found."""
    result.outcome = result.DONE
    result.message = f"{made}. {', '.join(NOT_ESTIMATED)}: as they were known"
    result.table_in_base = made.table_in_base.vector
    result.height_m, result.tilt_x_rad, result.tilt_y_rad = made.correction.tolist()
    result.covariance = made.covariance.ravel()
    result.residuals_m = made.residuals_m.tolist()
    result.std_m = made.std_m.tolist()
    result.reduced_chi_square = made.reduced_chi_square
