# SPDX-License-Identifier: Apache-2.0
"""Frames through the tf2 of ROS, where it is installed: goals in any of them, and what is broadcast."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, TransformStamped
from rclpy.executors import SingleThreadedExecutor

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.samples import Pose as TipPose
from tactile_resonance.nodes import frames
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.pole_map_node import PoleMapNode
from tactile_resonance.nodes.running import POLES, STREAM, initialised
from tactile_resonance.nodes.scan_node import ScanNode
from tactile_resonance.processes import free_domain_id
from test.spinning import spin_until

TABLE = [-0.49, -0.13, 0.2, 0.3, -0.2, -1.5]
CAMERA = Rotation.from_rotvec([2.0, -1.0, 0.5])


@pytest.fixture
def tf2_ros():
    return pytest.importorskip("tf2_ros", reason="tf2_ros is not here: it comes with a full ROS 2")


@pytest.fixture
def executor():
    table = f"table_in_base:=[{','.join(map(str, TABLE))}]"
    arguments = ["--ros-args", "-p", table, "-p", "contact:=none", "-p", "table_frame:=left/table"]
    with initialised(domain_id=free_domain_id(os.environ), args=arguments):
        made = SingleThreadedExecutor()
        try:
            yield made
        finally:
            for node in made.get_nodes():
                node.destroy_node()
            made.shutdown()


def start(executor, node):
    executor.add_node(node)
    if isinstance(node, ManagedNode):
        node.trigger_configure()
        node.trigger_activate()
    return node


def transform(parent, child, place, turn, stamp_s=0):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = parent, Time(sec=stamp_s)
    to = message.transform.translation
    to.x, to.y, to.z = map(float, place)
    x, y, z, w = map(float, turn.as_quat())
    message.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
    return message


def looked_up(executor, node, *names, stamp_s=0):
    task = executor.create_task(frames.look_up(node, "base", names, Time(sec=stamp_s)))
    assert spin_until(executor, task.done)
    return task.result()


class Empty(ManagedNode):
    """A node of this package that does nothing."""

    def __init__(self, broadcast_tf=True):
        super().__init__("empty", (replace(frames.BROADCAST_TF, default=broadcast_tf),))

    def configure(self):
        pass


def test_a_frame_is_looked_up_through_the_tree(executor, tf2_ros):
    node = start(executor, Empty())
    user = start(executor, rclpy.create_node("user"))
    turn = Rotation.from_rotvec([0.0, 0.0, 0.5])
    tf2_ros.StaticTransformBroadcaster(user).sendTransform(
        [
            transform("world", "base", [1.0, 2.0, 3.0], turn),
            transform("world", "mount", [0.5, -1.0, 1.0], CAMERA),
            transform("mount", "camera", [0.0, 0.0, 0.1], Rotation.identity()),
        ]
    )
    found, missing = looked_up(executor, node, "camera", "world")
    assert missing == ""
    in_world = np.array([0.5, -1.0, 1.0]) + CAMERA.apply([0.0, 0.0, 0.1])
    expected = turn.inv().apply(in_world - [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found["camera"].position_m, expected, atol=1e-12)
    off = found["camera"].rotation.inv() * turn.inv() * CAMERA
    assert off.magnitude() < 1e-12
    # nothing listens to TF any more
    assert node.count_subscribers("/tf") == 0


def test_a_frame_that_is_not_in_the_tree_is_named_with_those_that_are(
    executor, tf2_ros, monkeypatch
):
    monkeypatch.setattr(frames, "LOOK_WITHIN_S", 1.0)
    node = start(executor, Empty())
    user = start(executor, rclpy.create_node("user"))
    broadcaster = tf2_ros.StaticTransformBroadcaster(user)
    broadcaster.sendTransform(transform("world", "base", [1.0, 2.0, 3.0], CAMERA))
    found, missing = looked_up(executor, node, "camera")
    assert found == {}
    assert missing.startswith('tf2: "camera" passed to lookupTransform')
    assert missing.endswith("; it knows base, world")


def test_a_stamp_asks_for_the_frame_as_it_stood_then(executor, tf2_ros):
    """Of a moving frame: 0 is the newest, another one is met between two that were broadcast."""
    node = start(executor, Empty())
    user = start(executor, rclpy.create_node("user"))
    broadcaster = tf2_ros.TransformBroadcaster(user)

    def move():
        steps = ((100, 0.0), (110, 1.0))
        broadcaster.sendTransform(
            [transform("base", "camera", [x, 0, 0], CAMERA, at_s) for at_s, x in steps]
        )

    user.create_timer(0.02, move)
    for stamp_s, x in ((0, 1.0), (104, 0.4)):
        found, _ = looked_up(executor, node, "camera", stamp_s=stamp_s)
        assert found["camera"].position_m[0] == pytest.approx(x, abs=1e-9)


def test_the_nodes_broadcast_one_tree(executor, tf2_ros):
    listener = start(executor, rclpy.create_node("listener"))
    buffer = tf2_ros.Buffer()
    tf2_ros.TransformListener(buffer, listener)
    heard = set()

    def hear(message):
        heard.update((t.child_frame_id, t.header.frame_id) for t in message.transforms)

    from tf2_msgs.msg import TFMessage

    listener.create_subscription(TFMessage, "/tf_static", hear, POLES)
    listener.create_subscription(TFMessage, "/tf", hear, 100)
    start(executor, ScanNode())
    pole_map = start(executor, PoleMapNode())
    empty = start(executor, Empty())
    tip = TipGeometry()
    frames.broadcast_fixed(empty, "tip", {"sensor": tip.sensor, "tool": TipPose.at_origin()})
    poses = listener.create_publisher(PoseStamped, "tcp_pose", STREAM)
    turn = Rotation.from_rotvec([3.0, 0.2, 0.1])
    x, y, z, w = turn.as_quat().tolist()
    message = PoseStamped(
        pose=Pose(position=Point(x=0.1, y=0.2, z=0.3), orientation=Quaternion(x=x, y=y, z=z, w=w))
    )
    message.header.frame_id, message.header.stamp = "base", Time(sec=5)
    timer = listener.create_timer(0.02, lambda: poses.publish(message))
    now = rclpy.time.Time()
    names = {"left/table": "base", "tip": "base", "sensor": "tip", "tool": "tip"}
    assert spin_until(executor, lambda: len(heard) >= len(names))
    assert spin_until(executor, lambda: buffer.can_transform("base", "tip", now))
    timer.cancel()

    def where(frame):
        t = buffer.lookup_transform("base", frame, now).transform
        r = t.rotation
        to = t.translation
        return np.array([to.x, to.y, to.z]), Rotation.from_quat([r.x, r.y, r.z, r.w])

    place, turned = where("left/table")
    np.testing.assert_allclose([*place, *turned.as_rotvec()], TABLE, atol=1e-12)
    place, turned = where("tip")
    np.testing.assert_allclose(place, [0.1, 0.2, 0.3], atol=1e-12)
    assert (turned.inv() * turn).magnitude() < 1e-12
    # the ball is a beam's length from the clamp, along the x axis of the sensor
    clamp, along = where("sensor")
    ball = clamp + along.apply([tip.beam_length_m, 0.0, 0.0])
    np.testing.assert_allclose(ball, place, atol=1e-12)
    assert turn.inv().apply(clamp - place)[2] > 0.01  # higher than the ball, out of the tissue
    # who does not listen to TF costs nothing
    assert pole_map.count_subscribers("tcp_pose") == 1
    assert heard == set(names.items())  # one parent each, and none of the driver's


def test_nothing_is_broadcast_where_somebody_else_does(executor, tf2_ros):
    node = start(executor, Empty(broadcast_tf=False))
    frames.broadcast_fixed(node, "base", {"table": TipPose.at_origin()})
    frames.TipBroadcaster(node, "tip")
    assert node.count_publishers("/tf_static") == node.count_publishers("/tf") == 0


def test_without_tf2_goals_are_in_table_or_base_and_nothing_is_broadcast(executor, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    node = start(executor, Empty())
    frames.broadcast_fixed(node, "base", {"table": TipPose.at_origin()})
    frames.TipBroadcaster(node, "tip")
    assert node.count_publishers("/tf_static") == node.count_publishers("/tf") == 0
    assert looked_up(executor, node, "camera") == ({}, frames.ABSENT)
    assert looked_up(executor, node) == ({}, "")
    page = (Path(__file__).resolve().parents[2] / "docs" / "client.md").read_text()
    assert f"accepted is 'table' or 'base' ({frames.ABSENT})" in page
