# SPDX-License-Identifier: Apache-2.0
"""The time of the simulated bench as fake_hardware_node has it: simulated, or the machine's."""

from __future__ import annotations

import contextlib
import threading
import time

from rosgraph_msgs.msg import Clock

from tactile_resonance.clock import ClockLostError, SimulatedClock, time_address
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.simulation.bench_time import BenchTime
from tactile_resonance.simulation.robot.reactor import Reactor

STEP_NS = 2_000_000
CLOCK_S = 0.04
"""Between two messages on `/clock`, by the machine's clock."""


class BenchServer:
    """Serves the time of a bench without a robot, in a thread of its own.

    Parameters
    ----------
    address : str
        ``HOST:PORT``.

    Raises
    ------
    ValueError
        If the port cannot be opened.
    """

    def __init__(self, address: str) -> None:
        host, port = time_address(address)
        self._reactor = Reactor(host)
        self._time = BenchTime(self._reactor, STEP_NS, simulated=True)
        try:
            self._reactor.listen(port, self._time.serve)
        except ValueError:
            self._reactor.close()
            raise
        self._thread = threading.Thread(target=self._time.run, name="bench time", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the time, for all participants."""
        self._time.stop()
        self._thread.join()
        self._reactor.close()


class BenchNow:
    """ROS time as the bench has it; for any thread.

    Parameters
    ----------
    node : ManagedNode
        Publishes simulated time on `/clock` until it is cleaned up.
    address : str
        ``HOST:PORT`` of simulated time; empty: the machine's time.
    """

    def __init__(self, node: ManagedNode, address: str) -> None:
        self._clock: SimulatedClock | None = None
        self._lock = threading.Lock()
        if address:
            self._clock = SimulatedClock(address, node.get_name())
            node.resources.callback(self._clock.close)
            self._publisher = node.publish_on(Clock, "/clock", 1)
            node.every(CLOCK_S, self._publish)

    def __call__(self) -> int:
        """Time now [ns]."""
        if self._clock is None:
            return time.time_ns()
        with self._lock:
            return self._clock.ask_ns()

    def _publish(self) -> None:
        with contextlib.suppress(ClockLostError):  # the bench has ended, which its owner reports
            self._publisher.publish(Clock(clock=time_message(self())))
