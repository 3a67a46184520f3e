# SPDX-License-Identifier: Apache-2.0
"""Scans and calibrations for a node of your own: asked for and followed without spinning or blocking."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Any

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Point, Pose, PoseArray
from rclpy.action.client import ClientGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from unique_identifier_msgs.msg import UUID

from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.msg import PointResult
from tactile_resonance.nodes.goals import (
    ASK_AGAIN_S,
    GoalClient,
    Steps,
    answer_to,
    failed_in,
    offer,
)
from tactile_resonance.nodes.running import NEW_POINT_RESULTS, STEADY

TICK_S = 0.1
ANSWERS_WITHIN_S = 10.0
"""Of scan_node, which answers at once: longer means that it has ended or hangs."""


class Ending(Enum):
    """How a scan or a calibration ended; a run that was begun and is not complete can be resumed."""

    COMPLETE = "complete"  # every point of the plan is finished, the table is found
    ENDED = "ended"  # some are not
    CANCELLED = "cancelled"  # on request
    REJECTED = "rejected"  # the goal was not accepted
    REFUSED = "refused"  # it was, and no point could be begun, or the touches determine no table
    LOST = "lost"  # scan_node went away, or the client was destroyed


@dataclass(frozen=True)
class ScanOutcome:
    """How a scan ended; ``action/Scan.action`` gives unit and meaning of each field.

    Attributes
    ----------
    ending : Ending
    message : str
        Why, in a sentence.
    done, failed, skipped : int or None
        None where scan_node went away: the run has them.
    """

    ending: Ending
    message: str
    run_directory: str = ""
    points: int = 0
    done: int | None = 0
    failed: int | None = 0
    skipped: int | None = 0
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


_ENDINGS = (Ending.COMPLETE, Ending.ENDED, Ending.REFUSED)
"""By the field ``outcome`` of either result."""


@dataclass
class AskedGoal:
    """A goal that is under way.

    Attributes
    ----------
    kind : type
        Of its outcome, which has fields of the action's result.
    wait_s : float
        How long an active server is waited for [s].
    on_feedback, on_point : callable, optional
        Called with each feedback, with each finished attempt at a point.
    future : Future
        Its result is the outcome.
    """

    client: GoalClient
    kind: type
    goal: Any
    wait_s: float
    on_feedback: Callable[[Any], None] | None
    on_point: Callable[[PointResult], None] | None = None
    future: Future = field(default_factory=Future)
    handle: ClientGoalHandle | None = None
    cancelled: bool = False
    cancelled_s: float = -math.inf  # when that was sent last
    heard_s: float = -math.inf
    heard: Any = None  # the newest feedback

    def lost(self, why: str = "scan_node went away") -> Any:
        """Outcome where the result is not known."""
        run = getattr(self.heard, "run_directory", "")
        if not run:
            return self.kind(Ending.LOST, why)
        far = f"{self.heard.finished} of {self.heard.points} points were finished"
        text = f"{why}, {far}; the run can be resumed"
        unknown = dict.fromkeys(("done", "failed", "skipped"))
        return self.kind(Ending.LOST, text, run_directory=run, points=self.heard.points, **unknown)

    def outcome(self, answer: Any) -> Any:
        """Outcome of the answer to the goal's result."""
        result, ending = answer.result, _ENDINGS[answer.result.outcome]
        if failed_in(answer):
            return self.lost("scan_node failed in it, its log says how")
        if answer.status == GoalStatus.STATUS_CANCELED:
            ending = Ending.CANCELLED
        names = [f.name for f in fields(self.kind) if f.name != "ending"]
        return self.kind(ending, **{name: getattr(result, name) for name in names})

    def hear(self, message: Any) -> None:
        """Take a feedback."""
        self.heard_s = time.monotonic()
        self.heard = message.feedback
        if self.on_feedback is not None:
            self.on_feedback(message.feedback)

    def send_cancellation(self) -> None:
        """Cancel it where it is accepted, once more where that may be lost."""
        now_s = time.monotonic()
        if self.cancelled and self.handle is not None and now_s - self.cancelled_s > ASK_AGAIN_S:
            self.cancelled_s = now_s
            self.handle.cancel_goal_async()


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
        self._group = group = MutuallyExclusiveCallbackGroup()
        self._scans = GoalClient(node, Scan, f"{prefix}scan", callback_group=group)
        name = f"{prefix}calibrate_table"
        self._calibrations = GoalClient(node, CalibrateTable, name, callback_group=group)
        self._services = {
            name: node.create_client(Trigger, f"{prefix}scan/{name}", callback_group=group)
            for name in ("pause", "resume", "skip_point", "repeat_point", "rejection")
        }
        topic, qos = f"{prefix}point_result", NEW_POINT_RESULTS
        self._points = node.create_subscription(
            PointResult, topic, self._on_point, qos, callback_group=group
        )
        self._timer = node.create_timer(TICK_S, self._on_tick, callback_group=group, clock=STEADY)
        self._timer.cancel()
        self._asked: AskedGoal | None = None

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
        header = _checked(Header, frame_id=frame)
        goal = _checked(
            Scan.Goal,
            scene=str(scene),
            poses=_checked(PoseArray, header=header, poses=list(poses)),
            force_n=_number("force_n", force_n),
            f0_std_hz=_number("f0_std_hz", f0_std_hz),
            damping_ratio_std=_number("damping_ratio_std", damping_ratio_std),
            run_directory=str(run_directory),
            resume=resume,
            seed=seed,
            notes=notes,
        )
        return self._begin(AskedGoal(self._scans, ScanOutcome, goal, wait_s, on_feedback, on_point))

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
        goal = _checked(
            CalibrateTable.Goal,
            points=list(points),
            force_n=_number("force_n", force_n),
            search_m=_number("search_m", search_m),
            flatness_m=_number("flatness_m", flatness_m),
            most_tilt_rad=_number("most_tilt_rad", most_tilt_rad),
            heading_rad=_number("heading_rad", heading_rad),
            sensor=sensor,
            file=str(file),
        )
        return self._begin(
            AskedGoal(self._calibrations, CalibrationOutcome, goal, wait_s, on_feedback)
        )

    def cancel(self) -> None:
        """End the scan or calibration after drawing the tip back; its future is done when that is.

        Of a client that has none under way: that which another client began, and may have left behind.
        """
        if self._asked is not None:
            self._asked.cancelled = True
            self._asked.send_cancellation()
            return
        for client in (self._scans, self._calibrations):
            if client.server_is_ready():
                ClientGoalHandle(client, UUID(), None).cancel_goal_async()  # without an id: all goals

    def pause(self) -> Future:
        """Wait with the tip free once the point under way is finished; as all below, a `Trigger.Response`.

        ``success`` is False too where no answer comes within 10 s; whether it was done is not known then.
        """
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
        """Take everything off the node again; a scan under way goes on, and its future is done as `LOST`.

        One that was not seen to begin is cancelled.
        """
        asked, self._asked = self._asked, None
        if asked is not None and asked.heard is None:
            self._steps.close()  # before what it sends with is destroyed
        self._node.destroy_timer(self._timer)
        self._node.destroy_subscription(self._points)
        for service in self._services.values():
            self._node.destroy_client(service)
        self._scans.destroy()
        self._calibrations.destroy()
        if asked is not None:
            asked.future.set_result(asked.lost("its client was destroyed"))

    def _begin(self, asked: AskedGoal) -> Future:
        if self._asked is not None:
            raise RuntimeError(
                "goal: one of this client is under way; cancel it or await its outcome"
            )
        self._asked, self._steps = asked, self._conduct(asked)
        self._timer.reset()
        return asked.future

    # in the executor

    def _on_tick(self) -> None:
        asked = self._asked
        if asked is None:  # a timer may fire once more after it was cancelled
            return
        asked.send_cancellation()
        try:
            next(self._steps)
        except StopIteration as ended:
            self._timer.cancel()
            self._asked = None
            asked.future.set_result(ended.value)

    def _conduct(self, asked: AskedGoal) -> Steps:
        """From the goal to the outcome, one step with each tick."""
        waited_for = "no scan_node is there"
        deadline_s = time.monotonic() + asked.wait_s

        def wanted() -> bool:
            return not asked.cancelled and time.monotonic() < deadline_s

        while wanted():
            if not asked.client.server_is_ready():
                yield
                continue
            try:
                asked.handle = yield from offer(asked.client, asked.goal, asked.hear, wanted)
            except TimeoutError:
                waited_for = "scan_node does not answer"
                break
            if asked.handle is not None:
                answer = yield from answer_to(asked.client, asked.handle, lambda: asked.heard_s)
                return asked.lost() if answer is None else asked.outcome(answer)
            why, refused_s = self._call("rejection"), time.monotonic()
            while not why.done() and time.monotonic() - refused_s < ASK_AGAIN_S:
                yield
            if why.done() and why.result().success:
                return asked.kind(Ending.REJECTED, why.result().message)
            waited_for = "scan_node is not active"
            yield
        if asked.cancelled:
            return asked.kind(Ending.CANCELLED, "cancelled before it was accepted")
        return asked.kind(Ending.REJECTED, f"{waited_for}, for {asked.wait_s:g} s")

    def _call(self, name: str) -> Future:
        service = self._services[name]
        if not service.service_is_ready():
            answer = Future()
            answer.set_result(Trigger.Response(success=False, message="no scan_node is there"))
            return answer
        request = service.call_async(Trigger.Request())

        def give_up() -> None:  # in the group of the service, which takes no answer meanwhile
            if not request.done():
                text = f"scan_node does not answer, for {ANSWERS_WITHIN_S:g} s"
                request.set_result(Trigger.Response(success=False, message=text))

        group = self._group
        timer = self._node.create_timer(ANSWERS_WITHIN_S, give_up, callback_group=group, clock=STEADY)
        request.add_done_callback(lambda _: self._node.destroy_timer(timer))
        return request

    def _on_point(self, message: PointResult) -> None:
        asked = self._asked
        if asked is not None and asked.on_point is not None:
            asked.on_point(message)


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"goal: {name}: got {value!r}; accepted is a number") from error


def _checked(kind: type, **values: Any) -> Any:
    """Message with its fields checked: unchecked, a value of a wrong type ends the process that sends it."""
    try:
        return kind(check_fields=True, **values)
    except AssertionError as error:
        raise ValueError(f"goal: {error}") from error
