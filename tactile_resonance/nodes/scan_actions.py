# SPDX-License-Identifier: Apache-2.0
"""Actions `scan` and `calibrate_table`: one goal at a time; goals, feedback and results as messages."""

from __future__ import annotations

import math
import time
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, fields
from typing import Any

from rclpy.action.server import ServerGoalHandle
from std_srvs.srv import Trigger

from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.nodes.managed_node import ManagedNode, end_goal, in_thread
from tactile_resonance.poles.result import Poles
from tactile_resonance.scan.failures import Interrupted, PointFailed, ScanEnded
from tactile_resonance.scan.goal import ScanGoal
from tactile_resonance.scan.hands import Controls, Progress, Request, Summary
from tactile_resonance.scan.table_calibration import (
    NOT_ESTIMATED,
    CalibrationRequest,
    TableCalibration,
)

AT_ONCE_S = 1.0
"""Goals rejected within this time of each other may be of two clients: the reasons of all are reported [s]."""
OF_ANOTHER = "; of another goal at that time: "
DONE = CalibrateTable.Result.DONE
"""Outcome of a goal that has succeeded, of a scan too."""
RUNNING = "a scan or a calibration is running, cancel it or wait for its result"


class OneGoal:
    """Several actions of one node, of which one goal at a time is worked at, in a thread of its own.

    Accepts, works at and ends goals; reports why the newest one was rejected.

    Parameters
    ----------
    node : ManagedNode
        Whose actions they are, until it is cleaned up, and whose service ``scan/rejection`` has the reason:
        rclpy has no place for it in its answer to a goal.
    around : callable
        Context of the work, entered and left in the executor's thread.

    Attributes
    ----------
    handle : ServerGoalHandle or None
        The goal that is worked at.
    controls : Controls or None
        What is asked of it; None where none is worked at.
    """

    def __init__(
        self, node: ManagedNode, around: Callable[[], AbstractContextManager[None]]
    ) -> None:
        self._node, self._around = node, around
        self.handle: ServerGoalHandle | None = None
        self.controls: Controls | None = None
        self._action = ""
        self._rejected: list[tuple[float, str]] = []  # when [s], and why; the newest first
        self._told = False
        node.serve(Trigger, "scan/rejection", self._on_rejection)

    def act(
        self,
        kind: type,
        name: str,
        check: Callable[[Any], Awaitable[Any]],
        work: Callable[[ServerGoalHandle, Any, Any], None],
        unknown: Callable[[], Any],
    ) -> None:
        """Offer an action.

        Parameters
        ----------
        kind : type
        name : str
        check : callable
            Awaited with the goal; raises ``ValueError`` or ``OSError`` where it is wrong.
        work : callable
            Called in a thread with the handle of the goal, what its check has returned and the result, to be
            filled in; what it raises is the result's message.
        unknown : callable
            Makes the result of a goal of which nothing came.
        """
        found: dict[int, Any] = {}  # by the check of a goal, by its message

        async def refuses(message: Any) -> bool:
            reason = ""
            try:
                self._require_free()
                checked = await check(message)
                self._require_free()
                found[id(message)] = checked
            except (ValueError, OSError) as error:
                reason = " ".join(str(error).split())
                self._node.get_logger().warning(f"goal rejected: {reason}")
            except Exception as error:  # else it ends the node
                reason = self._node.health.failed("goal", error)
            # who asks for the reason does not say of which goal: also those that nobody has asked for yet
            now_s = time.monotonic()
            others = [e for e in self._rejected if now_s - e[0] < AT_ONCE_S and e[1] != reason]
            self._rejected = [(now_s, reason)] if reason else []
            self._rejected += [] if self._told else others
            self._told = False
            return bool(reason)

        async def serve(goal: ServerGoalHandle) -> Any:
            checked, result = found.pop(id(goal.request)), unknown()
            if self.handle is not None:
                goal.abort()
                result.message = RUNNING
                return result
            self.handle, self.controls, self._action = goal, Controls(), name
            if goal.is_cancel_requested or not self._node.active:  # before there were controls
                self.cancel()

            def do() -> None:
                try:
                    work(goal, checked, result)
                except (ValueError, OSError, PointFailed, ScanEnded, Interrupted) as error:
                    result.message = str(error) or "cancelled"
                    self._node.health.error(result.message)
                except Exception as error:  # an answer without this would tell of a goal that is done
                    result.message = self._node.health.failed(name, error)

            try:
                with self._around():
                    await in_thread(self._node, do, "goal")
            finally:
                self.handle = self.controls = None
            end_goal(goal, result.outcome == DONE)
            return result

        self._node.act(kind, name, serve, lambda _: self.cancel(), refuses)

    def serve_control(self, name: str, ask: Callable[[Controls], None]) -> None:
        """Service ``ACTION/...`` that asks something of the goal of that action, where one is worked at."""
        action = name.partition("/")[0]

        def do() -> str:
            if self.controls is None or self._action != action:
                raise ValueError(f"no {action} is running")
            ask(self.controls)
            return ""

        self._node.serve_trigger(name, do)

    def cancel(self) -> None:
        """Cancel the goal that is worked at."""
        if self.controls is not None:
            self.controls.ask(Request.CANCEL)

    def forget_rejection(self) -> None:
        """From now on nothing was rejected."""
        self._rejected = []

    def _require_free(self) -> None:
        if self.handle is not None:
            raise ValueError(RUNNING)

    def _on_rejection(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._told, reasons = True, [reason for _, reason in self._rejected]
        response.success, response.message = bool(reasons), OF_ANOTHER.join(reasons)
        return response


def scan_goal(message: Scan.Goal) -> ScanGoal:
    """What a message asks for, not checked yet."""
    poses = tuple(
        (p.position.x, p.position.y, p.position.z)
        + (p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w)
        for p in message.poses.poses
    )
    names = [each.name for each in fields(ScanGoal) if each.name not in ("poses", "frame_id")]
    given = {name: getattr(message, name) for name in names}
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
    told = asdict(summary)
    result.outcome = Scan.Result.COMPLETE if told.pop("complete") else Scan.Result.ENDED
    for name, value in told.items():
        setattr(result, name, value)


def calibration_request(message: CalibrateTable.Goal) -> CalibrationRequest:
    """What a goal asks for; ValueError where it is wrong."""
    names = [each.name for each in fields(CalibrationRequest) if each.name != "points_m"]
    given = {name: value for name in names if (value := getattr(message, name))}
    points = tuple((point.x, point.y, point.z) for point in message.points)
    return CalibrationRequest(points, **given)


def no_table() -> CalibrateTable.Result:
    """Result without a table: no figure of it is known."""
    result = CalibrateTable.Result(outcome=CalibrateTable.Result.FAILED)
    result.table_in_base, result.covariance = [math.nan] * 6, [math.nan] * 9
    for name in ("height_m", "tilt_x_rad", "tilt_y_rad", "reduced_chi_square"):
        setattr(result, name, math.nan)
    return result


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
