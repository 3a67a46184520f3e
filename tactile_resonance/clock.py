# SPDX-License-Identifier: Apache-2.0
"""The clock of devices, loops and waits: this machine's, or that of a simulated bench.

Simulated time belongs to the bench (`simulation.plant.bench_time`) and goes on in steps. Each participant
connects to the bench and sends the time up to which it may go on. When that time is reached the bench reports
it to the participant and waits for its next message. So nothing that is computed comes too late, however slow
the machine is. A participant also sends its demand, whether it needs time to pass:

- `Demand.NONE`: time may stand as far as this participant is concerned;
- `Demand.REAL`: it goes on, at the pace of real time at most;
- `Demand.FAST`: it goes on as fast as all participants allow.

Without any demand time goes on at the pace of real time; where a participant conducts (a scan), it stands
then. The conductor lets it go on with `go` until a device hands over a result, such as a block of samples:
then it stands until the next `go`, so that no time passes while the conductor decides.
"""

from __future__ import annotations

import contextlib
import json
import select
import socket
import struct
import time
from collections.abc import Callable
from enum import IntEnum
from typing import Protocol

PORT = 30021
"""Port of a bench's time where no other is given."""

ENDLESS_NS = 1 << 62
"""Time without a limit [ns]."""

MESSAGE = struct.Struct("<Bxxxxxxxqqq")
"""Kind and three integers, in both directions."""


class Demand(IntEnum):
    """Whether a participant needs time to pass."""

    NONE = 0
    REAL = 1
    FAST = 2


class ToBench(IntEnum):
    """Kinds of messages to the bench, with their integers."""

    HOLD = 1  # time up to which it may go on [ns], demand, packets sent to the robot
    ASK = 2  # answered by TIME
    GO = 3
    SEED = 4  # up to three integers, from which all noise follows from now on
    PORTS = 5  # local ports of the connections to the robot's RTDE server and to the cell's bus
    WAKE = 6  # time [ns] that is to be reported when it is reached; it does not hold time up
    ANNOUNCE = 7  # as HOLD, before the packets are sent


class FromBench(IntEnum):
    """Kinds of messages from the bench, with their integers."""

    # a time that was waited for: time now [ns], stamp of the newest robot state sent [ns], frames sent
    TOLD = 1
    TIME = 2  # the answer to ASK: time now [ns]


class ClockLostError(ConnectionError):
    """The connection to the bench whose time it was is lost."""


class Clock(Protocol):
    """A clock that never goes back: of a simulated bench, whose time is ROS time, unless it says otherwise."""

    simulated: bool = True

    def now_ns(self) -> int:
        """Time now [ns]."""
        ...

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        """Return at a time, or at once where it has passed; the demand is that for simulated time."""
        ...

    def ros_ns(self, time_ns: int) -> int:
        """A time of this clock as ROS time: since 1970, or of the simulation [ns]."""
        return time_ns

    def own_ns(self, ros_ns: int) -> int:
        """A ROS time as one of this clock [ns]."""
        return ros_ns


ROS_STEP_NS = 5_000_000
"""Beyond it ROS time was set, against the monotonic clock [ns]; where it is only corrected, both go alike."""


class WallClock:
    """The machine's monotonic clock, related to ROS time when it is made, and again where that was set."""

    simulated = False

    def __init__(self) -> None:
        self._ros_ahead_ns = _ros_ahead_ns()

    def now_ns(self) -> int:
        """Time now [ns]."""
        return time.monotonic_ns()

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        """Sleep until a time; at once where it has passed."""
        left_ns = time_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)

    def ros_ns(self, time_ns: int) -> int:
        """UNIX time [ns]."""
        return time_ns + self._ahead_ns

    def own_ns(self, ros_ns: int) -> int:
        """Time of this clock [ns] at a UNIX time [ns]."""
        return ros_ns - self._ahead_ns

    @property
    def _ahead_ns(self) -> int:
        if abs(time.time_ns() - time.monotonic_ns() - self._ros_ahead_ns) > ROS_STEP_NS:
            ahead_ns = _ros_ahead_ns()
            if abs(ahead_ns - self._ros_ahead_ns) > ROS_STEP_NS:  # else this thread had to wait between
                self._ros_ahead_ns = ahead_ns
        return self._ros_ahead_ns


def _ros_ahead_ns() -> int:
    """UNIX time less monotonic time [ns], of three looks the one that took least."""
    looks = []
    for _ in range(3):
        before_ns, ros_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        looks.append((after_ns - before_ns, ros_ns - before_ns))
    return min(looks)[1]


class SimulatedClock(Clock):
    """Takes part in the time of a bench; for one thread, except `now_ns`, which any thread may call.

    Parameters
    ----------
    address : str
        ``HOST:PORT`` of the bench's time.
    name : str
        Names the participant in messages about what holds time up.
    told_with : str
        Name of another participant, which holds time in place of this one; the times that it waits for are
        reported here instead.
    hands_over : bool
        Whether each time that it waits for ends a conductor's `go`.
    conducts : bool
        Whether time stands while no participant needs it.

    Raises
    ------
    ClockLostError
        If no bench answers.
    ValueError
        If the address is not HOST:PORT.
    """

    def __init__(
        self,
        address: str,
        name: str,
        *,
        told_with: str = "",
        hands_over: bool = False,
        conducts: bool = False,
    ) -> None:
        self.name = name
        self._now_ns = 0
        self.robot_ns = self.frames = 0
        self._buffer = b""
        try:
            self._socket = socket.create_connection(time_address(address), 5.0)
        except OSError as error:
            raise ClockLostError(f"no simulated time at {address}: {error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        join = {"name": name, "with": told_with, "hands_over": hands_over, "conducts": conducts}
        self._socket.sendall(json.dumps(join).encode() + b"\n")
        self._socket.settimeout(None)
        self.ask_ns()

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self._socket.fileno()

    def now_ns(self) -> int:
        """Time that the bench reported last [ns]."""
        return self._now_ns

    def ask_ns(self) -> int:
        """Time now [ns], asked of the bench."""
        self._send(ToBench.ASK)
        while self._next(None) is not FromBench.TIME:
            pass
        return self._now_ns

    def hold(self, until_ns: int, demand: Demand, packets: int = -1) -> None:
        """Let time go on up to a time [ns]; see the module's text for the demand.

        `packets` is the number of packets sent to the robot since it was last stated as 0: the bench waits for
        all of them before its next step. Below 0 it states nothing.
        """
        self._send(ToBench.HOLD, min(until_ns, ENDLESS_NS), demand, packets)

    def announce(self, until_ns: int, demand: Demand, packets: int) -> None:
        """As `hold`, before the packets are sent: they are waited for as long as this takes part."""
        self._send(ToBench.ANNOUNCE, until_ns, demand, packets)

    def free(self, demand: Demand = Demand.NONE) -> None:
        """Let time go on without a limit."""
        self.hold(ENDLESS_NS, demand)

    def wait_until(
        self,
        time_ns: int,
        demand: Demand = Demand.FAST,
        /,
        while_waiting: Callable[[], None] | None = None,
    ) -> None:
        """Let time go on up to a time [ns] and wait until it is reached; then it stands until the next call.

        `while_waiting` is called every tenth of a second of this machine's time; what it raises ends the
        wait.
        """
        if time_ns <= self._now_ns:
            return
        self.hold(time_ns, demand)
        while self._now_ns < time_ns:
            self.wait_told(while_waiting)

    def sleep_until(self, time_ns: int) -> None:
        """Wait until a time [ns] is reached, without holding time up or demanding that it pass."""
        if time_ns <= self._now_ns:
            return
        self._send(ToBench.WAKE, time_ns)
        while self._now_ns < time_ns:
            self.wait_told()

    def wait_told(self, while_waiting: Callable[[], None] | None = None) -> None:
        """Wait until the bench reports a time that was waited for."""
        while self._next(while_waiting) is not FromBench.TOLD:
            pass

    def refresh(self) -> None:
        """Take the messages that have come, without waiting."""
        while self._buffer or select.select([self._socket], [], [], 0)[0]:
            self._next(None)

    def go(self) -> None:
        """Let time go on until a device hands a result over; for a participant that conducts."""
        self._send(ToBench.GO)

    def seed(self, *integers: int) -> None:
        """Let all noise of the bench follow from these integers, three at most, from now on."""
        self._send(ToBench.SEED, *integers)

    def ports(self, robot: int, bus: int) -> None:
        """Name local ports; with each time the bench then reports how much it has sent to them."""
        self._send(ToBench.PORTS, robot, bus)

    def interrupt(self) -> None:
        """Make a wait in another thread raise `ClockLostError`; from any thread."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Take part no more."""
        self._socket.close()

    def _send(self, kind: ToBench, *integers: int) -> None:
        a, b, c = (*integers, 0, 0, 0)[:3]
        try:
            self._socket.sendall(MESSAGE.pack(kind, a, b, c))
        except OSError as error:
            raise ClockLostError(f"simulated time: {error}") from error

    def _next(self, while_waiting: Callable[[], None] | None) -> FromBench:
        """Take the next message."""
        while len(self._buffer) < MESSAGE.size:
            if while_waiting is not None and not select.select([self._socket], [], [], 0.1)[0]:
                while_waiting()
                continue
            try:
                data = self._socket.recv(64 * MESSAGE.size)
            except OSError as error:
                raise ClockLostError(f"simulated time: {error}") from error
            if not data:
                raise ClockLostError("simulated time: the bench has ended")
            self._buffer += data
        kind, now_ns, robot_ns, frames = MESSAGE.unpack_from(self._buffer)
        self._buffer = self._buffer[MESSAGE.size :]
        self._now_ns = now_ns
        if kind == FromBench.TOLD:
            self.robot_ns, self.frames = robot_ns, frames
        return FromBench(kind)


def time_address(text: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``.

    Raises
    ------
    ValueError
        If it is not HOST:PORT.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"time: {text!r}, expected HOST:PORT of a simulated bench")
    return host, int(port)
