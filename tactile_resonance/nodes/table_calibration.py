# SPDX-License-Identifier: Apache-2.0
"""The work of the action `calibrate_table`."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import BinaryIO

from rclpy.action.server import ServerGoalHandle

from tactile_resonance.action import CalibrateTable
from tactile_resonance.nodes.scan_hands import NodeHands
from tactile_resonance.nodes.scan_messages import fill_calibration_result, no_table
from tactile_resonance.scan.goal import Frames
from tactile_resonance.scan.hands import Check, Interrupted, PointFailed, ScanEnded, Touch
from tactile_resonance.scan.scan_point import ScanPoint
from tactile_resonance.scan.table_calibration import (
    CalibrationRequest,
    calibrate_table,
)
from tactile_resonance.scan.table_file import as_text
from tactile_resonance.sensor import sensor_named


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
