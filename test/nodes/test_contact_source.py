# SPDX-License-Identifier: Apache-2.0
"""Who tells force and place of a block: what was told arrives as it is, what was not told has a reason."""

import contextlib
import math
import os
import threading
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from tactile_resonance.srv import ForceOver

from tactile_resonance.contact.force_spread import ForceSpread
from tactile_resonance.nodes import contact_source
from tactile_resonance.nodes.contact_source import ANSWER_WITHIN_S
from tactile_resonance.nodes.managed_node import HUNG_AFTER, TIME_SERVER, ManagedNode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.running import PLACES, initialised
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Contact
from tactile_resonance.recording.messages import time_from_message

START_NS, END_NS = 1_700_000_000_123_456_789, 1_700_000_000_523_456_789
WITHIN_S = 60.0


class Asker(ManagedNode):
    def __init__(self):
        super().__init__("excitation_node", (contact_source.PARAMETER, TIME_SERVER, HUNG_AFTER))

    def configure(self):
        self.source = contact_source.make_contact_source(self)


@contextlib.contextmanager
def asker(**parameters):
    """A node that asks, active, and another beside it; an executor spins both."""
    given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    with initialised(args=["--ros-args", *given], domain_id=free_domain_id(os.environ)):
        node, other, executor = Asker(), Node("contact_node"), SingleThreadedExecutor()
        node.trigger_configure()
        node.trigger_activate()
        for each in (node, other):
            executor.add_node(each)
        spinning = threading.Thread(target=executor.spin)
        spinning.start()
        try:
            yield node, other
        finally:
            executor.shutdown()
            spinning.join()
            for each in (node, other):
                each.destroy_node()


def wait(holds):
    deadline_s = time.monotonic() + WITHIN_S
    while not holds() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert holds()


def pose_at(stamp_ns):
    pose = PoseStamped()
    pose.header.stamp, pose.header.frame_id = time_message(stamp_ns), "base"
    pose.pose.position.x, pose.pose.position.z, pose.pose.orientation.y = 0.1, 0.3, 1.0
    pose.pose.orientation.w = 0.0
    return pose


def test_what_the_service_tells_of_exactly_this_block_arrives(monkeypatch):
    monkeypatch.setattr(contact_source, "ANSWER_WITHIN_S", WITHIN_S)
    asked = []

    def serve(request, response):
        asked.append((time_from_message(request.start), time_from_message(request.end)))
        response.force_n, response.force_std_n, response.coverage = 0.0101, 2e-5, 0.93
        response.force_rms_n, response.force_min_n, response.force_max_n = 3e-4, 0.009, 0.011
        response.tip_pose = pose_at(START_NS + 5)
        return response

    with asker() as (node, other):
        other.create_service(ForceOver, "force_over", serve)
        wait(node.source._client.service_is_ready)
        told = node.source.over(START_NS, END_NS)
    assert asked == [(START_NS, END_NS)]
    assert told == Contact(
        force_n=0.0101,
        force_std_n=2e-5,
        position_m=(0.1, 0.0, 0.3),
        orientation_xyzw=(0.0, 1.0, 0.0, 0.0),
        frame_id="base",
        time_ns=START_NS + 5,
        coverage=0.93,
        spread=ForceSpread(3e-4, 0.009, 0.011),
    )


def test_a_service_that_is_discovered_late_is_waited_for(monkeypatch):
    """The first block of a scan whose nodes have just come up."""
    monkeypatch.setattr(contact_source, "ANSWER_WITHIN_S", WITHIN_S)
    monkeypatch.setattr(contact_source, "DISCOVERED_WITHIN_S", WITHIN_S)

    def serve(_, response):
        response.force_n, response.force_std_n, response.coverage = 0.01, 1e-5, 1.0
        response.tip_pose = pose_at(START_NS)
        return response

    with asker() as (node, other):
        later = threading.Timer(0.5, other.create_service, (ForceOver, "force_over", serve))
        later.start()
        told = node.source.over(START_NS, END_NS)
        later.join()
    assert (told.force_n, told.reason) == (0.01, "")


def test_a_force_that_is_not_known_keeps_its_reason_and_its_place(monkeypatch):
    monkeypatch.setattr(contact_source, "ANSWER_WITHIN_S", WITHIN_S)

    def serve(request, response):
        response.force_n = response.force_std_n = math.nan
        response.coverage, response.reason = 0.4, "forces cover 40 % of the block"
        response.tip_pose = pose_at(START_NS)
        return response

    with asker() as (node, other):
        other.create_service(ForceOver, "force_over", serve)
        wait(node.source._client.service_is_ready)
        told = node.source.over(START_NS, END_NS)
    assert math.isnan(told.force_n)
    assert (told.coverage, told.reason) == (0.4, "forces cover 40 % of the block")
    assert told.position_m == (0.1, 0.0, 0.3)


def test_without_a_service_the_reason_says_so():
    with asker() as (node, _):
        told = node.source.over(START_NS, END_NS)
    assert math.isnan(told.force_n)
    assert told.position_m is None
    assert told.reason == "no node serves force_over"


@pytest.mark.parametrize(
    ("parameters", "within_s"),
    [({}, ANSWER_WITHIN_S), ({"time_server": "127.0.6.8:1", "hung_after_s": 90.0}, 90.0)],
)
def test_a_record_does_not_wait_for_an_answer_that_does_not_come(monkeypatch, parameters, within_s):
    waited_s = []

    class NeverSet(threading.Event):
        def wait(self, timeout=None):
            waited_s.append(timeout)
            return self.is_set()

    async def serve(request, response):
        await Future()
        return response

    with asker(**parameters) as (node, other):
        other.create_service(ForceOver, "force_over", serve)
        wait(node.source._client.service_is_ready)
        monkeypatch.setattr(contact_source, "threading", SimpleNamespace(Event=NeverSet))
        contact = node.source.over(START_NS, END_NS)
        assert waited_s == [within_s]
        assert not node.source._client._pending_requests
    assert math.isnan(contact.force_n)
    assert contact.reason == f"no answer on force_over within {within_s:g} s"


def test_where_nobody_measures_the_force_the_place_is_what_is_told():
    with asker(contact_source="tcp_pose") as (node, other):
        nowhere = node.source.over(START_NS, END_NS)
        assert nowhere.position_m is None
        poses = other.create_publisher(PoseStamped, "tcp_pose", PLACES)
        wait(lambda: poses.get_subscription_count() == 1)
        poses.publish(pose_at(START_NS))
        wait(lambda: node.source.over(START_NS, END_NS).position_m is not None)
        told = node.source.over(START_NS, END_NS)
    for contact in (nowhere, told):
        assert math.isnan(contact.force_n)
        assert contact.reason == "the force is not measured (contact_source)"
    assert told.position_m == (0.1, 0.0, 0.3)
    assert told.time_ns == START_NS
