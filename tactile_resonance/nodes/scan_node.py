# SPDX-License-Identifier: Apache-2.0
"""Scans: from a scene to a run directory with every point in it."""

from __future__ import annotations

import math
import os
import socket
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

from rclpy.action.server import ServerGoalHandle
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from tactile_resonance import msg
from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.fields import require
from tactile_resonance.nodes.frames import BROADCAST_TF, broadcast_fixed, look_up
from tactile_resonance.nodes.managed_node import HUNG_AFTER, TIME_SERVER, ManagedNode, in_thread
from tactile_resonance.nodes.parameters import Fixed, Parameter, pose_of, values
from tactile_resonance.nodes.running import POINT_RESULTS
from tactile_resonance.nodes.scan_actions import (
    OneGoal,
    calibration_request,
    fill_calibration_result,
    fill_scan_result,
    no_table,
    scan_feedback,
    scan_goal,
)
from tactile_resonance.nodes.scan_hands import NodeHands
from tactile_resonance.scan.goal import Frames, GoalFiles, named_frames, resumed_run
from tactile_resonance.scan.hands import Phase, Progress, Request, Touch
from tactile_resonance.scan.point_result import TOPIC
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.recorded import recorded_results
from tactile_resonance.scan.run_start import UNCHECKED, new_run, start_run
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.table_calibration import CalibrationRequest, as_text, calibrate_table
from tactile_resonance.sensor import sensor_named

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

FEEDBACK_EVERY_S = 0.2
CONTROLS = {
    "scan/pause": lambda controls: controls.paused.set(),
    "scan/resume": lambda controls: controls.paused.clear(),
    "scan/skip_point": lambda controls: controls.ask(Request.SKIP),
    "scan/repeat_point": lambda controls: controls.ask(Request.REPEAT),
}


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
        self._hands = NodeHands(self, self._tell_waiting)
        broadcast_fixed(self, base_frame, {table_frame: self._frames.table_in_base})
        self._files = GoalFiles(*values(self, "run_folder", "goal_folders"))
        self._results = self.publish_on(msg.PointResult, TOPIC, POINT_RESULTS)
        self._run_directory = ""
        self._told: tuple[Phase, str, float] | None = None
        goals = self._goals = OneGoal(self, self._hands.listening)
        for name, ask in CONTROLS.items():
            goals.serve_control(name, ask)
        refused = partial(Scan.Result, outcome=Scan.Result.REFUSED)
        goals.act(Scan, "scan", self._check_scan, self._scan, refused)
        check = self._check_calibration
        goals.act(CalibrateTable, "calibrate_table", check, self._calibrate, no_table)

    def deactivate(self) -> None:
        """End the scan after retracting; its points stay finished."""
        self._goals.forget_rejection()
        self._goals.cancel()

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As every node, once the scan has ended: without its clients it could not draw the tip back."""
        if self._goals.handle is not None:
            self.health.error("not cleaned up yet: a scan that is to end draws the tip back")
            return TransitionCallbackReturn.FAILURE
        return super().on_cleanup(state)

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
            await in_thread(self, partial(resumed_run, goal), "check")
            return frames
        stamp = message.poses.header.stamp
        good = stamp.sec >= 0 and stamp.nanosec < 1_000_000_000
        require(good, "poses.header.stamp", (stamp.sec, stamp.nanosec), "a time, or 0")
        poses, missing = await look_up(self, frames.base, named_frames(goal, frames), stamp)
        frames = replace(frames, others=poses, no_others=missing)
        forces = self._hands.free_air
        work = partial(new_run, goal, frames, self._files, forces=forces)
        await in_thread(self, work, "check")  # 10 000 poses take seconds
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
        self, goal: ServerGoalHandle, request: CalibrationRequest, result: CalibrateTable.Result
    ) -> None:
        """Touch, fit and save."""
        # those of this configuration: the node may have another one before the tip is back
        hands, frames, check = self._hands, self._frames, self._goals.controls.check_cancelled
        who = f"{self.get_fully_qualified_name()} on {socket.gethostname()}"
        who += ", simulated" if self.time_server else ""
        hands.frame_in_base = frames.table_in_base
        radius_m = sensor_named(request.sensor).tip.radius_m
        feedback = CalibrateTable.Feedback(points=len(request.points_m), height_m=math.nan)

        def touch(point: ScanPoint) -> Touch:
            feedback.point = point.index
            goal.publish_feedback(feedback)
            found = hands.find(point, request.force_n, radius_m, check)
            feedback.height_m = found.ball_m[2] - radius_m
            return found

        file = None
        try:
            with hands.at_work():
                file = _new_file(request.file) if request.file else None
                hands.retract()
                made = calibrate_table(request, frames.table_in_base, radius_m, touch)
        except ValueError:
            result.outcome = result.REFUSED
            raise
        else:
            fill_calibration_result(result, made)
            if file is not None:
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
        finally:
            if file is not None:
                with suppress(OSError):  # of what could not be written: told above
                    file.close()
                if not result.file:
                    Path(request.file).unlink()

    def _scan(self, goal: ServerGoalHandle, frames: Frames, result: Scan.Result) -> None:
        try:
            with self._hands.at_work():
                self._run(goal, frames, result)
        finally:
            self._progress, self._told, self._run_directory = None, None, ""

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


def _new_file(name: str) -> BinaryIO:
    """Open a new file before anything is touched; ``ValueError`` where there can be none."""
    path = Path(name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("xb")
    except OSError as error:
        accepted = f"a new file in a folder that can be written ({error.strerror})"
        raise ValueError(f"file: got {name!r}; accepted is {accepted}") from error


main = ScanNode.run
