# SPDX-License-Identifier: Apache-2.0
"""Follows a goal from its sending to its outcome in the executor of a caller, whatever is lost on the way."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action.client import ClientGoalHandle
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from unique_identifier_msgs.msg import UUID

from tactile_resonance.msg import PointResult
from tactile_resonance.nodes.goals import GoalClient, drop
from tactile_resonance.nodes.running import STEADY

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
    run_directory: str = ""  # of a scan, as heard

    def lost(self) -> Any:
        """Outcome where the server went away."""
        if not self.run_directory:
            return self.kind(Ending.LOST, "scan_node went away")
        text = "scan_node went away; the run can be resumed"
        return self.kind(Ending.LOST, text, run_directory=self.run_directory)

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
        self.run_directory = getattr(message.feedback, "run_directory", "")
        if self.on_feedback is not None:
            self.on_feedback(message.feedback)


class GoalConduct:
    """Conducts one goal at a time, in the executor that spins the node.

    Parameters
    ----------
    node : Node
    group : CallbackGroup
        Of the clients of goals and rejection.
    rejection : callable
        Asks why the newest goal was not accepted; a future of a `Trigger.Response`.
    """

    def __init__(self, node: Node, group: CallbackGroup, rejection: Callable[[], Future]) -> None:
        self._node = node
        self._rejection = rejection
        self._begin = node.create_guard_condition(self._conduct, ReentrantCallbackGroup())
        self._timer = node.create_timer(TICK_S, self._on_tick, callback_group=group, clock=STEADY)
        self._timer.cancel()
        self._tick = Future()
        self.asked: AskedGoal | None = None
        self._waiting: AskedGoal | None = None  # until it is begun, once
        self._claim = threading.Lock()

    def begin(self, asked: AskedGoal) -> Future:
        """Ask for a goal; return the future of its outcome."""
        if self.asked is not None:
            raise RuntimeError(
                "goal: one of this client is under way; cancel it or await its outcome"
            )
        self.asked = self._waiting = asked
        self._timer.reset()
        self._begin.trigger()
        return asked.future

    def cancel(self) -> None:
        """Cancel the goal under way, also before it is accepted."""
        if self.asked is not None:
            self.asked.cancelled = True
            if self.asked.handle is not None:
                self.asked.handle.cancel_goal_async()

    def destroy(self) -> None:
        """Take timer and guard condition off the node."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_guard_condition(self._begin)

    # in the executor

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
            self.asked = None
        asked.future.set_result(outcome)

    async def _send(self, asked: AskedGoal) -> Any:
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
            answers.append(asked.client.send_goal_async(asked.goal, asked.hear, goal_uuid=goal_id))
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
                why = self._rejection()
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

    async def _follow(self, asked: AskedGoal) -> Any:
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
                await self._tick


def _any_done(futures: Sequence[Future]) -> bool:
    return any(future.done() for future in futures)


def _new_id() -> UUID:
    return UUID(uuid=list(uuid.uuid4().bytes))
