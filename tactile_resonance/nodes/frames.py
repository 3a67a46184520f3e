# SPDX-License-Identifier: Apache-2.0
"""The tree of frames (tf2) where it is installed: frames of goals are looked up, our own are broadcast.

The only module that imports tf2. The wheels of ROS 2 on PyPI lack it; there nothing is broadcast, and of other
frames than table and base nothing is known.

The tree has one parent per frame, and frames of a robot's driver are never broadcast:

    base (of the driver) -> table          scan_node, from table_in_base
    base                 -> tip            pole_map_node, from tcp_pose
    tip                  -> sensor, tool   contact_node, from sensor_config and robot_config
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import yaml
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.event_handler import QoSPublisherMatchedInfo
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.time import Time

from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import (
    quaternion_from_vector,
    turn_from_quaternion,
    vector,
    vector_from_turn,
)
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.parameters import Fixed, values
from tactile_resonance.nodes.running import LATCHED, STREAM

BROADCAST_TF = Fixed(
    "broadcast_tf",
    True,
    "Broadcast where its frames stand, where tf2 is installed; false: another program does.",
)

ABSENT = "other frames need tf2_ros, which is not installed here"
LOOK_WITHIN_S = 5.0
"""A frame that has not been heard of by then is unknown [s]."""
LOOK_EVERY_S = 0.05
TF = QoSProfile(depth=100)


async def look_up(
    node: ManagedNode, base: str, names: Sequence[str], stamp: TimeMessage
) -> tuple[dict[str, Pose], str]:
    """Look frames up in a base, while the executor goes on.

    It listens to TF only meanwhile: idle, each message would cost processor time.

    Parameters
    ----------
    node : ManagedNode
    base : str
    names : sequence of str
    stamp : builtin_interfaces.msg.Time
        When they stood there; 0: the newest that is known.

    Returns
    -------
    poses : dict of str to Pose
    missing : str
        Why others are not among them; empty where all are.
    """
    tf2 = _tf2() if names else None
    if tf2 is None:
        return {}, ABSENT if names else ""
    buffer, over, when = tf2.Buffer(), Future(), Time.from_msg(stamp)
    listener = tf2.TransformListener(buffer, node)
    end_s = time.monotonic() + LOOK_WITHIN_S

    def look() -> None:
        known = all(buffer.can_transform(base, name, when) for name in names)
        if (known or time.monotonic() > end_s) and not over.done():
            over.set_result(None)

    timer = node.steady_timer(LOOK_EVERY_S, look)
    try:
        await over
        return _found(tf2, buffer, base, names, when)
    finally:
        node.destroy_timer(timer)
        listener.unregister()


def _found(
    tf2: Any, buffer: Any, base: str, names: Sequence[str], when: Time
) -> tuple[dict[str, Pose], str]:
    poses, reasons = {}, []
    for name in names:
        try:
            poses[name] = _pose(buffer.lookup_transform(base, name, when).transform)
        except tf2.TransformException as error:
            reasons.append(" ".join(str(error).split()))
    if not reasons:
        return poses, ""
    tree = yaml.safe_load(buffer.all_frames_as_yaml()) or {}
    known = sorted({*tree, *(of["parent"] for of in tree.values())})
    return poses, f"tf2: {' '.join(reasons)}; it knows {', '.join(known) or 'none'}"


def broadcast_fixed(node: ManagedNode, parent: str, children: Mapping[str, Pose]) -> None:
    """Broadcast fixed frames until the node is cleaned up, if its parameter says so and tf2 is there."""
    (wanted,) = values(node, BROADCAST_TF.name)
    if not (wanted and _tf2()):
        return
    from tf2_msgs.msg import TFMessage

    publisher = node.create_publisher(TFMessage, "/tf_static", LATCHED)
    node.resources.callback(node.destroy_publisher, publisher)
    now = node.get_clock().now().to_msg()
    publisher.publish(
        TFMessage(transforms=[_transform(now, parent, *child) for child in children.items()])
    )


class TipBroadcaster:
    """Broadcasts where the tip is, from `tcp_pose`, while `/tf` has a subscriber."""

    def __init__(self, node: ManagedNode, tip_frame: str) -> None:
        self._node, self._tip_frame = node, tip_frame
        self._poses: Subscription | None = None
        self._last: TimeMessage | None = None
        (wanted,) = values(node, BROADCAST_TF.name)
        if wanted and _tf2():
            from tf2_msgs.msg import TFMessage

            self._make = TFMessage
            self._publisher = node.publish_on(TFMessage, "/tf", TF, self._on_listeners)
            node.resources.callback(self._stop)

    def _on_listeners(self, matched: QoSPublisherMatchedInfo) -> None:
        if matched.current_count and self._poses is None:
            self._poses = self._node.create_subscription(
                PoseStamped, "tcp_pose", self._on_pose, STREAM
            )
        elif not matched.current_count:
            self._stop()

    def _stop(self) -> None:
        if self._poses is not None:
            self._node.destroy_subscription(self._poses)
            self._poses = None

    def _on_pose(self, message: PoseStamped) -> None:
        stamp, tip = message.header.stamp, TransformStamped(child_frame_id=self._tip_frame)
        if stamp == self._last:  # tf2 warns of repeated ones
            return
        self._last, tip.header = stamp, message.header
        place, to = message.pose.position, tip.transform.translation
        to.x, to.y, to.z = place.x, place.y, place.z
        tip.transform.rotation = message.pose.orientation
        self._publisher.publish(self._make(transforms=[tip]))


def _tf2() -> Any:
    """Return the module tf2_ros, or None."""
    try:
        import tf2_ros
    except ImportError:
        return None
    return tf2_ros


def _transform(stamp: TimeMessage, parent: str, child: str, pose: Pose) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.stamp, message.header.frame_id = stamp, parent
    to, turn = message.transform.translation, message.transform.rotation
    to.x, to.y, to.z = vector(pose.position_m)
    turn.x, turn.y, turn.z, turn.w = quaternion_from_vector(vector(pose.rotation_rad))
    return message


def _pose(transform: Any) -> Pose:
    place, turn = transform.translation, transform.rotation
    rotation = vector_from_turn(turn_from_quaternion(turn.x, turn.y, turn.z, turn.w))
    return Pose(np.array([place.x, place.y, place.z]), np.array(rotation))
