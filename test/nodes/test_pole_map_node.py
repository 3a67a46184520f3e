# SPDX-License-Identifier: Apache-2.0
"""The map as a reader of its topics sees it, early or late, through real publishers and subscriptions."""

import os

import numpy as np
import pytest
import yaml
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
from tactile_resonance.nodes import pole_map_node
from tactile_resonance.nodes.messages import poles_to_message
from tactile_resonance.nodes.pole_map_node import PoleMapNode
from tactile_resonance.nodes.running import LATCHED, POINT_RESULTS, POLES, initialised
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Contact, Origin
from tactile_resonance.scan.point_result import PointKind, PointOutcome, PointResult
from tactile_resonance.scan.pole_map import HIGH_RGB, LOW_RGB, shares
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues
from test.spinning import spin_until

NUMPY = {PointField.FLOAT32: "<f4", PointField.UINT8: "u1"}
COVARIANCE = np.array([[[4e-4, 0.0], [0.0, 4e-9]]])
OUTPUTS = {
    "pole_map": PointCloud2,
    "pole_map/markers": MarkerArray,
    "pole_map/legend": MarkerArray,
    "pole_map/surface": MarkerArray,
}


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


def point_result(key, x, f0_hz, outcome=PointOutcome.DONE, kind=PointKind.TISSUE, **values):
    """Result of a point planned at x [m] on the surface, 2 mm below the tip."""
    message = msg.PointResult(
        outcome=int(outcome), kind=kind.value, measurement_id=key, x_m=x, y_m=0.001, z_m=-0.002
    )
    message.poles = [poles(key, x + values.get("off", 0.0), f0_hz)] if f0_hz else []
    return message


class Bench:
    """The node, a publisher of what it hears, and readers that come when the test says."""

    def __init__(self, kind=msg.Poles, topic="poles", qos=POLES):
        self.map_node = PoleMapNode()
        self.user = rclpy.create_node("user")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.map_node)
        self.executor.add_node(self.user)
        self.publisher = self.user.create_publisher(kind, topic, qos)
        self.map_node.trigger_configure()
        self.map_node.trigger_activate()
        self.until(lambda: self.publisher.get_subscription_count() == 1)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.executor.shutdown()
        self.map_node.destroy_node()
        self.user.destroy_node()

    def until(self, done):
        assert spin_until(self.executor, done)

    def send(self, *messages):
        for message in messages:
            self.publisher.publish(message)
        last = messages[-1].measurement_id
        self.until(
            lambda: (
                self.map_node._left_out
                or last in {p.result.measurement_id for p in self.map_node._grown.map.points}
            )
        )

    def read(self, kind, topic):
        """Subscribe and wait for the latched message."""
        heard = []
        self.user.create_subscription(kind, topic, heard.append, LATCHED)
        self.until(lambda: heard)
        return heard


OF_POLES = ["--ros-args", "-p", "source:=poles"]


@pytest.fixture
def bench():
    """A map of whatever poles there are."""
    domain = free_domain_id(os.environ)
    with initialised(domain_id=domain, args=OF_POLES), Bench() as made:
        yield made


@pytest.fixture
def scanned():
    """A map of what a scan accepts, as it is without parameters."""
    given = (msg.PointResult, "point_result", POINT_RESULTS)
    with initialised(domain_id=free_domain_id(os.environ)), Bench(*given) as made:
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
    bench.until(lambda: len(bench.map_node._grown.map.points) == 4)
    bench.map_node.trigger_activate()
    assert bench.read(PointCloud2, "pole_map")[0].width == 4


def test_what_is_new_replaces_what_was_there(bench):
    bench.send(poles(1, 0.0, 250.0))
    heard = bench.read(PointCloud2, "pole_map")
    bench.send(poles(2, 0.004, 251.0))
    bench.publisher.publish(poles(1, 0.0, 250.25))
    bench.until(lambda: list(table(heard[-1])["f0_hz"]) == [251.0, 250.25])


def test_only_what_is_new_and_read_is_made(bench, monkeypatch):
    made = []
    for name in ("cloud", "marker", "legend", "surface"):
        make = getattr(pole_map_node, f"{name}_message")
        monkeypatch.setattr(
            pole_map_node,
            f"{name}_message",
            lambda *given, n=name, m=make: (made.append(n), m(*given))[1],
        )
    bench.send(poles(1, 0.0, 250.0))
    spin_until(bench.executor, lambda: made, 0.6)  # three periods of publishing
    assert made == []
    heard = bench.read(MarkerArray, "pole_map/legend")
    assert made == ["legend"]
    # nothing new: the same once more, for rviz may have dropped it, and nobody else hears
    bench.until(lambda: len(heard) >= 3)
    assert made == ["legend"]


def test_what_is_shown_is_repeated_with_a_new_stamp(bench):
    bench.send(*[poles(k, 0.004 * (k % 3), 250.0 + k) for k in range(1, 8)])
    heard = {topic: bench.read(kind, topic) for topic, kind in OUTPUTS.items()}
    bench.until(lambda: all(len(messages) >= 2 for messages in heard.values()))
    for messages in heard.values():
        parts = [getattr(m, "markers", [m]) for m in (messages[0], messages[-1])]
        stamps = [{(p.header.stamp.sec, p.header.stamp.nanosec) for p in each} for each in parts]
        assert max(stamps[0]) < min(stamps[1])
        for first, last in zip(*parts, strict=True):
            last.header.stamp = first.header.stamp
            assert last == first


def test_how_it_is_drawn_may_change_and_the_legend_states_what_is_shown(bench):
    bench.send(*[poles(k, 0.004 * (k % 3), 250.0 + k) for k in range(1, 8)])
    shown = bench.read(MarkerArray, "pole_map/markers")
    changes = {"ellipse_m_per_hz": 0.01, "ellipse_m_per_damping": 1.0, "ellipse_probability": 0.5}
    for name, value in changes.items():
        assert bench.map_node.set_parameters([rclpy.Parameter(name, value=value)])[0].successful
    (legend,) = bench.read(MarkerArray, "pole_map/legend")
    lines = [marker.text for marker in legend.markers]
    assert {"ellipses: 50 %", "x: 1 mm = 0.1 Hz of f0", "y: 1 mm = 0.001 of damping ratio"} <= {*lines}
    f0_std_hz, radius = COVARIANCE[0, 0, 0] ** 0.5, (-2 * np.log(1 - 0.5)) ** 0.5
    half_m = radius * 0.01 * f0_std_hz

    def widest_m():
        (ellipses,) = (m for m in shown[-1].markers if m.ns == "ellipses")
        return np.ptp([point.x for point in ellipses.points[:72]]) / 2

    bench.until(lambda: widest_m() == pytest.approx(half_m, rel=1e-6))


def test_a_result_that_cannot_be_read_is_left_out_and_the_node_lives_on(scanned):
    scanned.publisher.publish(msg.PointResult(kind="water", measurement_id=7))
    scanned.until(lambda: scanned.map_node._left_out == 1)
    assert scanned.map_node.health._error == "result of measurement 7: 'water' is not a valid PointKind"
    scanned.map_node._left_out = 0
    scanned.send(point_result(8, 0.0, 250.0))
    assert scanned.read(PointCloud2, "pole_map")[0].width == 1


def test_markers_wait_for_their_frame(bench):
    bench.send(*[poles(k, 0.004 * (k % 3), 250.0 + k) for k in range(1, 8)])
    for topic in list(OUTPUTS)[1:]:
        assert all(m.frame_locked for m in bench.read(MarkerArray, topic)[0].markers)


def test_poles_in_the_robots_base_are_shown_on_the_table_of_the_namespace():
    given = {"frame_id": "left_table", "base_frame": "left_base", "table_in_base": TABLE_IN_BASE}
    arguments = [*OF_POLES, "-r", "__ns:=/left"]
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


def bar_and_texts(legend):
    (bar,) = (m for m in legend.markers if m.type == Marker.TRIANGLE_LIST)
    return bar, [m for m in legend.markers if m.type == Marker.TEXT_VIEW_FACING]


def test_the_legend_tells_the_clouds_colours_and_units(bench):
    bench.send(*[poles(k, 0.004 * k, 250.0 + k) for k in range(1, 6)])
    rows = table(bench.read(PointCloud2, "pole_map")[0])
    (legend,) = bench.read(MarkerArray, "pole_map/legend")
    assert legend.markers[0].action == Marker.DELETEALL  # of more lines than there are now
    names = [(m.ns, m.id) for m in legend.markers]
    assert len(set(names)) == len(names)  # rviz takes no two of one name
    bar, markers = bar_and_texts(legend)
    texts = [m.text for m in markers]
    heights = np.array([p.y for p in bar.points])
    rgb = np.array([(c.r, c.g, c.b) for c in bar.colors])
    np.testing.assert_allclose(rgb[heights.argmin()] * 255, LOW_RGB, atol=0.5)
    np.testing.assert_allclose(rgb[heights.argmax()] * 255, HIGH_RGB, atol=0.5)
    f0 = rows["f0_hz"]
    wanted = [f"{f0.min():.2f} Hz", f"{f0.max():.2f} Hz", "colour: natural frequency f0"]
    wanted += ["ellipses: 95 %", "5 points, 0 failed", "simulated, not measured"]
    assert set(wanted) <= set(texts)
    for axis, unit in (("x", "Hz of f0"), ("y", "of damping ratio")):
        assert any(t.startswith(f"{axis}: 1 mm = ") and t.endswith(unit) for t in texts)
    # each figure stands at its place of the bar
    at = {m.text: m.pose.position.y for m in markers}
    assert at[wanted[0]] == pytest.approx(heights.min())
    assert at[wanted[1]] == pytest.approx(heights.max())


# height of rviz's texts: of figures in Liberation Sans, the mean width of a character
CHARACTER = 0.45
# of the part of rviz's window that shows the map, width over height, beside the panels; Ogre's field of view
ASPECT, VIEW_RAD = 1.3, np.pi / 4
ROW, MAP_20, MAP_5, MAP_150 = (
    [(x, y) for x in np.linspace(*across, 6) for y in np.linspace(*up, n)]
    for across, up, n in (
        ((-0.01, 0.01), (0, 0), 1),
        ((-0.01, 0.01), (-0.01, 0.01), 5),
        ((0.0, 0.005), (0.0, 0.005), 5),
        ((-0.075, 0.075), (-0.075, 0.075), 5),
    )
)


def rviz_views():
    view = yaml.safe_load(share_path("config/pole_map.rviz").read_text())["Visualization Manager"]
    every = [view["Views"]["Current"], *view["Views"]["Saved"]]
    return {v["Name"]: v for v in every}


def projected(view, points):
    """(..., 2) places in the window, each from -1 to 1, of points (..., 3) in an orbit view."""
    yaw, pitch = view["Yaw"], view["Pitch"]
    back = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    axes = np.stack([right, np.cross(back, right), back])
    focus = np.array([view["Focal Point"][name] for name in "XYZ"])
    x, y, z = np.moveaxis((np.asarray(points) - focus) @ axes.T, -1, 0)
    half = np.tan(VIEW_RAD / 2) * (view["Distance"] - z)
    return np.stack([x / (ASPECT * half), y / half], axis=-1)


def boxes_beside_the_bar(bar, texts, *others):
    """Corners (2,) and (2,) of all that is drawn, of which nothing lies over anything else."""
    boxes = []
    for m in texts:
        assert "\n" not in m.text
        assert m.scale.x == pytest.approx(0.6 * m.scale.z)  # 0: as wide as for a text 1 m high
        half = np.array([CHARACTER * len(m.text), 1.0]) * m.scale.z / 2
        middle = np.array([m.pose.position.x, m.pose.position.y])
        boxes.append((middle - half, middle + half))
    for marker in (bar, *others):
        corners = np.array([(p.x, p.y) for p in marker.points])
        boxes.append((corners.min(axis=0), corners.max(axis=0)))
    for k, (low, high) in enumerate(boxes):
        assert all(np.any(low >= b) or np.any(a >= high) for a, b in boxes[:k])
    bar_y = [p.y for p in bar.points]
    heights = np.array([m.pose.position.y for m in texts])
    assert np.all((heights >= min(bar_y) - 1e-9) & (heights <= max(bar_y) + 1e-9))
    return boxes


@pytest.mark.parametrize(
    ("places", "name"),
    [
        ([(0.0, 0.0)], "Current View"),
        (ROW, "Current View"),
        (MAP_20, "Current View"),
        (MAP_5, "Current View"),
        (MAP_150, "Map of 200 mm"),
    ],
    ids=["one point", "row", "20 mm", "5 mm", "150 mm"],
)
def test_map_and_legend_are_in_the_view(bench, places, name):
    bench.send(*[poles(k, 0, 250.0 + k, place=(x, y, 0)) for k, (x, y) in enumerate(places)])
    bar, texts = bar_and_texts(bench.read(MarkerArray, "pole_map/legend")[0])
    (ellipses, _) = bench.read(MarkerArray, "pole_map/markers")[0].markers
    size_m = bench.map_node._grown.map.size_m
    assert size_m == pytest.approx(max(np.ptp(places), 0.02 if len(places) == 1 else 0))
    boxes = boxes_beside_the_bar(bar, texts, ellipses)
    low, high = (np.array(side) for side in zip(*boxes, strict=True))
    ends = np.stack([low.min(axis=0), high.max(axis=0)])  # left lower, right upper
    outline = [(x, y, 0.0) for x in ends[:, 0] for y in ends[:, 1]]
    there = projected(rviz_views()[name], outline)
    assert np.abs(there).max() < 1
    if places is MAP_20:  # what the launch files scan fills the window
        assert np.ptp(there[:, 0]) > 1.6


@pytest.mark.parametrize(
    ("name", "count"), [("tissue", 18), ("meningioma of the left temporal lobe", 3)]
)
def test_a_legend_of_many_lines_or_long_ones_is_no_larger(tmp_path, name, count):
    spread = {"damping_ratio": 0.0336, "f0_std_hz": 0.1, "damping_ratio_std": 1e-3}
    classes = {f"{name} {k}": {"f0_hz": 250.0 + 2 * k, **spread} for k in range(count)}
    path = tmp_path / "classes.yaml"
    path.write_text(yaml.safe_dump({"tissue_classes": classes}))
    arguments = [*OF_POLES, "-p", f"classes_file:={path}"]
    with initialised(domain_id=free_domain_id(os.environ), args=arguments), Bench() as bench:
        bench.send(
            *[poles(k, 0, 250.0 + 2 * k, place=(0.001 * k, 0, 0)) for k in range(count)],
            poles(99, 0, 240.0, place=(0.02, 0, 0)),
        )
        bar, texts = bar_and_texts(bench.read(MarkerArray, "pole_map/legend")[0])
    assert sum(any(known in m.text for known in classes) for m in texts) == count
    boxes = boxes_beside_the_bar(bar, texts)
    assert max(high[0] for _, high in boxes) < 0.02 + 1.06 * 0.02


def test_the_surface_covers_the_points_in_the_colours_of_the_legend(bench):
    f0 = lambda i, j: 250.0 + i + 0.5 * j + (3.0 if i == j == 2 else 0.0)  # noqa: E731
    x, y = np.linspace(-0.01, 0.0137, 5), np.linspace(0.001, 0.0101, 4)
    bench.send(
        *[poles(i + 5 * j, 0, f0(i, j), place=(x[i], y[j], 0)) for i in range(5) for j in range(4)]
    )
    (sheet,) = bench.read(MarkerArray, "pole_map/surface")[0].markers
    bar, _ = bar_and_texts(bench.read(MarkerArray, "pole_map/legend")[0])
    assert sheet.type == Marker.TRIANGLE_LIST
    assert sheet.scale.x == sheet.scale.y == sheet.scale.z == 1.0
    corners = np.array([(p.x, p.y, p.z) for p in sheet.points])
    # each place between the outermost points lies in one triangle
    a, b, c = np.moveaxis(corners.reshape(-1, 3, 3)[..., :2], 1, 0)
    low, high = np.array([x[0], y[0]]), np.array([x[-1], y[-1]])
    for place in np.random.default_rng(1).uniform(low, high, (50, 2)):
        sides = [(p - place, q - place) for p, q in ((a, b), (b, c), (c, a))]
        left = [p[:, 0] * q[:, 1] > p[:, 1] * q[:, 0] for p, q in sides]
        assert np.sum(left[0] & left[1] & left[2]) == 1
    np.testing.assert_allclose(corners.min(axis=0)[:2], low)
    np.testing.assert_allclose(corners.max(axis=0)[:2], high)
    assert np.all(corners[:, 2] < 0)  # below the ellipses
    assert np.all(corners[:, 2] > -1e-3)
    # the colour that the bar has at the same frequency
    found = bench.map_node._grown.map
    value = found.krige().predict(corners[:, :2])[0]
    bar_y, first = np.unique([p.y for p in bar.points], return_index=True)
    at = bar_y[0] + shares(value, found.f0_hz) * np.ptp(bar_y)
    for name in "rgb":
        channel = np.array([getattr(c, name) for c in bar.colors])[first]
        own = [getattr(c, name) for c in sheet.colors]
        np.testing.assert_allclose(own, np.interp(at, bar_y, channel), atol=2e-3)
    assert 0 < sheet.colors[0].a < 1  # points and ellipses stand out


def test_too_few_points_have_no_surface(bench):
    bench.send(*[poles(k, 0.004 * k, 250.0 + k) for k in range(1, 4)])
    (sheet,) = bench.read(MarkerArray, "pole_map/surface")[0].markers
    assert sheet.action == Marker.DELETE


def test_poles_of_nowhere_or_another_frame_are_left_out(bench):
    bench.send(poles(1, 0.0, 250.0))
    lost = poles(2, 0.004, 251.0)
    lost.tip_pose.header.frame_id = ""
    bench.publisher.publish(poles(3, 0.004, 252.0, frame="elsewhere"))
    bench.publisher.publish(lost)
    bench.publisher.publish(poles(4, 0.004, 253.0, place=(np.nan, 0.001, 0.0)))
    bench.until(lambda: bench.map_node._left_out == 3)
    assert len(table(bench.read(PointCloud2, "pole_map")[0])) == 1
    assert bench.map_node.details()["left out"] == "3"


def test_clear_empties_every_output(bench):
    bench.send(*[poles(k, 0.004 * (k % 3), 250.0 + k) for k in range(1, 8)])
    heard = {topic: bench.read(kind, topic) for topic, kind in OUTPUTS.items()}
    assert heard["pole_map/surface"][-1].markers[0].action == Marker.ADD
    client = bench.user.create_client(Trigger, "pole_map/clear")
    bench.until(client.service_is_ready)
    answer = client.call_async(Trigger.Request())
    bench.until(answer.done)
    assert answer.result().message == "7 points cleared"
    bench.until(lambda: heard["pole_map"][-1].width == 0)
    for topic in ("pole_map/markers", "pole_map/surface"):
        bench.until(lambda t=topic: all(m.action == Marker.DELETE for m in heard[t][-1].markers))
    bench.until(lambda: heard["pole_map/legend"][-1].markers[0].action == Marker.DELETEALL)


def test_only_what_a_scan_accepts_is_on_the_map(scanned):
    others = scanned.user.create_publisher(msg.Poles, "poles", POLES)
    others.publish(poles(9, 0.1, 300.0))
    for message in (
        point_result(1, 0.0, 246.6, kind=PointKind.AIR),
        point_result(2, 0.004, 300.0, PointOutcome.DISCARDED),
        point_result(3, 0.008, 300.0, PointOutcome.SKIPPED),
        point_result(4, 0.012, 300.0, PointOutcome.FAILED),
        point_result(
            5, 0.016, None, PointOutcome.FAILED
        ),  # before it had poles: where the tip was nobody knows
        point_result(6, 0.020, 256.0),
    ):
        scanned.publisher.publish(message)
    scanned.until(lambda: scanned.map_node._grown.map.estimated)
    rows = table(scanned.read(PointCloud2, "pole_map")[0])
    assert list(rows["f0_hz"]) == [256.0]
    (markers,) = scanned.read(MarkerArray, "pole_map/markers")
    (crosses,) = [m.points for m in markers.markers if m.ns == "failures"]
    assert len(crosses) == 4
    assert np.mean([(p.x, p.y) for p in crosses], axis=0) == pytest.approx([0.012, 0.004])
    told = scanned.map_node.details()
    assert (told["left out"], told["failures"]) == ("0", "2")
    # the legend counts both, though only one has a cross
    _, texts = bar_and_texts(scanned.read(MarkerArray, "pole_map/legend")[-1])
    assert "1 point, 2 failed" in [m.text for m in texts]


@pytest.mark.parametrize(
    ("outcome", "f0_hz", "left"),
    [
        (PointOutcome.DONE, 251.0, [255.0, 251.0]),
        (PointOutcome.FAILED, 251.0, [255.0]),
        (PointOutcome.FAILED, None, [255.0]),
        (PointOutcome.SKIPPED, None, [255.0]),
        (PointOutcome.DISCARDED, 251.0, [250.0, 255.0]),
    ],
)
def test_a_point_that_is_repeated_replaces_its_former_result(scanned, outcome, f0_hz, left):
    scanned.publisher.publish(point_result(1, 0.0, 250.0))
    scanned.publisher.publish(point_result(2, 0.004, 255.0))
    # the tip comes down a millimetre beside: it is the same point
    scanned.publisher.publish(point_result(3, 0.0, f0_hz, outcome, off=0.001))
    scanned.publisher.publish(point_result(4, 0.1, 260.0))
    scanned.until(lambda: 260.0 in [p.result.f0_hz for p in scanned.map_node._grown.map.points])
    found = [point.result.f0_hz for point in scanned.map_node._grown.map.estimated]
    assert found == [*left, 260.0]
    failed = outcome is PointOutcome.FAILED
    assert scanned.map_node.details()["failures"] == str(int(failed))


def test_late_readers_get_the_results_of_a_whole_scan(scanned):
    count = 4000  # a thousand points, each discarded three times
    for k in range(count):
        scanned.publisher.publish(msg.PointResult(index=k))
    heard = []
    scanned.user.create_subscription(
        msg.PointResult, "point_result", lambda m: heard.append(m.index), POINT_RESULTS
    )
    scanned.until(lambda: len(heard) == count)
    assert heard == list(range(count))


def test_tissue_is_called_from_a_scene():
    scene = share_path("config/scenes/inclusion_scan.yaml")
    arguments = [*OF_POLES, "-p", f"classes_file:={scene}"]
    with initialised(domain_id=free_domain_id(os.environ), args=arguments), Bench() as bench:
        bench.send(
            poles(1, 0.0, 253.8, 0.0336), poles(2, 0.004, 258.0, 0.0379), poles(3, 0.008, 240.0)
        )
        rows = table(bench.read(PointCloud2, "pole_map")[0])
        assert list(rows["tissue_class"]) == [0, 1, 255]
        assert rows["tissue_probability"][0] > 0.9
        assert np.isnan(rows["tissue_probability"][2])
        texts = [m.text for m in bench.read(MarkerArray, "pole_map/legend")[0].markers]
        assert {"class 0, gelatine 10 %: 1", "class 255, unknown: 1"} <= set(texts)


@pytest.mark.parametrize(("age_s", "called"), [(1.0, 0), (5.0, 255)])
def test_force_and_age_of_a_result_are_accounted_for(age_s, called):
    """Gelatine under 9.5 mN for 1 s is gelatine; the same pole after 5 s, in which gelatine creeps, is not."""
    scene = share_path("config/scenes/demo.yaml")
    arguments = ["--ros-args", "-p", f"classes_file:={scene}"]
    mode = SimulatedBench.from_configuration().coupled(read_tissues()["gel10"], force_n=9.5e-3)
    f0_hz, damping = (getattr(mode.mode_near(255), name) for name in ("f0_hz", "damping_ratio"))
    message = point_result(7, 0.0, f0_hz)
    message.contact_age_s = age_s
    message.poles = [poles(7, 0.0, f0_hz, damping)]
    message.poles[0].contact_force_n, message.poles[0].contact_force_std_n = 9.5e-3, 1e-5
    given = (msg.PointResult, "point_result", POINT_RESULTS)
    with (
        initialised(domain_id=free_domain_id(os.environ), args=arguments),
        Bench(*given) as bench,
    ):
        bench.send(message)
        (row,) = table(bench.read(PointCloud2, "pole_map")[0])
    assert row["tissue_class"] == called
    assert row["f0_hz"] == pytest.approx(f0_hz, abs=1e-4)  # as measured


def test_a_classes_file_that_is_wrong_is_refused(tmp_path):
    path = tmp_path / "classes.yaml"
    path.write_text("tissue_classes: {a: {f0_hz: 250.0}}\n")
    with initialised(
        domain_id=free_domain_id(os.environ), args=[*OF_POLES, "-p", f"classes_file:={path}"]
    ):
        node = PoleMapNode()
        node.trigger_configure()
        assert node.state_name() == "unconfigured"
        assert "classes.yaml: tissue_classes.a.damping_ratio: got None" in node.health._error
        node.destroy_node()


def test_a_boundary_that_is_wanted_is_drawn_where_it_is():
    """Poles rise by 1 Hz per millimetre of x: the boundary at 254 Hz is a line across the map."""
    arguments = [*OF_POLES, "-p", "boundary_f0_hz:=[254.0, 0.0]"]
    with initialised(domain_id=free_domain_id(os.environ), args=arguments), Bench() as bench:
        x_mm = np.arange(0.0, 9.0, 2.0)
        for k, y_m in enumerate((0.0, 0.004)):
            bench.send(
                *(
                    poles(1 + 10 * k + j, 1e-3 * x, 252.5 + x, place=(1e-3 * x, y_m, 0.0))
                    for j, x in enumerate(x_mm)
                )
            )
        markers = bench.read(MarkerArray, "pole_map/markers")[0].markers
    outline, band = (marker for marker in markers if marker.ns == "boundary")
    places = np.array([[point.x, point.y] for point in outline.points])
    np.testing.assert_allclose(places[:, 0], 0.0015, atol=5e-5)
    assert np.ptp(places[:, 1]) > 0.004
    around = np.array([point.x for point in band.points])
    assert around.min() < 0.0015 < around.max()


def test_the_boundary_of_an_adaptive_scan_is_that_of_its_report():
    """Also where no point lies: over the whole region of the scene."""
    path = share_path("config/scenes/demo.yaml")
    arguments = [*OF_POLES, "-p", f"adaptive_scene:={path}"]
    level_hz, results = read_scan_scene(path).adaptive.wanted.levels[0], []
    with initialised(domain_id=free_domain_id(os.environ), args=arguments), Bench() as bench:
        for k, y_m in enumerate((-0.002, 0.002)):
            for j, x_m in enumerate(np.linspace(-0.006, 0.006, 5)):
                f0_hz = level_hz + 1e3 * x_m
                bench.send(poles(1 + 10 * k + j, x_m, f0_hz, place=(x_m, y_m, 0.0)))
                results.append(
                    PointResult(0, x_m=x_m, y_m=y_m, f0_hz=f0_hz, f0_std_hz=COVARIANCE[0, 0, 0] ** 0.5)
                )
        markers = bench.read(MarkerArray, "pole_map/markers")[0].markers
    outline, _ = (marker for marker in markers if marker.ns == "boundary")
    places = np.array([[point.x, point.y] for point in outline.points])
    reported = np.concatenate(read_scan_scene(path).adaptive.boundary(results).outline_m)
    assert {tuple(place) for place in places.round(9)} == {tuple(at) for at in reported.round(9)}
    assert np.ptp(places[:, 1]) == pytest.approx(0.015, rel=0.05)
    np.testing.assert_allclose(np.median(places[:, 0]), 0.0, atol=2e-4)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (["adaptive_scene:=whole_map.yaml"], "accepted is a scene with adaptive positions"),
        (["adaptive_scene:=inclusion_scan.yaml"], "accepted is a scene with adaptive positions"),
        (["adaptive_scene:=demo.yaml", "boundary_f0_hz:=[254.0, 0.0]"], "accepted is empty where"),
    ],
)
def test_a_scene_without_a_boundary_of_its_own_is_refused(given, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = yaml.safe_load(share_path("config/scenes/demo.yaml").read_text())
    del scene["positions"]["adaptive"]["boundary"]
    scene["positions"]["adaptive"]["map"] = {"f0_std_hz": 0.5}
    (tmp_path / "whole_map.yaml").write_text(yaml.safe_dump(scene, sort_keys=False))
    arguments = [*OF_POLES, *(word for each in given for word in ("-p", each))]
    with initialised(domain_id=free_domain_id(os.environ), args=arguments):
        node = PoleMapNode()
        node.trigger_configure()
        assert node.state_name() == "unconfigured"
        assert "adaptive_scene: got" in node.health._error
        assert text in node.health._error
        node.destroy_node()


@pytest.mark.parametrize("given", ["[1.0]", "[255.0, 254.0]"])
def test_a_boundary_that_cannot_be_is_refused(given):
    arguments = [*OF_POLES, "-p", f"boundary_f0_hz:={given}"]
    with initialised(domain_id=free_domain_id(os.environ), args=arguments):
        node = PoleMapNode()
        node.trigger_configure()
        assert node.state_name() == "unconfigured"
        assert "boundary_f0_hz" in node.health._error
        node.destroy_node()
