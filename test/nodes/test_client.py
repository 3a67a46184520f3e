# SPDX-License-Identifier: Apache-2.0
"""A node of a user that asks scan_node for scans: what is rejected, and why; cancel, pause, skip."""

import json
import math
import os
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.task import Future
from tactile_resonance.action import Scan
from tactile_resonance.msg import PointResult

from tactile_resonance import client as client_module
from tactile_resonance.client import CalibrationOutcome, Ending, ScanOutcome, TactileClient
from tactile_resonance.nodes import goals, scan_actions, scan_goal, scan_node
from tactile_resonance.nodes.client import NoAnswer
from tactile_resonance.nodes.running import POINT_RESULTS, POLES, initialised
from tactile_resonance.nodes.scan_actions import RUNNING
from tactile_resonance.nodes.scan_node import ScanNode
from tactile_resonance.processes import free_domain_id
from tactile_resonance.scan.run_content import checksum_of
from test.spinning import spin_until

HERE = (Pose(),)
GOAL = {"poses": HERE, "frame": "table", "force_n": 0.01}


class Stack:
    """scan_node without a robot, alone, and a user's node."""

    def __init__(self, executor, folder):
        self.executor = executor  # of the user; scan_node is a process of its own elsewhere, with one thread
        self.own = SingleThreadedExecutor()
        self.scan_node = ScanNode()
        self.user = Node("user")
        self.client = TactileClient(self.user)
        self.folder = folder
        self.own.add_node(self.scan_node)
        executor.add_node(self.user)

    def spin_once(self, timeout_s):
        self.own.spin_once(timeout_s / 2)
        self.executor.spin_once(timeout_s / 2)

    def activate(self):
        self.scan_node.trigger_configure()
        self.scan_node.trigger_activate()

    def until(self, holds):
        assert spin_until(self, holds)

    def ended(self, future):
        self.until(future.done)
        outcome = future.result()
        assert isinstance(outcome, ScanOutcome)
        return outcome

    def begin(self, heard, **goal):
        """A scan that waits for nodes, which do not come."""
        goal = {**GOAL, "run_directory": self.folder / "run", **goal}
        future = self.client.scan(**goal, on_feedback=heard.append)
        self.until(lambda: heard and heard[-1].phase == Scan.Feedback.PHASE_WAITING)
        return future


@pytest.fixture(params=[SingleThreadedExecutor, lambda: MultiThreadedExecutor(2)])
def stack(request, tmp_path):
    with initialised(
        domain_id=free_domain_id(os.environ),
        args=[
            *("--ros-args", "-p", "contact:=none", "-p", f"run_folder:={tmp_path}"),
            *("-p", f"goal_folders:=[{tmp_path}]"),
        ],
    ):
        made = Stack(request.param(), tmp_path)
        try:
            yield made
        finally:
            made.client.destroy()
            made.user.destroy_node()
            made.scan_node.destroy_node()
            made.executor.shutdown()
            made.own.shutdown()


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_goals_that_are_wrong_are_rejected_with_the_reason_and_nothing_is_left(stack):
    stack.activate()
    (stack.folder / "full").mkdir()
    (stack.folder / "full" / "something").touch()
    lying = (Pose(orientation=Quaternion(w=0.5)),)
    nowhere = (Pose(position=Point(x=math.nan)),)
    new = stack.folder / "new"
    gated = stack.folder / "gated.yaml"
    gated.write_text("gate: {force_rms_n: 3.0e-4}\nforce_n: 0.01\n")
    for changes, reason in (
        ({"poses": ()}, "scene: got ''; accepted is a scene file, or poses and force_n"),
        ({"frame": "camera"}, "got 'camera'; accepted is 'table' or 'base'"),
        ({"force_n": -0.01}, "force_n: got -0.01; accepted is a number above 0"),
        ({"force_n": 0.0}, "force_n: got 0.0; accepted is a number above 0"),
        ({"f0_std_hz": -1.0}, "f0_std_hz: got -1.0"),
        ({"damping_ratio_std": math.inf}, "damping_ratio_std: got inf"),
        ({"poses": lying}, "poses[0].orientation: got (0.0, 0.0, 0.0, 0.5)"),
        ({"poses": nowhere}, "poses[0]: x: got nan; accepted is a finite number"),
        ({"notes": "{tip_wetness: damp}"}, "notes.tip_wetness: got 'damp'"),
        ({"scene": stack.folder / "none.yaml"}, "none.yaml: cannot be read"),
        ({"run_directory": stack.folder / "full"}, "holds something; accepted is a new or empty"),
        ({"resume": True}, "accepted is the folder of a run, to resume it"),
        ({"scene": "../../setup.py"}, "scene: got '../../setup.py'; accepted is a file of the package"),
        ({"scene": "none.yaml"}, "scene: got 'none.yaml'; accepted is a file of the package"),
        ({"scene": "/etc/passwd"}, "a path in"),
        ({"run_directory": "/etc/new"}, "run_directory: got '/etc/new'; accepted is a path in"),
        ({"run_directory": "../new"}, "(goal_folders of scan_node adds others)"),
        ({"run_directory": "/etc", "resume": True}, "a path in"),
        ({"scene": gated}, "contact is none: no force is measured then"),
    ):
        goal = {**GOAL, "run_directory": new, **changes}
        outcome = stack.ended(stack.client.scan(**goal))
        assert outcome.ending is Ending.REJECTED
        assert reason in outcome.message
        assert not new.exists()


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_a_goal_that_takes_long_to_check_holds_up_nothing_else(stack, monkeypatch):
    stack.activate()
    begun, answered, waited = threading.Event(), threading.Event(), []

    def check(*_, **__):
        begun.set()
        waited.append(answered.wait(5.0))
        raise ValueError("checked")

    monkeypatch.setattr(scan_node, "new_run", check)
    scan = stack.client.scan(**GOAL)
    stack.until(begun.is_set)
    stack.until(stack.client.pause().done)
    answered.set()
    assert stack.ended(scan).message == "checked"
    assert waited == [True]


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_a_node_is_not_cleaned_up_before_its_scan_has_ended(stack):
    stack.activate()
    scan = stack.begin([])
    assert stack.scan_node.trigger_deactivate() is TransitionCallbackReturn.SUCCESS
    assert stack.scan_node.trigger_cleanup() is TransitionCallbackReturn.FAILURE
    assert stack.scan_node.state_name() == "inactive"
    assert stack.ended(scan).ending is Ending.ENDED
    assert stack.scan_node.trigger_cleanup() is TransitionCallbackReturn.SUCCESS


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("seed", -1), ("seed", 1.5), ("seed", 2**64), ("notes", None), ("frame", None)),
        *(("poses", ["x"]), ("resume", "yes")),
    ],
)
@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_values_that_no_goal_can_hold_are_refused_at_once(stack, name, value):
    """Unchecked, they end the executor, or the process."""
    field = "frame_id" if name == "frame" else name
    with pytest.raises(ValueError, match=f"goal: The '{field}' field must be"):
        stack.client.scan(**{**GOAL, name: value})
    for wrong in ("much", None):
        with pytest.raises(ValueError, match=f"goal: force_n: got {wrong!r}; accepted is a number"):
            stack.client.scan(**{**GOAL, "force_n": wrong})
    stack.activate()
    future = stack.begin([])  # another one is taken
    stack.client.cancel()
    assert stack.ended(future).ending is Ending.CANCELLED


def test_a_goal_is_sent_once_whatever_the_executor(stack, monkeypatch):
    stack.activate()
    sent, heard = [], []
    send = stack.client._scans.send_goal_async

    def counted(*arguments, **options):
        sent.append(options["goal_uuid"])
        return send(*arguments, **options)

    monkeypatch.setattr(stack.client._scans, "send_goal_async", counted)
    future = stack.begin(heard)
    said = len(heard)
    stack.until(lambda: len(heard) > said + 3)
    assert len({bytes(goal_id.uuid) for goal_id in sent}) == 1
    stack.client.cancel()
    assert stack.ended(future).ending is Ending.CANCELLED


def test_a_scan_is_followed_paused_and_cancelled_by_a_node_that_does_not_spin_itself(stack):
    stack.activate()
    heard = []
    future = stack.begin(heard)
    with pytest.raises(RuntimeError, match="one of this client is under way"):
        stack.client.scan(**GOAL)
    pausing = stack.client.pause()
    stack.until(lambda: pausing.done() and heard[-1].phase == Scan.Feedback.PHASE_PAUSED)
    assert pausing.result().success
    resuming = stack.client.resume()
    stack.until(lambda: resuming.done() and heard[-1].phase == Scan.Feedback.PHASE_WAITING)
    # somebody else's goal
    other = TactileClient(stack.user)
    outcome = stack.ended(other.scan(**GOAL))
    assert (outcome.ending, outcome.message) == (Ending.REJECTED, RUNNING)
    other.destroy()
    stack.client.cancel()
    outcome = stack.ended(future)
    assert (outcome.ending, outcome.points) == (Ending.CANCELLED, 1)
    assert outcome.run_directory == str(stack.folder / "run")
    # and the next
    heard.clear()
    again = stack.begin(heard, run_directory=stack.folder / "second")
    stack.client.cancel()
    assert stack.ended(again).ending is Ending.CANCELLED
    skipping = stack.client.skip()
    stack.until(skipping.done)
    assert (skipping.result().success, skipping.result().message) == (False, "no scan is running")


def test_results_of_points_come_while_a_scan_is_under_way(stack):
    stack.activate()
    points, inside, most_inside = [], [], []

    def on_point(point):
        inside.append(point)
        most_inside.append(len(inside))
        time.sleep(0.02)
        points.append(point.label)
        inside.pop()

    publisher = stack.user.create_publisher(PointResult, "point_result", POLES)
    publisher.publish(PointResult(label="of a scan before"))
    spin_until(stack, lambda: False, 0.5)
    future = stack.begin([], on_point=on_point)
    labels = [f"point {k}" for k in range(20)]
    for label in labels:
        publisher.publish(PointResult(label=label))
    stack.until(lambda: len(points) == len(labels))
    assert points == labels
    assert max(most_inside) == 1  # whatever the executor
    stack.client.cancel()
    stack.ended(future)
    publisher.publish(PointResult(label="of a scan after"))
    assert not spin_until(stack, lambda: len(points) > len(labels), 0.5)


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_no_result_of_a_long_run_that_is_resumed_is_lost(stack):
    """scan_node publishes all of them at once, before a client takes the first."""
    stack.activate()
    publisher, indices = stack.user.create_publisher(PointResult, "point_result", POINT_RESULTS), []
    spin_until(stack, lambda: publisher.get_subscription_count(), 10.0)
    future = stack.begin([], on_point=lambda point: indices.append(point.index))
    for index in range(1000):
        publisher.publish(PointResult(index=index))
    stack.until(lambda: indices and indices[-1] == 999)
    assert indices == list(range(1000))
    stack.client.cancel()
    stack.ended(future)


def test_an_outcome_can_be_awaited(stack):
    stack.activate()

    async def palpate():
        return await stack.client.scan(**{**GOAL, "frame": "camera"})

    task = stack.executor.create_task(palpate)
    assert stack.ended(task).ending is Ending.REJECTED


def test_a_goal_whose_frame_is_looked_up_keeps_no_other_waiting(stack, monkeypatch):
    asked, over = [], Future()

    async def look_up(node, base, names, stamp):
        if not names:
            return {}, ""
        asked.append((base, names, stamp))
        await over
        return {}, "there is none"

    monkeypatch.setattr(scan_node, "look_up", look_up)
    stack.activate()
    waiting = stack.client.scan(**{**GOAL, "frame": "camera"})
    stack.until(lambda: asked)
    assert asked[0] == ("base", ("camera",), Time())  # the newest
    other = TactileClient(stack.user)
    outcome = stack.ended(other.scan(**{**GOAL, "force_n": -1.0}))
    assert "force_n: got -1.0" in outcome.message
    assert not waiting.done()
    over.set_result(None)
    outcome = stack.ended(waiting)
    assert outcome.ending is Ending.REJECTED
    assert "got 'camera'" in outcome.message  # not why another goal, which came later, was rejected
    other.destroy()


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_of_two_clients_that_are_rejected_at_once_each_hears_its_own_reason_too(stack):
    stack.activate()
    other = TactileClient(stack.user)
    stack.until(lambda: stack.client._scans.server_is_ready() and other._scans.server_is_ready())
    asked = [stack.client.scan(**{**GOAL, "frame": "camera"}), other.scan(**{**GOAL, "force_n": -1.0})]
    told = [stack.ended(future).message for future in asked]
    assert "got 'camera'" in told[0]
    assert "force_n: got -1.0" in told[1]
    later = stack.ended(other.scan(**{**GOAL, "force_n": -2.0})).message
    assert later == "force_n: got -2.0; accepted is a number above 0 (0 or NaN: the scene's)"
    other.destroy()


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_a_node_that_is_not_active_is_waited_for(stack):
    outcome = stack.ended(stack.client.scan(**GOAL, wait_s=0.3))
    assert outcome.ending is Ending.REJECTED
    assert outcome.message == "no scan_node is there, for 0.3 s"
    repeating = stack.client.repeat()
    stack.until(repeating.done)
    assert not repeating.result().success
    stack.scan_node.trigger_configure()
    outcome = stack.ended(stack.client.scan(**GOAL, wait_s=2.0))
    assert outcome == ScanOutcome(Ending.REJECTED, "scan_node is not active, for 2 s")
    future = stack.client.scan(**GOAL)
    assert not spin_until(stack, future.done, 0.5)
    stack.client.cancel()
    assert stack.ended(future).ending is Ending.CANCELLED
    future = stack.client.scan(**{**GOAL, "frame": "camera"})
    assert not spin_until(stack, future.done, 0.5)
    stack.scan_node.trigger_activate()
    assert "got 'camera'" in stack.ended(future).message
    # what it had against the last goal is nothing against the next
    stack.scan_node.trigger_deactivate()
    outcome = stack.ended(stack.client.scan(**GOAL, wait_s=1.0))
    assert outcome.message == "scan_node is not active, for 1 s"


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_a_node_that_hangs_is_not_said_to_be_absent(stack, monkeypatch):
    monkeypatch.setattr(client_module, "ASK_AGAIN_S", 0.2)
    stack.activate()
    stack.until(stack.client._scans.server_is_ready)
    future = stack.client.scan(**GOAL, wait_s=0.3)
    assert spin_until(stack.executor, future.done)
    outcome = future.result()
    told = outcome.ending, outcome.message
    assert told == (Ending.REJECTED, "scan_node does not answer, for 0.3 s")


@pytest.mark.parametrize("name", ["pause", "resume", "skip", "repeat"])
def test_a_request_that_a_node_does_not_answer_is_given_up(stack, monkeypatch, name):
    monkeypatch.setattr(client_module, "ANSWERS_WITHIN_S", 0.3)
    stack.activate()
    stack.until(stack.client._services["pause"].service_is_ready)
    stack.until(stack.client._services["repeat_point"].service_is_ready)
    request = getattr(stack.client, name)()
    assert spin_until(stack.executor, request.done, 10.0)  # scan_node does not spin
    told = request.result().success, request.result().message
    assert told == (False, "scan_node does not answer, for 0.3 s")
    assert not list(stack.user.timers)[1:]  # the client's own alone
    # an answer that is late changes nothing, and the next request has its own
    monkeypatch.setattr(client_module, "ANSWERS_WITHIN_S", 60.0)
    again = getattr(stack.client, name)()
    stack.until(again.done)
    assert again.result().message == "no scan is running"
    assert request.result().message == told[1]


def test_a_scan_whose_node_goes_away_is_lost(stack, monkeypatch):
    monkeypatch.setattr(goals, "GONE_S", 1.0)
    stack.activate()
    heard = []
    future = stack.begin(heard, run_directory="named by the node")
    stack.own.remove_node(stack.scan_node)
    stack.scan_node.trigger_deactivate()
    stack.scan_node.trigger_shutdown()
    outcome = stack.ended(future)
    assert outcome.ending is Ending.LOST
    # it can be resumed
    assert outcome.run_directory == heard[-1].run_directory
    assert Path(outcome.run_directory, "run.json").is_file()
    far = f"{heard[-1].finished} of {heard[-1].points} points were finished"
    assert outcome.message == f"scan_node went away, {far}; the run can be resumed"
    assert (outcome.done, outcome.failed, outcome.skipped) == (None, None, None)
    assert outcome.points == heard[-1].points


def test_a_client_that_is_destroyed_leaves_no_future_undone(stack):
    stack.activate()
    other, heard = TactileClient(stack.user), []
    future = other.scan(**GOAL, run_directory=stack.folder / "run", on_feedback=heard.append)
    stack.until(lambda: heard and heard[-1].phase == Scan.Feedback.PHASE_WAITING)
    other.destroy()
    outcome = stack.ended(future)
    assert (outcome.ending, outcome.run_directory) == (Ending.LOST, str(stack.folder / "run"))
    assert outcome.message.startswith("its client was destroyed, 0 of 1 points were finished")
    # the scan goes on, and keeps others out
    assert stack.ended(stack.client.scan(**GOAL)).message == RUNNING


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_a_scan_whose_client_is_destroyed_before_it_is_seen_to_begin_is_cancelled(stack, monkeypatch):
    monkeypatch.setattr(client_module.AskedGoal, "hear", lambda *_: None)  # feedback is late
    stack.activate()
    other = TactileClient(stack.user)
    future = other.scan(**GOAL)
    stack.until(lambda: other._scans._pending_goal_requests)
    stack.user.destroy_timer(other._timer)  # it looks no more
    stack.until(lambda: stack.scan_node._goals.handle is not None)
    stack.until(lambda: not other._scans._pending_goal_requests)  # its answer has come
    other.destroy()
    assert stack.ended(future).ending is Ending.LOST
    stack.until(lambda: stack.scan_node._goals.handle is None)


@pytest.mark.parametrize("kind", [ScanOutcome, CalibrationOutcome])
def test_a_goal_whose_node_goes_away_before_a_run_is_lost_without_one(kind):
    asked = client_module.AskedGoal(None, kind, None, wait_s=1.0, on_feedback=None)
    lost = asked.lost()
    assert (type(lost), lost.ending, lost.message) == (kind, Ending.LOST, "scan_node went away")


def test_a_scan_that_another_client_left_behind_can_be_cancelled(stack):
    stack.activate()
    future = stack.begin([])
    other = TactileClient(stack.user)
    try:
        # what is under way keeps others out
        refused = other.scan(**GOAL)
        stack.until(refused.done)
        assert refused.result().ending is Ending.REJECTED
        assert "cancel it or wait" in refused.result().message
        other.cancel()
        assert stack.ended(future).ending is Ending.CANCELLED
        other.cancel()  # nothing is there to be cancelled
    finally:
        other.destroy()


@pytest.mark.parametrize(
    ("name", "now", "began", "told"),
    [
        ("table_in_base", [0.0] * 6, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0], "[0.0, 0.0, 0.0, "),
        ("contact", "none", "robot", "'none'; accepted is robot, with which the run began"),
    ],
)
def test_a_run_that_began_otherwise_is_not_resumed(stack, name, now, began, told):
    """Without a robot poles of air would count as those of its points: nothing brings the tip there."""
    stack.activate()
    future = stack.begin([], run_directory="mine")
    stack.client.cancel()
    run = Path(stack.ended(future).run_directory)
    facts = json.loads((run / "run.json").read_text())
    assert facts["facts"]["scan_node"][name] == now
    facts["facts"]["scan_node"][name] = began
    facts["crc32"] = checksum_of({key: facts[key] for key in facts if key != "crc32"})
    (run / "run.json").write_text(json.dumps(facts))
    outcome = stack.ended(stack.client.scan(run_directory="mine", resume=True))
    assert outcome.ending is Ending.REFUSED
    assert outcome.message.startswith(f"{name}: got {told}")
    assert "with which the run began, to resume it" in outcome.message


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
@pytest.mark.parametrize("where", ["start_run", "in_thread"])
def test_a_scan_that_a_defect_ends_is_not_complete(stack, monkeypatch, where):
    """ROS answers with an empty result then, whose outcome is that of a complete scan."""

    def defect(*_, **__):
        raise KeyError("what nobody thought of")

    monkeypatch.setattr(scan_node if where == "start_run" else scan_actions, where, defect)
    stack.activate()
    outcome = stack.ended(stack.client.scan(**{**GOAL, "run_directory": stack.folder / "run"}))
    expected = {
        "start_run": (Ending.REFUSED, "KeyError: 'what nobody thought of'"),
        "in_thread": (Ending.LOST, "scan_node failed in it, its log says how"),
    }
    assert (outcome.ending, outcome.message) == expected[where]
    if where == "in_thread":
        return
    monkeypatch.undo()
    heard = []
    again = stack.begin(heard, run_directory=stack.folder / "second")  # the next is taken
    stack.client.cancel()
    assert stack.ended(again).ending is Ending.CANCELLED


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_a_goal_that_a_defect_rejects_has_that_as_its_reason(stack, monkeypatch):
    def defect(*_, **__):
        raise KeyError("what nobody thought of")

    stack.activate()
    assert stack.ended(stack.client.scan(**{**GOAL, "frame": "camera"})).ending is Ending.REJECTED
    monkeypatch.setattr(scan_node, "new_run", defect)
    outcome = stack.ended(stack.client.scan(**GOAL))
    assert outcome == ScanOutcome(Ending.REJECTED, "KeyError: 'what nobody thought of'")


def test_a_scan_node_in_a_namespace_is_named(stack):
    client = TactileClient(stack.user, namespace="left")
    outcome = stack.ended(client.scan(**GOAL, wait_s=0.3))
    assert client._scans._action_name == "left/scan"
    assert outcome.ending is Ending.REJECTED
    client.destroy()


@pytest.mark.parametrize("stack", [SingleThreadedExecutor], indirect=True)
def test_scan_goal_needs_no_manager(stack, monkeypatch, tmp_path):
    """In a stack whose supervisor brings the nodes up there is none, and nobody reports that all are active."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(stack.user.context.get_domain_id()))
    stack.activate()
    given = {"scene": str(tmp_path / "none.yaml"), "resume": False, "start_within_s": 20.0}
    monkeypatch.setattr(scan_goal, "values", lambda _, *names: [given.get(name, "") for name in names])
    spinning = threading.Thread(target=stack.own.spin)
    spinning.start()
    try:
        with scan_goal.ScanRequest(lambda: None) as request, pytest.raises(NoAnswer) as ended:
            request.run()
    finally:
        stack.own.shutdown()
        spinning.join()
    assert str(ended.value).startswith(f"rejected: {tmp_path / 'none.yaml'}: cannot be read")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["-p", "start_within_s:=0"], "'0' of type 'INTEGER', expecting type 'DOUBLE': start_within_s"),
        (["-p", "start_within_s:=0.0"], "start_within_s out of range"),
        (["--params-file", "none.yaml"], "none.yaml"),
    ],
)
def test_scan_goal_refuses_in_one_line_what_it_cannot_use(given, told, monkeypatch, capsys):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain_id(os.environ)))
    monkeypatch.setattr(sys, "argv", ["scan_goal", "--ros-args", *given])
    context = rclpy.Context()
    monkeypatch.setattr(rclpy, "Context", lambda: context)
    with pytest.raises(SystemExit) as ended:
        scan_goal.main()
    assert ended.value.code == 1
    assert not context.ok()
    said = capsys.readouterr().err
    assert told in said
    assert said.count("\n") == 1
