# SPDX-License-Identifier: Apache-2.0
"""Ideal contact through the interfaces of contact_node, to try a stack without a 500 Hz loop.

The tip is where a goal puts it, after a fixed time, and the force is exactly the one asked for. There is no
robot, no load cell and no control law behind it, and none of their errors.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.action.server import ServerGoalHandle
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.action import MakeContact
from tactile_resonance.clock import ClockLostError, SimulatedClock
from tactile_resonance.contact.goal import State
from tactile_resonance.contact.result import Cause, NotIdleError, refusal_cause
from tactile_resonance.nodes.goal_thread import in_thread
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.running import STREAM
from tactile_resonance.nodes.stop_input import StopInput
from tactile_resonance.recording.messages import time_from_message
from tactile_resonance.srv import ForceOver

CONTACT_S = 0.5
"""From a goal to the force that it asks for [s]: about as long as a robot that is near takes."""
PUBLISH_S = 0.05
MOST_STAYS = 1000


@dataclass(frozen=True)
class Stay:
    """The tip somewhere, from a time on.

    Attributes
    ----------
    since_ns : int
        ROS time [ns].
    force_n : float
        0 in air.
    pose : PoseStamped
        With an empty frame where it is unknown.
    """

    since_ns: int
    force_n: float
    pose: PoseStamped


class Stays:
    """Where the tip was and how hard it pressed, and what follows for an interval."""

    def __init__(self) -> None:
        self._stays: deque[Stay] = deque([Stay(0, 0.0, PoseStamped())], maxlen=MOST_STAYS)

    @property
    def newest(self) -> Stay:
        """The present one."""
        return self._stays[-1]

    def add(self, stay: Stay) -> None:
        """The tip is somewhere else from now on."""
        self._stays.append(stay)

    def serve(self, request: ForceOver.Request, response: ForceOver.Response) -> ForceOver.Response:
        """The force over an interval, as the service `force_over` answers."""
        start_ns, end_ns = time_from_message(request.start), time_from_message(request.end)
        response.force_n = response.force_std_n = math.nan
        response.force_rms_n = response.force_min_n = response.force_max_n = math.nan
        if not start_ns < end_ns:
            response.reason = "the interval is empty"
            return response
        spans: list[tuple[float, float]] = []  # length [ns], force
        until_ns = end_ns
        for stay in reversed(self._stays):
            span_ns = max(0, until_ns - max(start_ns, stay.since_ns))
            if span_ns:
                spans.append((span_ns, stay.force_n))
                response.tip_pose = stay.pose
            until_ns = min(until_ns, stay.since_ns)
        seen_ns = sum(span_ns for span_ns, _ in spans)
        response.coverage = seen_ns / (end_ns - start_ns)
        if until_ns > start_ns:
            response.reason = f"the block begins before what is kept, {MOST_STAYS} places"
            return response
        mean_n = sum(span_ns * force_n for span_ns, force_n in spans) / seen_ns
        square = sum(span_ns * (force_n - mean_n) ** 2 for span_ns, force_n in spans) / seen_ns
        response.force_n, response.force_std_n, response.force_rms_n = mean_n, 0.0, square**0.5
        forces_n = [force_n for _, force_n in spans]
        response.force_min_n, response.force_max_n = min(forces_n), max(forces_n)
        return response


class IdealContact:
    """Action `make_contact`, services `retract` and `stop`; publishes `contact_state`, `tcp_pose`, `wrench`.

    Parameters
    ----------
    node : ManagedNode
        Owns the interfaces, until it is cleaned up.
    stays : Stays
        Receives each place of the tip.
    force_at : callable
        From a place (3,) in the base [m] and the force asked for [N]: the depth that brings it [m] and the
        height of the surface above that place [m]; None where nothing is to be touched.
    placed : callable
        Called when the tip is put somewhere.
    now_ns : callable
        ROS time now [ns].
    stop : StopInput
    base_frame, frame_id : str
    """

    def __init__(
        self,
        node: ManagedNode,
        stays: Stays,
        force_at: Callable[[np.ndarray, float], tuple[float, float] | None],
        placed: Callable[[], None],
        now_ns: Callable[[], int],
        stop: StopInput,
        base_frame: str,
        frame_id: str,
    ) -> None:
        self._node, self._stays, self._force_at, self._placed = node, stays, force_at, placed
        self._now_ns = now_ns
        self._base_frame, self._frame_id = base_frame, frame_id
        self._lock = threading.Lock()
        self._drawn_back = threading.Event()
        self._state, self._cause, self._message = State.IDLE, "", ""
        self._depth_m = math.nan
        self._stop = stop
        self._states = node.publish_on(msg.ContactState, "contact_state", STREAM)
        self._poses = node.publish_on(PoseStamped, "tcp_pose", STREAM)
        self._wrenches = node.publish_on(WrenchStamped, "wrench", STREAM)
        node.serve(Trigger, "retract", self._on_retract)
        node.every(PUBLISH_S, self._publish)
        node.act(
            MakeContact,
            "make_contact",
            self._on_goal,
            on_cancel=lambda _: self.draw_back(),
            refusal=lambda _: "the tip is stopped" if stop.stopped else "",
        )

    async def _on_goal(self, goal: ServerGoalHandle) -> MakeContact.Result:
        result = await in_thread(self._node, lambda: self._make(goal.request), "ideal contact")
        if goal.is_cancel_requested:
            self.draw_back()  # for a cancellation before the work began
            goal.canceled()
        elif result.reached:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _make(self, request: MakeContact.Goal) -> MakeContact.Result:
        """Bring the tip there, taking as long as a contact takes."""
        nan = math.nan
        result = MakeContact.Result(force_n=nan, force_std_n=nan, depth_m=nan)
        result.stiffness_n_per_m = result.surface_m = result.surface_std_m = nan
        result.contact_s = result.total_s = result.peak_force_n = nan
        if not self._lock.acquire(blocking=False):
            result.cause, result.message = Cause.BUSY.value, "goal: a contact is under way"
            return result
        try:
            self._drawn_back.clear()  # a stop after this is seen in the wait, one before in the refusal
            try:
                self._check(request)
            except ValueError as error:
                result.cause, result.message = refusal_cause(error).value, str(error)
                return result
            self._say(State.APPROACH, "", "")
            began_ns = self._now_ns()
            if not self._wait(CONTACT_S):
                self._say(State.IDLE, "cancelled", "drawn back on request")
                result.cause, result.message = self._cause, self._message
                return result
            place = request.pose.pose.position
            found = self._force_at(np.array([place.x, place.y, place.z]), request.force_n)
            if found is None:
                self._say(State.IDLE, "surface_missing", "nothing to touch there")
                result.cause, result.message = self._cause, self._message
                return result
            self._depth_m, result.surface_m = found
            now_ns = self._now_ns()
            pose = PoseStamped(header=request.pose.header, pose=request.pose.pose)
            pose.header.stamp = time_message(now_ns)
            self._stays.add(Stay(now_ns, request.force_n, pose))
            self._placed()
            self._say(State.HOLD, "none", "")
            if self._drawn_back.is_set():  # asked for after the wait
                self.draw_back()
            result.reached, result.cause, result.depth_m = True, "none", self._depth_m
            result.force_n, result.force_std_n = request.force_n, 0.0
            result.peak_force_n, result.surface_std_m = request.force_n, 0.0
            result.contact_s = result.total_s = (now_ns - began_ns) * 1e-9
            return result
        finally:
            self._lock.release()

    def _check(self, request: MakeContact.Goal) -> None:
        """Raise ``ValueError`` where a goal is refused."""
        frame = request.pose.header.frame_id
        if frame != self._base_frame:
            raise ValueError(f"pose: in frame {frame!r}, accepted is {self._base_frame!r}")
        if not 0 < request.force_n < math.inf:
            raise ValueError(f"force_n: {request.force_n:g}, accepted is above 0")
        if self._stop.stopped:
            raise ValueError("goal: refused while the tip is stopped")
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

    def _on_retract(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.draw_back()
        response.success = True
        response.message = "asked; contact_state reports when it is idle"
        return response

    def draw_back(self) -> None:
        """Lift the tip off, also one that is on its way."""
        self._drawn_back.set()
        if self._state is State.HOLD:
            now_ns = self._now_ns()
            self._stays.add(Stay(now_ns, 0.0, self._stays.newest.pose))
            self._depth_m = math.nan
            self._placed()
            self._say(State.IDLE, "cancelled", "drawn back on request")

    def _say(self, state: State, cause: str, message: str) -> None:
        self._state, self._cause, self._message = state, cause, message
        self._publish()

    def _publish(self) -> None:
        now = time_message(self._now_ns())
        stay = self._stays.newest
        state = msg.ContactState(state=self._state.value, cause=self._cause, message=self._message)
        state.header.stamp, state.header.frame_id = now, self._frame_id
        state.instance, state.stopped = self._node.instance, self._stop.stopped
        holds = self._state is State.HOLD
        state.force_n = stay.force_n if holds else math.nan
        state.zero_moved_n = math.nan
        state.depth_m, state.stiffness_n_per_m = self._depth_m, math.nan
        self._states.publish(state)
        if stay.pose.header.frame_id:
            pose = PoseStamped(header=stay.pose.header, pose=stay.pose.pose)
            pose.header.stamp = now
            self._poses.publish(pose)
        wrench = WrenchStamped()
        wrench.header.stamp, wrench.header.frame_id = now, self._frame_id
        wrench.wrench.force.z = stay.force_n
        self._wrenches.publish(wrench)
