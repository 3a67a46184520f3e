# SPDX-License-Identifier: Apache-2.0
"""The time of an arm: this machine's, or that of a simulated bench, which a control loop may lead."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from tactile_resonance.clock import Clock, Demand, SimulatedClock, WallClock
from tactile_resonance.contact.interfaces import ArmError, Cell
from tactile_resonance.drivers.ur_client_process import ClientProcess
from tactile_resonance.drivers.ur_exchange import NOTHING, UrCommand

if TYPE_CHECKING:
    from tactile_resonance.drivers.ur_arm import UrArm

# In simulated time, between two looks at an arm that is not connected.
AWAY_S = 0.002
# After so long without an answer `waits_for` names the process.
SILENT_S = 1.0


class ArmTime:
    """The clock of an arm, and in simulated time the arm's part in it.

    Where no loop leads simulated time, the bench is asked for it. Where a loop leads it, it goes on up to the
    time that the loop sends with each command; the arm's client process, which receives the commands, passes
    that on to the bench.

    Parameters
    ----------
    address : str
        ``HOST:PORT`` of a simulated bench's time; empty: this machine's clock.

    Attributes
    ----------
    clock : Clock
        Clock on which the arm's states are dated.
    led : SimulatedClock or None
        The same while a loop leads the time.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self.clock: Clock = WallClock()
        self.led: SimulatedClock | None = None
        self._asked: SimulatedClock | None = None
        self._until_ns = 0
        self._said_s = 0.0  # when the client was last sent a time
        self._hurried = False  # something has begun since the loop said what it needs
        self._speaking = threading.Lock()

    @property
    def client_name(self) -> str:
        """Name of the client process among the participants."""
        return f"client of the arm, process {os.getpid()}"

    def begin(self) -> None:
        """Connect to the bench; ClockLostError where none answers. Nothing to do on the wall clock."""
        if self.address and self._asked is None:
            self._asked = SimulatedClock(self.address, f"{self.client_name}: owner")
            self.clock = _AskedClock(self._asked)

    def close(self) -> None:
        """Leave the bench; the clock is this machine's again."""
        self.follow()
        if self._asked is not None:
            self._asked.close()
            self._asked, self.clock = None, WallClock()

    def lead(self, bus_port: Callable[[], int]) -> None:
        """Lead from now on; the client process must be asked for the same.

        Parameters
        ----------
        bus_port : callable
            Local port of the connection to the bus of a load cell; 0: none.
        """
        name = self.client_name
        self.led = SimulatedClock(self.address, f"{name}: loop", told_with=name)
        self.clock, self._bus_port, self._named_ports = self.led, bus_port, (0, 0)

    def follow(self) -> None:
        """Lead no more."""
        if self.led is not None:
            self.led.close()
            self.led, self.clock = None, _AskedClock(self._asked) if self._asked else WallClock()

    # while a loop leads

    def name_ports(self, robot_port: int) -> None:
        """Have the bench report what it has sent to robot and cell, either of which may be reconnected."""
        assert self.led is not None
        ports = robot_port, self._bus_port()
        if ports != self._named_ports:
            self.led.ports(*ports)
            self.led.ask_ns()  # answered after the ports were received
            self._named_ports = ports

    def send(self, client: ClientProcess, command: UrCommand, until_ns: int, demand: Demand) -> None:
        """Send a command, and up to which time [ns] the bench may go on after it."""
        with self._speaking:
            self._until_ns, self._said_s = until_ns, time.monotonic()
            if self._hurried:
                demand, self._hurried = Demand.FAST, False
            client.send(command._replace(until_ns=until_ns, demand=int(demand)))

    def hurry(self, client: ClientProcess) -> None:
        """Make a wait that does not demand time demand it: something needs it now. From any thread."""
        with contextlib.suppress(ArmError), self._speaking:
            self._hurried = True  # the loop may be about to send that it needs no time
            client.send(UrCommand(NOTHING, until_ns=self._until_ns, demand=int(Demand.FAST)))

    def look_again(self) -> None:
        """Wait a moment of this machine's time, and ask for the bench's, which the arm does not hold."""
        assert self.led is not None
        time.sleep(AWAY_S)
        self.led.ask_ns()

    def waits_for(self, client: ClientProcess, heard_s: float) -> str:
        """What has not answered for a second, for people; empty: nothing.

        Parameters
        ----------
        client : ClientProcess
        heard_s : float
            When the robot was last heard, on this machine's monotonic clock [s].
        """
        now_s = time.monotonic()
        if self.led is None or now_s - self._said_s < SILENT_S:
            return ""
        if client.exchange.heard_ns != self._until_ns:
            return "the arm's client process"
        return "the simulated robot" if now_s - heard_s > SILENT_S else ""


class _AskedClock:
    """Simulated time that is asked for whenever it is needed."""

    simulated = True

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock = clock
        self.ros_ns = self.own_ns = clock.ros_ns

    def now_ns(self) -> int:
        return self._clock.ask_ns()

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        while self.now_ns() < time_ns:
            time.sleep(AWAY_S)


class LedClock:
    """A `Clock` that a loop leads: when it returns, the data that arm and cell sent until then have been read.

    Parameters
    ----------
    arm : UrArm
        Connected; while this clock is open, its time goes on only as the loop asks for.
    cell : Cell
    while_waiting : callable
        Called every tenth of a second of this machine's time while simulated time stands; what it raises ends
        the wait.
    """

    simulated = True

    def __init__(self, arm: UrArm, cell: Cell, while_waiting: Callable[[], None]) -> None:
        from tactile_resonance.drivers.can_wrench import CanWrench  # it needs python-can

        self._arm, self._while_waiting = arm, while_waiting
        self._cell = cell if isinstance(cell, CanWrench) else None
        arm.lead(self._bus_port)
        if self._cell is not None:
            self._cell.clock = arm.clock

    def now_ns(self) -> int:
        """Time now [ns]."""
        return self._arm.clock.now_ns()

    def ros_ns(self, time_ns: int) -> int:
        """The same: simulated time is ROS time."""
        return time_ns

    def own_ns(self, ros_ns: int) -> int:
        """The same."""
        return ros_ns

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        """Let time go on to a time, and wait for all data that robot and cell have sent until then."""
        self._arm.wait_until(time_ns, demand, self._while_waiting)
        if self._cell is not None:
            self._cell.catch_up(self._arm.frames)

    def ask_ns(self) -> int:
        """Time now [ns], asked of the bench: it may have gone on without this clock."""
        return self._arm.ask_ns()

    def hurry(self) -> None:
        """Make a wait that does not demand time demand it: something needs it now. From any thread."""
        self._arm.hurry()

    def close(self) -> None:
        """Lead no more: time goes on without the loop."""
        self._arm.follow()

    def _bus_port(self) -> int:
        return 0 if self._cell is None else self._cell.local_port
