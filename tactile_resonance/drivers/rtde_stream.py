# SPDX-License-Identifier: Apache-2.0
"""States of the robot straight from its RTDE server, read without waiting.

ur_rtde's own receive interface runs a thread that wakes for every state and copies all of them behind locks, a
fifth of a processor core at 500 Hz. Here the thread that needs states drains the socket when it needs them.
Commands go through ur_rtde; this only listens.

Protocol: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": packets of a length (u16, itself
included), a type (u8) and a payload, big-endian; protocol version 2.
"""

from __future__ import annotations

import socket
import struct
import time
from functools import partial
from typing import NamedTuple

PORT = 30004
_VARIABLES = (
    ("timestamp", "DOUBLE", "d"),
    ("actual_TCP_pose", "VECTOR6D", "6d"),
    ("actual_TCP_speed", "VECTOR6D", "6d"),
    ("actual_TCP_force", "VECTOR6D", "6d"),
    ("safety_status_bits", "UINT32", "I"),
    ("runtime_state", "UINT32", "I"),
    ("robot_mode", "INT32", "i"),
    ("safety_mode", "INT32", "i"),
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
    safety_bits, runtime_state, robot_mode, safety_mode : int
        As RTDE names them.
    """

    robot_time_s: float
    pose: tuple[float, ...]
    speed: tuple[float, ...]
    force: tuple[float, ...]
    safety_bits: int
    runtime_state: int
    robot_mode: int
    safety_mode: int


# what `RobotState` itself calls, at half of the time
_new_state = partial(tuple.__new__, RobotState)


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
            states.append(_new_state((v[3], v[4:10], v[10:16], v[16:22], *v[22:])))
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
