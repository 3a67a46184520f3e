# SPDX-License-Identifier: Apache-2.0
"""What contact_node publishes from its loop: `wrench`, `tcp_pose`, `contact_state`."""

from __future__ import annotations

import math
import time

from geometry_msgs.msg import PoseStamped, WrenchStamped

from tactile_resonance import msg
from tactile_resonance.contact.goal import State
from tactile_resonance.contact.loop import Cycle
from tactile_resonance.contact.samples import WrenchSample
from tactile_resonance.nodes.contact_thread import ContactThread
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import contact_state, tip_pose, wrench_message
from tactile_resonance.nodes.parameters import values
from tactile_resonance.nodes.running import STREAM, RCLError
from tactile_resonance.nodes.stop_input import StopInput

SAID_AGAIN_S = 0.1
"""While simulated time stands the state is published again after so long, by this machine's clock [s]."""


class ContactTopics:
    """Publishes at a rate, and whenever the state changes, where there are subscribers.

    Parameters
    ----------
    node : ManagedNode
        Whose publishers they are, until it is cleaned up.
    stop : StopInput

    Attributes
    ----------
    period_s : float
        Between two messages, by the loop's clock [s].
    """

    def __init__(self, node: ManagedNode, stop: StopInput) -> None:
        names = ("frame_id", "base_frame", "publish_rate_hz")
        self._frame_id, self._base_frame, rate_hz = values(node, *names)
        self._node, self._stop = node, stop
        self.period_s, self._period_ns = 1 / rate_hz, round(1e9 / rate_hz)
        self._wrench = node.publish_on(WrenchStamped, "wrench", STREAM)
        self._pose = node.publish_on(PoseStamped, "tcp_pose", STREAM)
        self._state = node.publish_on(msg.ContactState, "contact_state", STREAM)
        self._wrenches: list[WrenchSample] = []
        self._next_ns = 0
        self._before: State | None = None
        self._newest: msg.ContactState | None = None
        self._said_s = 0.0

    def take(self, cycle: Cycle, thread: ContactThread) -> None:
        """Take a cycle, in the loop's thread."""
        self._wrenches += cycle.wrenches
        changed = cycle.state is not self._before
        if cycle.time_ns < self._next_ns and not changed:
            return
        self._before = cycle.state
        # in step with the clock, without making up for what a late loop has missed
        self._next_ns = max(self._next_ns, cycle.time_ns - self._period_ns) + self._period_ns
        wrenches, self._wrenches = self._wrenches, []
        try:
            self._publish(wrenches, cycle, thread)
        except RCLError:
            # once ROS has been shut down there are no subscribers, but the tip is still to be drawn back
            if self._node.context.ok():
                raise

    def say_again(self) -> None:
        """Publish the newest state again, for those that missed it, where none was published for a while."""
        if self._newest is not None and time.monotonic() - self._said_s > SAID_AGAIN_S:
            self._say(self._newest)

    def _publish(self, wrenches: list[WrenchSample], cycle: Cycle, thread: ContactThread) -> None:
        ros_ns = thread.clock.ros_ns
        if cycle.arm is not None and self._pose.get_subscription_count():
            arm = cycle.arm
            pose = (arm.position_m, arm.rotation_rad)
            self._pose.publish(tip_pose(ros_ns(arm.time_ns), self._base_frame, *pose))
        if wrenches and self._wrench.get_subscription_count():
            self._wrench.publish(wrench_message(wrenches, cycle, ros_ns, self._frame_id))
        controller, loop = thread.controller, thread.loop
        what = cycle.state, ros_ns(cycle.time_ns), controller.estimate, controller.result
        state = contact_state(*what, self._frame_id)
        if cycle.state is State.HOLD:
            motion = controller.motion
            state.message = "" if motion is None else str(motion)
            state.tissue_moves_m = math.nan if motion is None else motion.half_way_m
        state.cycles, state.overruns = loop.cycles, loop.overruns
        self._say(state)

    def _say(self, state: msg.ContactState) -> None:
        self._newest, self._said_s = state, time.monotonic()
        state.instance, state.stopped = self._node.instance, self._stop.stopped
        if self._state.get_subscription_count():
            self._state.publish(state)
