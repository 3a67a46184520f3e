# SPDX-License-Identifier: Apache-2.0
"""Scans and calibrations for a node of your own: asked for and followed without spinning or blocking."""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Point, Pose, PoseArray
from rclpy.action.client import ClientGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from unique_identifier_msgs.msg import UUID

from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.msg import PointResult
from tactile_resonance.nodes.goal_client import GoalClient
from tactile_resonance.nodes.goals import drop
from tactile_resonance.nodes.running import RESULTS, STEADY

TICK_S = 0.1
ASK_AGAIN_S = 2.0
"""An answer that has not come by then may be lost: it is asked for again."""
SILENT_S = 5.0
"""A scan that has told nothing for so long may have lost its node: its result is asked for again."""
GONE_S = 10.0
"""A node that nobody has seen for so long has gone."""


class Ending(Enum):
    """How a scan or a calibration ended; a run that was begun and is not complete can be resumed."""

    COMPLETE = "complete"  # every point of the plan is finished, the table is found
    ENDED = "ended"  # some are not
    CANCELLED = "cancelled"  # on request
    REJECTED = "rejected"  # the goal was not accepted
    REFUSED = "refused"  # it was, and no point could be begun, or the touches determine no table
    LOST = "lost"  # scan_node went away


@dataclass(frozen=True)
class ScanOutcome:
    """How a scan ended; ``action/Scan.action`` gives unit and meaning of each field.

    Attributes
    ----------
    ending : Ending
    message : str
        Why, in a sentence.
    """

    ending: Ending
    message: str
    run_directory: str = ""
    points: int = 0
    done: int = 0
    failed: int = 0
    skipped: int = 0
    blocks: int = 0
    blocks_saved: int = 0
    saved_s: float = 0.0
    repeats: int = 0
    sensor_drifted: bool = False
    sensor_health: str = ""


@dataclass(frozen=True)
class CalibrationOutcome:
    """How a calibration ended; ``action/CalibrateTable.action`` gives unit and meaning of each field.

    Attributes
    ----------
    ending : Ending
    message : str
        Why, in a sentence; of a table that was found correction and residuals.
    """

    ending: Ending
    message: str
    table_in_base: Sequence[float] = (math.nan,) * 6
    height_m: float = math.nan
    tilt_x_rad: float = math.nan
    tilt_y_rad: float = math.nan
    covariance: Sequence[float] = (math.nan,) * 9
    residuals_m: Sequence[float] = ()
    std_m: Sequence[float] = ()
    reduced_chi_square: float = math.nan
    file: str = ""


_ENDINGS: dict[type, dict[int, Ending]] = {
    ScanOutcome: {
        Scan.Result.COMPLETE: Ending.COMPLETE,
        Scan.Result.ENDED: Ending.ENDED,
        Scan.Result.REFUSED: Ending.REFUSED,
    },
    CalibrationOutcome: {
        CalibrateTable.Result.DONE: Ending.COMPLETE,
        CalibrateTable.Result.FAILED: Ending.ENDED,
        CalibrateTable.Result.REFUSED: Ending.REFUSED,
    },
}


@dataclass
class _Asked:
    """A goal that is under way."""

    client: GoalClient
    kind: type  # of its outcome
    goal: Any
    wait_s: float
    on_feedback: Callable[[Any], None] | None
    on_point: Callable[[PointResult], None] | None = None
    future: Future = field(default_factory=Future)
    handle: ClientGoalHandle | None = None
    cancelled: bool = False
    heard_s: float = 0.0
    run_directory: str = ""  # as heard


class TactileClient:
    """Client of scan_node; futures and callbacks, one at a time, come in the executor that spins the node.

    Futures may also be awaited in coroutines of that executor.

    Parameters
    ----------
    node : Node
        Of the caller, who spins it.
    namespace : str
        Of scan_node; empty: that of the node.
    """

    def __init__(self, node: Node, namespace: str = "") -> None:
        self._node = node
        prefix = f"{namespace.rstrip('/')}/" if namespace else ""
        # of its own: a callback of the caller that awaits would keep all others of its group waiting
        group = MutuallyExclusiveCallbackGroup()
        self._scans = GoalClient(node, Scan, f"{prefix}scan", callback_group=group)
        name = f"{prefix}calibrate_table"
        self._calibrations = GoalClient(node, CalibrateTable, name, callback_group=group)
        self._services = {
            name: node.create_client(Trigger, f"{prefix}scan/{name}", callback_group=group)
            for name in ("pause", "resume", "skip_point", "repeat_point", "rejection")
        }
        self._points = node.create_subscription(
            PointResult, f"{prefix}point_result", self._on_point, RESULTS, callback_group=group
        )
        self._begin = node.create_guard_condition(self._conduct, ReentrantCallbackGroup())
        self._timer = node.create_timer(TICK_S, self._on_tick, callback_group=group, clock=STEADY)
        self._timer.cancel()
        self._tick = Future()
        self._asked: _Asked | None = None
        self._waiting: _Asked | None = None  # until it is begun, once
        self._claim = threading.Lock()

    def scan(
        self,
        *,
        scene: str | Path = "",
        poses: Sequence[Pose] = (),
        frame: str = "",
        force_n: float = 0.0,
        f0_std_hz: float = 0.0,
        damping_ratio_std: float = 0.0,
        run_directory: str | Path = "",
        resume: bool = False,
        seed: int = 0,
        notes: str = "",
        on_feedback: Callable[[Scan.Feedback], None] | None = None,
        on_point: Callable[[PointResult], None] | None = None,
        wait_s: float = 60.0,
    ) -> Future:
        """Ask for a scan of a scene, or of poses.

        Parameters
        ----------
        scene, force_n, f0_std_hz, damping_ratio_std, run_directory, resume, seed, notes
            Fields of the goal (``action/Scan.action``); paths are those of scan_node's machine.
        poses : sequence of Pose
            Points on the surface: +z out of the tissue, +x from clamp to tip.
        frame : str
            Of the poses: scan_node's ``table_frame`` or ``base_frame``; where tf2 is installed, any frame
            that it connects with them.
        on_feedback, on_point : callable
            Called with each feedback and with each finished attempt at a point.
        wait_s : float
            How long an active scan_node is waited for [s].

        Returns
        -------
        Future
            Its result is a `ScanOutcome`, whatever happens.

        Raises
        ------
        RuntimeError
            If a goal of this client is under way.
        ValueError
            If a value is not of the type or in the range of its field.
        """
        try:
            # unchecked, a value of a wrong type ends the process that sends it
            header = Header(check_fields=True, frame_id=frame)
            goal = Scan.Goal(
                check_fields=True,
                scene=str(scene),
                poses=PoseArray(check_fields=True, header=header, poses=list(poses)),
                force_n=float(force_n),
                f0_std_hz=float(f0_std_hz),
                damping_ratio_std=float(damping_ratio_std),
                run_directory=str(run_directory),
                resume=resume,
                seed=seed,
                notes=notes,
            )
        except AssertionError as error:
            raise ValueError(f"scan: {error}") from error
        return self._ask(_Asked(self._scans, ScanOutcome, goal, wait_s, on_feedback, on_point))

    def calibrate_table(
        self,
        points: Sequence[Point],
        *,
        force_n: float = 0.0,
        search_m: float = 0.0,
        flatness_m: float = 0.0,
        most_tilt_rad: float = 0.0,
        heading_rad: float = 0.0,
        sensor: str = "",
        file: str | Path = "",
        on_feedback: Callable[[CalibrateTable.Feedback], None] | None = None,
        wait_s: float = 60.0,
    ) -> Future:
        """Ask for the table's place in the base, found by touch, for the next start of the nodes.

        Parameters
        ----------
        points, force_n, search_m, flatness_m, most_tilt_rad, heading_rad, sensor, file
            Fields of the goal (``action/CalibrateTable.action``).
        on_feedback : callable
            Called with each feedback.
        wait_s : float
            How long an active scan_node is waited for [s].

        Returns
        -------
        Future
            Its result is a `CalibrationOutcome`, whatever happens.

        Raises
        ------
        RuntimeError, ValueError
            As `scan`.
        """
        try:
            goal = CalibrateTable.Goal(
                check_fields=True,
                points=list(points),
                force_n=float(force_n),
                search_m=float(search_m),
                flatness_m=float(flatness_m),
                most_tilt_rad=float(most_tilt_rad),
                heading_rad=float(heading_rad),
                sensor=sensor,
                file=str(file),
            )
        except AssertionError as error:
            raise ValueError(f"calibrate_table: {error}") from error
        return self._ask(_Asked(self._calibrations, CalibrationOutcome, goal, wait_s, on_feedback))

    def cancel(self) -> None:
        """End the scan or calibration after drawing the tip back; its future tells when that is done."""
        if self._asked is not None:
            self._asked.cancelled = True
            if self._asked.handle is not None:
                self._asked.handle.cancel_goal_async()

    def pause(self) -> Future:
        """Wait with the tip free once the point under way is finished; as all below, a `Trigger.Response`."""
        return self._call("pause")

    def resume(self) -> Future:
        """Go on after a pause."""
        return self._call("resume")

    def skip(self) -> Future:
        """Leave the point under way for good; between two points the next."""
        return self._call("skip_point")

    def repeat(self) -> Future:
        """Repeat the point under way; between two points the last."""
        return self._call("repeat_point")

    def destroy(self) -> None:
        """Take everything off the node again; a scan under way goes on, and is followed no longer."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_guard_condition(self._begin)
        self._node.destroy_subscription(self._points)
        for service in self._services.values():
            self._node.destroy_client(service)
        self._scans.destroy()
        self._calibrations.destroy()

    def _ask(self, asked: _Asked) -> Future:
        if self._asked is not None:
            raise RuntimeError(
                "goal: one of this client is under way; cancel it or await its outcome"
            )
        self._asked = self._waiting = asked
        self._timer.reset()
        self._begin.trigger()
        return asked.future

    # in the executor

    def _call(self, name: str) -> Future:
        service = self._services[name]
        if service.service_is_ready():
            return service.call_async(Trigger.Request())
        answer = Future()
        answer.set_result(Trigger.Response(success=False, message="no scan_node is there"))
        return answer

    def _on_point(self, message: PointResult) -> None:
        asked = self._asked
        if asked is not None and asked.on_point is not None:
            asked.on_point(message)

    def _on_tick(self) -> None:
        tick, self._tick = self._tick, Future()
        tick.set_result(None)

    async def _until(self, holds: Callable[[], bool], within_s: float) -> bool:
        """Let time pass until something holds, looked at with each tick; whether it does."""
        deadline_s = time.monotonic() + within_s
        while not holds():
            if time.monotonic() > deadline_s:
                return False
            await self._tick
        return True

    async def _conduct(self) -> None:
        """From the goal to the outcome; an executor of several threads may begin it more than once."""
        with self._claim:
            asked, self._waiting = self._waiting, None
        if asked is None:
            return
        try:
            ended = await self._send(asked)
            outcome = await self._follow(asked) if ended is None else ended
        finally:
            self._timer.cancel()
            self._asked = None
        asked.future.set_result(outcome)

    async def _send(self, asked: _Asked) -> Any:
        """Send the goal until it is accepted, or return the outcome where it is not; None where it is.

        A goal whose answer is late, or lost, is sent again under its id, and accepted once.
        """
        goal_id, answers = _new_id(), list[Future]()
        waited_for = "no scan_node is there"
        deadline_s = time.monotonic() + asked.wait_s
        while not asked.cancelled and time.monotonic() < deadline_s:
            if not asked.client.server_is_ready():
                await self._tick
                continue
            hear = self._hear_for(asked)
            answers.append(asked.client.send_goal_async(asked.goal, hear, goal_uuid=goal_id))
            await self._until(partial(_any_done, answers), ASK_AGAIN_S)
            handles = [answer.result() for answer in answers if answer.done()]
            asked.handle = next((handle for handle in handles if handle.accepted), None)
            # what was sent twice may be refused because it is known
            if asked.handle is None and handles and len(answers) > 1:
                result = handles[-1].get_result_async()
                answered = await self._until(result.done, ASK_AGAIN_S)
                if not answered or result.result().status != GoalStatus.STATUS_UNKNOWN:
                    asked.handle = handles[-1]
            if asked.handle is not None:
                return None
            if handles:
                drop(answers)
                why = self._call("rejection")
                if await self._until(why.done, ASK_AGAIN_S) and why.result().success:
                    return asked.kind(Ending.REJECTED, why.result().message)
                waited_for = "scan_node is not active"
                goal_id, answers = _new_id(), []
                await self._tick
        drop(answers)
        ClientGoalHandle(asked.client, goal_id, None).cancel_goal_async()
        if asked.cancelled:
            return asked.kind(Ending.CANCELLED, "cancelled before it was accepted")
        return asked.kind(Ending.REJECTED, f"{waited_for}, for {asked.wait_s:g} s")

    async def _follow(self, asked: _Asked) -> Any:
        """Outcome of a goal that was accepted."""
        assert asked.handle is not None
        results = list[Future]()
        seen_s = time.monotonic()
        while True:
            if asked.cancelled:  # also before it was accepted, and again where that is lost
                asked.handle.cancel_goal_async()
            results.append(asked.handle.get_result_async())
            asked.heard_s = time.monotonic()
            while time.monotonic() - asked.heard_s < SILENT_S:
                answer = next((r.result() for r in results if r.done()), None)
                if answer is not None and answer.status != GoalStatus.STATUS_UNKNOWN:
                    return _outcome(answer, asked.kind)
                if asked.client.server_is_ready():
                    seen_s = time.monotonic()
                if answer is not None or time.monotonic() - seen_s > GONE_S:
                    if asked.kind is CalibrationOutcome:
                        return CalibrationOutcome(Ending.LOST, "scan_node went away")
                    text = "scan_node went away; the run can be resumed"
                    return ScanOutcome(Ending.LOST, text, asked.run_directory)
                await self._tick

    def _hear_for(self, asked: _Asked) -> Callable[[Any], None]:
        def hear(message: Any) -> None:
            asked.heard_s = time.monotonic()
            if asked.kind is ScanOutcome:
                asked.run_directory = message.feedback.run_directory
            if asked.on_feedback is not None:
                asked.on_feedback(message.feedback)

        return hear


def _any_done(futures: Sequence[Future]) -> bool:
    return any(future.done() for future in futures)


def _new_id() -> UUID:
    return UUID(uuid=list(uuid.uuid4().bytes))


def _outcome(answer: Any, kind: type) -> Any:
    """Outcome of the answer to a goal's result."""
    result, ending = answer.result, _ENDINGS[kind][answer.result.outcome]
    if answer.status == GoalStatus.STATUS_CANCELED:
        ending = Ending.CANCELLED
    names = [f.name for f in fields(kind) if f.name != "ending"]
    return kind(ending, **{name: getattr(result, name) for name in names})
