# SPDX-License-Identifier: Apache-2.0
"""Scans: from a scene to a run directory with every point in it."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

from rclpy.action.server import ServerGoalHandle
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.fields import require
from tactile_resonance.nodes.frames import BROADCAST_TF, broadcast_fixed, look_up
from tactile_resonance.nodes.managed_node import (
    HUNG_AFTER,
    TIME_SERVER,
    ManagedNode,
    end_goal,
    in_thread,
)
from tactile_resonance.nodes.parameters import Fixed, Parameter, pose_of, values
from tactile_resonance.nodes.running import POINT_RESULTS
from tactile_resonance.nodes.scan_actions import (
    calibrate,
    calibration_request,
    fill_scan_result,
    no_table,
    scan_feedback,
    scan_goal,
)
from tactile_resonance.nodes.scan_hands import NodeHands
from tactile_resonance.nodes.scan_time import ScanTime
from tactile_resonance.scan.goal import Frames, GoalFiles, named_frames, resumed_run
from tactile_resonance.scan.hands import (
    Controls,
    Interrupted,
    Phase,
    PointFailed,
    Progress,
    Request,
    ScanEnded,
)
from tactile_resonance.scan.point_result import TOPIC
from tactile_resonance.scan.recorded import recorded_results
from tactile_resonance.scan.run_start import UNCHECKED, new_run, start_run
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.table_calibration import CalibrationRequest

PARAMETERS = (
    Fixed(
        "contact",
        "robot",
        "What brings the tip to the tissue: contact_node, or nothing (the tip is taken to be where the plan "
        "states, and its pose is published).",
        choices=("robot", "none"),
    ),
    Fixed(
        "table_in_base",
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        "The table in the robot's base: position [m] and rotation vector [rad].",
    ),
    Fixed(
        "table_frame",
        "table",
        "Frame of the table: of poses without a scene, and of scenes that name none.",
    ),
    Fixed("base_frame", "base", "Frame of the robot's base."),
    BROADCAST_TF,
    Fixed(
        "run_folder",
        "",
        "Folder of the runs that name none; empty: tactile_resonance/runs in $ROS_HOME (~/.ros where "
        "that is not set).",
    ),
    Fixed(
        "goal_folders",
        [""],
        "Folders in which files and run folders of goals may be, beside the package's scenes and run_folder; "
        "/ for any.",
    ),
    Parameter("seed", 1, "Seed of the phases of the first point.", 1, 2**62),
    TIME_SERVER,
    HUNG_AFTER,
)

RUNNING = "a scan or a calibration is running, cancel it or wait for its result"
FEEDBACK_EVERY_S = 0.2
CONTROLS = {
    "scan/pause": lambda controls: controls.paused.set(),
    "scan/resume": lambda controls: controls.paused.clear(),
    "scan/skip_point": lambda controls: controls.ask(Request.SKIP),
    "scan/repeat_point": lambda controls: controls.ask(Request.REPEAT),
}


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
        self._asked = self._rejection = ""
        node.serve(Trigger, "scan/rejection", self._on_rejection)

    def act(
        self,
        kind: type,
        name: str,
        check: Callable[[Any], Awaitable[Any]],
        work: Callable[[ServerGoalHandle, Any], Any],
        done: int,
        busy: Any,
    ) -> None:
        """Offer an action.

        Parameters
        ----------
        kind : type
        name : str
        check : callable
            Awaited with the goal; raises ``ValueError`` or ``OSError`` where it is wrong.
        work : callable
            Called in a thread with the handle of the goal and what its check has returned; returns the result.
        done : int
            The result's field ``outcome`` of a goal that has succeeded.
        busy : message
            Result of a goal that was accepted beside another one.
        """
        found: dict[int, Any] = {}  # by the check of a goal, by its message

        async def refuses(message: Any) -> bool:
            self._asked = asked = str(message)
            reason = ""
            try:
                self._require_free()
                checked = await check(message)
                self._require_free()
                found[id(message)] = checked
            except (ValueError, OSError) as error:
                reason = " ".join(str(error).split())
                self._node.get_logger().warning(f"goal rejected: {reason}")
            if self._asked == asked:  # no other came while this one was checked
                self._rejection = reason
            return bool(reason)

        async def serve(goal: ServerGoalHandle) -> Any:
            checked = found.pop(id(goal.request))
            if self.handle is not None:
                goal.abort()
                return busy
            self.handle, self.controls = goal, Controls()
            if goal.is_cancel_requested or not self._node.active:  # before there were controls
                self.cancel()
            try:
                with self._around():
                    result = await in_thread(self._node, lambda: work(goal, checked), "goal")
            finally:
                self.handle = self.controls = None
            end_goal(goal, result.outcome == done)
            return result

        self._node.act(kind, name, serve, lambda _: self.cancel(), refuses)

    def serve_control(self, name: str, ask: Callable[[Controls], None]) -> None:
        """Service that asks something of the goal that is worked at."""

        def do() -> str:
            if self.controls is None:
                raise ValueError("no scan is running")
            ask(self.controls)
            return ""

        self._node.serve_trigger(name, do)

    def cancel(self) -> None:
        """Cancel the goal that is worked at."""
        if self.controls is not None:
            self.controls.ask(Request.CANCEL)

    def forget_rejection(self) -> None:
        """From now on nothing was rejected."""
        self._rejection = ""

    def _require_free(self) -> None:
        if self.handle is not None:
            raise ValueError(RUNNING)

    def _on_rejection(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = bool(self._rejection), self._rejection
        return response


class ScanNode(ManagedNode):
    """Actions `scan` and `calibrate_table`; services `pause`, `resume`, `skip_point`, ... of `scan/`.

    Publishes `point_result` (latched).
    """

    def __init__(self) -> None:
        super().__init__("scan_node", PARAMETERS)
        self._progress: Progress | None = None

    def configure(self) -> None:
        """Offer the actions; the topics are subscribed to when a scan begins."""
        names = ("table_in_base", "table_frame", "base_frame")
        table, table_frame, base_frame = values(self, *names)
        self._frames = Frames(table_frame, base_frame, pose_of(table, "table_in_base"))
        self._time = ScanTime(self.time_server, self.hung_after_s)
        self._hands = NodeHands(self, self._time, self._tell_waiting)
        broadcast_fixed(self, base_frame, {table_frame: self._frames.table_in_base})
        self._files = GoalFiles(*values(self, "run_folder", "goal_folders"))
        self._results = self.publish_on(msg.PointResult, TOPIC, POINT_RESULTS)
        self._run_directory = ""
        self._told: tuple[Phase, str, float] | None = None
        goals = self._goals = OneGoal(self, self._hands.listening)
        for name, ask in CONTROLS.items():
            goals.serve_control(name, ask)
        done, busy = Scan.Result.COMPLETE, Scan.Result(outcome=Scan.Result.REFUSED, message=RUNNING)
        goals.act(Scan, "scan", self._check_scan, self._scan, done, busy)
        done, busy = CalibrateTable.Result.DONE, no_table(CalibrateTable.Result.FAILED, RUNNING)
        check = self._check_calibration
        goals.act(CalibrateTable, "calibrate_table", check, self._calibrate, done, busy)

    def deactivate(self) -> None:
        """End the scan after retracting; its points stay finished."""
        self._goals.forget_rejection()
        self._goals.cancel()

    def details(self) -> dict[str, str]:
        """The scan under way."""
        progress = self._progress
        if progress is None:
            return {}
        return {
            "phase": progress.phase.value,
            "points": f"{progress.finished} of {progress.points}",
        }

    async def _check_scan(self, message: Scan.Goal) -> Frames:
        """Frames as they stand now, for a goal that is in order."""
        goal, frames = self._files.checked(scan_goal(message)), self._frames
        if goal.resume:
            resumed_run(goal)
            return frames
        stamp = message.poses.header.stamp
        good = stamp.sec >= 0 and stamp.nanosec < 1_000_000_000
        require(good, "poses.header.stamp", (stamp.sec, stamp.nanosec), "a time, or 0")
        poses, missing = await look_up(self, frames.base, named_frames(goal, frames), stamp)
        frames = replace(frames, others=poses, no_others=missing)
        new_run(goal, frames, self._files, forces=self._hands.free_air)
        return frames

    async def _check_calibration(self, message: CalibrateTable.Goal) -> CalibrationRequest:
        accepted = "robot: a table is calibrated by touch"
        require(self._hands.free_air, "contact", "none", accepted)
        request = calibration_request(message)
        if request.file:
            path = self._files.to_write(request.file, "file")
            require(not os.path.lexists(path), "file", str(path), "a new file")
            request = replace(request, file=str(path))
        return request

    # in the thread of a goal

    def _calibrate(
        self, goal: ServerGoalHandle, request: CalibrationRequest
    ) -> CalibrateTable.Result:
        who = f"{self.get_fully_qualified_name()} on {socket.gethostname()}"
        who += ", simulated" if self.time_server else ""
        check = self._goals.controls.check_cancelled
        self._hands.frame_in_base = self._frames.table_in_base
        with self._time.conducted():
            self._hands.meet()
            result = calibrate(goal, request, self._hands, check, self._frames, who)
        if result.outcome != result.DONE:
            self.health.error(result.message)
        return result

    def _scan(self, goal: ServerGoalHandle, frames: Frames) -> Scan.Result:
        result = Scan.Result(outcome=Scan.Result.REFUSED)
        try:
            with self._time.conducted():
                self._hands.meet()
                self._run(goal, frames, result)
        except (ValueError, OSError, PointFailed, ScanEnded, Interrupted) as error:
            result.message = str(error) or "cancelled before the first point"
            self.health.error(result.message)
        finally:
            self._progress, self._told, self._run_directory = None, None, ""
        return result

    def _run(self, goal: ServerGoalHandle, frames: Frames, result: Scan.Result) -> None:
        """Open the run and scan; the result is filled in as far as that comes."""
        (seed,) = values(self, "seed")
        controls, files = self._goals.controls, self._files
        plan, run, seed = start_run(
            files.checked(scan_goal(goal.request)),
            frames,
            files,
            self._hands,
            seed=seed,
            tip_use=self._hands.tip_use if self._hands.free_air else None,
            tell=self._tell,
            check=controls.check_cancelled,
        )
        for problem in run.content.problems:
            self.get_logger().warning(f"damaged, left out of the run: {problem}")
        if UNCHECKED in plan.skipped:
            self.get_logger().warning(UNCHECKED.why)
        result.run_directory, result.points = str(run.path), plan.most_points
        self._run_directory = result.run_directory
        result.outcome = Scan.Result.ENDED
        self.get_logger().info(f"run goes to {run.path}")
        with run:
            for cdr in recorded_results(run.content):  # of a run that is continued
                self._publish(cdr)
            runner = ScanRunner(
                plan,
                run,
                self._hands,
                controls,
                self._tell,
                seed,
                self._publish,
            )
            fill_scan_result(result, runner.run())

    def _publish(self, result: bytes) -> None:
        if self.active:  # a scan that the node's end interrupts ends after its publishers
            self._results.publish(result)

    def _tell(self, progress: Progress) -> None:
        """Feedback of what is new at once, of the rest now and then."""
        self._progress = progress
        now_s, (phase, waiting_for, told_s) = time.monotonic(), self._told or (None, "", -math.inf)
        news = (progress.phase, progress.waiting_for) != (phase, waiting_for)
        if not news and now_s - told_s < FEEDBACK_EVERY_S:
            return
        if news and progress.waiting_for:
            self.get_logger().warning(f"the scan waits: {progress.waiting_for}")
        self._told = progress.phase, progress.waiting_for, now_s
        self._feed_back(progress)

    def _tell_waiting(self, waited_for: str) -> None:
        """Report a node that keeps a scan waiting, once, in the log and a scan's feedback."""
        if waited_for:
            self.get_logger().warning(f"the scan waits for {waited_for}")
            if self._progress is not None:
                self._feed_back(replace(self._progress, waiting_for=waited_for))

    def _feed_back(self, progress: Progress) -> None:
        goal = self._goals.handle
        if goal is not None:
            goal.publish_feedback(scan_feedback(progress, self._run_directory))


main = ScanNode.run

if __name__ == "__main__":
    main()
