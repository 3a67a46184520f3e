# SPDX-License-Identifier: Apache-2.0
"""Scans: from a scene to a run directory with every point in it."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.action.server import ServerGoalHandle
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.configuration import share_path
from tactile_resonance.contact.samples import Pose
from tactile_resonance.fields import require
from tactile_resonance.nodes.frames import BROADCAST_TF, broadcast_fixed, look_up
from tactile_resonance.nodes.goal_thread import in_thread
from tactile_resonance.nodes.managed_node import HUNG_AFTER, TIME_SERVER, ManagedNode
from tactile_resonance.nodes.parameters import Parameter, pose_of, values
from tactile_resonance.nodes.running import POINT_RESULTS, run_node
from tactile_resonance.nodes.scan_hands import NodeHands
from tactile_resonance.nodes.scan_messages import feedback_message, fill_result, goal_of
from tactile_resonance.nodes.scan_time import ScanTime
from tactile_resonance.nodes.table_calibration import calibrate, no_table, request_of
from tactile_resonance.nodes.tip_use import TipUseClient
from tactile_resonance.scan.controls import Controls, Request
from tactile_resonance.scan.facts import run_facts
from tactile_resonance.scan.goal import (
    Frames,
    ScanGoal,
    WantedScan,
    named_frames,
    read_goal,
    resumed_run,
)
from tactile_resonance.scan.goal_files import GoalFiles
from tactile_resonance.scan.hands import Interrupted, PointFailed, ScanEnded
from tactile_resonance.scan.measurement import design_measurement
from tactile_resonance.scan.plan import Plan, plan_points
from tactile_resonance.scan.point_result import TOPIC
from tactile_resonance.scan.preparation import UNCHECKED, Prepared, prepare
from tactile_resonance.scan.progress import Phase, Progress
from tactile_resonance.scan.recorded import recorded_results
from tactile_resonance.scan.run_directory import RunDirectory, expected_bytes
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scan_point import ScanPoint
from tactile_resonance.scan.scene import ScanScene, read_scan_scene
from tactile_resonance.scan.surface_search import Touch
from tactile_resonance.scan.table_calibration import CalibrationRequest
from tactile_resonance.sensor import read_sensor

PARAMETERS = (
    Parameter(
        "contact",
        "robot",
        "What brings the tip to the tissue: contact_node, or nothing (the tip is taken to be where the plan "
        "states, and its pose is published).",
        choices=("robot", "none"),
        read_only=True,
    ),
    Parameter(
        "table_in_base",
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        "The table in the robot's base: position [m] and rotation vector [rad].",
        read_only=True,
    ),
    Parameter(
        "table_frame",
        "table",
        "Frame of the table: of poses without a scene, and of scenes that name none.",
        read_only=True,
    ),
    Parameter("base_frame", "base", "Frame of the robot's base.", read_only=True),
    BROADCAST_TF,
    Parameter(
        "run_folder",
        "",
        "Folder of the runs that name none; empty: tactile_resonance/runs in $ROS_HOME (~/.ros where "
        "that is not set).",
        read_only=True,
    ),
    Parameter(
        "goal_folders",
        [""],
        "Folders in which files and run folders of goals may be, beside the package's scenes and run_folder; "
        "/ for any.",
        read_only=True,
    ),
    Parameter("seed", 1, "Seed of the phases of the first point.", 1, 2**62),
    TIME_SERVER,
    HUNG_AFTER,
)

FEEDBACK_EVERY_S = 0.2
RUNNING = "a scan or a calibration is running, cancel it or wait for its result"


class ScanNode(ManagedNode):
    """Actions `scan` and `calibrate_table`; services `pause`, `resume`, `skip_point`, ... of `scan/`.

    Publishes `point_result` (latched).
    """

    def __init__(self) -> None:
        super().__init__("scan_node", PARAMETERS)

    def configure(self) -> None:
        """Offer the action; the topics are subscribed to when a scan begins."""
        names = ("contact", "table_in_base", "table_frame", "base_frame")
        contact, table, table_frame, base_frame = values(self, *names)
        self._time = ScanTime(self.time_server, self.hung_after_s)
        table_in_base, robot = pose_of(table, "table_in_base"), contact == "robot"
        self._tip_use = TipUseClient(self) if robot else None
        self._hands = NodeHands(self, base_frame, robot, self._time, self._tell_waiting)
        self._frames = Frames(table_frame, base_frame, table_in_base)
        self._frames_of: dict[int, Frames] = {}  # as they stood when a goal arrived, by its message
        broadcast_fixed(self, base_frame, {table_frame: table_in_base})
        self._files = GoalFiles(*values(self, "run_folder", "goal_folders"))
        self._asked = self._rejection = ""
        self._results = self.publish_on(msg.PointResult, TOPIC, POINT_RESULTS)
        self._controls: Controls | None = None
        self._goal: ServerGoalHandle | None = None
        self._run_directory = ""
        self._progress: Progress | None = None
        for name, ask in {
            "scan/pause": lambda c: c.paused.set(),
            "scan/resume": lambda c: c.paused.clear(),
            "scan/skip_point": lambda c: c.ask(Request.SKIP),
            "scan/repeat_point": lambda c: c.ask(Request.REPEAT),
        }.items():
            self.serve(Trigger, name, self._control(ask))
        self.serve(Trigger, "scan/rejection", self._on_rejection)
        busy = Scan.Result(outcome=Scan.Result.REFUSED, message=RUNNING)
        self._act(Scan, "scan", self._scan, self._check_scan, busy)
        busy = no_table(CalibrateTable.Result.FAILED, RUNNING)
        self._act(
            *(CalibrateTable, "calibrate_table", self._calibrate, self._check_calibration, busy)
        )

    def deactivate(self) -> None:
        """End the scan after retracting; its points stay finished."""
        self._rejection = ""
        self._cancel()

    def details(self) -> dict[str, str]:
        """The scan under way."""
        progress = getattr(self, "_progress", None)
        if progress is None:
            return {}
        return {
            "phase": progress.phase.value,
            "points": f"{progress.finished} of {progress.points}",
        }

    def _act(self, kind: type, name: str, work: Any, check: Any, busy: Any) -> None:
        """Offer an action of which, with the others of this kind, one goal at a time is worked at."""
        serve, refusal = partial(self._on_goal, work, busy), partial(self._refusal, check)
        self.act(kind, name, serve, lambda _: self._cancel(), refusal)

    def _control(self, ask: Any) -> Any:
        def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            controls = self._controls
            if controls is None:
                response.message = "no scan is running"
                return response
            ask(controls)
            response.success = True
            return response

        return serve

    def _cancel(self) -> None:
        if self._controls is not None:
            self._controls.ask(Request.CANCEL)

    async def _refusal(self, check: Callable[[Any], Awaitable[Frames]], message: Any) -> str:
        """Why a goal is rejected, kept for who asks; empty where it is accepted."""
        reason = ""
        self._asked = asked = str(message)
        try:
            self._require_free()
            frames = await check(message)
            self._require_free()
            self._frames_of[id(message)] = frames
        except (ValueError, OSError) as error:
            reason = " ".join(str(error).split())
            self.get_logger().warning(f"goal rejected: {reason}")
        if self._asked == asked:  # no other came while its frames were looked up
            self._rejection = reason
        return reason

    def _require_free(self) -> None:
        if self._goal is not None:
            raise ValueError(RUNNING)

    async def _check_scan(self, message: Scan.Goal) -> Frames:
        goal, frames = self._files.checked(goal_of(message)), self._frames
        if goal.resume:
            resumed_run(goal)
            return frames
        stamp = message.poses.header.stamp
        good = stamp.sec >= 0 and stamp.nanosec < 1_000_000_000
        require(good, "poses.header.stamp", (stamp.sec, stamp.nanosec), "a time, or 0")
        names = named_frames(goal, frames)
        found = await look_up(self, frames.base, names, stamp)
        frames = replace(frames, others=found.poses, no_others=found.missing)
        self._new_run(goal, frames)
        return frames

    async def _check_calibration(self, message: CalibrateTable.Goal) -> Frames:
        accepted = "robot: a table is calibrated by touch"
        require(self._hands.free_air, "contact", "none", accepted)
        self._calibration_of(message)
        return self._frames

    def _calibration_of(self, message: CalibrateTable.Goal) -> CalibrationRequest:
        request = request_of(message)
        if request.file:
            path = self._files.to_write(request.file, "file")
            require(not os.path.lexists(path), "file", str(path), "a new file")
            request = replace(request, file=str(path))
        return request

    def _on_rejection(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Why the last goal was rejected: rclpy has no place for it in its answer to a goal."""
        response.success, response.message = bool(self._rejection), self._rejection
        return response

    async def _on_goal(
        self, work: Callable[[ServerGoalHandle, Frames], Any], busy: Any, goal: ServerGoalHandle
    ) -> Any:
        frames = self._frames_of.pop(id(goal.request))
        if self._goal is not None:
            goal.abort()
            return busy
        self._goal, self._controls = goal, Controls()
        if goal.is_cancel_requested:  # before there were controls
            self._cancel()
        try:
            with self._hands.listening():
                result = await in_thread(self, lambda: self._conduct(work, goal, frames), "scan")
        finally:
            self._goal = None
        if result.outcome in (Scan.Result.COMPLETE, CalibrateTable.Result.DONE):
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _conduct(self, work: Any, goal: ServerGoalHandle, frames: Frames) -> Any:
        """Result of a goal, worked at in its thread."""
        self._time.begin()
        try:
            self._hands.meet()
            return work(goal, frames)
        finally:
            self._time.end()
            self._controls, self._progress, self._run_directory = None, None, ""

    def _calibrate(self, goal: ServerGoalHandle, frames: Frames) -> CalibrateTable.Result:
        assert self._controls is not None
        who = f"{self.get_fully_qualified_name()} on {socket.gethostname()}"
        who += ", simulated" if self.time_server else ""
        request, check = self._calibration_of(goal.request), self._controls.check_cancelled
        self._hands.frame_in_base = frames.table_in_base
        result = calibrate(goal, request, self._hands, check, frames, who)
        if result.outcome != result.DONE:
            self.health.error(result.message)
        return result

    def _scan(self, goal: ServerGoalHandle, frames: Frames) -> Scan.Result:
        result, tell = Scan.Result(outcome=Scan.Result.REFUSED), self._tell_of(goal)
        assert self._controls is not None
        try:
            scene, plan, run, seed = self._prepare(goal.request, frames, tell)
            result.run_directory, result.points = str(run.path), len(plan.points)
            self._run_directory = result.run_directory
            result.outcome = Scan.Result.ENDED
            self.get_logger().info(f"run goes to {run.path}")
            with run:
                for cdr in recorded_results(run.content):  # of a run that is gone on with
                    self._publish(cdr)
                runner = ScanRunner(
                    *(scene, plan, run, self._hands, self._controls, tell, seed, self._publish)
                )
                fill_result(result, runner.run())
        except (ValueError, OSError, PointFailed, ScanEnded, Interrupted) as error:
            result.message = str(error) or "cancelled before the first point"
            self.health.error(result.message)
        return result

    def _publish(self, result: bytes) -> None:
        if self.active:  # a scan that the node's end interrupts ends after its publishers
            self._results.publish(result)

    def _prepare(
        self, request: Scan.Goal, frames: Frames, tell: Callable[[Progress], None]
    ) -> tuple[ScanScene, Plan, RunDirectory, int]:
        """Scene, plan and the open run of a goal; ValueError where it is refused."""
        goal = self._files.checked(goal_of(request))
        if goal.resume:
            run = RunDirectory.open(resumed_run(goal))
            try:
                self._require_same_table(run)
                scene = read_scan_scene(run.path / "scene.yaml")
                self._require_force(scene)
                others = _frames_of_run(run, scene, frames)
                scene = self._place(scene, replace(frames, others=others))
                plan = plan_points(scene, run.content.points)
                return scene, plan, run, int(run.content.facts["seed"])
            except BaseException:
                run.close()
                raise
        wanted, where, needed = self._new_run(goal, frames)
        scene, plan = self._place(wanted.scene, frames), wanted.plan
        (seed,) = values(self, "seed")
        seed = goal.seed or seed
        made = self._prepared(scene, plan, tell)
        plan = made.plan
        facts = self._facts(scene, plan, seed)
        facts["frames"] = {name: pose.vector.tolist() for name, pose in frames.others.items()}
        facts.update(made.facts)
        run = RunDirectory.create(where, wanted.text, plan.points, facts, needed)
        return scene, plan, run, seed

    def _require_force(self, scene: ScanScene) -> None:
        """A gate judges a force that is measured."""
        accepted = "none where scan_node's parameter contact is none: no force is measured then"
        require(scene.gate is None or self._hands.free_air, "gate", scene.gate, accepted)

    def _require_same_table(self, run: RunDirectory) -> None:
        """A run goes on where it began; where the table is known better now, that is another place."""
        noted = run.content.facts.get("scan_node", {}).get("table_in_base")
        (table,) = values(self, "table_in_base")
        accepted = f"{noted}, with which the run began, to resume it"
        require(noted in (None, list(table)), "table_in_base", list(table), accepted)

    def _place(self, scene: ScanScene, frames: Frames) -> ScanScene:
        """Tell the hands where the scene's frame stands, and return it with that frame's name."""
        frame_id = frames.of_scene(scene.frame_id)
        self._hands.frame_in_base = frames.in_base(frame_id, "frame_id")
        return replace(scene, frame_id=frame_id)

    def _new_run(self, goal: ScanGoal, frames: Frames) -> tuple[WantedScan, Path, int]:
        """What a goal asks for, the folder of its run, and the room that needs [bytes]; ValueError if wrong."""
        wanted = read_goal(goal, frames)
        self._require_force(wanted.scene)
        where = Path(goal.run_directory) if goal.run_directory else self._files.unused()
        design = design_measurement(wanted.scene)
        blocks, samples = design.periods * design.realisations, round(50e3 * design.block_s)
        needed = expected_bytes(len(wanted.scene.positions_m), blocks, samples, design.lines)
        RunDirectory.check_new(where, needed)
        return wanted, where, needed

    def _prepared(
        self, scene: ScanScene, plan: Plan | None, tell: Callable[[Progress], None]
    ) -> Prepared:
        """Find by touch what is to be found so; ValueError where it is not."""
        controls, tip_use = self._controls, self._tip_use
        assert controls is not None
        radius_m = read_sensor(share_path(f"config/sensors/{scene.sensor.name}.yaml")).tip.radius_m

        def find(point: ScanPoint, force_n: float, count: int) -> Touch:
            tell(Progress(point, Phase.SURFACE, point.index, count))
            return self._hands.find(point, force_n, radius_m, controls.check_cancelled)

        use_of = None if tip_use is None else lambda: tip_use.ask(scene.sensor.name)
        made = prepare(scene, plan, radius_m, find, use_of)
        if UNCHECKED in made.plan.skipped:
            self.get_logger().warning(UNCHECKED.why)
        return made

    def _facts(self, scene: ScanScene, plan: Plan, seed: int) -> dict[str, Any]:
        """What a reader of the run should know beside its plan."""
        names = ("contact", "table_in_base", "base_frame")
        own = dict(zip(names, values(self, *names), strict=True))
        own["table_in_base"] = list(own["table_in_base"])
        notes = scene.notes.as_json()
        return run_facts(plan, seed, {"name": scene.name, "notes": notes, "scan_node": own})

    def _tell_waiting(self, waited_for: str) -> None:
        """Report a node that keeps a scan waiting, once, in the log and a scan's feedback."""
        goal, progress = self._goal, self._progress
        if waited_for:
            self.get_logger().warning(f"the scan waits for {waited_for}")
        if waited_for and goal is not None and progress is not None:
            waiting = replace(progress, waiting_for=waited_for)
            goal.publish_feedback(feedback_message(waiting, self._run_directory))

    def _tell_of(self, goal: ServerGoalHandle) -> Any:
        last = [("", "", -math.inf)]

        def tell(progress: Progress) -> None:
            self._progress = progress
            now_s, news = time.monotonic(), (progress.phase, progress.waiting_for)
            if news == last[0][:2] and now_s - last[0][2] < FEEDBACK_EVERY_S:
                return
            if progress.waiting_for and news != last[0][:2]:
                self.get_logger().warning(f"the scan waits: {progress.waiting_for}")
            last[0] = (*news, now_s)
            goal.publish_feedback(feedback_message(progress, self._run_directory))

        return tell


def _frames_of_run(run: RunDirectory, scene: ScanScene, frames: Frames) -> dict[str, Pose]:
    """Other frames in the base, as they stood when a run began."""
    noted = run.content.facts.get("frames")
    if noted is None:  # of an earlier version, where every scene's frame was the table
        return {scene.frame_id: frames.table_in_base}
    return {name: Pose.from_vector(vector) for name, vector in noted.items()}


def main() -> None:
    """Console script."""
    run_node(ScanNode)


if __name__ == "__main__":
    main()
