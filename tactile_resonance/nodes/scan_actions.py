# SPDX-License-Identifier: Apache-2.0
"""Actions `scan` and `calibrate_table`: goals, feedback and results as messages, and the work of the latter."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import BinaryIO

from rclpy.action.server import ServerGoalHandle

from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.nodes.scan_hands import NodeHands
from tactile_resonance.poles.result import Poles
from tactile_resonance.scan.goal import Frames, ScanGoal
from tactile_resonance.scan.hands import (
    Check,
    Interrupted,
    PointFailed,
    Progress,
    ScanEnded,
    Summary,
    Touch,
)
from tactile_resonance.scan.point_outcome import SensorHealth
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.table_calibration import (
    NOT_ESTIMATED,
    CalibrationRequest,
    TableCalibration,
    as_text,
    calibrate_table,
)
from tactile_resonance.sensor import sensor_named

# Fields of equal name in message and object.
SCAN_OPTIONS = (
    *("scene", "force_n", "f0_std_hz", "damping_ratio_std"),
    *("run_directory", "resume", "seed", "notes"),
)
SUMMARY = ("message", "done", "failed", "skipped", "blocks", "blocks_saved", "saved_s", "repeats")
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
    given = {name: getattr(message, name) for name in SCAN_OPTIONS}
    return ScanGoal(poses=poses, frame_id=message.poses.header.frame_id, **given)


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
    for name in SUMMARY:
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


def calibrate(
    goal: ServerGoalHandle,
    request: CalibrationRequest,
    hands: NodeHands,
    check: Check,
    frames: Frames,
    who: str,
) -> CalibrateTable.Result:
    """Touch, fit and save, in a thread of its own.

    Parameters
    ----------
    goal : ServerGoalHandle
    request : CalibrationRequest
        What it asks for, its file where it may be.
    hands : NodeHands
    check : callable
        Raises `Interrupted` where the goal is cancelled.
    frames : Frames
        With the table as it is known.
    who : str
        Made it, for the file.
    """
    radius_m = sensor_named(request.sensor).tip.radius_m
    feedback = CalibrateTable.Feedback(points=len(request.points_m), height_m=math.nan)

    def touch(point: ScanPoint) -> Touch:
        feedback.point = point.index
        goal.publish_feedback(feedback)
        found = hands.find(point, request.force_n, radius_m, check)
        feedback.height_m = found.ball_m[2] - radius_m
        return found

    result = no_table(CalibrateTable.Result.FAILED)
    file = None
    try:
        file = _new_file(request.file) if request.file else None
        hands.retract()
        made = calibrate_table(request, frames.table_in_base, radius_m, touch)
    except (PointFailed, ScanEnded, Interrupted) as error:
        result.message = str(error) or "cancelled"
        return result
    except ValueError as error:
        result.outcome, result.message = result.REFUSED, str(error)
        return result
    else:
        fill_calibration_result(result, made)
        if file is None:
            return result
        known = {
            "base_frame": frames.base,
            "table_frame": frames.table,
            "known_table_in_base": frames.table_in_base.vector.tolist(),
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "made_by": who,
        }
        try:
            file.write(as_text(made, request, known).encode())
            file.flush()
            os.fsync(file.fileno())
            result.file = request.file
        except OSError as error:
            result.message += f". NOT WRITTEN: {error}"
        return result
    finally:
        if file is not None:
            file.close()
            if not result.file:
                Path(request.file).unlink()


def _new_file(name: str) -> BinaryIO:
    """Open a new file before anything is touched; ``ValueError`` where there can be none."""
    path = Path(name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("xb")
    except OSError as error:
        accepted = f"a new file in a folder that can be written ({error.strerror})"
        raise ValueError(f"file: got {name!r}; accepted is {accepted}") from error
