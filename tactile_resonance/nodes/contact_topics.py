# SPDX-License-Identifier: Apache-2.0
"""What contact_node tells and hears beside its goals: topics, the service `force_over`, the stop, and poles."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from tactile_resonance import msg
from tactile_resonance._typing import FloatArray
from tactile_resonance.clock import Clock
from tactile_resonance.contact.force_spread import ForceRecord
from tactile_resonance.contact.goal import TARED, State
from tactile_resonance.contact.resonance_touch import PolesTouch
from tactile_resonance.contact.samples import WrenchSample
from tactile_resonance.nodes.managed_node import ManagedNode, in_thread
from tactile_resonance.nodes.messages import (
    contact_state,
    pose_to_message,
    tip_pose,
    wrench_message,
    write_force_over,
)
from tactile_resonance.nodes.parameters import values
from tactile_resonance.nodes.running import STREAM, RCLError
from tactile_resonance.poles.result import Poles
from tactile_resonance.recording.messages import poles_from_message, time_from_message
from tactile_resonance.srv import ForceOver

if TYPE_CHECKING:  # ideal contact has a stop too, and no loop
    from tactile_resonance.contact.loop import Cycle
    from tactile_resonance.nodes.contact_thread import ContactThread

SAID_AGAIN_S = 0.1
"""While simulated time stands the state is published again after so long, by this machine's clock [s]."""
WAIT_S = 0.2
"""An answer waits so long for the loop to come to the end of its block, on the machine's clock [s]."""
IN_AIR = (State.IDLE, State.TRAVEL, State.TARE)
FORGOTTEN_NS = 1_000_000_000
"""So long after the tip left the tissue a record may still show it: stamps err, and the bench plays ahead."""


class StopInput:
    """The stop of a surgery stack: the tip leaves the tissue, and stays out until it is released.

    Service and topic `stop`, true: stop, false: release; served in every state of the node's life.

    What counts is the newest request, whoever it came from. A node that is reconfigured remembers it, one
    that is restarted does not.

    Parameters
    ----------
    node : ManagedNode

    Attributes
    ----------
    stopped : bool
    draw_back : callable
        Called with each request to stop.
    """

    def __init__(self, node: ManagedNode) -> None:
        self.stopped, self.draw_back = False, lambda: None
        self._node = node
        node.create_service(SetBool, "stop", self._on_request)
        node.create_subscription(Bool, "stop", lambda message: self._set(message.data), 10)

    def _on_request(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self._set(request.data)
        response.success = True
        response.message = "stopped; contact_state reports when it is idle"
        if not request.data:
            response.message = "released; nothing moves until a goal asks for it"
        return response

    def _set(self, stopped: bool) -> None:
        if stopped != self.stopped:
            self._node.get_logger().warning("stopped" if stopped else "the stop is released")
        self.stopped = stopped
        if stopped:
            self.draw_back()


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


class ForceService:
    """The service `force_over`: force and place of the tip over a block, of all wrenches in it.

    Keeps what the loop sees, and answers for any interval of the last 30 s.

    Parameters
    ----------
    node : ManagedNode
        Whose service it is, until it is cleaned up.
    rate_hz, period_s : float
        Of the wrenches, and of the loop.
    clock : callable
        The loop's clock; None while there is no loop.
    base_frame : str
        Of poses.
    """

    def __init__(
        self,
        node: ManagedNode,
        rate_hz: float,
        period_s: float,
        clock: Callable[[], Clock | None],
        base_frame: str,
    ) -> None:
        self._record = ForceRecord(rate_hz, period_s)
        self._node, self._clock, self._base_frame = node, clock, base_frame
        self._state, self._bias_n = State.IDLE, (0.0, 0.0, 0.0)
        node.serve(ForceOver, "force_over", self._on_request)

    def take(self, cycle: Cycle) -> None:
        """Take a cycle, in the loop's thread."""
        if cycle.bias_n != self._bias_n:
            self._bias_n = cycle.bias_n
            self._record.restart(cycle.bias_std_n)
        valid = cycle.state in TARED and cycle.fault is None
        self._record.add(cycle.time_ns, cycle.wrenches, cycle.bias_n, cycle.arm, valid=valid)
        self._state = cycle.state

    async def _on_request(
        self, request: ForceOver.Request, response: ForceOver.Response
    ) -> ForceOver.Response:
        clock = self._clock()
        if clock is None:
            return write_force_over(response, "contact_node is not active")
        start_ns = clock.own_ns(time_from_message(request.start))
        end_ns = clock.own_ns(time_from_message(request.end))
        if not start_ns < end_ns:
            return write_force_over(response, "the interval is empty")
        # while nothing is under way the loop looks seldom, and there is no force to wait for
        if not self._record.reaches(end_ns, 0.0) and self._state is not State.IDLE:
            wait = partial(self._record.reaches, end_ns, WAIT_S)
            await in_thread(self._node, wait, "force_over")
        over = self._record.over(start_ns, end_ns)
        idle = self._state is State.IDLE and over.reason
        reason = "no contact was under way" if idle else over.reason
        write_force_over(response, reason, over.force_n, over.force_std_n, over.spread)
        response.coverage = over.coverage
        time_ns = clock.ros_ns(over.time_ns)
        response.tip_pose = pose_to_message(replace(over, time_ns=time_ns, frame_id=self._base_frame))
        return response


class TouchFromPoles:
    """First contact detected by poles: those of an approach are tested against those taken in air.

    Poles are those of all that a measurement has taken so far. So a touch is detected the sooner the shorter
    measurements are, and only the last poles of each are a reference: those before hold the same data.

    Parameters
    ----------
    false_alarm_probability : float
        Of one block.
    now_ns : int
        ROS time now [ns]: of what was before nothing is known.
    """

    def __init__(self, false_alarm_probability: float, now_ns: int) -> None:
        self._touch = PolesTouch(false_alarm_probability)
        self._air_ns = self._clear_ns = now_ns

    def moved(self, state: State, now_ns: int) -> None:
        """Where the contact is, in every cycle of the loop."""
        if state not in IN_AIR:
            self._air_ns = now_ns
            if state is not State.APPROACH:
                self._clear_ns = now_ns

    def hear(self, message: msg.Poles, state: State, now_ns: int) -> bool:
        """Take the poles of a measurement so far; whether they show a touch.

        Raises
        ------
        ValueError
            If they are not finite or their covariance is unknown.
        """
        poles, origin = poles_from_message(message)
        if not len(poles.f0_hz):
            return False
        # its middle is known; it ended before now, so it cannot have begun before this
        began_ns = 2 * origin.time_ns - now_ns - FORGOTTEN_NS
        if state in IN_AIR:
            if message.final and began_ns > self._air_ns:
                self._touch.add_air(*_pole(poles))
            return False
        if state is not State.APPROACH or not self._touch.ready or began_ns < self._clear_ns:
            return False
        return self._touch.touched(*_pole(poles))


def _pole(poles: Poles) -> tuple[FloatArray, FloatArray]:
    """f0 [Hz] and damping ratio (2,), and their covariance (2, 2) from noise.

    What the model lacks is the same in air and in the approach, noise is not. Where the noise is unknown, after
    one period, all that is known counts.
    """
    mode = poles.main
    covariance = mode.noise if np.all(np.isfinite(mode.noise)) else mode.covariance
    if not np.all(np.isfinite(covariance)):
        raise ValueError(f"covariance: unknown ({poles.message or poles.status.name.lower()})")
    return mode.estimate, covariance
