# SPDX-License-Identifier: Apache-2.0
"""No block is dropped silently: on disk before it is heard, refused before it is played."""

import array
import signal
import struct
import time

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from robot_at_hand import own_time
from tactile_resonance.action import Measure

from tactile_resonance import msg
from tactile_resonance.nodes.client import HANGS_S, NodeClient
from tactile_resonance.nodes.messages import pose_to_message, record_to_message
from tactile_resonance.nodes.running import EXCITATIONS, RESULTS, STREAM
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.record import Contact
from test.recording.stores import read_store

TOPICS = {
    "excitation": (msg.Excitation, EXCITATIONS),
    "record": (msg.Record, RESULTS),
    "frf": (msg.FRF, RESULTS),
    "poles": (msg.Poles, RESULTS),
    "bench/block": (msg.Record, RESULTS),
}
STREAMED = ("record", "frf", "poles")
TIME = own_time(15)
# short periods: many blocks in little time
SHORT = {"samples_per_period": 2000, "f_min_hz": 100.0}
SILENT_S = 1.0
"""Periods are 0.04 s."""


class Client(NodeClient):
    """Asks for measurements and hears everything; moves the tip as a robot would."""

    def __init__(self):
        super().__init__("client", lambda: None)

    def join(self):
        self.heard = {topic: [] for topic in TOPICS}
        for topic, (kind, qos) in TOPICS.items():
            self._node.create_subscription(kind, topic, self.heard[topic].append, qos)
        self.pose = self._node.create_publisher(PoseStamped, "tcp_pose", STREAM)
        self._node.create_timer(0.05, self.move)
        self.moves = 0
        self.client = ActionClient(self._node, Measure, "measure")

    def why(self):
        return str({topic: len(messages) for topic, messages in self.heard.items()})

    def move(self):
        self.moves += 1
        contact = Contact(
            position_m=(1e-5 * self.moves, 0.0, 0.0), frame_id="table", time_ns=time.time_ns()
        )
        self.pose.publish(pose_to_message(contact))

    def until(self, done, what):
        self.wait(done, HANGS_S, what)

    def ask(self, **goal):
        """Future of the result of a goal; asked until the node is active."""
        return self.begin(self.client, Measure.Goal(**goal)).get_result_async()

    def measure(self, **goal):
        result = self.ask(**goal)
        self.until(result.done, "the measurement")
        return result.result().result

    def meet(self, **goal):
        """Measure until every topic is heard, and the bench hears the tip's place."""
        for attempt in range(10):
            key = self.measure(**goal).measurement_id
            deadline = time.monotonic() + 2.0 * (1 + attempt)
            while time.monotonic() < deadline:
                self.spin(0.05)
                if all(self.finished(topic, key) for topic in STREAMED):
                    if self.of("record", key)[-1].tip_pose.pose.position.x > 0:
                        return
                    self.spin(0.5 * (1 + attempt))  # the bench has not discovered who tells it
                    break
        raise AssertionError("the nodes are not heard")

    def measure_to_the_end(self, **goal):
        """Measure, and wait for its poles before the next, as a scan does; the id."""
        key = self.measure(**goal).measurement_id
        self.until(lambda: all(self.finished(topic, key) for topic in STREAMED), "its poles")
        return key

    def until_silent(self, topic):
        """Wait until nothing has come on a topic for a while."""
        count, news_s = -1, 0.0

        def silent():
            nonlocal count, news_s
            if count != (count := len(self.heard[topic])):
                news_s = time.monotonic()
            return time.monotonic() - news_s > SILENT_S

        self.until(silent, f"{topic} to be silent")

    def of(self, topic, key):
        return [m for m in self.heard[topic] if m.measurement_id == key]

    def finished(self, topic, key):
        return any(m.final for m in self.of(topic, key))


def bits(message):
    """Everything in a message, to the bit; its serialised form has padding of any value."""
    if hasattr(message, "get_fields_and_field_types"):
        return [bits(getattr(message, name)) for name in message.get_fields_and_field_types()]
    if isinstance(message, array.array):
        return message.tobytes()
    return struct.pack("d", message) if isinstance(message, float) else message


def start(nodes, names, **parameters):
    nodes.bring_up(names, parameters)


def assert_on_disk(content, messages):
    """Every message is in the store, to the bit."""
    stored = {
        (m.measurement_id, r.realisation, r.block_index): r
        for m in content.measurements
        for r in m.records
    }
    for message in messages:
        record = stored[(message.measurement_id, message.realisation, message.block_index)]
        assert bits(record_to_message(record)) == bits(message)


def test_kill_leaves_every_published_record_on_disk(domain, tmp_path):
    records = tmp_path / "records"
    with NodeProcesses(tmp_path / "log") as nodes, Client() as client:
        start(
            nodes,
            ("fake_hardware_node", "excitation_node", "frf_node", "poles_node"),
            excitation_node={"record_folder": records, "time_server": TIME, **SHORT},
            fake_hardware_node={"time_server": TIME},
        )
        client.meet(periods=3)
        client.heard["record"].clear()
        client.ask(periods=100_000, label="to be killed")
        client.until(lambda: len(client.heard["record"]) >= 25, "records")
        node = nodes._processes["excitation_node"]
        node.send_signal(signal.SIGKILL)
        node.wait()
        client.until_silent("record")  # what was on its way
    content = read_store(records)
    assert content.problems == []
    last = content.measurements[-1]
    assert last.gaps == ()
    assert last.excitations[0].label == "to be killed"
    assert len(last.records) >= len(client.heard["record"]) >= 25
    assert_on_disk(content, client.heard["record"])


def test_what_cannot_be_recorded_is_refused_before_anything_is_played(domain, tmp_path):
    blocked = tmp_path / "a file"
    blocked.write_text("no folder")
    with NodeProcesses(tmp_path / "log") as bench, Client() as client:
        start(bench, ("fake_hardware_node",), fake_hardware_node={"time_server": TIME})
        with NodeProcesses(tmp_path / "log") as nodes:
            start(
                nodes,
                ("excitation_node",),
                excitation_node={"record_folder": blocked / "x", "time_server": TIME},
            )
            result = client.measure(periods=3)
            assert result.outcome == Measure.Result.REFUSED
            assert result.message.startswith("record_folder: ")
            assert "a file" in result.message
        with NodeProcesses(tmp_path / "log") as nodes:
            start(
                nodes,
                ("excitation_node",),
                excitation_node={"record_folder": tmp_path / "r", "time_server": TIME},
            )
            result = client.measure(periods=2**32 - 1)
            assert result.outcome == Measure.Result.REFUSED
            assert "MB free, the measurement may take 14" in result.message
            assert list((tmp_path / "r").iterdir()) == []
            assert client.heard["excitation"] == []
            assert client.heard["bench/block"] == []
            # and what fits is measured as if nothing had happened
            assert client.measure(periods=3).outcome == Measure.Result.DONE


def test_a_disk_that_goes_away_ends_the_measurement(domain, tmp_path):
    records = tmp_path / "records"
    with NodeProcesses(tmp_path / "log") as nodes, Client() as client:
        start(
            nodes,
            ("fake_hardware_node", "excitation_node"),
            excitation_node={"record_folder": records, "time_server": TIME, **SHORT},
            fake_hardware_node={"time_server": TIME},
        )
        result = client.ask(periods=100_000)
        client.until(lambda: len(client.heard["record"]) >= 5, "records")
        records.rename(tmp_path / "gone")
        client.until(result.done, "the measurement to end")
        result = result.result().result
        assert result.outcome == Measure.Result.FAILED
        assert result.message.startswith("record_folder: ")
        # only what had been written was handed out
        last = result.blocks - 1
        client.until(lambda: client.heard["record"][-1].block_index == last, "the last record")
        client.until_silent("bench/block")
        assert client.heard["record"][-1].block_index == last


def test_replay_gives_the_same_frfs_and_poles_to_the_bit(domain, tmp_path):
    records = tmp_path / "records"
    readers = ("frf_node", "poles_node")
    with NodeProcesses(tmp_path / "log") as nodes, Client() as client:
        start(
            nodes,
            ("fake_hardware_node", "excitation_node", *readers),
            excitation_node={
                "record_folder": records,
                "frame_id": "left/tip",
                "time_server": TIME,
            },
            fake_hardware_node={"time_server": TIME},
        )
        client.meet(periods=3)
        keys = [
            client.measure_to_the_end(periods=4, realisations=2, label=f"point {k}", seed=k)
            for k in (1, 2)
        ]
        recorded = {
            (topic, key): [bits(m) for m in client.of(topic, key)]
            for topic in STREAMED
            for key in keys
        }
        assert {len(messages) for messages in recorded.values()} == {8}
        assert client.of("poles", keys[0])[-1].f0_hz[0] == pytest.approx(250, abs=50)
        assert client.of("record", keys[1])[-1].tip_pose.pose.position.x > 0
    content = read_store(records)
    warm_up = [m.measurement_id for m in content.measurements if m.measurement_id not in keys]
    assert [m.measurement_id for m in content.measurements[-2:]] == keys

    with NodeProcesses(tmp_path / "log") as nodes, Client() as client:
        start(
            nodes,
            ("excitation_node", *readers),
            excitation_node={
                "device": "replay",
                "device_config": records,
                "replay_speed": 0.0,
                "frame_id": "elsewhere",
            },
        )
        client.meet(
            measurement_id=warm_up[-1]
        )  # the first may have been before the bench heard of the tip
        # out of turn, the warm-up did not count
        replayed = [client.measure_to_the_end() for _ in content.measurements]
        assert replayed == [m.measurement_id for m in content.measurements]
        for (topic, key), messages in recorded.items():
            assert [bits(m) for m in client.of(topic, key)] == messages
        result = client.measure()
        assert result.outcome == Measure.Result.REFUSED
        assert "the recording is over" in result.message
