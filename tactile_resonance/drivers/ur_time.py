# SPDX-License-Identifier: Apache-2.0
"""The time of a simulated bench for an arm: asked for where it is needed, or led by a control loop.

Where a loop leads it, time goes on up to that which the loop sends with each command; the arm's client process,
which receives the commands, passes that on to the bench.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from tactile_resonance.clock import Clock, Demand, SimulatedClock
from tactile_resonance.contact.interfaces import ArmError, Cell
from tactile_resonance.drivers.ur_exchange import NOTHING, ClientProcess, UrCommand

if TYPE_CHECKING:
    from tactile_resonance.drivers.ur_arm import UrArm

# In simulated time, between two looks at an arm that is not connected.
AWAY_S = 0.002
# After so long without an answer `waits_for` names the process.
SILENT_S = 1.0


def client_name() -> str:
    """Name of the arm's client process among the participants."""
    return f"client of the arm, process {os.getpid()}"


class AskedClock(SimulatedClock):
    """Simulated time that is asked for whenever it is needed, by one thread, and goes on without this clock."""

    def now_ns(self) -> int:
        """Time now [ns]."""
        return self.ask_ns()

    def wait_until(self, time_ns: int, *_: object, **__: object) -> None:
        """Wait for a time without letting it go on."""
        self.sleep_until(time_ns)


class LedClock(Clock):
    """A `Clock` that a loop leads: when it returns, the data that arm and cell sent until then have been read.

    Parameters
    ----------
    arm : UrArm
        Connected; while this clock is open, its time goes on only as the loop asks for.
    cell : Cell or None
    while_waiting : callable
        Called every tenth of a second of this machine's time while simulated time stands; what it raises ends
        the wait.

    Attributes
    ----------
    bench : SimulatedClock
        On which the arm's states are dated meanwhile.
    pending : UrCommand or None
        Sent with the next time that the loop waits for.
    dated : bool
        False: states are dated once the loop knows the time again.
    """

    def __init__(self, arm: UrArm, cell: Cell | None, while_waiting: Callable[[], None]) -> None:
        from tactile_resonance.drivers.can_wrench import CanWrench  # it needs python-can

        self._arm, self.while_waiting = arm, while_waiting
        self._cell = cell if isinstance(cell, CanWrench) else None
        self._until_ns = 0
        self._said_s = 0.0  # when the client was last sent a time
        self._hurried = False  # something has begun since the loop said what it needs
        self._speaking = threading.Lock()
        self._named_ports = (0, 0)
        self.pending: UrCommand | None = None
        self.dated = False
        self.bench = SimulatedClock(
            arm.time_server, f"{client_name()}: loop", told_with=client_name()
        )
        arm.be_led(self)
        self.bench.ask_ns()
        if self._cell is not None:
            self._cell.clock = self.bench

    def now_ns(self) -> int:
        """Time now [ns]."""
        return self.bench.now_ns()

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        """Let time go on to a time, and wait for all data that robot and cell have sent until then.

        What was commanded before has reached the robot by then.
        """
        client = self._arm.client
        if client is None:
            self._look_again()
        else:
            self._wait_until(client, time_ns, demand)
        if self._cell is not None:
            self._cell.catch_up(self.bench.frames)

    def ask_ns(self) -> int:
        """Time now [ns], asked of the bench: it may have gone on without this clock."""
        return self.bench.ask_ns()

    def hurry(self) -> None:
        """Make a wait that does not demand time demand it: something needs it now. From any thread."""
        client = self._arm.client
        if client is None:
            return
        with contextlib.suppress(ArmError), self._speaking:
            self._hurried = True  # the loop may be about to send that it needs no time
            client.send(UrCommand(NOTHING, until_ns=self._until_ns, demand=int(Demand.FAST)))

    def close(self) -> None:
        """Lead no more: time goes on without the loop."""
        if self._arm.led is not self:
            return
        pending, self.pending = self.pending, None
        if self._arm.client is not None and pending is not None:
            self._arm.client.send(pending)
        self.bench.close()
        self._arm.be_led(None)

    @property
    def waits_for(self) -> str:
        """What has not answered for a second, for people; empty: nothing."""
        now_s, client = time.monotonic(), self._arm.client
        if client is None or now_s - self._said_s < SILENT_S:
            return ""
        if client.exchange.heard_ns != self._until_ns:
            return "the arm's client process"
        return "the simulated robot" if now_s - self._arm.heard_s > SILENT_S else ""

    def _wait_until(self, client: ClientProcess, time_ns: int, demand: Demand) -> None:
        self._name_ports()
        command, self.pending = self.pending or UrCommand(NOTHING), None

        def check() -> None:
            client.look()
            self._arm.receive()  # a robot whose time stands repeats its state
            self.while_waiting()

        try:
            with self._speaking:
                self._until_ns, self._said_s = time_ns, time.monotonic()
                if self._hurried:
                    demand, self._hurried = Demand.FAST, False
                client.send(command._replace(until_ns=time_ns, demand=int(demand)))
            while self.bench.now_ns() < time_ns:
                self.bench.wait_told(check)
            if not self.dated:
                self.bench.ask_ns()  # times received while it connected are of the past
            self._arm.catch_up(self.bench.robot_ns)
            if not self.dated:
                self._arm.date_anew()
                self.dated = True
        except ArmError:  # reported by `state`
            self._look_again()

    def _name_ports(self) -> None:
        """Have the bench report what it has sent to robot and cell, either of which may be reconnected."""
        ports = self._arm.robot_port, 0 if self._cell is None else self._cell.local_port
        if ports != self._named_ports:
            self.bench.ports(*ports)
            self.bench.ask_ns()  # answered after the ports were received
            self._named_ports = ports

    def _look_again(self) -> None:
        """Wait a moment of this machine's time, and ask for the bench's, which the arm does not hold."""
        time.sleep(AWAY_S)
        self.bench.ask_ns()
