# SPDX-License-Identifier: Apache-2.0
"""Sources of the tip's place and force over a block: the service `force_over`, or the topic `tcp_pose`."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

from geometry_msgs.msg import PoseStamped

from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.parameters import Fixed, values
from tactile_resonance.nodes.running import STREAM
from tactile_resonance.record import Contact
from tactile_resonance.recording.messages import contact_from_message, spread_from_message
from tactile_resonance.srv import ForceOver

PARAMETER = Fixed(
    "contact_source",
    "force_over",
    "Source of the tip's place and force over a block: the service force_over of contact_node (or of the "
    "simulated bench), or the topic tcp_pose where no force is measured.",
    choices=("force_over", "tcp_pose"),
)

ANSWER_WITHIN_S = 0.25
"""Longest time for which a record waits for its force, on the machine's clock; not in simulated time [s]."""
DISCOVERED_WITHIN_S = 10.0
"""In simulated time a node that has just come up, and is not known to all yet, is waited for so long [s]."""
POLL_S = 5e-4


def make_contact_source(node: ManagedNode) -> MeasuredContact | PublishedPlace:
    """The source that the node's parameter names, for a thread other than the executor's."""
    (name,) = values(node, PARAMETER.name)
    return MeasuredContact(node) if name == "force_over" else PublishedPlace(node)


class MeasuredContact:
    """Place and force over a past interval by the service `force_over`."""

    def __init__(self, node: ManagedNode) -> None:
        self._client = node.client_of(ForceOver, "force_over")
        self._within_s = node.hung_after_s if node.time_server else ANSWER_WITHIN_S

    def over(self, start_ns: int, end_ns: int) -> Contact:
        """Contact from one ROS time to another [ns]; with a reason where the force is unknown."""
        deadline = time.monotonic() + min(self._within_s, DISCOVERED_WITHIN_S)
        # rclpy's own wait looks four times a second
        while not self._client.service_is_ready() and time.monotonic() < deadline:
            time.sleep(POLL_S)
        if not self._client.service_is_ready():
            return Contact(reason=f"no node serves {self._client.srv_name}")
        request = ForceOver.Request(start=time_message(start_ns), end=time_message(end_ns))
        answered = threading.Event()
        future = self._client.call_async(request)
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(self._within_s):
            self._client.remove_pending_request(future)
            return Contact(
                reason=f"no answer on {self._client.srv_name} within {self._within_s:g} s"
            )
        over: ForceOver.Response = future.result()
        contact = contact_from_message(over.tip_pose, over.force_n, over.force_std_n)
        spread = spread_from_message(over, "force_")
        return replace(contact, coverage=over.coverage, reason=over.reason, spread=spread)


class PublishedPlace:
    """By the topic `tcp_pose`; the force is not measured."""

    def __init__(self, node: ManagedNode) -> None:
        self._pose = PoseStamped()
        node.listen(PoseStamped, "tcp_pose", self._on_pose, STREAM)

    def over(self, start_ns: int, end_ns: int) -> Contact:
        """The newest place, whatever the interval."""
        nan = float("nan")
        contact = contact_from_message(self._pose, nan, nan)
        return replace(contact, reason="the force is not measured (contact_source)")

    def _on_pose(self, message: PoseStamped) -> None:
        self._pose = message
