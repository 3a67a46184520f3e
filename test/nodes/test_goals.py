# SPDX-License-Identifier: Apache-2.0
"""Goals whose answers are late or lost, on a clock set by the test: each is followed or cancelled."""

from dataclasses import dataclass
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from action_msgs.msg import GoalStatus
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future
from tactile_resonance.action import Measure, Scan

from tactile_resonance import client as client_module
from tactile_resonance.client import Ending, TactileClient
from tactile_resonance.nodes import goals as goals_module
from tactile_resonance.nodes.goals import ASK_AGAIN_S, GOAL_ENDS_WITHIN_S, TAKEN_WITHIN_S, Goals
from tactile_resonance.scan.failures import (
    Interrupted,
    NodeAway,
    PointDisturbed,
    PointFailed,
    ScanEnded,
)

REFUSED = "refused"
LOST = None


@dataclass
class Late:
    """The question itself comes so late [s]."""

    by_s: float


def nothing():
    """Has nothing to say while something is waited for."""


class Node:
    """A node that takes goals, seen through a client; time goes on in `pause` alone.

    As rclpy's server does, it refuses an id that it knows, and answers for the result of one that it does not
    know that it is unknown.

    Parameters
    ----------
    answers : dict
        Delay of the answer to the n-th question [s], `LOST`, `REFUSED`, or `Late`; by default at once.
    """

    def __init__(self, answers):
        self.now_s, self.up = 0.0, True
        self.answers = answers
        self.result_of = lambda status: status
        self.ends_after_s = 0.0  # from a cancellation to the end of its goal
        self.lost_results = self.lost_cancellations = 0  # so many of the first to come
        self.asked, self.running, self.cancelled = [], [], []
        self.requested, self.feedback = 0, None
        self.results = {}
        self._due = []

    # the clock

    def monotonic(self):
        return self.now_s

    def pause(self, seconds):
        self.now_s += seconds
        due = [entry for entry in self._due if entry[0] <= self.now_s]
        self._due = [entry for entry in self._due if entry[0] > self.now_s]
        for _, happens in due:
            happens()

    def _after(self, delay_s, happens):
        if delay_s:
            self._due.append((self.now_s + delay_s, happens))
        else:
            happens()

    def _later(self, delay_s, result):
        future = Future(executor=None)
        if delay_s is not LOST:
            self._due.append((self.now_s + delay_s, lambda: future.set_result(result)))
        return future

    # the client

    def server_is_ready(self):
        return self.up

    def send_goal_async(self, goal, feedback, goal_uuid):
        answer, self.feedback = self.answers.get(len(self.asked), 0.0), feedback
        self.asked.append(bytes(goal_uuid.uuid))
        if not isinstance(answer, Late):
            handle = self._take(goal_uuid, answer != REFUSED)
            return self._later(0.0 if answer == REFUSED else answer, handle)
        future = Future(executor=None)
        arrives = (self.now_s + answer.by_s, lambda: future.set_result(self._take(goal_uuid, True)))
        self._due.append(arrives)
        return future

    def _take(self, goal_uuid, ready):
        goal_id = bytes(goal_uuid.uuid)
        accepted = ready and goal_id not in self.results
        if accepted:
            self.running.append(goal_id)
            self.results[goal_id] = Future()
        return ClientGoalHandle(self, goal_uuid, SimpleNamespace(accepted=accepted))

    def _cancel_goal_async(self, handle):
        goal_id = bytes(handle.goal_id.uuid)
        if self.lost_cancellations:
            self.lost_cancellations -= 1
            return self._later(LOST, None)
        self.cancelled.append(goal_id)
        known = goal_id in self.running
        if known:
            self._after(self.ends_after_s, lambda: self.end(goal_id, GoalStatus.STATUS_CANCELED))
        return self._later(0.0, SimpleNamespace(goals_canceling=[goal_id] if known else []))

    def _get_result_async(self, handle):
        goal_id = bytes(handle.goal_id.uuid)
        self.requested += 1
        if self.lost_results:
            self.lost_results -= 1
            return self._later(LOST, None)
        unknown = SimpleNamespace(status=GoalStatus.STATUS_UNKNOWN, result=None)
        return self.results.get(goal_id) or self._later(0.0, unknown)

    def end(self, goal_id, status=GoalStatus.STATUS_SUCCEEDED):
        self.running.remove(goal_id)
        result = self.result_of(status)
        self.results[goal_id].set_result(SimpleNamespace(status=status, result=result))


@pytest.fixture
def taken(monkeypatch):
    """Makes a node and the goals asked of it."""

    def make(answers=None):
        node = Node(answers or {})
        monkeypatch.setattr(goals_module, "time", node)
        return node, Goals(node, "measure", node.pause)

    return make


def ended_by(node, error, after_s):
    """A check that raises from a time on."""

    def check():
        if node.now_s > after_s:
            raise error

    return check


def test_a_goal_is_asked_for_once_and_followed_to_its_end(taken):
    node, goals = taken()
    handle = goals.send("goal", nothing)
    assert handle.accepted
    (goal_id,) = node.asked
    node.end(goal_id)
    assert goals.follow(handle, nothing) == GoalStatus.STATUS_SUCCEEDED
    assert node.cancelled == []


@pytest.mark.parametrize(
    "answers", [{0: 5.0}, {0: 5.0, 1: LOST, 2: LOST}, {0: LOST}, {0: LOST, 1: 1.0}]
)
def test_a_late_or_lost_answer_is_asked_for_under_the_same_id_and_the_goal_is_taken_once(
    taken, answers
):
    node, goals = taken(answers)
    handle = goals.send("goal", nothing)
    assert node.now_s > ASK_AGAIN_S
    assert len(node.asked) > 1
    assert len(set(node.asked)) == 1
    assert node.running == [bytes(handle.goal_id.uuid)]
    node.end(node.asked[0])
    # it is the goal that is followed, whatever its second question was answered
    assert goals.follow(handle, nothing) == GoalStatus.STATUS_SUCCEEDED
    assert node.cancelled == []


def test_a_result_that_is_lost_is_requested_again(taken):
    node, goals = taken()
    handle = goals.send("goal", nothing)
    node.lost_results = 2
    node.end(node.asked[0])
    assert goals.follow(handle, nothing) == GoalStatus.STATUS_SUCCEEDED
    assert node.now_s == pytest.approx(2 * goals_module.SILENT_S, abs=0.1)


def test_a_goal_that_a_defect_ended_is_not_taken_for_done(taken):
    """ROS answers with an empty result, in which a measurement is done."""
    node, goals = taken()
    handle = goals.send("goal", nothing)
    assert Measure.Result().outcome == Measure.Result.DONE
    node.result_of = lambda status: Measure.Result()
    node.end(bytes(handle.goal_id.uuid), GoalStatus.STATUS_ABORTED)
    with pytest.raises(PointDisturbed, match="its node failed in it"):
        goals.follow(handle, nothing)


def test_a_result_is_requested_once_while_feedback_comes(taken):
    node, goals = taken()
    heard = []
    handle = goals.send("goal", nothing, heard.append)
    end_s = node.now_s + 4 * goals_module.SILENT_S

    def poll():
        node.feedback("so far")
        if node.now_s > end_s and node.running:
            node.end(node.asked[0])

    assert goals.follow(handle, poll) == GoalStatus.STATUS_SUCCEEDED
    assert node.requested == 1
    assert set(heard) == {"so far"}


def test_a_goal_that_is_refused_is_asked_for_again_as_another(taken):
    node, goals = taken({0: REFUSED, 1: REFUSED})
    handle = goals.send("goal", nothing)
    assert len(set(node.asked)) == 3
    assert node.running == [bytes(handle.goal_id.uuid)] == node.asked[-1:]


def test_a_question_that_comes_after_the_same_was_refused_leaves_no_goal_behind(taken):
    node, goals = taken({0: Late(10.0), 1: REFUSED})
    handle = goals.send("goal", nothing)
    assert node.running == [bytes(handle.goal_id.uuid)]
    assert node.running[0] != node.asked[0]
    node.pause(20.0)
    assert node.cancelled == node.asked[:1]
    assert node.running == [bytes(handle.goal_id.uuid)]


@pytest.mark.parametrize("answers", [{0: 1.0}, {0: LOST}, {0: 3.0}, {0: Late(1.0)}, {0: Late(5.0)}])
@pytest.mark.parametrize(
    "error", [Interrupted("enough"), PointFailed("no"), ScanEnded("no"), KeyboardInterrupt()]
)
def test_a_goal_that_is_given_up_before_its_answer_came_does_not_go_on(taken, answers, error):
    node, goals = taken(answers)
    with pytest.raises(type(error)):
        goals.send("goal", ended_by(node, error, 0.5))
    node.pause(10.0)  # what is late comes now
    assert node.running == []
    assert set(node.cancelled) == set(node.asked)


def test_a_goal_whose_node_goes_away_before_it_answers_is_cancelled_where_it_was_taken(taken):
    node, goals = taken({0: 3.0})

    def poll():
        node.up = node.now_s < 1.0

    with pytest.raises(NodeAway, match="measure: its node went away"):
        goals.send("goal", poll)
    node.pause(10.0)
    assert node.running == []


@pytest.mark.parametrize("answer", [REFUSED, LOST])
def test_a_goal_that_nobody_takes_ends_the_scan(taken, answer):
    node, goals = taken(dict.fromkeys(range(10000), answer))
    with pytest.raises(ScanEnded, match="measure: no node takes the goal for 60 s"):
        goals.send("goal", nothing)
    assert node.now_s == pytest.approx(TAKEN_WITHIN_S, abs=0.1)
    assert node.running == []


def test_no_goal_is_sent_while_its_node_is_away(taken):
    node, goals = taken()
    node.up = False
    with pytest.raises(ScanEnded):
        goals.send("goal", nothing)
    assert node.asked == []


@pytest.mark.parametrize("error", [Interrupted("enough"), PointFailed("no"), ScanEnded("no")])
def test_a_goal_that_is_left_is_cancelled_and_waited_for(taken, error):
    node, goals = taken()
    node.ends_after_s = 3.0  # with its block
    handle = goals.send("goal", nothing)
    with pytest.raises(type(error)):
        goals.follow(handle, ended_by(node, error, node.now_s + 1.0))
    assert node.cancelled == node.asked
    assert node.running == []


def test_a_goal_that_does_not_end_is_not_waited_for_for_ever(taken):
    node, goals = taken()
    node.ends_after_s = 1e9
    handle = goals.send("goal", nothing)
    cancelled_s = node.now_s
    with pytest.raises(Interrupted):
        goals.follow(handle, ended_by(node, Interrupted("enough"), cancelled_s))
    assert node.now_s - cancelled_s == pytest.approx(GOAL_ENDS_WITHIN_S, abs=0.1)


def test_a_goal_of_a_node_that_was_started_anew_is_not_waited_for(taken):
    node, goals = taken()
    handle = goals.send("goal", nothing)
    node.results.clear()
    node.running.clear()
    with pytest.raises(NodeAway, match="its node does not know the goal"):
        goals.follow(handle, nothing)
    assert node.now_s < 1.0


@pytest.fixture
def scan(monkeypatch):
    """Makes a node, the outcome of a scan asked of it, and what lets that scan go on for some time."""

    def make(answers=None):
        node = Node(answers or {})
        node.result_of = lambda _: Scan.Result(outcome=Scan.Result.COMPLETE)
        for module in (client_module, goals_module):
            monkeypatch.setattr(module, "time", node)
        monkeypatch.setattr(client_module, "GoalClient", lambda *_, **__: node)
        client = TactileClient(MagicMock())
        future = client.scan(scene="x.yaml")

        def go_on(seconds):
            until_s = node.now_s + seconds
            while not future.done() and node.now_s < until_s:
                client._on_tick()
                node.pause(client_module.TICK_S)

        return node, client, future, go_on

    return make


@pytest.mark.parametrize(
    "answers", [{}, {0: 5.0}, {0: 5.0, 1: LOST, 2: LOST}, {0: LOST}, {0: LOST, 1: 1.0}]
)
def test_a_scan_whose_answers_are_late_or_lost_is_accepted_once(scan, answers):
    node, _, future, go_on = scan(answers)
    go_on(10.0)
    assert len(set(node.asked)) == len(node.running) == 1
    assert not future.done()
    node.end(node.asked[0])
    go_on(1.0)
    assert future.result().ending is Ending.COMPLETE
    assert node.cancelled == []


def test_a_scan_asked_of_a_node_that_was_killed_is_taken_by_the_one_that_follows(scan):
    # a killed node stays in the graph until its lease ends: the first goal goes to it
    node, _, future, go_on = scan({0: LOST})
    go_on(1.0)
    node.up = False
    node.running.clear()
    node.results.clear()
    go_on(5.0)
    assert node.running == []
    node.up = True
    go_on(5.0)
    assert len(node.running) == 1
    assert not future.done()


def test_a_scan_whose_node_was_started_anew_is_lost(scan):
    node, _, future, go_on = scan()
    go_on(60.0)
    assert not future.done()
    node.results.clear()
    go_on(goals_module.SILENT_S + 1.0)
    assert future.result().ending is Ending.LOST


@pytest.mark.parametrize("answers", [{0: 1.0}, {0: LOST}, {0: 3.0}, {0: Late(1.0)}, {0: Late(5.0)}])
def test_a_scan_that_is_cancelled_before_its_answer_came_does_not_go_on(scan, answers):
    node, client, future, go_on = scan(answers)
    go_on(0.5)
    client.cancel()
    go_on(30.0)
    node.pause(10.0)  # what is late comes now
    assert node.running == []
    assert future.result().ending is Ending.CANCELLED


def test_a_cancellation_that_is_lost_is_sent_again_while_feedback_comes(scan):
    node, client, future, go_on = scan()
    go_on(1.0)
    node.lost_cancellations = 2
    client.cancel()
    while not future.done() and node.now_s < 30.0:
        client._asked.hear(SimpleNamespace(feedback=None))
        go_on(1.0)
    assert future.result().ending is Ending.CANCELLED
    assert node.cancelled == node.asked
