# SPDX-License-Identifier: Apache-2.0
"""Follows a goal from its sending to its outcome in the executor of a caller, whatever is lost on the way."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action.client import ClientGoalHandle
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.task import Future

from tactile_resonance.msg import PointResult
from tactile_resonance.nodes.goals import ASK_AGAIN_S, GoalClient, offer
from tactile_resonance.nodes.running import STEADY

TICK_S = 0.1
SILENT_S = 5.0
"""A scan that has sent no feedback for so long may have lost its node: its result is requested again."""
GONE_S = 10.0
"""A node that was not discovered for so long is gone."""


class Ending(Enum):
    """How a scan or a calibration ended; a run that was begun and is not complete can be resumed."""

    COMPLETE = "complete"  # every point of the plan is finished, the table is found
    ENDED = "ended"  # some are not
    CANCELLED = "cancelled"  # on request
    REJECTED = "rejected"  # the goal was not accepted
    REFUSED = "refused"  # it was, and no point could be begun, or the touches determine no table
    LOST = "lost"  # scan_node went away


@dataclass
class AskedGoal:
    """A goal that is under way.

    Attributes
    ----------
    kind : type
        Of its outcome: a dataclass of `Ending`, message, and further fields of the action's result.
    endings : mapping from int to Ending
        By the result's field ``outcome``.
    wait_s : float
        How long an active server is waited for [s].
    on_feedback, on_point : callable, optional
        Called with each feedback, with each finished attempt at a point.
    future : Future
        Its result is the outcome.
    """

    client: GoalClient
    kind: type
    endings: Mapping[int, Ending]
    goal: Any
    wait_s: float
    on_feedback: Callable[[Any], None] | None
    on_point: Callable[[PointResult], None] | None = None
    future: Future = field(default_factory=Future)
    handle: ClientGoalHandle | None = None
    cancelled: bool = False
    heard_s: float = 0.0
    heard: Any = None  # the newest feedback

    def lost(self) -> Any:
        """Outcome where the server went away."""
        run = getattr(self.heard, "run_directory", "")
        if not run:
            return self.kind(Ending.LOST, "scan_node went away")
        far = f"{self.heard.finished} of {self.heard.points} points were finished"
        text = f"scan_node went away, {far}; the run can be resumed"
        unknown = dict.fromkeys(("done", "failed", "skipped"))
        return self.kind(Ending.LOST, text, run_directory=run, **unknown)

    def outcome(self, answer: Any) -> Any:
        """Outcome of the answer to the goal's result."""
        result, ending = answer.result, self.endings[answer.result.outcome]
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


class GoalConduct:
    """Conducts one goal at a time, in the executor that spins the node: one step with each tick of a timer.

    Parameters
    ----------
    node : Node
    group : CallbackGroup
        Of the clients of goals and rejection; its callbacks exclude each other.
    rejection : callable
        Asks why the newest goal was not accepted; a future of a `Trigger.Response`.
    """

    def __init__(self, node: Node, group: CallbackGroup, rejection: Callable[[], Future]) -> None:
        self._node, self._rejection = node, rejection
        self._timer = node.create_timer(TICK_S, self._on_tick, callback_group=group, clock=STEADY)
        self._timer.cancel()
        self.asked: AskedGoal | None = None

    def begin(self, asked: AskedGoal) -> Future:
        """Ask for a goal; return the future of its outcome."""
        if self.asked is not None:
            raise RuntimeError(
                "goal: one of this client is under way; cancel it or await its outcome"
            )
        self._steps = self._conduct(asked)
        self.asked = asked
        self._timer.reset()
        return asked.future

    def cancel(self) -> None:
        """Cancel the goal under way, also before it is accepted."""
        if self.asked is not None:
            self.asked.cancelled = True
            if self.asked.handle is not None:
                self.asked.handle.cancel_goal_async()

    def destroy(self) -> None:
        """Take the timer off the node."""
        self._node.destroy_timer(self._timer)

    # in the executor

    def _on_tick(self) -> None:
        asked = self.asked
        if asked is None:  # a timer may fire once more after it was cancelled
            return
        try:
            next(self._steps)
        except StopIteration as ended:
            self._timer.cancel()
            self.asked = None
            asked.future.set_result(ended.value)

    def _conduct(self, asked: AskedGoal) -> Generator[None, None, Any]:
        """From the goal to the outcome."""
        ended = yield from self._send(asked)
        return (yield from self._follow(asked)) if ended is None else ended

    def _send(self, asked: AskedGoal) -> Generator[None, None, Any]:
        """Send the goal until it is accepted, or return the outcome where it is not; None where it is."""
        waited_for = "no scan_node is there"
        deadline_s = time.monotonic() + asked.wait_s
        while not asked.cancelled and time.monotonic() < deadline_s:
            if not asked.client.server_is_ready():
                yield
                continue
            # what was asked for may have begun: its answer is waited for even where it is wanted no more
            wanted_s = time.monotonic()
            with contextlib.closing(offer(asked.client, asked.goal, asked.hear)) as waiting:
                while time.monotonic() - wanted_s < ASK_AGAIN_S:
                    try:
                        next(waiting)
                    except StopIteration as answered:
                        asked.handle = answered.value
                        break
                    yield
                    if not asked.cancelled and time.monotonic() < deadline_s:
                        wanted_s = time.monotonic()
                else:
                    break
            if asked.handle is not None:
                return None
            why, refused_s = self._rejection(), time.monotonic()
            while not why.done() and time.monotonic() - refused_s < ASK_AGAIN_S:
                yield
            if why.done() and why.result().success:
                return asked.kind(Ending.REJECTED, why.result().message)
            waited_for = "scan_node is not active"
            yield
        if asked.cancelled:
            return asked.kind(Ending.CANCELLED, "cancelled before it was accepted")
        return asked.kind(Ending.REJECTED, f"{waited_for}, for {asked.wait_s:g} s")

    def _follow(self, asked: AskedGoal) -> Generator[None, None, Any]:
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
                    return asked.outcome(answer)
                if asked.client.server_is_ready():
                    seen_s = time.monotonic()
                if answer is not None or time.monotonic() - seen_s > GONE_S:
                    return asked.lost()
                yield
