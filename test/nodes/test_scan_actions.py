# SPDX-License-Identifier: Apache-2.0
"""Goals of scan_node, of which one at a time is worked at."""

import asyncio
import contextlib
from types import SimpleNamespace

import pytest

pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from tactile_resonance.nodes import scan_actions
from tactile_resonance.scan.failures import Interrupted, ScanEnded


class Node:
    """Keeps what an action is served by."""

    def __init__(self, active):
        self.active = active

    def serve(self, *_):
        pass

    def serve_trigger(self, name, do):
        self.control = do

    def act(self, kind, name, serve, on_cancel, refuses):
        self.goal, self.refuses = serve, refuses


class Result(SimpleNamespace):
    outcome, message = 0, ""


@pytest.fixture
def in_this_thread(monkeypatch):
    """Work of a goal is done at once."""

    async def here(node, work, name):
        return work()

    monkeypatch.setattr(scan_actions, "in_thread", here)
    monkeypatch.setattr(scan_actions, "end_goal", lambda goal, done: None)


@pytest.mark.parametrize("active", [True, False])
def test_a_goal_accepted_as_the_node_is_deactivated_is_cancelled_at_once(monkeypatch, in_this_thread, active):
    """`deactivate` cancels what is under way: a goal that has not begun yet has no controls to be found by."""
    node = Node(active=True)
    goals = scan_actions.OneGoal(node, contextlib.nullcontext)
    monkeypatch.setattr(goals, "_require_free", lambda: None)
    cancelled = []

    def work(goal, checked, result):
        cancelled.append(goals.controls.cancelled.is_set())

    async def check(message):
        return "checked"

    goals.act(object, "scan", check, work, Result)
    request = SimpleNamespace()
    assert not asyncio.run(node.refuses(request))
    node.active = active
    asyncio.run(node.goal(SimpleNamespace(request=request, is_cancel_requested=False)))
    assert cancelled == [not active]


def test_what_is_asked_of_a_scan_is_refused_while_a_table_is_calibrated(in_this_thread):
    """It would be answered that it is done, and the arm would go on."""
    node = Node(active=True)
    goals = scan_actions.OneGoal(node, contextlib.nullcontext)
    goals.serve_control("scan/pause", lambda controls: controls.paused.set())

    def work(goal, checked, result):
        if goal.request.action == "scan":
            node.control()
        else:
            with pytest.raises(ValueError, match="no scan is running"):
                node.control()
        paused.append(goals.controls.paused.is_set())

    async def check(message):
        return "checked"

    paused = []
    for action in ("scan", "calibrate_table"):
        goals.act(object, action, check, work, Result)
        request = SimpleNamespace(action=action)
        assert not asyncio.run(node.refuses(request))
        asyncio.run(node.goal(SimpleNamespace(request=request, is_cancel_requested=False)))
    assert paused == [True, False]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (Interrupted(), "cancelled"),
        (ScanEnded("the disk is full"), "the disk is full"),
        (ValueError("points: got 2"), "points: got 2"),
        (ZeroDivisionError("by zero"), "scan: by zero"),
    ],
)
def test_what_ends_the_work_is_the_message_of_its_result(in_this_thread, error, message):
    """Also a defect: the result of rclpy's own would tell of a scan that is done."""
    node, reported = Node(active=True), []
    failed = lambda what, defect: f"{what}: {defect}"  # noqa: E731
    node.health = SimpleNamespace(error=reported.append, failed=failed)
    goals = scan_actions.OneGoal(node, contextlib.nullcontext)

    def work(goal, checked, result):
        raise error

    async def check(message):
        return "checked"

    goals.act(object, "scan", check, work, Result)
    request = SimpleNamespace()
    assert not asyncio.run(node.refuses(request))
    goal = SimpleNamespace(request=request, is_cancel_requested=False)
    assert asyncio.run(node.goal(goal)).message == message
    assert goals.handle is None
