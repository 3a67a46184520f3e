# SPDX-License-Identifier: Apache-2.0
"""What the simulated bench runs on: its robot as a process, or its time alone; and who plays excitations."""

from __future__ import annotations

import contextlib
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rosgraph_msgs.msg import Clock

from tactile_resonance.clock import ClockLostError, SimulatedClock, time_address
from tactile_resonance.multisine import Excitation
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.processes import may_take_priority, start_child
from tactile_resonance.simulation.plant.bench_time import BenchTime
from tactile_resonance.simulation.plant.defaults import PRIORITY, READY, order
from tactile_resonance.simulation.ur5e.reactor import Reactor

START_WITHIN_S = 90.0
ANSWER_WITHIN_S = 10.0
END_WITHIN_S = 3.0
STEP_NS = 2_000_000
CLOCK_S = 0.04
"""Between two messages on `/clock`, by the machine's clock."""


class PlantChild:
    """Starts `tactile_resonance simulate-ur`, with tissue and load cell, as a process that ends with its owner.

    Parameters
    ----------
    host : str
        Address of the robot, 127.x.y.z.
    scene : Path
    table_in_base : six numbers
    seed : int
    simulated_time : bool
        Its time goes on as those who take part in it let it; else that of the wall clock.

    Raises
    ------
    ValueError
        If it does not come up; with what it printed.
    """

    def __init__(
        self,
        host: str,
        scene: Path,
        table_in_base: Sequence[float],
        seed: int,
        simulated_time: bool,
    ) -> None:
        self._host = host
        pace = ["--priority", str(PRIORITY if may_take_priority(PRIORITY) else 0)]
        command = [
            *(sys.executable, "-m", "tactile_resonance.cli", "simulate-ur", "--host", host),
            *("--scene", str(scene), "--seed", str(seed % 2**31), "--table"),
            *(str(float(value)) for value in table_in_base),
            *(["--simulated-time"] if simulated_time else pace),
        ]
        self._process = start_child(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        deadline = time.monotonic() + START_WITHIN_S
        said = []
        while time.monotonic() < deadline:
            ready, _, _ = select.select([self._process.stdout], [], [], 0.1)
            line = self._process.stdout.readline() if ready else ""
            if line.startswith(READY):
                return
            if line.strip():
                said.append(line.strip())
            elif self._process.poll() is not None:
                break
        self.close()
        raise ValueError(
            f"robot_host: no simulated robot at {host}: {' '.join(said) or 'no output'}"
        )

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def ask(self, what: str, **arguments: object) -> dict[str, Any]:
        """Answer of its control port; ``OSError`` where none comes."""
        return order(self._host, what, timeout_s=ANSWER_WITHIN_S, **arguments)

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        try:
            self._process.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


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
        Publishes simulated time on `/clock` until it is cleaned up, where it lives in that.
    """

    def __init__(self, node: ManagedNode) -> None:
        self._clock: SimulatedClock | None = None
        self._lock = threading.Lock()
        if node.time_server:
            self._clock = SimulatedClock(node.time_server, node.get_name())
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


class BenchPlayer:
    """Plays one excitation at a time, in a thread of its own.

    Parameters
    ----------
    time_server : str
        Address of the simulated time in which it plays; empty: the machine's clock.
    """

    def __init__(self, time_server: str) -> None:
        self._time_server = time_server
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._clock: SimulatedClock | None = None

    def play(
        self,
        excitation: Excitation,
        start_ns: int,
        hand_out: Callable[[int], None],
    ) -> None:
        """Begin to play; what was played before must have been silenced.

        Parameters
        ----------
        excitation : Excitation
        start_ns : int
            ROS time of the first sample [ns].
        hand_out : callable
            Called in the thread with the ROS time of the end of each block [ns], at that time.

        Raises
        ------
        ClockLostError
            If no bench serves the simulated time.
        """
        if self._time_server:
            self._clock = SimulatedClock(self._time_server, "bench")
        self._stop.clear()

        def play() -> None:
            for count in range(1, excitation.periods + 1):
                end_ns = start_ns + round(count * excitation.period_s * 1e9)
                if not self._wait_until(end_ns):
                    return
                hand_out(end_ns)

        self._thread = threading.Thread(target=play, name="bench", daemon=True)
        self._thread.start()

    def silence(self) -> None:
        """Stop at once; returns when nothing more is handed out."""
        self._stop.set()
        if self._clock is not None:
            self._clock.interrupt()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._clock is not None:
            self._clock.close()
            self._clock = None

    def _wait_until(self, time_ns: int) -> bool:
        """Wait for a ROS time [ns]; False where it was silenced meanwhile."""
        if self._clock is None:
            return not self._stop.wait(max(0, time_ns - time.time_ns()) / 1e9)
        try:
            self._clock.sleep_until(time_ns)
        except ClockLostError:
            return False
        return not self._stop.is_set()
