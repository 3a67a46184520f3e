# SPDX-License-Identifier: Apache-2.0
"""States of the robot straight from its RTDE server, read without waiting; the newest one dated, and judged.

ur_rtde's own receive interface runs a thread that wakes for every state and copies all of them behind locks, a
fifth of a processor core at 500 Hz. Here the thread that needs states drains the socket when it needs them.
Commands go through ur_rtde; this only listens.

Protocol, modes and status bits: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": packets of a length
(u16, itself included), a type (u8) and a payload, big-endian; protocol version 2.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

from tactile_resonance.contact.clocks import ClockTracker
from tactile_resonance.contact.interfaces import ArmFault
from tactile_resonance.contact.samples import ArmSample

PORT = 30004
_VARIABLES = (
    ("timestamp", "DOUBLE", "d"),
    ("actual_TCP_pose", "VECTOR6D", "6d"),
    ("actual_TCP_speed", "VECTOR6D", "6d"),
    ("actual_TCP_force", "VECTOR6D", "6d"),
    ("safety_status_bits", "UINT32", "I"),
    ("runtime_state", "UINT32", "I"),
    ("robot_mode", "INT32", "i"),
)
_STATE = struct.Struct(">HcB" + "".join(code for _, _, code in _VARIABLES))
_HEAD = struct.Struct(">HB")
_DATA, _VERSION, _OUTPUTS, _START = b"U", b"V", b"O", b"S"
_AT_ONCE = 1 << 16


class RobotState(NamedTuple):
    """One state as the robot sent it.

    Attributes
    ----------
    robot_time_s : float
        Its time stamp.
    pose, speed, force : tuples of 6 floats
        Of the tool centre point in the base [m, rad], [m/s, rad/s], [N, N m]; the force is measured by the
        robot's own sensor.
    safety_bits, runtime_state, robot_mode : int
        As RTDE names them.
    """

    robot_time_s: float
    pose: tuple[float, ...]
    speed: tuple[float, ...]
    force: tuple[float, ...]
    safety_bits: int
    runtime_state: int
    robot_mode: int


class RtdeStream:
    """A connection over which the robot sends its states.

    Parameters
    ----------
    host : str
    rate_hz : float
        States a second.
    timeout_s : float
        For the connection and each answer.

    Attributes
    ----------
    local_port : int
    round_trip_s : float
        Of the network: least time of three TCP connections.

    Raises
    ------
    ConnectionError
        If no robot answers, or it does not send what is asked for; with the reason.
    """

    def __init__(self, host: str, rate_hz: float, timeout_s: float = 2.0) -> None:
        took = []
        for _ in range(3):
            begun_s = time.perf_counter()
            try:
                channel = socket.create_connection((host, PORT), timeout_s)
            except (OSError, ValueError) as error:  # ValueError: neither a name nor an address
                reason = getattr(error, "strerror", None) or error
                raise ConnectionError(
                    f"no robot answers at {host}, port {PORT}: {reason}"
                ) from error
            took.append(time.perf_counter() - begun_s)
            if len(took) < 3:
                channel.close()
        self._socket, self.round_trip_s = channel, min(took)
        self._buffer = b""
        self.local_port = int(self._socket.getsockname()[1])
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._begin(rate_hz)
        except OSError as error:
            self._socket.close()
            raise ConnectionError(f"{host}, port {PORT}: {error or 'no answer'}") from error
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self._socket.fileno()

    def read(self) -> list[RobotState]:
        """States since the last call, oldest first, without waiting.

        Raises
        ------
        ConnectionError
            If the robot has closed the connection, or sends what is not RTDE.
        """
        data = self._received()
        if not data:
            return []
        buffer = self._buffer + data if self._buffer else data
        states, at, size = [], 0, _STATE.size
        while len(buffer) - at >= size:
            v = _STATE.unpack_from(buffer, at)
            if v[0] != size or v[1] != _DATA:
                begin = self._skip(buffer, at)
                if begin is None:
                    break
                at = begin
                continue
            at += size
            states.append(RobotState(v[3], v[4:10], v[10:16], v[16:22], *v[22:]))
        self._buffer = buffer[at:]
        return states

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()

    def _received(self) -> bytes:
        """All bytes that have come: after a long time without a call, too, the newest state is among them."""
        received = b""
        while len(received) % _AT_ONCE == 0:
            try:
                data = self._socket.recv(_AT_ONCE)
            except BlockingIOError:
                break
            if not data:
                raise ConnectionError("the robot has closed the connection")
            received += data
        return received

    def _skip(self, buffer: bytes, at: int) -> int | None:
        """Position of the packet behind one that is not a state; None where the latter is not complete yet."""
        (length, _) = _HEAD.unpack_from(buffer, at)
        if length < _HEAD.size:
            raise ConnectionError(f"the robot sends a packet of {length} bytes")
        return at + length if len(buffer) - at >= length else None

    def _begin(self, rate_hz: float) -> None:
        """Agree on the protocol and on what is sent, and start."""
        if self._ask(_VERSION, struct.pack(">H", 2)) != b"\1":
            raise ConnectionError("it does not take version 2 of the RTDE protocol")
        names = ",".join(name for name, _, _ in _VARIABLES)
        answer = self._ask(_OUTPUTS, struct.pack(">d", rate_hz) + names.encode())
        types = ",".join(kind for _, kind, _ in _VARIABLES)
        if answer[1:].decode("ascii", "replace") != types:
            raise ConnectionError(f"it does not send {names} but {answer[1:]!r}")
        if self._ask(_START, b"") != b"\1":
            raise ConnectionError("it does not start to send")

    def _ask(self, kind: bytes, payload: bytes) -> bytes:
        """Payload of the answer to a request."""
        self._socket.sendall(struct.pack(">Hc", _HEAD.size + len(payload), kind) + payload)
        while True:
            length, found = _HEAD.unpack(self._exactly(_HEAD.size))
            if length < _HEAD.size:
                raise ConnectionError(f"a packet of {length} bytes")
            data = self._exactly(length - _HEAD.size)
            if found == kind[0]:
                return data

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self._socket.recv(size - len(data))
            if not part:
                raise ConnectionError("the connection was closed")
            data += part
        return data


CYCLE_S = 0.002
ROBOT_RUNNING = 7
PROGRAM_STOPPED, PROGRAM_PLAYING = 1, 2
_ROBOT_MODES = {
    -1: "no controller", 0: "disconnected", 1: "confirm safety", 2: "booting", 3: "power off",
    4: "power on", 5: "idle, brakes closed", 6: "backdrive", 7: "running", 8: "updating firmware",
}  # fmt: skip
_STOPS = (
    (5, ArmFault.EMERGENCY_STOP, "system emergency stop"),
    (6, ArmFault.EMERGENCY_STOP, "robot emergency stop"),
    (7, ArmFault.EMERGENCY_STOP, "emergency stop"),
    (8, ArmFault.PROTECTIVE_STOP, "a safety limit was violated"),
    (9, ArmFault.PROTECTIVE_STOP, "the safety system has a fault"),
    (4, ArmFault.PROTECTIVE_STOP, "safeguard stop"),
    (2, ArmFault.PROTECTIVE_STOP, "protective stop"),
    (3, ArmFault.PROTECTIVE_STOP, "recovery mode"),
    (10, ArmFault.PROTECTIVE_STOP, "stopped by the safety system"),
)


def stop_fault(safety_bits: int, robot_mode: int) -> tuple[ArmFault, str] | None:
    """Return why the arm cannot move whatever program runs; None where it can."""
    for bit, fault, text in _STOPS:
        if safety_bits >> bit & 1:
            return fault, f"{text} (safety_status_bits {safety_bits:#x})"
    if robot_mode != ROBOT_RUNNING:
        name = _ROBOT_MODES.get(robot_mode, "unknown")
        return (
            ArmFault.PROGRAM_STOPPED,
            f"the robot is not running: robot_mode {robot_mode} ({name})",
        )
    return None


@lru_cache(maxsize=16)  # each state is judged, and seldom differs from the one before
def motion_fault(
    safety_bits: int, robot_mode: int, runtime_state: int
) -> tuple[ArmFault, str] | None:
    """Return why no command would be followed; None where it would."""
    fault = stop_fault(safety_bits, robot_mode)
    if fault is None and runtime_state != PROGRAM_PLAYING:
        return (
            ArmFault.PROGRAM_STOPPED,
            f"the control program does not run (runtime_state {runtime_state}): its watchdog expired, or "
            "it was stopped at the robot",
        )
    return fault


class StateReader:
    """Newest state of a robot.

    Parameters
    ----------
    stream : RtdeStream
    now_ns : callable
        Returns the time of the clock on which states are dated [ns].
    round_trip_s : float
        Of the network [s].

    Attributes
    ----------
    stream : RtdeStream
    newest : RobotState or None
    sample : ArmSample or None
        The same state, as the contract of an arm has it.
    fault : tuple of ArmFault and str, or None
        Why no command would be followed in it.
    received : int
        States so far.
    """

    def __init__(self, stream: RtdeStream, now_ns: Callable[[], int], round_trip_s: float) -> None:
        self.newest: RobotState | None = None
        self.sample: ArmSample | None = None
        self.fault: tuple[ArmFault, str] | None = None
        self.received = 0
        self.stream, self._now_ns, self._trip_s = stream, now_ns, round_trip_s
        self._tracker = self._new_tracker()
        self._guarded = self._ended = False

    @property
    def clock_std_s(self) -> float:
        """Standard deviation of the states' times [s]."""
        return self._tracker.uncertainty_s

    @property
    def revived(self) -> bool:
        """A program runs, but not the one that was guarded: that one has ended, or was paused.

        Whoever started it (the library after a lost connection, someone at the pendant) has not set its
        watchdog, and it may follow an old velocity. So it is reported as stopped.
        """
        runs = self.newest is not None and self.newest.runtime_state == PROGRAM_PLAYING
        return self._ended and runs

    def guard(self, on: bool) -> None:
        """From now on no program but the one that runs counts as ours; or forget that."""
        self._guarded, self._ended = on, False

    def read(self, now_known: bool = True) -> bool:
        """Take the states that have come, without waiting; whether any have. Raises `ConnectionError`.

        Where the present time is not known, states are dated by the relation of the clocks found before.
        """
        states = self.stream.read()
        if not states:
            return False
        if self._guarded:
            for state in states:
                if state.runtime_state != PROGRAM_PLAYING:
                    self._ended = True
        self.received += len(states)
        before, self.newest = self.newest, states[-1]
        # a robot whose simulated time stands repeats its state
        if before is None or self.newest.robot_time_s != before.robot_time_s:
            self._date(self.newest, now_known)
        return True

    def date_anew(self) -> None:
        """Forget how the robot's clock was related to this one, and date the newest state now."""
        self._tracker = self._new_tracker()
        if self.newest is not None:
            self._date(self.newest, True)

    def _new_tracker(self) -> ClockTracker:
        # what all messages share cannot be seen by listening: half of the round trip, and how long a
        # state waits in the robot before it is sent, at most a cycle
        return ClockTracker(self._trip_s / 2, math.hypot(self._trip_s, CYCLE_S) / 12**0.5)

    def _date(self, newest: RobotState, now_known: bool) -> None:
        if now_known or self.sample is None:
            self._tracker.add(newest.robot_time_s, self._now_ns())
        runtime = PROGRAM_STOPPED if self.revived else newest.runtime_state
        self.fault = fault = motion_fault(newest.safety_bits, newest.robot_mode, runtime)
        self.sample = ArmSample(
            self._tracker.to_local_ns(newest.robot_time_s),
            newest.robot_time_s,
            newest.pose[:3],
            newest.pose[3:],
            newest.speed,
            fault is None,
            "" if fault is None else fault[1],
            newest.force,
        )
