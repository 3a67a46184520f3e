# SPDX-License-Identifier: Apache-2.0
"""The tip brought to the tissue and back by contact_node."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from std_srvs.srv import SetBool, Trigger

from tactile_resonance import msg
from tactile_resonance.action import Indent, MakeContact
from tactile_resonance.contact.goal import Cause, HoldMode
from tactile_resonance.nodes.goals import POLL_S, GoalClient, Goals, answer_of, wait_for
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import HOLDS
from tactile_resonance.nodes.node_watch import ScanTime
from tactile_resonance.nodes.running import NEWEST
from tactile_resonance.recording.messages import PROTOCOLS, time_from_message
from tactile_resonance.scan.failures import (
    NODE_BACK_WITHIN_S,
    PointDisturbed,
    PointFailed,
    ScanEnded,
    Stopped,
    SurfaceEarly,
    SurfaceMissing,
)
from tactile_resonance.scan.hands import Check
from tactile_resonance.scan.point_outcome import StateTimes
from tactile_resonance.scan.tissue_tests import ProtocolRequest

STATE_TOPIC = "contact_state"
UNKNOWN = msg.ContactState(tissue_moves_m=math.nan, zero_moved_n=math.nan)
"""Before contact_node has told a state that counts."""
TOUCH_RETRACT_WITHIN_S = 20.0  # after a touch of a surface that is searched for
RETRACT_WITHIN_S = NODE_BACK_WITHIN_S  # a contact_node that is brought back draws the tip back too
ASK_AGAIN_S = 1.0
NOT_ACTIVE = "is contact_node active?"
OFFERED_WITHIN_S = 5.0
# Faults of the devices or the node, and requests of other clients, are no fault of the point: it is repeated.
FOREIGN_CAUSES = frozenset(
    cause.value
    for cause in (
        *(Cause.FORCE_SOURCE, Cause.FORCE_STALE, Cause.FORCE_INVALID),
        *(Cause.ARM_STALE, Cause.ARM_STOPPED, Cause.ARM_LINK),
        *(Cause.CANCELLED, Cause.BUSY, Cause.STOPPED),
    )
)


class TipContact:
    """Client of contact_node, for a thread of its own.

    Parameters
    ----------
    node : ManagedNode
    scan_time : ScanTime
    end_if_hung : callable
        Raises `ScanEnded` where a node that is waited for hangs.

    Attributes
    ----------
    touching : bool
        The tip is on the tissue, or may be.
    stopped : bool
        Somebody keeps it out, and contact_node refuses goals.
    touched_ns : int or None
        First touch of the contact that is held (ROS time) [ns]; None where none is.
    """

    def __init__(
        self, node: ManagedNode, scan_time: ScanTime, end_if_hung: Callable[[], None]
    ) -> None:
        self._time, self._end_if_hung = scan_time, end_if_hung
        self._node = node
        client = GoalClient(node, MakeContact, "make_contact")
        self._goals = Goals(client, "make_contact")
        tester = GoalClient(node, Indent, "indent")
        self._tests = Goals(tester, "indent")
        for each in (client, tester):
            node.resources.callback(each.destroy)
        self._retract = node.client_of(Trigger, "retract")
        self._stop = node.client_of(SetBool, "stop")

    def listen(self) -> None:
        """Subscribe to contacts, for one scan; where the tip is now is unknown."""
        self.touching = True  # a scan that was killed may have left it there
        self.stopped, self._instance = False, 0
        self.touched_ns: int | None = None
        self._held_ns = 0  # when the contact was first seen to be held
        self._stop_asked_s = 0.0
        self._state = UNKNOWN
        self._times, self._low = StateTimes(), False
        # the newest only: the recorder's may have to wait behind what else is recorded
        # always: a scan that the node's deactivation ends still draws the tip back
        self._node.listen(msg.ContactState, STATE_TOPIC, self._on_state, NEWEST, always=True)

    @property
    def spent_s(self) -> dict[str, float]:
        """Time of the newest contact in each of its states, as fields of `PointResult`; empty: unknown."""
        return self._times.fields

    @property
    def tissue_moves_m(self) -> float:
        """Half the way of tissue that the tip follows while it holds its force [m]; NaN: none is seen."""
        return self._state.tissue_moves_m

    def hold(
        self,
        pose: PoseStamped,
        force_n: float,
        hold: HoldMode,
        check: Check,
        standoff_m: float = math.inf,
    ) -> MakeContact.Result:
        """Press there until the force is held, from a standoff that is no higher than the usual one."""
        goal = MakeContact.Goal(pose=pose, force_n=force_n)
        self._low = math.isfinite(standoff_m)
        goal.standoff_m = standoff_m if self._low else 0.0
        goal.hold = HOLDS[hold]
        result, check = self._make(goal, check), self._going(check)
        while (state := self._state).state != state.STATE_HOLD:
            check()
            if state.cause not in ("", Cause.NONE.value):
                raise self.failure(state)
            time.sleep(POLL_S)
        self.touched_ns = self._held_ns - round(result.contact_s * 1e9)
        return result

    def touch(self, pose: PoseStamped, force_n: float, check: Check) -> MakeContact.Result:
        """Touch and draw back."""
        try:
            return self._make(MakeContact.Goal(pose=pose, force_n=force_n), check)
        finally:
            self.retract(TOUCH_RETRACT_WITHIN_S)

    def offers_tests(self) -> bool:
        """Whether a node offers the action `indent`: ideal contact does not."""
        return self._tests.client.wait_for_server(self._time.patience_s(OFFERED_WITHIN_S))

    def test(
        self, pose: PoseStamped, asked: ProtocolRequest, force_n: float, check: Check
    ) -> Indent.Result:
        """Carry a mechanical test out, and leave the tip free."""
        goal = Indent.Goal(
            protocol=PROTOCOLS[asked.kind],
            pose=pose,
            force_n=force_n,
            hold_s=asked.hold_s,
            press_speed_m_s=asked.press_speed_m_s or 0.0,
            unload_speed_m_s=asked.draw_back_m_s,
        )
        try:
            return self._sent(self._tests, goal, check)
        finally:
            self.retract()

    def retract(self, within_s: float = RETRACT_WITHIN_S) -> float:
        """Draw the tip back and wait until it is free; return by how much the zero of the force moved [N].

        0 where it did not, or where that is unknown.
        """
        if not self.touching:
            return 0.0
        deadline, why = time.monotonic() + within_s, NOT_ACTIVE
        while time.monotonic() < deadline:
            self._end_if_hung()
            self._time.go()
            why = self._ask_to_retract()
            if not why and wait_for(lambda: self._is(msg.ContactState.STATE_IDLE), ASK_AGAIN_S):
                self.touching, self.touched_ns = False, None
                moved_n = self._state.zero_moved_n
                # a refused goal made no contact: the state still describes the one before
                return 0.0 if math.isnan(moved_n) or not self._times.fields else moved_n
            state = self._state
            if state.cause == Cause.HELD.value and state.state == state.STATE_FAULT:
                raise ScanEnded(f"the tip is held: {state.message}")
            why = why or state.message or NOT_ACTIVE
        raise ScanEnded(f"the tip was not drawn back within {within_s:g} s: {why}")

    def rise(self) -> None:
        """Wait until a tip that was drawn back to a low standoff is at the usual one and stands."""
        if not self._low:
            return
        self._low = False
        self._time.go()
        asked = not self._ask_to_retract()
        if asked and wait_for(lambda: self._is(msg.ContactState.STATE_RETRACT), ASK_AGAIN_S):
            wait_for(lambda: self._is(msg.ContactState.STATE_IDLE), TOUCH_RETRACT_WITHIN_S)

    def check(self) -> None:
        """`PointFailed` or `PointDisturbed` where a contact that was made is held no longer.

        `PointDisturbed` also where none was made, and the tip moves or touches for somebody else.
        """
        state = self._state
        if self.touching and state.state not in (UNKNOWN.state, state.STATE_HOLD):
            raise self.failure(state)
        free = (UNKNOWN.state, state.STATE_IDLE, state.STATE_FAULT)
        if not self.touching and state.state not in free:
            text = f"contact: {state.state}: asked for by another client, the tip is not at rest in air"
            raise PointDisturbed(text, Cause.BUSY.value)

    def _make(self, goal: MakeContact.Goal, check: Check) -> MakeContact.Result:
        """Contact that was reached; `PointFailed` or `PointDisturbed` where it was not."""
        result = self._sent(self._goals, goal, check)
        if not result.reached:
            raise self.failure(result)
        return result

    def _sent(self, goals: Goals, goal: MakeContact.Goal | Indent.Goal, check: Check) -> Any:
        """Result of a goal, from a tip that is free."""
        # a contact that a scan before this one left is ended first
        state = self._state
        self.touching = self.touching or state.state not in (UNKNOWN.state, state.STATE_IDLE)
        self.retract()
        self.touching = True
        self._state = UNKNOWN
        self._times = StateTimes()
        self._time.go()
        check = self._going(check)
        return goals.follow(goals.send(goal, check), check)

    def _going(self, check: Check) -> Check:
        """The same, and time goes on."""

        def both() -> None:
            check()
            self._time.keep_going()

        return both

    def _ask_to_retract(self) -> str:
        """Why contact_node does not take the request, empty: it does; states before its answer do not count."""
        answer = answer_of(
            self._retract, Trigger.Request(), ASK_AGAIN_S, check=self._end_if_hung
        )
        if answer is None:
            return NOT_ACTIVE
        self._state = UNKNOWN
        if answer.success:
            return ""
        time.sleep(0.05)
        return str(answer.message)

    def _is(self, state: str) -> bool:
        """Whether contact_node reports a state; idle: that the tip is free."""
        return bool(self._state.state == state)

    def _on_state(self, message: msg.ContactState) -> None:
        before, stamp_ns = self._state, time_from_message(message.header.stamp)
        self._times.take(message.state, stamp_ns)
        if message.state == message.STATE_HOLD and before.state != message.state:
            self._held_ns = stamp_ns
        self._state = message  # last: whoever sees that it is held reads since when
        if not self.stopped or message.stopped or message.instance == self._instance:
            self.stopped, self._instance = message.stopped, message.instance
        elif time.monotonic() - self._stop_asked_s > ASK_AGAIN_S:
            # a node that was restarted does not know that it was stopped, and nobody has released it
            self._stop_asked_s = time.monotonic()
            self._stop.call_async(SetBool.Request(data=True))

    def failure(self, ended: MakeContact.Result | Indent.Result | msg.ContactState) -> PointFailed:
        """What to raise for a contact that was not reached, or that ended."""
        if self.stopped and ended.cause == Cause.CANCELLED.value:
            return Stopped()
        text = f"contact: {ended.cause}: {ended.message}"
        if ended.cause in FOREIGN_CAUSES:
            return PointDisturbed(text, ended.cause)
        if ended.cause == Cause.SURFACE_MISSING.value:
            return SurfaceMissing(text)
        if ended.cause == Cause.SURFACE_EARLY.value:
            return SurfaceEarly(text)
        return PointFailed(text)
