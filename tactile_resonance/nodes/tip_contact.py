# SPDX-License-Identifier: Apache-2.0
"""The tip brought to the tissue and back by contact_node."""

from __future__ import annotations

import time

from geometry_msgs.msg import PoseStamped
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.action import MakeContact
from tactile_resonance.contact.result import Cause
from tactile_resonance.nodes.goal_client import GoalClient
from tactile_resonance.nodes.goals import POLL_S, follow_goal, send_goal
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.publisher_watch import PublisherWatch
from tactile_resonance.nodes.running import NEWEST
from tactile_resonance.scan.disturbances import Disturbances
from tactile_resonance.scan.hands import (
    NODE_BACK_WITHIN_S,
    Check,
    NodeAway,
    PointDisturbed,
    PointFailed,
    ScanEnded,
)
from tactile_resonance.scan.scene import Hold

STATE_TOPIC = "contact_state"
RETRACT_WITHIN_S = NODE_BACK_WITHIN_S  # a contact_node that is brought back draws the tip back too
STATE_WITHIN_S = 1.0
STATE_STALE_S = 2.0
# What says nothing of the point: it comes again.
DEVICE_CAUSES = frozenset(
    cause.value
    for cause in (
        *(Cause.FORCE_SOURCE, Cause.FORCE_STALE, Cause.FORCE_INVALID),
        *(Cause.ARM_STALE, Cause.ARM_STOPPED, Cause.ARM_LINK),
    )
)


class TipContact:
    """Client of contact_node, for a thread of its own.

    Parameters
    ----------
    node : ManagedNode

    Attributes
    ----------
    touching : bool
        The tip is on the tissue, or may be.
    """

    def __init__(self, node: ManagedNode) -> None:
        self._node = node
        self.touching = True  # a scan that was killed may have left it there
        self._state: msg.ContactState | None = None
        self._state_s = float("-inf")
        # the newest only: the recorder's may have to wait behind what else is recorded
        node.listen(msg.ContactState, STATE_TOPIC, self._on_state, NEWEST)
        self._contact = GoalClient(node, MakeContact, "make_contact")
        node.resources.callback(self._contact.destroy)
        self._retract = node.create_client(Trigger, "retract")
        node.resources.callback(node.destroy_client, self._retract)

    def hold(self, pose: PoseStamped, force_n: float, hold: Hold, check: Check) -> None:
        """Press there until the force is held."""
        goal = MakeContact.Goal(pose=pose, force_n=force_n)
        goal.hold = goal.HOLD_FORCE if hold is Hold.FORCE else goal.HOLD_INDENTATION
        self._make(goal, check)
        deadline = time.monotonic() + STATE_WITHIN_S
        while self._state is None or self._state.state != msg.ContactState.STATE_HOLD:
            if time.monotonic() > deadline:
                self.check()
            check()
            time.sleep(POLL_S)

    def touch(self, pose: PoseStamped, force_n: float, check: Check) -> MakeContact.Result:
        """Touch and draw back; what is disturbed comes again."""
        disturbed = Disturbances()
        while True:
            try:
                return self._make(MakeContact.Goal(pose=pose, force_n=force_n), check)
            except PointDisturbed as error:
                if not disturbed.again(error):
                    raise
            finally:
                self.retract()

    def retract(self) -> None:
        """Draw the tip back and wait until it is free."""
        if not self.touching:
            return
        deadline = time.monotonic() + RETRACT_WITHIN_S
        asked_s = float("-inf")
        while time.monotonic() < deadline:
            state = self._state
            since_s = time.monotonic() - asked_s
            if state is not None and state.state == state.STATE_IDLE and since_s < float("inf"):
                self.touching = False
                return
            if since_s > 1.0 and self._retract.service_is_ready():
                self._retract.call_async(Trigger.Request())
                asked_s = time.monotonic()
            time.sleep(POLL_S)
        raise ScanEnded(f"the tip was not drawn back within {RETRACT_WITHIN_S:g} s")

    def check(self) -> None:
        """`PointFailed` or `PointDisturbed` where a contact that was made is held no longer."""
        state = self._state
        if not self.touching or state is None:
            return
        silent_s = time.monotonic() - self._state_s
        if silent_s > STATE_STALE_S:
            text = f"contact_node: nothing heard of it for {silent_s:.1f} s"
            raise NodeAway(text, "contact_node silent")
        if state.state != state.STATE_HOLD:
            raise _failure(state)

    def _make(self, goal: MakeContact.Goal, check: Check) -> MakeContact.Result:
        """Contact that was reached; `PointFailed` or `PointDisturbed` where it was not."""
        self.touching = True
        watch = PublisherWatch(self._node, (STATE_TOPIC,))
        handle = send_goal(self._contact, goal, "make_contact", check)
        result = follow_goal(self._contact, handle, "contact_node", check, watch)
        if not result.reached:
            raise _failure(result)
        return result

    def _on_state(self, message: msg.ContactState) -> None:
        self._state, self._state_s = message, time.monotonic()


def _failure(told: MakeContact.Result | msg.ContactState) -> PointFailed:
    """What a contact that was not reached, or that ended, means for the point."""
    text = f"contact: {told.cause}: {told.message}"
    if told.cause in DEVICE_CAUSES:
        return PointDisturbed(text, told.cause)
    return PointFailed(text)
