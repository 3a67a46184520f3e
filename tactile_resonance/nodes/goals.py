# SPDX-License-Identifier: Apache-2.0
"""Goals of actions, asked for and followed from a thread of one's own while nodes come and go."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future

from tactile_resonance.nodes.publisher_watch import PublisherWatch
from tactile_resonance.scan.hands import Check, Interrupted, NodeAway, PointFailed, ScanEnded

POLL_S = 0.005
# A node that was started anew needs so long at most until it takes goals again.
TAKEN_WITHIN_S = 60.0
ANSWER_WITHIN_S = 2.0
# A measurement that is cancelled ends with its block.
GOAL_ENDS_WITHIN_S = 15.0


def send_goal(client: ActionClient, goal: Any, name: str, check: Check) -> ClientGoalHandle:
    """Goal that was accepted; waits for a node that is being brought back."""
    deadline = time.monotonic() + TAKEN_WITHIN_S
    while time.monotonic() < deadline:
        check()
        if client.server_is_ready():
            future = client.send_goal_async(goal)
            if is_done(future, ANSWER_WITHIN_S) and future.result().accepted:
                return future.result()
        time.sleep(0.05)
    raise ScanEnded(f"{name}: no node takes the goal for {TAKEN_WITHIN_S:g} s")


def follow_goal(
    client: ActionClient,
    handle: ClientGoalHandle,
    node: str,
    check: Check,
    watch: PublisherWatch,
    each_poll: Callable[[], None] = lambda: None,
) -> Any:
    """Result of a goal; one that is left for whatever reason is cancelled and waited for."""
    future = handle.get_result_async()
    try:
        while not future.done():
            if not client.server_is_ready():
                raise NodeAway(f"{node} went away", f"{node} went away")
            if topic := watch.renewed():
                text = f"{topic}: who publishes it was started anew"
                raise NodeAway(text, "node started anew")
            check()
            each_poll()
            time.sleep(POLL_S)
    except (PointFailed, Interrupted):
        # one that was started anew, or is gone, does not know the goal: there is no end to wait for
        cancelled = handle.cancel_goal_async()
        if is_done(cancelled, ANSWER_WITHIN_S) and cancelled.result().goals_canceling:
            is_done(future, GOAL_ENDS_WITHIN_S)
        raise
    return future.result().result


def is_done(future: Future, timeout_s: float) -> bool:
    """Wait for it; whether it came."""
    deadline = time.monotonic() + timeout_s
    while not future.done() and time.monotonic() < deadline:
        time.sleep(POLL_S)
    return future.done()
