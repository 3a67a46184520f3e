# SPDX-License-Identifier: Apache-2.0
"""What contact_node publishes from its loop: `wrench`, `tcp_pose`, `contact_state`."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped, WrenchStamped

from tactile_resonance import msg
from tactile_resonance.contact.loop import Cycle
from tactile_resonance.contact.samples import WrenchSample
from tactile_resonance.nodes.contact_messages import pose_message, state_message, wrench_message
from tactile_resonance.nodes.contact_thread import ContactThread
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import STREAM, RCLError


class ContactTopics:
    """Publishes every so many cycles, to those who listen.

    Parameters
    ----------
    node : ManagedNode
        Whose publishers they are, until it is cleaned up.
    frame_id, base_frame : str
        Of the tip, of its poses.
    every : int
        Cycles.
    """

    def __init__(self, node: ManagedNode, frame_id: str, base_frame: str, every: int) -> None:
        self._node, self._every = node, every
        self._frame_id, self._base_frame = frame_id, base_frame
        self._wrench = node.publish_on(WrenchStamped, "wrench", STREAM)
        self._pose = node.publish_on(PoseStamped, "tcp_pose", STREAM)
        self._state = node.publish_on(msg.ContactState, "contact_state", STREAM)
        self._wrenches: list[WrenchSample] = []
        self._unpublished = 0

    def take(self, cycle: Cycle, thread: ContactThread | None) -> None:
        """Take a cycle, in the loop's thread; `thread` is None while that is being made."""
        self._wrenches += cycle.wrenches
        self._unpublished += 1
        if self._unpublished < self._every:
            return
        self._unpublished = 0
        wrenches, self._wrenches = self._wrenches, []
        try:
            self._publish(wrenches, cycle, thread)
        except RCLError:
            # once ROS has been shut down nobody listens, but the tip is still to be drawn back
            if self._node.context.ok():
                raise

    def _publish(
        self, wrenches: list[WrenchSample], cycle: Cycle, thread: ContactThread | None
    ) -> None:
        if cycle.arm is not None and self._pose.get_subscription_count():
            self._pose.publish(pose_message(cycle, self._base_frame))
        if wrenches and self._wrench.get_subscription_count():
            self._wrench.publish(wrench_message(wrenches, cycle, self._frame_id))
        if self._state.get_subscription_count():
            self._state.publish(self._state_message(cycle, thread))

    def _state_message(self, cycle: Cycle, thread: ContactThread | None) -> msg.ContactState:
        if thread is None:
            return state_message(cycle, None, None, self._frame_id)
        controller, loop = thread.controller, thread.loop
        state = state_message(cycle, controller.estimate, controller.result, self._frame_id)
        state.cycles, state.overruns = loop.cycles, loop.overruns
        return state
