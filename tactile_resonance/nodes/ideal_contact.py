# SPDX-License-Identifier: Apache-2.0
"""Ideal contact through the interfaces of contact_node, to try a stack without a 500 Hz loop.

The tip is where a goal puts it, after a fixed time, and the force is exactly the one asked for; the contact
creeps under it. There is no robot, no load cell and no control law behind it, and none of their errors.
"""

from __future__ import annotations

import contextlib
import threading

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.action.server import ServerGoalHandle

from tactile_resonance import msg
from tactile_resonance.action import MakeContact
from tactile_resonance.clock import ClockLostError, SimulatedClock
from tactile_resonance.contact.goal import (
    Cause,
    ContactResult,
    NotIdleError,
    State,
    not_reached,
    refusal_cause,
)
from tactile_resonance.contact.parameters import check_goal, read_contact
from tactile_resonance.nodes.contact_topics import StopInput
from tactile_resonance.nodes.managed_node import ManagedNode, end_goal, in_thread
from tactile_resonance.nodes.messages import (
    contact_goal,
    contact_result,
    contact_state,
    pose_to_message,
    time_message,
)
from tactile_resonance.nodes.parameters import values
from tactile_resonance.nodes.running import STREAM
from tactile_resonance.nodes.simulated_tip import SimulatedTip, Stay, pressing
from tactile_resonance.record import Contact

CONTACT_S = 0.5
"""From a goal to the force that it asks for [s]: about as long as a robot that is near takes."""
PUBLISH_S = 0.05
CLEAR_M = 0.05
"""Above the table: where the tip is before its first goal."""
DRAWN_BACK = not_reached(Cause.CANCELLED, "drawn back on request")


class IdealContact:
    """Action `make_contact`, services `retract` and `stop`; publishes `contact_state`, `tcp_pose`, `wrench`.

    Parameters
    ----------
    node : ManagedNode
        Owns the interfaces, until it is cleaned up.
    tip : SimulatedTip
        That it brings to the tissue.
    stop : StopInput
    """

    def __init__(self, node: ManagedNode, tip: SimulatedTip, stop: StopInput) -> None:
        self._node, self._tip, self._stop = node, tip, stop
        (self._base_frame,) = values(node, "base_frame")
        place = Contact(position_m=tip.above_table(CLEAR_M), frame_id=self._base_frame)
        tip.stays.add(Stay(0, 0.0, pose_to_message(place)))
        self._drawn_back = threading.Event()
        self._state: State = State.IDLE
        self._result: ContactResult | None = None
        stop.draw_back = self.draw_back
        self._states = node.publish_on(msg.ContactState, "contact_state", STREAM)
        self._poses = node.publish_on(PoseStamped, "tcp_pose", STREAM)
        self._wrenches = node.publish_on(WrenchStamped, "wrench", STREAM)
        node.serve_trigger("retract", self._on_retract)
        node.every(PUBLISH_S, self._publish)
        node.act(
            MakeContact,
            "make_contact",
            self._on_goal,
            on_cancel=lambda _: self.draw_back(),
            refuses=lambda _: stop.stopped,
        )

    async def _on_goal(self, goal: ServerGoalHandle) -> MakeContact.Result:
        try:
            self._check(goal.request)
        except ValueError as error:
            result = not_reached(refusal_cause(error), str(error))
        else:
            self._drawn_back.clear()  # a stop after this is seen in the wait, one before in the refusal
            self._say(State.APPROACH)
            result = await in_thread(self._node, lambda: self._touch(goal.request), "ideal contact")
        if goal.is_cancel_requested:
            self.draw_back()  # for a cancellation before the work began
        end_goal(goal, result.reached and not goal.is_cancel_requested)
        return contact_result(result)

    def _touch(self, request: MakeContact.Goal) -> ContactResult:
        """Bring the tip there, taking as long as a contact takes."""
        began_ns = self._tip.now_ns()
        if not self._wait(CONTACT_S):
            return self._say(State.IDLE, DRAWN_BACK)
        place = request.pose.pose.position
        found = self._tip.found_at(np.array([place.x, place.y, place.z]), request.force_n)
        if found is None:
            missing = not_reached(Cause.SURFACE_MISSING, "nothing to touch there")
            return self._say(State.IDLE, missing)
        now_ns = self._tip.now_ns()
        self._tip.place(Stay(now_ns, request.force_n, request.pose), began_ns)
        took_s, (depth_m, surface_m) = (now_ns - began_ns) * 1e-9, found
        reached = ContactResult(
            reached=True,
            cause=Cause.NONE,
            message="",
            total_s=took_s,
            peak_force_n=request.force_n,
            force_n=request.force_n,
            force_std_n=0.0,
            depth_m=depth_m,
            surface_m=surface_m,
            surface_std_m=0.0,
            contact_s=took_s,
        )
        self._say(State.HOLD, reached)
        if self._drawn_back.is_set():  # asked for after the wait
            self.draw_back()
        return reached

    def _check(self, request: MakeContact.Goal) -> None:
        """Raise ``ValueError`` where a goal is refused, as contact_node refuses it by default."""
        goal = contact_goal(request, self._base_frame, self._tip.ball_radius_m)
        check_goal(goal, *read_contact())
        if self._stop.stopped:
            raise NotIdleError("goal: refused while the tip is stopped")
        if self._state is not State.IDLE:
            raise NotIdleError(f"goal: refused in state {self._state.value}; accepted in idle")

    def _wait(self, seconds: float) -> bool:
        """Let time pass; False where the tip is to be drawn back meanwhile."""
        server = self._node.time_server
        if not server:
            return not self._drawn_back.wait(seconds)

        def check() -> None:
            if self._drawn_back.is_set():
                raise ClockLostError("drawn back")

        try:
            with contextlib.closing(SimulatedClock(server, "ideal contact")) as clock:
                clock.wait_until(clock.now_ns() + round(seconds * 1e9), while_waiting=check)
        except ClockLostError:
            return False
        return not self._drawn_back.is_set()

    def _on_retract(self) -> str:
        self.draw_back()
        return "asked; contact_state reports when it is idle"

    def draw_back(self) -> None:
        """Lift the tip off, also one that is on its way."""
        self._drawn_back.set()
        if self._state is State.HOLD:
            self._tip.place(Stay(self._tip.now_ns(), 0.0, self._tip.stays.newest.pose))
            self._say(State.IDLE, DRAWN_BACK)

    def _say(self, state: State, result: ContactResult | None = None) -> ContactResult:
        """Publish from now on a state, and what became of the contact; None: not known yet."""
        self._state, self._result = state, result
        self._publish()
        return result

    def _publish(self) -> None:
        now_ns, frame_id = self._tip.now_ns(), self._tip.frame_id
        stay, result, now = self._tip.stays.newest, self._result, time_message(now_ns)
        state = contact_state(self._state, now_ns, None, result, frame_id)
        state.instance, state.stopped = self._node.instance, self._stop.stopped
        if self._state is State.HOLD:
            state.force_n, state.depth_m = stay.force_n, result.depth_m
        self._states.publish(state)
        if stay.pose.header.frame_id:
            self._poses.publish(stay.pose_at(now_ns))
        self._wrenches.publish(pressing(stay.force_n, now, frame_id))
