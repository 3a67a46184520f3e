# SPDX-License-Identifier: Apache-2.0
"""Time in step with a simulated controller: each of its steps waits for one command, each cycle for a step.

The controller publishes what a step brought, then the time of the step on the topic `clock`, and goes on only
when a command with that stamp has come. So neither is ever late, however slow the machine is.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage

from tactile_resonance.clock import Demand
from tactile_resonance.contact.interfaces import LoopClock
from tactile_resonance.nodes.running import PLACES
from tactile_resonance.recording.messages import time_from_message

POLL_S = 0.1
LOST_S = 1.0
"""What a step has not brought by then, on the machine's clock, is lost and no longer waited for [s]."""


class Arrivals:
    """The newest stamp of a topic, for a thread that waits for it while another spins."""

    def __init__(self) -> None:
        self.newest_ns = 0
        self.lost = False
        self._changed = threading.Condition()

    def add(self, stamp_ns: int) -> None:
        """Take the stamp of a message [ns]."""
        with self._changed:
            self.newest_ns, self.lost = stamp_ns, False
            self._changed.notify_all()

    def wait(self, stamp_ns: int, seconds: float) -> bool:
        """Wait for a stamp or a later one; whether it has come within so many seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self.newest_ns >= stamp_ns, seconds)


class Lockstep(LoopClock):
    """The clock of a loop that a simulated controller leads, and that leads it, as fast as it can.

    Parameters
    ----------
    node : Node
    answer : callable
        Publishes the command that holds, with the stamp that it is given [ns].

    Attributes
    ----------
    awaited : sequence of Arrivals
        What every step brings.
    while_waiting : callable
        Called every tenth of a second of this machine's time while simulated time stands.
    """

    def __init__(self, node: Node, answer: Callable[[int], None]) -> None:
        self.awaited: Sequence[Arrivals] = ()
        self.while_waiting: Callable[[], None] = lambda: None
        self._answer = answer
        self._steps = Arrivals()
        self._now_ns = 0
        node.create_subscription(
            ClockMessage,
            "clock",
            lambda message: self._steps.add(time_from_message(message.clock)),
            PLACES,
        )

    def now_ns(self) -> int:
        """Time of the newest step whose data are here [ns]."""
        return self._now_ns

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        """Answer step after step until a time is reached and its data are here."""
        while self._now_ns < time_ns:
            self._answer(self._now_ns)
            while not self._steps.wait(self._now_ns + 1, POLL_S):
                self.while_waiting()
                self._answer(self._now_ns)  # a controller that has just come up has not heard it
            step_ns = self._steps.newest_ns
            for arrivals in self.awaited:
                lost_s = time.monotonic() + LOST_S
                while not arrivals.lost and not arrivals.wait(step_ns, POLL_S):
                    self.while_waiting()
                    arrivals.lost = time.monotonic() > lost_s
            self._now_ns = step_ns
