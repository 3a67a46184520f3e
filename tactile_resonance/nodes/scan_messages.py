# SPDX-License-Identifier: Apache-2.0
"""Goal, feedback and result of the action `scan`, from and to messages."""

from __future__ import annotations

from tactile_resonance.action import Scan
from tactile_resonance.identification.result import Poles
from tactile_resonance.scan.goal import ScanGoal
from tactile_resonance.scan.progress import Progress, Summary
from tactile_resonance.scan.references import SensorHealth


def goal_of(message: Scan.Goal) -> ScanGoal:
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


def feedback_message(progress: Progress, run_directory: str) -> Scan.Feedback:
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


def fill_result(result: Scan.Result, summary: Summary) -> None:
    """Write how a scan ended."""
    result.outcome = Scan.Result.COMPLETE if summary.complete else Scan.Result.ENDED
    for name in (
        *("message", "done", "failed", "skipped", "blocks", "blocks_saved", "saved_s"),
        "repeats",
    ):
        setattr(result, name, getattr(summary, name))
    result.sensor_drifted = summary.health is SensorHealth.DRIFTED
    result.sensor_health = summary.health_sentence
