# SPDX-License-Identifier: Apache-2.0
"""From the bench to the map, all nodes as processes, and readers who come late."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import rclpy
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from robot_at_hand import own_time
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import PointCloud2
from tactile_resonance.action import Measure
from visualization_msgs.msg import MarkerArray

from benchmarks.scan_session import ScanSession
from tactile_resonance import msg
from tactile_resonance.configuration import share_path
from tactile_resonance.nodes.client import HANGS_S, ScanClient
from tactile_resonance.nodes.running import EXCITATIONS, LATCHED, POINT_RESULTS, POLES, RESULTS
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.scan.point_result import PointKind, PointOutcome
from tactile_resonance.scan.run_content import read_run

STREAM = ("excitation_node", "frf_node", "poles_node", "pole_map_node")
NODES = ("fake_hardware_node", *STREAM)
TIME = own_time(16)
PLACES = ((-0.01, -0.01, 0.0), (0.002, -0.001, 0.0), (0.01, 0.01, 0.0))
SCENE = """
name: with a hole
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.00, 0.0], radius_m: 0.025}}
positions:
  list: [[0.0, 0.0], [0.004, 0.0], [0.04, 0.0], [0.0, 0.008]]  # the third beside the gelatine
blocks: {least: 16, most: 16}
"""
ACCEPTED = (0, 1, 3)


def test_measured_points_are_on_the_map(domain, tmp_path):
    scene = share_path("config/scenes/inclusion_scan.yaml")
    parameters = {
        "fake_hardware_node": {"scene": scene, "time_server": TIME},
        "excitation_node": {"record_folder": tmp_path / "records", "time_server": TIME},
        "pole_map_node": {"classes_file": scene, "source": "poles"},  # nobody scans
    }
    with NodeProcesses(tmp_path / "log") as nodes, ScanSession(nodes.check) as session:
        nodes.bring_up(NODES, parameters)
        session.wait_for_nodes(HANGS_S)
        session.warm_up(PLACES[0], HANGS_S)
        found = [
            session.measure(place, Measure.Goal(periods=4, seed=5), lambda *_: None)
            for place in PLACES
        ]
        rows = rows_of(late_map(len(PLACES)))
    expected = [result.poles.f0_hz[0] for result in found]
    order = np.argsort(rows["x"])
    np.testing.assert_allclose(rows["f0_hz"][order], expected, rtol=1e-6)
    np.testing.assert_allclose(
        np.stack([rows["x"], rows["y"], rows["z"]], axis=1)[order], PLACES, atol=1e-9
    )
    assert list(rows["tissue_class"][order]) == [0, 1, 0]
    assert np.all(rows["force_n"] == np.float32(0.01))


class Client(ScanClient):
    """Asks for a scan and has a point repeated while it is measured, or asks for measurements."""

    def join(self):
        super().join()
        self._measure = ActionClient(self._node, Measure, "measure")
        self._asked = None

    def repeat_once(self, feedback):
        if self._asked is None and feedback.point == 1 and feedback.blocks:
            self._asked = self.tactile.repeat()

    def measure(self):
        result = self.begin(self._measure, Measure.Goal()).get_result_async()
        self.wait(result.done, HANGS_S, "the measurement")
        return result.result().result


@pytest.fixture(scope="module")
def scanned(module_domain, tmp_path_factory):
    """The run of a scan with references, a retry and a failed point, and what readers got of it.

    One of them comes when a point is on the map already, and stays.
    """
    folder = tmp_path_factory.mktemp("scanned")
    scene, run = folder / "scene.yaml", folder / "run"
    scene.write_text(SCENE)
    time_server = {"time_server": TIME}
    ideal = {"serve_contact": True, "table_in_base": [0.0] * 6}
    parameters = {
        "fake_hardware_node": {"scene": scene, **ideal, **time_server},
        "excitation_node": {"record_folder": folder / "records", **time_server},
        "scan_node": {"goal_folders": [str(folder)], **time_server},
    }
    with NodeProcesses(folder / "log") as nodes, Client(nodes.check) as client:
        nodes.bring_up((*NODES, "scan_node"), parameters)
        client.wait_until_up(HANGS_S)
        joined = InMidScan(client.tactile)

        def on_feedback(feedback):
            client.repeat_once(feedback)
            joined.follow(feedback)

        result = client.scan(
            5 * HANGS_S, scene=scene, run_directory=run, on_feedback=on_feedback
        )
        assert (result.done, result.failed, result.skipped) == (3, 1, 0), result.message
        cloud = late_map(len(ACCEPTED))
        told = late_reader(msg.PointResult, "point_result", POINT_RESULTS, lambda m: len(m) == 7)
        # as text, in which NaN is equal to NaN
        final = {str(message.poles[0]) for message in told if message.poles}
        poles = late_reader(msg.Poles, "poles", POLES, lambda m: final <= set(map(str, m)))
        seen = joined.result()
    return run, cloud, told, poles, seen


class InMidScan:
    """Readers of map and legend who come while the scan is paused after its second point.

    They have threads and contexts of their own; the scan goes on when both have something.
    """

    def __init__(self, tactile):
        self._tactile, self._pool = tactile, ThreadPoolExecutor(2)
        self._seen, self._heard, self._resumed = [], ([], []), False

    def follow(self, feedback):
        if not self._seen and feedback.finished == 2:
            self._tactile.pause()
            enough = (lambda heard: heard and heard[-1].width == len(ACCEPTED), bool)
            for kind, name, whole, heard in zip(
                (PointCloud2, MarkerArray), ("", "/legend"), enough, self._heard, strict=True
            ):
                read = (kind, f"pole_map{name}", LATCHED, whole, heard)
                self._seen.append(self._pool.submit(late_reader, *read))
        elif not self._resumed and all(self._heard):
            self._resumed = True
            self._tactile.resume()

    def result(self):
        return [future.result(2 * HANGS_S) for future in self._seen]


def test_the_map_of_a_scan_holds_the_accepted_points_of_tissue(scanned):
    run, cloud, _, poles, _ = scanned
    rows, results = rows_of(cloud), read_run(run).latest
    expected = np.array([(results[k].x_m, results[k].y_m, results[k].f0_hz) for k in ACCEPTED])
    found = np.stack([rows["x"], rows["y"], rows["f0_hz"]], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    # there were others, in air among them
    assert len({message.measurement_id for message in poles}) == 3 + 2 + 1
    assert min(message.f0_hz[0] for message in poles) < 250 < rows["f0_hz"].min()


def test_a_map_that_is_looked_at_in_mid_scan_is_there_and_goes_on(scanned):
    _, cloud, *_, (clouds, legends) = scanned
    # nobody listened before: what it holds was made for this reader
    assert clouds[0].width == 2
    assert clouds[-1].width == len(ACCEPTED)
    assert legends[0].markers
    assert clouds[-1].data == cloud.data


def test_a_late_reader_of_results_knows_what_counts(scanned):
    run, _, told, poles, _ = scanned
    assert [(m.kind, m.index, m.outcome) for m in told] == [
        (PointKind.AIR.value, 4, PointOutcome.DONE),
        (PointKind.TISSUE.value, 0, PointOutcome.DONE),
        (PointKind.TISSUE.value, 1, PointOutcome.DISCARDED),
        (PointKind.TISSUE.value, 1, PointOutcome.DONE),
        (PointKind.TISSUE.value, 2, PointOutcome.FAILED),
        (PointKind.TISSUE.value, 3, PointOutcome.DONE),
        (PointKind.AIR.value, 5, PointOutcome.DONE),
    ]
    assert told[2].reason == "left on request"
    assert "nothing to touch there" in told[4].reason
    # every measurement is accounted for, the one that was left too
    assert {m.measurement_id for m in told} - {0} == {m.measurement_id for m in poles}
    last = {message.measurement_id: message for message in poles}
    for message in told:
        if message.outcome == PointOutcome.DONE:
            (own,) = message.poles
            assert str(own) == str(last[message.measurement_id])  # NaN is equal to NaN
            assert message.f0_hz == message.poles[0].f0_hz[0]
            assert len(message.poles[0].total_covariance or message.poles[0].covariance) == 4
    assert told[4].poles == []
    assert [
        m.measurement_id for m in told if m.index in ACCEPTED and m.outcome == PointOutcome.DONE
    ] == [read_run(run).latest[k].measurement_id for k in ACCEPTED]


def test_a_replay_of_the_run_draws_the_same_map(scanned, domain, tmp_path):
    run, cloud, told, *_ = scanned
    replay = {"device": "replay", "device_config": run, "replay_speed": 0.0}
    with NodeProcesses(tmp_path / "log") as nodes, Client(nodes.check) as client:
        nodes.bring_up(STREAM, {"excitation_node": replay})
        client.wait_until_up(HANGS_S)
        played = []
        while (result := client.measure()).outcome == Measure.Result.DONE:
            played.append(result.measurement_id)
        assert len(played) == 3 + 2
        again = late_map(len(ACCEPTED))
        kept = late_reader(msg.PointResult, "point_result", POINT_RESULTS, lambda m: len(m) == 6)
    assert again.data == cloud.data
    assert list(map(str, kept)) == list(map(str, [*told[:2], *told[3:]]))  # NaN is equal to NaN


def test_a_recording_that_is_played_draws_the_same_map(scanned, domain, tmp_path):
    """As `ros2 bag play` does: publishers with the recorded quality of service, ten messages of history."""
    run, cloud, *_ = scanned
    context = rclpy.Context()
    with NodeProcesses(tmp_path / "log") as nodes, Client(nodes.check) as client:
        nodes.bring_up(["pole_map_node"], {})
        client.wait_until_up(HANGS_S)
        rclpy.init(context=context)
        player = rclpy.create_node("player", context=context)
        with Reader(run / "recording") as reader:
            profiles = {c.topic: qos_of(c) for c in reader.connections}
            publisher = player.create_publisher(
                msg.PointResult, "point_result", profiles["/point_result"]
            )
            for connection, _, cdr in reader.messages():
                if connection.topic == "/point_result":
                    publisher.publish(cdr)
        try:
            again = late_map(len(ACCEPTED))
        finally:
            player.destroy_node()
            rclpy.shutdown(context=context)
    assert again.data == cloud.data
    for topic, kind in (("/poles", POLES), ("/excitation", EXCITATIONS), ("/record", RESULTS)):
        assert profiles[topic].durability == kind.durability
        assert profiles[topic].reliability == kind.reliability


def qos_of(connection):
    (offered,) = connection.ext.offered_qos_profiles or [None]
    durability = offered.durability.name if offered else "VOLATILE"
    reliability = offered.reliability.name if offered else "RELIABLE"
    return QoSProfile(
        depth=10,
        durability=DurabilityPolicy[durability],
        reliability=ReliabilityPolicy[reliability],
    )


def late_reader(kind, topic, qos, enough, heard=None):
    """What a reader gets who comes now, until it is enough and some time for more has passed."""
    context, heard = rclpy.Context(), [] if heard is None else heard
    rclpy.init(context=context)
    node = rclpy.create_node("late_reader", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        node.create_subscription(kind, topic, heard.append, qos)
        deadline = time.monotonic() + HANGS_S
        while not enough(heard) and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)
        assert enough(heard), f"{len(heard)} of {topic} in {HANGS_S:g} s"
        deadline = time.monotonic() + 0.5
        while time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
    return heard


def late_map(count):
    """The latched cloud, which has `count` points."""
    clouds = late_reader(
        PointCloud2, "pole_map", LATCHED, lambda heard: heard and heard[-1].width == count
    )
    assert [cloud.width for cloud in clouds][-1:] == [count]
    return clouds[-1]


def rows_of(cloud):
    kinds = ["<f4" if f.datatype == f.FLOAT32 else "u1" for f in cloud.fields]
    names, offsets = [f.name for f in cloud.fields], [f.offset for f in cloud.fields]
    dtype = {"names": names, "formats": kinds, "offsets": offsets, "itemsize": cloud.point_step}
    return np.frombuffer(bytes(cloud.data), np.dtype(dtype))
