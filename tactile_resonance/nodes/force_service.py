# SPDX-License-Identifier: Apache-2.0
"""The service `force_over` of contact_node: force and place of the tip over a block, of all wrenches in it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rclpy.task import Future

from tactile_resonance.clock import Clock
from tactile_resonance.contact.force_spread import ForceRecord
from tactile_resonance.contact.goal import TARED, State
from tactile_resonance.contact.loop import Cycle
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import tip_pose, write_force_over
from tactile_resonance.recording.messages import time_from_message
from tactile_resonance.srv import ForceOver

WAIT_S = 0.2
"""An answer waits so long for the loop to come to the end of its block, on the machine's clock [s]."""
LOOK_EVERY_S = 0.1
"""While answers wait it is looked so often whether one has waited too long [s]."""


class ForceService:
    """Keeps what the loop sees, and answers for any interval of the last 30 s.

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
        self._clock, self._base_frame = clock, base_frame
        self._state, self._bias_n = State.IDLE, (0.0, 0.0, 0.0)
        self._now_ns, self._awaited_ns = 0, math.inf
        self._waiting: list[tuple[int, float, Future]] = []  # end [ns], deadline [s]
        self._guard = node.create_guard_condition(self._look)
        node.resources.callback(node.destroy_guard_condition, self._guard)
        self._timer = node.every(LOOK_EVERY_S, self._look)
        self._timer.cancel()
        node.serve(ForceOver, "force_over", self._on_request)

    def take(self, cycle: Cycle) -> None:
        """Take a cycle, in the loop's thread."""
        if cycle.bias_n != self._bias_n:
            self._bias_n = cycle.bias_n
            self._record.restart(cycle.bias_std_n)
        valid = cycle.state in TARED and cycle.fault is None
        self._record.add(cycle.time_ns, cycle.wrenches, cycle.bias_n, cycle.arm, valid=valid)
        self._state, self._now_ns = cycle.state, cycle.time_ns
        if cycle.time_ns >= self._awaited_ns:
            self._awaited_ns = math.inf
            self._guard.trigger()

    def _look(self) -> None:
        """Answer requests whose block is over by now, and those that have waited too long."""
        now_s = time.monotonic()
        for entry in list(self._waiting):
            end_ns, deadline_s, future = entry
            if end_ns <= self._now_ns or now_s > deadline_s:
                self._waiting.remove(entry)
                future.set_result(None)
        self._awaited_ns = min((end_ns for end_ns, _, _ in self._waiting), default=math.inf)
        if not self._waiting:
            self._timer.cancel()

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
        if end_ns > self._now_ns and self._state is not State.IDLE:
            future: Future = Future()
            self._waiting.append((end_ns, time.monotonic() + WAIT_S, future))
            self._awaited_ns = min(self._awaited_ns, end_ns)
            self._timer.reset()
            self._look()  # the loop may have come there meanwhile
            await future
        over = self._record.over(start_ns, end_ns)
        idle = self._state is State.IDLE and over.reason
        reason = "no contact was under way" if idle else over.reason
        write_force_over(response, reason, over.force_n, over.force_std_n, over.spread)
        response.coverage = over.coverage
        if not math.isnan(over.position_m[0]):
            middle_ns = clock.ros_ns((start_ns + end_ns) // 2)
            response.tip_pose = tip_pose(
                middle_ns, self._base_frame, over.position_m, over.rotation_rad
            )
        return response
