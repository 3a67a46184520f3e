# SPDX-License-Identifier: Apache-2.0
"""Goals of actions, asked for and followed while nodes come and go; and answers of services.

Every goal has an id that is chosen here, before anything is sent. So a goal whose answer is late, or lost, is
sent again under the same id, and accepted once; and a goal that is given up can be cancelled whether its answer
came or not. No goal goes on that is no longer followed.

`offer` and `answer_to` are generators, to be asked for again and again while answers are received: they yield
while they wait. `Goals` does so in a thread of one's own, `client.TactileClient` with a timer.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
import uuid
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.client import Client
from rclpy.task import Future
from unique_identifier_msgs.msg import UUID

from tactile_resonance.scan.failures import (
    Interrupted,
    NodeAway,
    PointDisturbed,
    PointFailed,
    ScanEnded,
)
from tactile_resonance.scan.hands import Check


def _locked(name: str) -> Callable:
    """Method of `ActionClient`, while no other of its client's is under way in another thread."""

    def call(client: GoalClient, *args: Any, **kwargs: Any) -> Any:
        with client.registering:
            return getattr(ActionClient, name)(client, *args, **kwargs)

    return call


class GoalClient(ActionClient):
    """`ActionClient` whose executor takes no answer before its request is registered.

    rclpy of Jazzy sends a request before it registers it: an answer that the executor's thread takes in between
    is dropped, and its future is never done (rclpy #1123). Kilted has this lock itself.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.registering = threading.Lock()
        super().__init__(*args, **kwargs)

    # what the executor takes answers with; what sends, the last two for the methods of a goal handle
    take_data, send_goal_async = _locked("take_data"), _locked("send_goal_async")
    _get_result_async = _locked("_get_result_async")
    _cancel_goal_async = _locked("_cancel_goal_async")


POLL_S = 0.005
# A node that was restarted accepts goals again within this.
TAKEN_WITHIN_S = 60.0
# An answer that has not come by then may be lost: the goal is sent again.
ASK_AGAIN_S = 2.0
# A goal without feedback for so long may have lost its node, or its result: that is requested again.
SILENT_S = 5.0
# A node that was not discovered for so long is gone.
GONE_S = 10.0
# A measurement that is cancelled ends with its block.
GOAL_ENDS_WITHIN_S = 15.0
REFUSED_AGAIN_S = 0.05

Steps = Generator[None, None, Any]


@dataclass
class Goals:
    """Goals of one action, one at a time.

    Parameters
    ----------
    client : ActionClient
    name : str
        Of the action, for messages.
    pause : callable
        Waits for a time [s]; answers are received meanwhile, by another thread or by this call.
    """

    client: ActionClient
    name: str
    pause: Callable[[float], None] = time.sleep
    _heard_s: float = field(default=-math.inf, init=False)  # feedback of the newest goal

    def send(
        self,
        goal: Any,
        check: Check,
        feedback: Callable[[Any], None] | None = None,
        refused: Callable[[], None] = lambda: None,
    ) -> ClientGoalHandle:
        """Send a goal until it is accepted; waits for a node that is being brought back, unless `check` raises.

        `refused` is called after each refusal: nothing of this goal is under way then.

        Raises
        ------
        NodeAway
            If the node goes away meanwhile.
        ScanEnded
            If no node accepts it.
        """

        def hear(message: Any) -> None:
            self._heard_s = time.monotonic()
            if feedback is not None:
                feedback(message)

        deadline_s = time.monotonic() + TAKEN_WITHIN_S
        while time.monotonic() < deadline_s:
            check()
            if self.client.server_is_ready():
                with contextlib.closing(offer(self.client, goal, hear)) as steps:
                    handle = self._wait(steps, lambda: self._require_node(check), deadline_s)
                if handle is not None:
                    return handle
                refused()
            self.pause(REFUSED_AGAIN_S)
        raise ScanEnded(f"{self.name}: no node takes the goal for {TAKEN_WITHIN_S:g} s")

    def follow(self, handle: ClientGoalHandle, check: Check) -> Any:
        """Result of a goal; where anything is raised the goal is cancelled first, and its end waited for.

        `PointDisturbed` where a defect of the node ended it.
        """
        steps = answer_to(self.client, handle, lambda: self._heard_s)
        try:
            answer = self._wait(steps, lambda: self._require_node(check))
            if answer is None:
                raise NodeAway(f"{self.name}: its node does not know the goal", "node went away")
        except (PointFailed, Interrupted, ScanEnded):
            # a node that was restarted, or is gone, does not know the goal: its end is not waited for
            cancelled = handle.cancel_goal_async()
            answered = wait_for(cancelled.done, ASK_AGAIN_S, pause=self.pause)
            if answered and cancelled.result().goals_canceling:
                self._wait(steps, lambda: None, time.monotonic() + GOAL_ENDS_WITHIN_S)
            raise
        if failed_in(answer):
            text = f"{self.name}: its node failed in it, its log says how"
            raise PointDisturbed(text, "node failed")
        return answer.result

    def _wait(self, steps: Steps, each: Callable[[], None], until_s: float = math.inf) -> Any:
        """What a generator returns; None where it has not returned by then."""
        while time.monotonic() < until_s:
            try:
                next(steps)
            except StopIteration as ended:
                return ended.value
            each()
            self.pause(POLL_S)
        return None

    def _require_node(self, check: Check) -> None:
        if not self.client.server_is_ready():
            raise NodeAway(f"{self.name}: its node went away", "node went away")
        check()


def wait_for(
    holds: Callable[[], bool],
    within_s: float,
    check: Check = lambda: None,
    pause: Callable[[float], None] = time.sleep,
) -> bool:
    """Whether something holds within a time [s]; `check` and `pause` as those of `answer_of`."""
    deadline_s = time.monotonic() + within_s
    while not holds():
        check()
        if time.monotonic() > deadline_s:
            return False
        pause(POLL_S)
    return True


def answer_of(
    service: Client,
    request: Any,
    within_s: float,
    *,
    check: Check = lambda: None,
    pause: Callable[[float], None] = time.sleep,
) -> Any:
    """Answer of a service that may be asked twice; None where none comes in time.

    A server that does not know its client yet drops the answer: it is asked again.

    Parameters
    ----------
    service : Client
    request : message
    within_s : float
        Longest wait, also for the service to be there [s].
    check : callable
        Called while waiting; raises where that has become pointless.
    pause : callable
        As that of `Goals`.
    """
    asked: list[Future] = []
    asked_s = -math.inf

    def answered() -> bool:
        nonlocal asked_s
        if time.monotonic() - asked_s > ASK_AGAIN_S and service.service_is_ready():
            asked.append(service.call_async(request))
            asked_s = time.monotonic()
        return any(each.done() for each in asked)

    wait_for(answered, within_s, check, pause)
    for each in asked:
        if not each.done():
            service.remove_pending_request(each)
    return next((each.result() for each in asked if each.done()), None)


def offer(
    client: ActionClient,
    goal: Any,
    feedback: Callable[[Any], None],
    wanted: Callable[[], bool] = lambda: True,
) -> Steps:
    """Offer a goal until it is answered; the handle of one that was accepted, None of one that was refused.

    One that is closed before is given up: whatever accepts the goal later cancels it. So is, with
    ``TimeoutError``, one that has no answer for a while after it was `wanted` last: it may have begun.
    """
    goal_id = UUID(uuid=list(uuid.uuid4().bytes))
    futures: list[Future] = []
    asked_s, wanted_s = -math.inf, time.monotonic()
    try:
        while True:
            if wanted():
                wanted_s = time.monotonic()
            elif time.monotonic() - wanted_s > ASK_AGAIN_S:
                raise TimeoutError
            if time.monotonic() - asked_s > ASK_AGAIN_S and client.server_is_ready():
                futures.append(client.send_goal_async(goal, feedback, goal_uuid=goal_id))
                asked_s = time.monotonic()
            answers = [future.result() for future in futures if future.done()]
            taken = next((answer for answer in answers if answer.accepted), None)
            if taken is not None:
                return taken
            if futures and futures[-1].done():
                # where it was sent twice a refusal may mean that it is known already
                refused = futures[-1].result()
                if len(futures) > 1 and (yield from _known(refused)):
                    return refused
                _drop(futures)
                return None
            yield
    except BaseException:
        _drop(futures)
        # its answer may be lost, and a cancellation does not need it; RuntimeError: ROS has been shut down
        with contextlib.suppress(RuntimeError):
            ClientGoalHandle(client, goal_id, None).cancel_goal_async()
        raise


def answer_to(
    client: ActionClient, handle: ClientGoalHandle, heard_s: Callable[[], float]
) -> Steps:
    """Answer to the result of a goal; None where its node has gone or does not know it.

    The result is requested again where neither it nor feedback, last at `heard_s`, has come for a while: each
    request is answered, and a result may be large.
    """
    answers: list[Future] = []
    asked_s, seen_s = -math.inf, time.monotonic()
    while True:
        now_s = time.monotonic()
        if now_s - max(asked_s, heard_s()) > SILENT_S or not answers:
            answers.append(handle.get_result_async())
            asked_s = now_s
        answer = next((each.result() for each in answers if each.done()), None)
        if answer is not None:
            return None if answer.status == GoalStatus.STATUS_UNKNOWN else answer
        if client.server_is_ready():
            seen_s = now_s
        elif now_s - seen_s > GONE_S:
            return None
        yield


def failed_in(answer: Any) -> bool:
    """Whether a defect ended a goal: rclpy gives an empty result then, whose outcome is that of success."""
    aborted = answer.status == GoalStatus.STATUS_ABORTED
    return aborted and answer.result == type(answer.result)()


def _known(refused: ClientGoalHandle) -> Generator[None, None, bool]:
    """Whether the node has a goal of this id after all."""
    result, asked_s = refused.get_result_async(), time.monotonic()
    while not result.done():
        if time.monotonic() - asked_s > ASK_AGAIN_S:
            return True  # it is under way
        yield
    return result.result().status != GoalStatus.STATUS_UNKNOWN


def _drop(futures: list[Future]) -> None:
    """Ignore answers from now on, but cancel goals that they accept."""
    for future in futures:
        future.add_done_callback(_cancel_if_taken)


def _cancel_if_taken(future: Future) -> None:
    """Cancel a goal that was accepted and is no longer followed."""
    if not future.cancelled() and future.exception() is None and future.result().accepted:
        with contextlib.suppress(RuntimeError):  # its client was destroyed, or ROS shut down
            future.result().cancel_goal_async()
