# SPDX-License-Identifier: Apache-2.0
"""The map as a reader of its topics sees it, early or late, through real publishers and subscriptions."""

import os
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2, PointField
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from tactile_resonance import msg
from tactile_resonance.configuration import share_path
from tactile_resonance.identification.result import Poles, PolesStatus
from tactile_resonance.nodes.conversions import poles_to_message
from tactile_resonance.nodes.pole_map_node import PoleMapNode
from tactile_resonance.nodes.running import LATCHED, POLES, initialised
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Contact, Origin
from tactile_resonance.scan.colour_scale import HIGH_RGB, LOW_RGB
from tactile_resonance.simulation.plant_defaults import TABLE_IN_BASE

NUMPY = {PointField.FLOAT32: "<f4", PointField.UINT8: "u1"}
COVARIANCE = np.array([[[4e-4, 0.0], [0.0, 4e-9]]])


def poles(key, x, f0_hz, damping=0.0336, frame="table", status=PolesStatus.OK, place=None):
    found = f0_hz is not None
    w = 2 * np.pi * (f0_hz or 0.0)
    result = Poles(
        poles_rad_s=np.array([complex(-damping * w, w)] if found else [], complex),
        f0_hz=np.array([f0_hz] if found else [], float),
        damping_ratio=np.array([damping] if found else [], float),
        residues=np.array([10.0 + 0j] if found else []),
        covariance=COVARIANCE if found else None,
        status=status,
        message="" if found else "no resonance in the band",
    )
    place = (x, 0.001 * key, 0.0) if place is None else tuple(place)
    contact = Contact(0.01, 1e-4, place, (0.0, 0.0, 0.0, 1.0), frame, 1)
    return poles_to_message(result, Origin(measurement_id=key, simulated=True, contact=contact))


class Bench:
    """The node, a publisher of poles, and readers that come when the test says."""

    def __init__(self):
        self.map_node = PoleMapNode()
        self.user = rclpy.create_node("user")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.map_node)
        self.executor.add_node(self.user)
        self.publisher = self.user.create_publisher(msg.Poles, "poles", POLES)
        self.map_node.trigger_configure()
        self.map_node.trigger_activate()
        self.until(lambda: self.publisher.get_subscription_count() == 1)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.executor.shutdown()
        self.map_node.destroy_node()
        self.user.destroy_node()

    def until(self, done, timeout_s=10.0):
        deadline = time.monotonic() + timeout_s
        while not done() and time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.02)
        assert done()

    def send(self, *messages):
        for message in messages:
            self.publisher.publish(message)
        last = messages[-1].measurement_id
        self.until(
            lambda: (
                self.map_node._left_out
                or last in {p.measurement_id for p in self.map_node._map.points}
            )
        )

    def read(self, kind, topic):
        """Subscribe and wait for the latched message."""
        heard = []
        self.user.create_subscription(kind, topic, heard.append, LATCHED)
        self.until(lambda: heard)
        return heard


@pytest.fixture
def bench():
    with initialised(domain_id=free_domain_id(os.environ)), Bench() as made:
        yield made


def table(cloud):
    names = [f.name for f in cloud.fields]
    offsets = [f.offset for f in cloud.fields]
    kinds = [NUMPY[f.datatype] for f in cloud.fields]
    dtype = np.dtype(
        {"names": names, "formats": kinds, "offsets": offsets, "itemsize": cloud.point_step}
    )
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data)
    return np.frombuffer(bytes(cloud.data), dtype)


def test_a_late_reader_gets_the_whole_map(bench):
    sent = [poles(k, 0.004 * k, 250.0 + k) for k in range(1, 5)]
    bench.send(*sent)
    (cloud,) = bench.read(PointCloud2, "pole_map")
    assert cloud.header.frame_id == "table"
    rows = table(cloud)
    np.testing.assert_allclose(rows["f0_hz"], [251, 252, 253, 254])
    np.testing.assert_allclose(rows["x"], [0.004, 0.008, 0.012, 0.016])
    np.testing.assert_allclose(rows["f0_std_hz"], 0.02)
    np.testing.assert_allclose(rows["damping_std"], 2e-9**0.5 * 2**0.5, rtol=1e-6)
    np.testing.assert_allclose(rows["force_n"], 0.01)
    assert set(rows["status"]) == {msg.Poles.STATUS_OK}
    assert set(rows["tissue_class"]) == {255}
    wanted = "x y z f0_hz damping_ratio f0_std_hz damping_std force_n tissue_class tissue_probability status"
    assert set(wanted.split()) == {f.name for f in cloud.fields}


def test_a_map_that_is_started_anew_gets_what_it_missed(bench):
    bench.send(*[poles(k, 0.004 * k, 250.0 + k) for k in range(1, 5)])
    bench.map_node.trigger_deactivate()
    bench.map_node.trigger_cleanup()
    bench.map_node.trigger_configure()
    bench.until(lambda: len(bench.map_node._map.points) == 4)
    bench.map_node.trigger_activate()
    assert bench.read(PointCloud2, "pole_map")[0].width == 4


def test_what_is_new_replaces_what_was_there(bench):
    bench.send(poles(1, 0.0, 250.0))
    heard = bench.read(PointCloud2, "pole_map")
    bench.send(poles(2, 0.004, 251.0))
    bench.publisher.publish(poles(1, 0.0, 250.25))
    bench.until(lambda: list(table(heard[-1])["f0_hz"]) == [251.0, 250.25])


def test_nothing_is_made_that_nobody_reads(bench, monkeypatch):
    made = []
    for name, publisher in bench.map_node._publishers_of.items():
        publish = publisher.publish
        monkeypatch.setattr(
            publisher, "publish", lambda m, n=name, p=publish: (made.append(n), p(m))
        )
    bench.send(poles(1, 0.0, 250.0))
    deadline = time.monotonic() + 0.6  # three periods of publishing
    bench.until(lambda: time.monotonic() > deadline)
    assert made == []
    bench.read(MarkerArray, "pole_map/legend")
    assert made == ["/legend"]
    # nothing new, nothing published
    deadline = time.monotonic() + 0.6
    bench.until(lambda: time.monotonic() > deadline)
    assert made == ["/legend"]


def test_poles_in_the_robots_base_are_shown_on_the_table_of_the_namespace():
    given = {"frame_id": "left_table", "base_frame": "left_base", "table_in_base": TABLE_IN_BASE}
    arguments = ["--ros-args", "-r", "__ns:=/left"]
    for name, value in given.items():
        arguments += ["-p", f"{name}:={value}"]
    places = np.array([[0.01, -0.01, 0.0], [0.0, 0.01, 0.001]])
    turn = Rotation.from_rotvec(TABLE_IN_BASE[3:])
    seen = np.array(TABLE_IN_BASE[:3]) + turn.apply(places)
    with initialised(domain_id=free_domain_id(os.environ), args=arguments), Bench() as bench:
        assert bench.map_node.get_fully_qualified_name() == "/left/pole_map_node"
        bench.send(*[poles(k, 0, 250.0, frame="left_base", place=seen[k]) for k in range(2)])
        cloud = bench.read(PointCloud2, "pole_map")[0]
        markers = bench.read(MarkerArray, "pole_map/legend")[0].markers
        bench.publisher.publish(poles(2, 0.0, 250.0, frame="base"))
        bench.until(lambda: bench.map_node._left_out == 1)
    rows = table(cloud)
    np.testing.assert_allclose(np.stack([rows[n] for n in "xyz"], axis=-1), places, atol=1e-7)
    assert {m.header.frame_id for m in (cloud, *markers)} == {"left_table"}


def test_failures_are_crosses_and_no_points(bench):
    bench.send(poles(1, 0.0, 250.0), poles(2, 0.004, None, status=PolesStatus.NO_RESONANCE))
    (markers,) = bench.read(MarkerArray, "pole_map/markers")
    by_name = {m.ns: m for m in markers.markers}
    assert len(markers.markers) == 2
    assert by_name["ellipses"].type == by_name["failures"].type == Marker.LINE_LIST
    assert len(by_name["ellipses"].points) == len(by_name["ellipses"].colors) == 72
    crosses = by_name["failures"].points
    assert np.mean([(p.x, p.y) for p in crosses], axis=0) == pytest.approx([0.004, 0.002])
    assert len(table(bench.read(PointCloud2, "pole_map")[0])) == 1


def test_the_legend_tells_the_clouds_colours_and_units(bench):
    bench.send(*[poles(k, 0.004 * k, 250.0 + k) for k in range(1, 6)])
    rows = table(bench.read(PointCloud2, "pole_map")[0])
    (legend,) = bench.read(MarkerArray, "pole_map/legend")
    bar = next(m for m in legend.markers if m.type == Marker.TRIANGLE_LIST)
    texts = [m.text for m in legend.markers if m.type == Marker.TEXT_VIEW_FACING]
    heights = np.array([p.y for p in bar.points])
    rgb = np.array([(c.r, c.g, c.b) for c in bar.colors])
    np.testing.assert_allclose(rgb[heights.argmin()] * 255, LOW_RGB, atol=0.5)
    np.testing.assert_allclose(rgb[heights.argmax()] * 255, HIGH_RGB, atol=0.5)
    assert f"{rows['f0_hz'].min():.2f} Hz" in texts
    assert f"{rows['f0_hz'].max():.2f} Hz" in texts
    assert any("ellipses: 95 %" in t and "1 mm = " in t and "simulated" in t for t in texts)
    # beside the map, not over it
    assert min(p.x for p in bar.points) > rows["x"].max()


def test_the_surface_has_its_uncertainty(bench):
    bench.send(
        *[poles(1 + i + 4 * j, 0.004 * i, 250.0 + i + 0.5 * j) for i in range(4) for j in range(4)]
    )
    rows = table(bench.read(PointCloud2, "pole_map/surface")[0])
    assert len(rows) > 100
    assert np.all(rows["f0_std_hz"] > 0)
    assert rows["f0_hz"].min() > 249
    assert rows["f0_hz"].max() < 256


def test_poles_of_nowhere_or_another_frame_are_left_out(bench):
    bench.send(poles(1, 0.0, 250.0))
    lost = poles(2, 0.004, 251.0)
    lost.tip_pose.header.frame_id = ""
    bench.publisher.publish(poles(3, 0.004, 252.0, frame="elsewhere"))
    bench.publisher.publish(lost)
    bench.until(lambda: bench.map_node._left_out == 2)
    assert len(table(bench.read(PointCloud2, "pole_map")[0])) == 1
    assert bench.map_node.details()["left out"] == "2"


def test_clear_empties_every_output(bench):
    bench.send(*[poles(k, 0.004 * (k % 3), 250.0 + k) for k in range(1, 8)])
    heard = {
        topic: bench.read(kind, topic)
        for topic, kind in (
            ("pole_map", PointCloud2),
            ("pole_map/markers", MarkerArray),
            ("pole_map/legend", MarkerArray),
            ("pole_map/surface", PointCloud2),
        )
    }
    assert heard["pole_map/surface"][-1].width > 0
    client = bench.user.create_client(Trigger, "pole_map/clear")
    bench.until(client.service_is_ready)
    answer = client.call_async(Trigger.Request())
    bench.until(answer.done)
    assert answer.result().message == "7 points cleared"
    bench.until(lambda: heard["pole_map"][-1].width == heard["pole_map/surface"][-1].width == 0)
    bench.until(
        lambda: all(m.action == Marker.DELETE for m in heard["pole_map/markers"][-1].markers)
    )
    bench.until(lambda: heard["pole_map/legend"][-1].markers[0].action == Marker.DELETEALL)


def test_tissue_is_called_from_a_scene():
    scene = share_path("config/scenes/inclusion_scan.yaml")
    arguments = ["--ros-args", "-p", f"classes_file:={scene}"]
    with initialised(domain_id=free_domain_id(os.environ), args=arguments), Bench() as bench:
        bench.send(
            poles(1, 0.0, 253.8, 0.0336), poles(2, 0.004, 258.0, 0.0379), poles(3, 0.008, 240.0)
        )
        rows = table(bench.read(PointCloud2, "pole_map")[0])
        assert list(rows["tissue_class"]) == [0, 1, 255]
        assert rows["tissue_probability"][0] > 0.9
        assert np.isnan(rows["tissue_probability"][2])
        texts = [m.text for m in bench.read(MarkerArray, "pole_map/legend")[0].markers]
        assert any("class 0, gelatine 10 %: 1" in t and "unknown: 1" in t for t in texts)


def test_a_classes_file_that_is_wrong_is_refused(tmp_path):
    path = tmp_path / "classes.yaml"
    path.write_text("tissue_classes: {a: {f0_hz: 250.0}}\n")
    with initialised(
        domain_id=free_domain_id(os.environ), args=["--ros-args", "-p", f"classes_file:={path}"]
    ):
        node = PoleMapNode()
        node.trigger_configure()
        assert node.state_name() == "unconfigured"
        assert "classes.yaml: tissue_classes.a.damping_ratio: got None" in node.health._error
        node.destroy_node()
