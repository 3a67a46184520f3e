# SPDX-License-Identifier: Apache-2.0
"""Ideal contact: the force over any block in closed form, and a contact as contact_node serves it."""

import contextlib
import math
import os
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Quaternion, WrenchStamped
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from spinning import spin_until
from std_srvs.srv import SetBool, Trigger
from tactile_resonance.action import MakeContact
from tactile_resonance.msg import ContactState
from tactile_resonance.srv import ForceOver, Truth

from tactile_resonance.clock import Demand, SimulatedClock
from tactile_resonance.nodes import ideal_contact, managed_node
from tactile_resonance.nodes.fake_hardware_node import FakeHardwareNode
from tactile_resonance.nodes.ideal_contact import CONTACT_S
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.running import STREAM, initialised
from tactile_resonance.nodes.simulated_tip import MOST_STAYS, Stay, Stays
from tactile_resonance.processes import free_domain_id
from tactile_resonance.recording.messages import time_from_message
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE
from tactile_resonance.simulation.sensor.bench import BenchTip, SimulatedBench
from tactile_resonance.simulation.tissue.scene import LaidScene

SECOND_NS = 10**9
WITHIN_S = 60.0
FORCE_N = 0.01
TIME_SERVER = f"127.{1 + os.getpid() % 250}.{1 + os.getpid() // 250 % 250}.8:30021"


def stay(since_s, force_n, frame="base", x=0.0):
    pose = PoseStamped()
    pose.header.frame_id, pose.pose.position.x = frame, x
    return Stay(round(since_s * SECOND_NS), force_n, pose)


def over(stays, start_s, end_s):
    request = ForceOver.Request(
        start=time_message(round(start_s * SECOND_NS)), end=time_message(round(end_s * SECOND_NS))
    )
    return stays.serve(request, ForceOver.Response())


@pytest.fixture
def stays():
    made = Stays()
    for entry in (stay(10.0, 0.01, x=1.0), stay(12.0, 0.0, x=1.0), stay(13.0, 0.02, x=2.0)):
        made.add(entry)
    return made


@pytest.mark.parametrize(
    ("start_s", "end_s", "force_n"),
    [
        (5.0, 6.0, 0.0),
        (10.5, 11.5, 0.01),
        (9.0, 11.0, 0.005),
        (11.0, 12.5, 0.01 * 1.0 / 1.5),
        (11.5, 13.25, (0.01 * 0.5 + 0.02 * 0.25) / 1.75),
        (13.0, 13.02, 0.02),
    ],
)
def test_force_over_a_block_is_the_integral_of_what_it_was(stays, start_s, end_s, force_n):
    told = over(stays, start_s, end_s)
    assert told.force_n == pytest.approx(force_n, rel=1e-12, abs=1e-18)
    assert (told.force_std_n, told.coverage, told.reason) == (0.0, 1.0, "")


def test_spread_over_a_block_is_that_of_what_it_was(stays):
    told = over(stays, 11.0, 12.5)
    # 10 mN for two thirds of it, nothing for the rest
    assert told.force_rms_n == pytest.approx(0.01 * math.sqrt(2) / 3, rel=1e-12)
    assert (told.force_min_n, told.force_max_n) == (0.0, 0.01)
    assert over(stays, 10.5, 11.5).force_rms_n == 0.0


def test_place_over_a_block_is_where_the_tip_was(stays):
    assert over(stays, 5.0, 6.0).tip_pose.header.frame_id == ""
    assert over(stays, 10.5, 11.5).tip_pose.pose.position.x == 1.0
    later = over(stays, 14.0, 15.0).tip_pose
    assert later.pose.position.x == 2.0
    assert time_from_message(later.header.stamp) == 14_500_000_000  # its middle, whatever was published since


def test_what_is_not_kept_any_more_is_not_made_up():
    stays = Stays()
    for number in range(MOST_STAYS + 10):
        stays.add(stay(100.0 + number, 0.01))
    for end_s in (50.0, 110.5):
        told = over(stays, 40.0, end_s)
        assert math.isnan(told.force_n)
        assert math.isnan(told.force_rms_n + told.force_min_n + told.force_max_n)
        assert "before what is kept" in told.reason
    assert over(stays, 200.0, 201.0).force_n == 0.01
    assert over(stays, 201.0, 201.0).reason == "the interval is empty"


@contextlib.contextmanager
def bench(**parameters):
    """The bench with ideal contact, a client of all it serves, and something that spins."""
    parameters = {"serve_contact": True, **parameters}
    given = [
        word for name, value in parameters.items() for word in ("-p", f"{name}:={value}".lower())
    ]
    with initialised(args=["--ros-args", *given], domain_id=free_domain_id(os.environ)):
        node, executor = FakeHardwareNode(), SingleThreadedExecutor()
        node.trigger_configure()
        node.trigger_activate()
        executor.add_node(node)
        states, poses, wrenches = [], [], []
        node.create_subscription(ContactState, "contact_state", states.append, STREAM)
        node.create_subscription(PoseStamped, "tcp_pose", poses.append, STREAM)
        node.create_subscription(WrenchStamped, "wrench", wrenches.append, STREAM)
        contact = ActionClient(node, MakeContact, "make_contact")
        retract = node.create_client(Trigger, "retract")
        stop = node.create_client(SetBool, "stop")
        force = node.create_client(ForceOver, "force_over")
        truth = node.create_client(Truth, "bench/get_truth")

        def wait(holds):
            assert spin_until(executor, holds)

        def answer(future):
            wait(future.done)
            return future.result()

        def make(goal):
            handle = answer(contact.send_goal_async(goal))
            return handle, handle.get_result_async()

        def state():
            count = len(states)
            wait(lambda: len(states) > count + 1)  # one may have been on its way
            return states[-1].state

        def force_over(start_ns, end_ns):
            request = ForceOver.Request(start=time_message(start_ns), end=time_message(end_ns))
            return answer(force.call_async(request))

        wait(lambda: contact.server_is_ready() and retract.service_is_ready())
        wait(truth.service_is_ready)
        wait(lambda: force.service_is_ready() and stop.service_is_ready() and states and wrenches)
        made = SimpleNamespace(node=node, make=make, answer=answer, wait=wait, state=state)
        made.stop = lambda on: answer(stop.call_async(SetBool.Request(data=on)))
        made.retract = lambda: answer(retract.call_async(Trigger.Request()))
        made.truth = lambda **asked: answer(truth.call_async(Truth.Request(**asked)))
        made.contact, made.force_over = contact, force_over
        made.states, made.poses, made.wrenches = states, poses, wrenches
        yield made
        contact.destroy()
        node.destroy_node()


@pytest.fixture
def ideal(monkeypatch):
    monkeypatch.setattr(ideal_contact, "CONTACT_S", 0.05)
    with bench() as made:
        yield made


def goal_at(x_m=0.0, y_m=0.0, z_m=0.0, force_n=FORCE_N, turn=(0.0, 0.0, 0.0, 1.0)):
    """On the first dish of the scene, in the base."""
    goal = MakeContact.Goal(force_n=force_n)
    goal.pose.header.frame_id = "base"
    place = goal.pose.pose.position
    # the table is turned by -90 degrees about z
    place.x, place.y, place.z = (np.array(TABLE_IN_BASE[:3]) + [y_m, -x_m, z_m]).tolist()
    goal.pose.pose.orientation = Quaternion(**dict(zip("xyzw", turn, strict=True)))
    return goal


def test_a_contact_is_made_held_told_and_drawn_back(ideal):
    assert ideal.state() == "idle"
    assert math.isnan(ideal.states[-1].force_n)
    before_ns = time.time_ns()
    handle, future = ideal.make(goal_at())
    assert handle.accepted
    result = ideal.answer(future).result
    made_ns = time.time_ns()
    assert (result.reached, result.cause) == (True, "none")
    assert (result.force_n, result.force_std_n) == (FORCE_N, 0.0)
    assert result.surface_m == pytest.approx(0.0, abs=1e-12)
    # as deep as the sensor's tip presses this tissue with this force
    gel = ideal.node._touch.tip.tissue
    assert gel.name == "gel10"
    coupled = BenchTip(gel, FORCE_N, 1.0).coupled(SimulatedBench.from_configuration())
    assert result.depth_m == pytest.approx(coupled.contact.indentation_m, rel=1e-12)
    assert result.depth_m > 0
    assert ideal.state() == "hold"
    ideal.wait(lambda: ideal.wrenches[-1].wrench.force.z == FORCE_N and ideal.poses)
    assert ideal.poses[-1].pose == goal_at().pose.pose
    assert {pose.header.frame_id for pose in ideal.poses} == {
        "base"
    }  # none before the tip is placed
    assert ideal.states[-1].force_n == FORCE_N
    # what the bench knows of a place is asked for in the frame of tcp_pose too
    at_1_s = {"hold_time_s": 1.0}
    told = ideal.truth(here=True, **at_1_s), ideal.truth(position=goal_at().pose.pose.position)
    assert [(each.tissue, list(each.f0_hz)) for each in told] == [("gel10", told[0].f0_hz.tolist())] * 2
    now_ns = time.time_ns()
    assert ideal.force_over(made_ns, now_ns).force_n == FORCE_N
    assert ideal.force_over(before_ns - SECOND_NS, before_ns).force_n == 0.0
    assert ideal.retract().success
    free_ns = time.time_ns()
    assert ideal.state() == "idle"
    ideal.wait(lambda: ideal.wrenches[-1].wrench.force.z == 0.0)
    assert ideal.force_over(free_ns, free_ns + SECOND_NS).force_n == 0.0
    # the next one is taken
    assert ideal.answer(ideal.make(goal_at(x_m=0.06))[1]).result.reached
    assert ideal.node._touch.tip.tissue.name == "gel12"


@pytest.mark.parametrize(
    ("change", "cause", "message"),
    [
        ({"force_n": -0.01}, "refused", "force_n: got -0.01; accepted is 1 mN or above"),
        ({"force_n": math.nan}, "refused", "force_n: got nan"),
        ({"force_n": 0.5}, "refused", "force_n: got 0.5; accepted is up to 0.02, two thirds of"),
        ({"z_m": 2.0}, "refused", "touch: its standoff"),
        ({"turn": (1.0, 0.0, 0.0, 0.0)}, "refused", "touch: tilted by more than"),
        ({"x_m": 0.03}, "surface_missing", "nothing to touch there"),
    ],
)
def test_what_cannot_be_touched_is_refused_with_its_cause(ideal, change, cause, message):
    _, future = ideal.make(goal_at(**change))
    outcome = ideal.answer(future)
    assert outcome.status == GoalStatus.STATUS_ABORTED
    assert (outcome.result.reached, outcome.result.cause) == (False, cause)
    assert message in outcome.result.message
    assert math.isnan(outcome.result.force_n)
    assert ideal.state() == "idle"


def test_a_goal_in_another_frame_or_beside_another_contact_is_refused(ideal):
    elsewhere = goal_at()
    elsewhere.pose.header.frame_id = "table"
    _, future = ideal.make(elsewhere)
    assert "pose: in frame 'table', accepted is 'base'" in ideal.answer(future).result.message
    assert ideal.answer(ideal.make(goal_at())[1]).result.reached
    _, future = ideal.make(goal_at())
    refused = ideal.answer(future).result
    assert (refused.cause, "goal: refused in state hold" in refused.message) == ("busy", True)
    assert ideal.state() == "hold"


@pytest.mark.parametrize("under_way", [False, True])
def test_a_stop_draws_the_tip_back_and_keeps_it_out_until_it_is_released(
    ideal, monkeypatch, under_way
):
    if under_way:
        monkeypatch.setattr(ideal_contact, "CONTACT_S", WITHIN_S)
    _, future = ideal.make(goal_at())
    ideal.wait(lambda: ideal.state() == ("approach" if under_way else "hold"))
    assert ideal.stop(True).success
    assert ideal.answer(future).result.reached == (not under_way)
    assert ideal.state() == "idle"
    assert ideal.states[-1].stopped
    assert ideal.node._touch.stays.newest.force_n == 0.0
    assert not ideal.answer(ideal.contact.send_goal_async(goal_at())).accepted
    # it is remembered while the node is made anew
    ideal.node.trigger_deactivate()
    ideal.node.trigger_cleanup()
    ideal.node.trigger_configure()
    ideal.node.trigger_activate()
    assert not ideal.answer(ideal.contact.send_goal_async(goal_at())).accepted
    assert ideal.stop(False).success
    assert ideal.state() == "idle"
    assert not ideal.states[-1].stopped
    monkeypatch.setattr(ideal_contact, "CONTACT_S", 0.05)
    assert ideal.answer(ideal.make(goal_at())[1]).result.reached


def test_no_goal_is_accepted_while_the_node_is_not_active(ideal):
    ideal.node.trigger_deactivate()
    assert not ideal.answer(ideal.contact.send_goal_async(goal_at())).accepted
    ideal.node.trigger_activate()
    handle, future = ideal.make(goal_at())
    assert handle.accepted
    assert ideal.answer(future).result.reached


def cancelled(ideal, when):
    """A goal that is cancelled at some moment, and what came of it."""
    handle, future = ideal.make(goal_at())
    when()
    ideal.answer(handle.cancel_goal_async())
    return ideal.answer(future)


def test_a_contact_that_is_cancelled_under_way_is_drawn_back(ideal, monkeypatch):
    monkeypatch.setattr(ideal_contact, "CONTACT_S", WITHIN_S)
    outcome = cancelled(ideal, lambda: ideal.wait(lambda: ideal.state() == "approach"))
    assert outcome.status == GoalStatus.STATUS_CANCELED
    assert outcome.result.cause == "cancelled"
    assert not outcome.result.reached
    assert ideal.state() == "idle"


def test_a_goal_beside_one_under_way_is_refused_and_changes_nothing(ideal, monkeypatch):
    monkeypatch.setattr(ideal_contact, "CONTACT_S", WITHIN_S)
    _, future = ideal.make(goal_at())
    ideal.wait(lambda: ideal.state() == "approach")
    refused = ideal.answer(ideal.make(goal_at())[1]).result
    assert (refused.reached, refused.cause) == (False, "busy")
    assert "goal: refused in state approach" in refused.message
    assert ideal.state() == "approach"
    assert not future.done()
    assert ideal.retract().success
    assert ideal.answer(future).result.cause == "cancelled"


def test_a_contact_that_is_cancelled_before_its_work_begins_leaves_no_tip_pressing(
    ideal, monkeypatch
):
    begin, held = threading.Event(), []

    def late(*args, target, **options):
        def work():
            begin.wait(WITHIN_S)
            target()

        held.append(True)
        return threading.Thread(*args, target=work, **options)

    monkeypatch.setattr(managed_node, "threading", SimpleNamespace(Thread=late))
    handle, future = ideal.make(goal_at())
    ideal.wait(lambda: held)
    ideal.answer(handle.cancel_goal_async())
    begin.set()
    assert ideal.answer(future).status == GoalStatus.STATUS_CANCELED
    assert ideal.state() == "idle"
    assert ideal.node._touch.stays.newest.force_n == 0.0


def test_a_retraction_that_is_asked_for_as_the_tip_arrives_is_not_lost(monkeypatch):
    monkeypatch.setattr(ideal_contact, "CONTACT_S", 0.05)
    arrives, goes_on, surface = threading.Event(), threading.Event(), LaidScene.surface

    def slowly(laid):
        arrives.set()
        goes_on.wait(WITHIN_S)
        return surface(laid)

    monkeypatch.setattr(LaidScene, "surface", slowly)
    with bench() as ideal:
        _, future = ideal.make(goal_at())
        ideal.wait(arrives.is_set)
        assert ideal.retract().success
        goes_on.set()
        ideal.answer(future)
        assert ideal.state() == "idle"
        assert ideal.node._touch.stays.newest.force_n == 0.0


def test_in_simulated_time_a_contact_takes_its_time_and_no_other():
    with contextlib.ExitStack() as stack:
        ideal = stack.enter_context(bench(time_server=TIME_SERVER))
        clock = SimulatedClock(TIME_SERVER, "test", conducts=True)
        stack.callback(clock.close)
        # it takes part and needs no time to pass: only the contact lets it go on
        clock.free(Demand.NONE)
        before_ns = clock.ask_ns()
        result = ideal.answer(ideal.make(goal_at())[1]).result
        after_ns = clock.ask_ns()
        assert result.reached
        assert result.total_s == pytest.approx(CONTACT_S, abs=0.002)  # a step of the bench
        assert (after_ns - before_ns) * 1e-9 == pytest.approx(CONTACT_S, abs=0.004)
        placed = ideal.node._touch.stays.newest.pose  # the pose that `bench/truth` publishes
        assert before_ns < time_from_message(placed.header.stamp) <= after_ns
        told = ideal.force_over(after_ns, after_ns + SECOND_NS // 10)
        assert told.force_n == FORCE_N
        assert time_from_message(told.tip_pose.header.stamp) == after_ns + SECOND_NS // 20  # its middle
