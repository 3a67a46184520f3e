# SPDX-License-Identifier: Apache-2.0
"""Which device a node gets, where its records go, and who tells force and place of a block."""

import contextlib
import math
import os
import re
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.task import Future
from tactile_resonance.action import Measure
from tactile_resonance.srv import ForceOver

from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.acquisition import DeviceError, DeviceInfo
from tactile_resonance.nodes import devices, excitation_node
from tactile_resonance.nodes.devices import FORCE_WITHIN_S
from tactile_resonance.nodes.excitation_node import ExcitationNode
from tactile_resonance.nodes.managed_node import HUNG_AFTER, TIME_SERVER, ManagedNode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.parameters import declare
from tactile_resonance.nodes.running import PLACES, initialised
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Channel, Contact, ForceSpread, Origin, Record
from tactile_resonance.recording.messages import record_from_message, time_from_message
from tactile_resonance.recording.store import read_stored


@pytest.fixture
def make():
    """Device of a node with these parameters."""

    def make_with(**parameters):
        given = [RosParameter(name, value=value) for name, value in parameters.items()]
        node = rclpy.create_node("owner", parameter_overrides=given)
        declare(node, devices.PARAMETERS)
        try:
            return devices.make_device(node)[0]
        finally:
            node.destroy_node()

    with initialised(domain_id=free_domain_id(os.environ)):
        yield make_with


def test_a_device_that_is_not_there_is_named(make, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="device_config: empty, expected a path .* replay"):
        make(device="replay")
    with pytest.raises(ValueError, match="no measurement in it"):
        make(device="replay", device_config=str(tmp_path))
    with pytest.raises(ValueError, match="nowhere.yaml: cannot be read"):
        make(device="nidaqmx", device_config=str(tmp_path / "nowhere.yaml"))
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with pytest.raises(DeviceError, match="install the package"):
        make(device="nidaqmx", device_config=str(share_path("config/devices/nidaqmx.yaml")))


def test_a_node_that_ends_closes_its_device(monkeypatch):
    closed = []

    class Device:
        def close(self):
            closed.append(True)

    monkeypatch.setattr(devices, "make_device", lambda _: (Device(), ()))
    with initialised(domain_id=free_domain_id(os.environ)):
        node = ExcitationNode()
        node.trigger_configure()
        node.destroy_node()
    assert closed == [True]


@contextlib.contextmanager
def active_node(monkeypatch, tmp_path, device):
    """An active excitation_node with a device of the test's own, that writes records to a folder."""
    monkeypatch.setattr(devices, "make_device", lambda _: (device, ()))
    given = ["--ros-args", "-p", f"record_folder:={tmp_path}"]
    with initialised(args=given, domain_id=free_domain_id(os.environ)):
        node = ExcitationNode()
        node.trigger_configure()
        node.trigger_activate()
        yield node
        node.destroy_node()


@pytest.mark.parametrize(
    ("raises", "kind", "outcome"),
    [
        ("plan", DeviceError, Measure.Result.REFUSED),
        ("configure", DeviceError, Measure.Result.NOT_READY),
        ("configure", ValueError, Measure.Result.REFUSED),
        ("", DeviceError, Measure.Result.REFUSED),
        ("play", DeviceError, Measure.Result.FAILED),
    ],
)
def test_what_an_error_means_is_a_matter_of_how_far_the_measurement_came(
    monkeypatch, tmp_path, raises, kind, outcome
):
    class Device(SimpleNamespace):
        def __getattr__(self, name):
            def call(*arguments):
                if name == raises:
                    raise kind(f"device: cannot {name}")
                return arguments[0] if arguments else None

            return call

        def configure(self, rate_hz):
            self.__getattr__("configure")(rate_hz)
            peak_v = 0.0 if raises == "" else math.inf
            return SimpleNamespace(name="weak", output_peak_v=peak_v)

    with active_node(monkeypatch, tmp_path, Device()) as node:
        result = node._measure(SimpleNamespace(request=Measure.Goal(level_v=0.1)), node._device)
    assert result.outcome == outcome
    expected = f"device: cannot {raises}" if raises else "level_v: peak"
    assert result.message.startswith(expected)


@pytest.mark.parametrize(
    "told",
    [
        Contact(0.01, 2e-5, (0.1, 0.0, 0.3), frame_id="base", spread=ForceSpread(1e-4, 9e-3, 0.011)),
        Contact(reason="no answer on force_over within 1 s"),
    ],
    ids=["told", "not told"],
)
def test_a_record_is_kept_and_handed_out_with_what_is_told_of_its_contact(monkeypatch, tmp_path, told):
    """Asked over the samples of this block; also where nobody answers no record is lost."""
    asked, published = [], []

    class Device:
        excitation = None

        def plan(self, excitations):
            return excitations

        def configure(self, rate_hz):
            return DeviceInfo("a device", math.inf)

        def play(self, excitation):
            self.excitation = excitation

        def read_block(self, timeout_s):
            volts = Channel(np.sin(np.arange(self.excitation.samples_per_period)))
            rate_hz, size = self.excitation.sample_rate_hz, self.excitation.samples_per_period
            return Record(volts, volts, rate_hz, size, origin=Origin(time_ns=START_NS))

        def stop(self):
            pass

        close = stop

    def ask(start_ns, end_ns):
        asked.append((start_ns, end_ns))
        return lambda: told

    with active_node(monkeypatch, tmp_path, Device()) as node:
        node._contact = SimpleNamespace(ask=ask)
        monkeypatch.setattr(node._records, "publish", published.append)
        goal = SimpleNamespace(
            request=Measure.Goal(level_v=0.1, periods=1, realisations=1),
            publish_feedback=lambda _: None,
            is_cancel_requested=False,
        )
        result = node._measure(goal, node._device)
    assert (result.message, result.blocks) == ("", 1)
    (file,) = tmp_path.rglob("record-*.npz")
    kept, (message,) = read_stored(file, Record), published
    block_ns = round(kept.samples_per_period / kept.sample_rate_hz * 1e9)
    assert asked == [(START_NS, START_NS + block_ns)]
    for record in (kept, record_from_message(message)):
        # NaN is not equal to itself
        assert repr(record.origin.contact) == repr(told)
        assert record.origin.time_ns == START_NS
        assert np.array_equal(record.sensor.samples, np.sin(np.arange(kept.samples_per_period)))


def test_a_measurement_of_a_former_configuration_leaves_the_present_one_alone(monkeypatch, tmp_path):
    """It ends when its device, which was closed, comes back from a block; another may be under way by then."""

    async def at_once(node, work, name):
        return work()

    class Device:
        info = SimpleNamespace(name="a device", output_peak_v=math.inf)

        def __init__(self):
            self.asked = []

        def __getattr__(self, name):
            def call(*given):
                self.asked.append(name)
                return self.info if name == "configure" else given[0] if given else None

            return call

        def read_block(self, timeout_s):
            node.trigger_deactivate()
            node.trigger_cleanup()
            node.trigger_configure()
            node.trigger_activate()
            node._measured, node._read_by_s = "another goal", 12.0
            raise DeviceError("device: closed")

    made, ended = [], []
    monkeypatch.setattr(devices, "make_device", lambda _: (made.append(Device()) or made[-1], ()))
    monkeypatch.setattr(excitation_node, "in_thread", at_once)
    given = ["--ros-args", "-p", f"record_folder:={tmp_path}"]
    with initialised(args=given, domain_id=free_domain_id(os.environ)):
        node = ExcitationNode()
        node.trigger_configure()
        node.trigger_activate()
        goal = SimpleNamespace(request=Measure.Goal(level_v=0.1), succeed=None, canceled=None)
        goal.abort = lambda: ended.append(goal)
        with pytest.raises(StopIteration):
            node._on_goal(goal).send(None)
        measured, read_by_s, present = node._measured, node._read_by_s, list(made[1].asked)
        node.destroy_node()
    assert ended == [goal]
    assert (measured, read_by_s) == ("another goal", 12.0)
    assert made[0].asked[-2:] == ["close", "stop"]
    assert present == []


def test_records_go_where_the_parameter_says(tmp_path):
    store = devices.open_store(str(tmp_path / "mine"), "bench")
    assert store.folder == tmp_path / "mine"
    assert not store.folder.exists()  # made by the first measurement


def test_records_go_to_ros_home_by_default(tmp_path, monkeypatch):
    parent = tmp_path / "ros" / "tactile_resonance" / "records"
    # two nodes in the same second do not share a folder
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "ros"))
    folders = [devices.open_store("", device).folder for device in ("bench", "nidaqmx")]
    assert sorted(parent.iterdir()) == sorted(folders)
    assert len(set(folders)) == 2
    assert re.fullmatch(r"\d{8}T\d{6}Z(-\d+)?", folders[0].name)
    monkeypatch.delenv("ROS_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    store = devices.open_store("", "bench")
    assert store.folder.parent == tmp_path / ".ros" / "tactile_resonance" / "records"


def test_a_replay_is_on_disk_already(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    assert devices.open_store("", "replay") is None
    assert devices.open_store(str(tmp_path / "copy"), "replay").folder == tmp_path / "copy"
    assert list(tmp_path.iterdir()) == []


def test_a_node_that_is_configured_anew_hears_each_block_of_the_bench_once():
    """Those of a device that nobody reads any more would be kept for ever."""
    with initialised(domain_id=free_domain_id(os.environ)):
        node = ExcitationNode()

        def heard():
            return [s.topic_name for s in node.subscriptions if s.topic_name == "/bench/block"]

        for _ in range(2):
            node.trigger_configure()
            assert len(heard()) == 1
            node.trigger_cleanup()
            assert heard() == []
        node.destroy_node()


START_NS, END_NS = 1_700_000_000_123_456_789, 1_700_000_000_523_456_789
WITHIN_S = 60.0


class Asker(ManagedNode):
    def __init__(self):
        super().__init__("excitation_node", (*devices.PARAMETERS, TIME_SERVER, HUNG_AFTER))

    def configure(self):
        self.source = devices.make_contact_source(self)


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
    monkeypatch.setattr(devices, "FORCE_WITHIN_S", WITHIN_S)
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
        answer = node.source.ask(START_NS, END_NS)
        wait(lambda: asked)  # the question is under way before anybody waits for its answer
        told = answer()
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
    monkeypatch.setattr(devices, "FORCE_WITHIN_S", WITHIN_S)
    monkeypatch.setattr(devices, "DISCOVERED_WITHIN_S", WITHIN_S)

    def serve(_, response):
        response.force_n, response.force_std_n, response.coverage = 0.01, 1e-5, 1.0
        response.tip_pose = pose_at(START_NS)
        return response

    with asker() as (node, other):
        later = threading.Timer(0.5, other.create_service, (ForceOver, "force_over", serve))
        later.start()
        told = node.source.ask(START_NS, END_NS)()
        later.join()
    assert (told.force_n, told.reason) == (0.01, "")


def test_a_force_that_is_not_known_keeps_its_reason_and_its_place(monkeypatch):
    monkeypatch.setattr(devices, "FORCE_WITHIN_S", WITHIN_S)

    def serve(request, response):
        response.force_n = response.force_std_n = math.nan
        response.coverage, response.reason = 0.4, "forces cover 40 % of the block"
        response.tip_pose = pose_at(START_NS)
        return response

    with asker() as (node, other):
        other.create_service(ForceOver, "force_over", serve)
        wait(node.source._client.service_is_ready)
        told = node.source.ask(START_NS, END_NS)()
    assert math.isnan(told.force_n)
    assert (told.coverage, told.reason) == (0.4, "forces cover 40 % of the block")
    assert told.position_m == (0.1, 0.0, 0.3)


def test_without_a_service_the_reason_says_so():
    with asker() as (node, _):
        told = node.source.ask(START_NS, END_NS)()
    assert math.isnan(told.force_n)
    assert told.position_m is None
    assert told.reason == "no node serves force_over"


@pytest.mark.parametrize(
    ("parameters", "within_s"),
    [({}, FORCE_WITHIN_S), ({"time_server": "127.0.6.8:1", "hung_after_s": 90.0}, 90.0)],
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
        monkeypatch.setattr(devices, "threading", SimpleNamespace(Event=NeverSet))
        contact = node.source.ask(START_NS, END_NS)()
        assert waited_s == [within_s]
        assert not node.source._client._pending_requests
    assert math.isnan(contact.force_n)
    assert contact.reason == f"no answer on force_over within {within_s:g} s"


def test_where_nobody_measures_the_force_the_place_is_what_is_told():
    with asker(contact_source="tcp_pose") as (node, other):
        nowhere = node.source.ask(START_NS, END_NS)()
        assert nowhere.position_m is None
        poses = other.create_publisher(PoseStamped, "tcp_pose", PLACES)
        wait(lambda: poses.get_subscription_count() == 1)
        poses.publish(pose_at(START_NS))
        wait(lambda: node.source.ask(START_NS, END_NS)().position_m is not None)
        told = node.source.ask(START_NS, END_NS)()
    for contact in (nowhere, told):
        assert math.isnan(contact.force_n)
        assert contact.reason == "the force is not measured (contact_source)"
    assert told.position_m == (0.1, 0.0, 0.3)
    assert told.time_ns == START_NS


def test_a_measurement_that_a_defect_ends_is_not_done():
    told = []
    health = SimpleNamespace(failed=lambda what, error: told.append(what) or repr(error))
    node = SimpleNamespace(_plan=lambda *_: {}["what nobody thought of"], health=health)
    result = ExcitationNode._measure(node, SimpleNamespace(request=Measure.Goal()), None)
    assert (result.outcome, result.blocks) == (Measure.Result.FAILED, 0)
    assert (result.message, told) == ("KeyError('what nobody thought of')", ["measurement"])
