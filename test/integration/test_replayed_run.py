# SPDX-License-Identifier: Apache-2.0
"""A run holds exactly what was published, tells any reader what it means, and gives the same poles again."""

import array
import dataclasses
import struct
import time
from collections import defaultdict
from functools import partial

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.action import ActionClient
from robot_at_hand import own_time
from rosbags.highlevel import AnyReader
from tactile_resonance.action import Measure

from tactile_resonance import msg
from tactile_resonance.client import Ending
from tactile_resonance.nodes.client import HANGS_S, ScanClient
from tactile_resonance.nodes.running import EXCITATIONS, RESULTS
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.scan.run_content import read_run

TIME = own_time(17)
SCENE = """
name: four points
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.00, 0.0], radius_m: 0.025}}
  - {name: gelatine 16 %, gelatine_percent: 16.0, disc: {center_m: [0.06, 0.0], radius_m: 0.025}}
positions:
  list: [[0.0, 0.0], [0.004, 0.0], [0.056, 0.0], [0.06, 0.0]]
precision: {f0_std_hz: 0.03}
blocks: {least: 3, most: 5}
"""
TOPICS = {
    "/excitation": (msg.Excitation, EXCITATIONS),
    "/record": (msg.Record, RESULTS),
    "/frf": (msg.FRF, RESULTS),
    "/poles": (msg.Poles, RESULTS),
}
READERS = ("frf_node", "poles_node")


class Client(ScanClient):
    """Asks for scans and measurements, and keeps everything that is published.

    Attributes
    ----------
    heard : dict
        Messages in their order, by topic and measurement.
    """

    def join(self):
        super().join()
        self.heard = defaultdict(list)
        for topic, (kind, qos) in TOPICS.items():
            self._node.create_subscription(kind, topic, partial(self._hear, topic), qos)
        self._measure = ActionClient(self._node, Measure, "measure")

    def _hear(self, topic, message):
        self.heard[topic, message.measurement_id].append(message)

    def ask(self, **goal):
        """Future of a measurement's result."""
        return self.begin(self._measure, Measure.Goal(**goal)).get_result_async()

    def measure(self, **goal):
        future = self.ask(**goal)
        self.wait(future.done, HANGS_S, "the measurement")
        return future.result().result

    def has(self, key, blocks):
        """Whether everything of a measurement has come."""
        return all(len(self.heard[t, key]) == blocks for t in TOPICS if t != "/excitation")

    def join_all(self, **goal):
        """Measure until everything of a measurement is heard: all have found each other by then."""
        for attempt in range(10):
            self.heard.clear()  # a replay has the same id again
            result = self.measure(**goal)
            deadline = time.monotonic() + 2.0 * (1 + attempt)
            while time.monotonic() < deadline:
                self.spin(0.05)
                if self.has(result.measurement_id, result.blocks):
                    return
        raise AssertionError("the nodes are not heard")


def bits(message, *without):
    """Everything in a message, to the bit, of whatever library; serialised forms have padding of any value."""
    if hasattr(message, "get_fields_and_field_types"):
        names = message.get_fields_and_field_types()
    elif dataclasses.is_dataclass(message):
        # without the constants of the definition and the name of its type
        names = [f.name for f in dataclasses.fields(message) if f.name[0].islower()]
    elif isinstance(message, list | tuple):
        return [bits(each, *without) for each in message]
    elif isinstance(message, array.array | np.ndarray):
        return message.tobytes()
    else:
        return struct.pack("d", message) if isinstance(message, float) else message
    return {name: bits(getattr(message, name)) for name in names if name not in without}


@pytest.fixture(scope="module")
def recorded(module_domain, tmp_path_factory):
    """A run, and what a subscriber heard while it was recorded."""
    folder = tmp_path_factory.mktemp("recorded")
    scene, run = folder / "scene.yaml", folder / "run"
    scene.write_text(SCENE)
    parameters = {
        "fake_hardware_node": {"scene": scene, "time_server": TIME},
        "excitation_node": {"record_folder": folder / "records", "time_server": TIME},
        "scan_node": {"contact": "none", "goal_folders": [str(folder)], "time_server": TIME},
    }
    with NodeProcesses(folder / "log") as nodes, Client(nodes.check) as client:
        nodes.bring_up(("fake_hardware_node", "excitation_node", *READERS, "scan_node"), parameters)
        client.wait_until_up(HANGS_S)
        client.join_all(periods=3)
        # somebody else is measuring when the scan begins: it waits, and records none of that
        other = client.ask(periods=20)
        result = client.scan(5 * HANGS_S, scene=scene, run_directory=run)
        assert result.ending is Ending.COMPLETE, result.message
        assert (result.done, result.failed, result.skipped) == (4, 0, 0)
        client.wait(other.done, HANGS_S, "the result of the other measurement")
        assert other.result().result.outcome == Measure.Result.DONE
        points = read_run(run).results
        client.wait(
            lambda: all(client.has(point.measurement_id, point.blocks) for point in points),
            HANGS_S,
            "what the scan has heard",
        )
        heard = client.heard
    return run, heard, other.result().result.measurement_id


def test_the_recording_holds_exactly_what_was_published(recorded):
    run, heard, other = recorded
    content = read_run(run)
    assert content.problems == ()
    assert [(r.index, r.attempt) for r in content.results] == [(k, 0) for k in range(4)]
    # types come from the definitions in the files, by a reader that knows nothing of this package
    with AnyReader([run / "recording"]) as reader:
        found = defaultdict(list)
        for connection, _, cdr in reader.messages():
            if connection.topic in TOPICS:
                message = reader.deserialize(cdr, connection.msgtype)
                found[connection.topic, int(message.measurement_id)].append(message)
        assert {c.topic for c in reader.connections} >= {*TOPICS, "/point_result"}
    keys = {key for _, key in found}
    points = {r.measurement_id for r in content.results}
    assert (
        keys == points
    )  # nothing of what somebody else measured; and without a robot no reference in air
    assert other not in keys
    for topic in TOPICS:
        for key in keys:
            # as many as the subscriber heard, in the same order, every field to the bit
            assert [bits(m) for m in found[topic, key]] == [bits(m) for m in heard[topic, key]]
    for result in content.results:
        counts = [len(found[topic, result.measurement_id]) for topic in TOPICS]
        assert counts == [1, result.blocks, result.blocks, result.blocks]
        assert 3 <= result.blocks <= 5


def test_a_replay_gives_every_pole_again_to_the_bit(recorded, domain, tmp_path):
    run, heard, _ = recorded
    with NodeProcesses(tmp_path / "log") as nodes, Client(nodes.check) as client:
        parameters = {"device": "replay", "device_config": run, "replay_speed": 0.0}
        nodes.bring_up(("excitation_node", *READERS), {"excitation_node": parameters})
        client.wait_until_up(HANGS_S)
        points = {r.measurement_id for r in read_run(run).results}
        client.join_all(measurement_id=min(points))  # out of turn, it does not count
        client.heard.clear()
        replayed = []
        while (result := client.measure()).outcome == Measure.Result.DONE:
            replayed.append(result.measurement_id)
            key, blocks = result.measurement_id, result.blocks
            client.wait(lambda key=key, n=blocks: client.has(key, n), HANGS_S, "the replay")
        again = client.heard
        assert "the recording is over" in result.message
    assert len(set(replayed)) == len(replayed) == len(list((run / "recording").glob("*.mcap")))
    assert points == set(replayed)
    for key in replayed:
        # a measurement that was ended early has no final block, its replay has
        assert [bits(m, "final") for m in again["/poles", key]] == [
            bits(m, "final") for m in heard["/poles", key]
        ]
        assert [bits(m, "final") for m in again["/frf", key]] == [
            bits(m, "final") for m in heard["/frf", key]
        ]
        assert heard["/poles", key][-1].f0_hz[0] > 200
