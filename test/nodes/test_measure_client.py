# SPDX-License-Identifier: Apache-2.0
"""All messages of a measurement are in its file, however close together they come, and in any order."""

import os
import queue
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from tactile_resonance.action import Measure

from tactile_resonance import msg
from tactile_resonance.nodes import measure_client
from tactile_resonance.nodes.fake_hardware_node import FakeHardwareNode
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.measure_client import MeasureClient, ScanRecorder
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.running import EXCITATIONS, POLES, RESULTS, initialised
from tactile_resonance.nodes.simulated_tip import truth_message
from tactile_resonance.processes import free_domain_id
from tactile_resonance.recording.messages import poles_from_message
from tactile_resonance.scan.failures import PointDisturbed, PointFailed
from tactile_resonance.scan.point_file import read_messages
from tactile_resonance.scan.point_result import POLES_TYPE, PointResult
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.run_content import file_of
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.simulation.sensor.bench import BenchTip
from test.spinning import spin_until

KEY, TRUTHS = 7, 12


class Listener(ManagedNode):
    def __init__(self):
        super().__init__("scan_node", ())

    def configure(self):
        self.recorder = ScanRecorder(self)


@pytest.fixture
def nodes():
    """Makes nodes and activates them, one executor for all."""
    with initialised(domain_id=free_domain_id(os.environ)):
        executor = SingleThreadedExecutor()

        def start(kind):
            node = kind()
            node.trigger_configure()
            node.trigger_activate()
            executor.add_node(node)
            return node

        yield start, executor
        for node in executor.get_nodes():
            node.destroy_node()


def tell(bench, number):
    """As `bench._play` does, when blocks end close together."""
    tip = BenchTip(None, 0.0, 1.0)
    for k in range(number):
        pose = PoseStamped()
        pose.header.stamp = time_message(1000 + k)
        bench._touch.truths.publish(truth_message(pose, tip, [tip.coupled(bench._bench)], KEY, "tip"))


@pytest.mark.parametrize("late", [False, True])
def test_truths_told_in_one_go_are_all_recorded(nodes, tmp_path, monkeypatch, late):
    start, executor = nodes
    bench = start(FakeHardwareNode)
    if late:  # the recorder's subscription is made, or matched, after the bench spoke
        tell(bench, TRUTHS)
    recorder = start(Listener).recorder
    plan = [ScanPoint(0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))]
    with RunDirectory.create(tmp_path / "run", "name: x\n", plan, {}) as run:
        with run.begin_point(0) as recording:
            recording.measurement_id = KEY
            write, topics = recording.write, []
            monkeypatch.setattr(
                recording, "write", lambda topic, *of: (topics.append(topic), write(topic, *of))
            )
            with recorder.recording(recording):
                assert spin_until(executor, bench._touch.truths.get_subscription_count)
                if not late:
                    tell(bench, TRUTHS)
                assert spin_until(executor, lambda: topics.count("/bench/truth") >= TRUTHS)
            recording.finish(PointResult(0, measurement_id=KEY))
        (result,) = run.content.latest
        messages = read_messages(file_of(run.path, result), POLES_TYPE)
        told = [poles_from_message(message)[1] for _, _, message in messages]
    assert [origin.time_ns for origin in told] == [1000 + k for k in range(TRUTHS)]


def test_a_measurement_is_complete_with_all_of_its_excitations(nodes, tmp_path):
    """Excitations have a topic of their own, so that records may come before them."""
    start, executor = nodes
    recorder = start(Listener).recorder
    outside = rclpy.create_node("outside")
    executor.add_node(outside)
    publishers = {
        topic: outside.create_publisher(kind, topic, qos)
        for topic, kind, qos in (
            ("excitation", msg.Excitation, EXCITATIONS),
            ("record", msg.Record, RESULTS),
            ("frf", msg.FRF, RESULTS),
            ("poles", msg.Poles, POLES),
        )
    }

    def tell(topic, **fields):
        publishers[topic].publish(publishers[topic].msg_type(measurement_id=KEY, **fields))

    assert spin_until(
        executor, lambda: all(p.get_subscription_count() for p in publishers.values())
    )
    plan = [ScanPoint(0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))]
    with (
        RunDirectory.create(tmp_path / "run", "name: x\n", plan, {}) as run,
        run.begin_point(0) as recording,
    ):
        recording.measurement_id = KEY
        with recorder.recording(recording):
            tell("excitation", excitation_id=4)
            for excitation_id in (4, 5):  # two realisations of a block each
                for topic in ("record", "frf", "poles"):
                    for _ in range(2):  # what comes twice is one block all the same
                        tell(topic, excitation_id=excitation_id)
            without = "of 2 blocks came 2 records, 2 FRFs, 2 poles; excitations without a message: 1"
            assert spin_until(executor, lambda: recorder.missing(2) == without)
            tell("excitation", excitation_id=5)
            assert spin_until(executor, lambda: recorder.missing(2) == "")
            assert recorder.missing(3).startswith("of 3 blocks came 2 records")
            assert recorder.poles.qsize() == 2
        recording.finish(PointResult(0, measurement_id=KEY))


def test_a_contact_that_is_seen_lost_after_the_last_block_was_lost_in_it():
    """The mean force sinks for 50 ms before a contact counts as lost: the measurement may be over by then."""
    done, polls = Measure.Result(outcome=Measure.Result.DONE, blocks=1), []

    def held():
        if polls:
            raise PointFailed("contact: contact_lost")

    def follow(handle, each_poll):
        each_poll()
        polls.append(handle)
        return done

    client = MeasureClient.__new__(MeasureClient)
    client._time = SimpleNamespace(simulated=False, go=lambda: None, patience_s=lambda s: s)
    client._goals = SimpleNamespace(send=lambda *_, **__: "handle", follow=follow)
    client.recorder = SimpleNamespace(poles=queue.SimpleQueue(), missing=lambda blocks: "")
    client.recorder.poles.put(msg.Poles())
    asked = Measure.Goal(), lambda *_: False, lambda: None
    assert client._follow(*asked, lambda: None) is not None
    client.recorder.poles.put(msg.Poles())
    polls.clear()
    with pytest.raises(PointFailed, match="contact_lost"):
        client._follow(*asked, held)


@pytest.mark.parametrize("blocks", [30, 31])
def test_results_are_waited_for_as_long_as_they_come(monkeypatch, blocks):
    """Fits that take four times as long as their blocks are 90 s behind after 30 blocks of 1 s."""
    now_s, fit_s = [0.0], 4.0
    monkeypatch.setattr(measure_client.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(
        measure_client.time, "sleep", lambda seconds: now_s.__setitem__(0, now_s[0] + seconds)
    )

    def missing(wanted):
        came = min(int(now_s[0] / fit_s), 30)  # a thirty-first never comes
        return "" if came >= wanted else f"of {wanted} blocks came {came} poles"

    client = MeasureClient.__new__(MeasureClient)
    client._time = SimpleNamespace(patience_s=lambda s: s)
    client.recorder = SimpleNamespace(missing=missing)
    result = Measure.Result(outcome=Measure.Result.DONE, blocks=blocks)
    if blocks == 30:
        client._wait_for_results(result, lambda: None)
        assert now_s[0] == pytest.approx(30 * fit_s, abs=2 * measure_client.POLL_S)
    else:
        with pytest.raises(PointDisturbed, match="of 31 blocks came 30 poles"):
            client._wait_for_results(result, lambda: None)
        limit_s = 30 * fit_s + measure_client.RESULTS_WITHIN_S
        assert now_s[0] == pytest.approx(limit_s, abs=2 * measure_client.POLL_S)
