# SPDX-License-Identifier: Apache-2.0
"""What `UrArm` and its client process share: one page of memory, and names of faults.

The client writes its newest state, the owner a sign of life; neither waits for the other. A state that
was read while it was written is told by its checksum.
"""

from __future__ import annotations

import mmap
import struct
import time
import zlib
from dataclasses import astuple, dataclass, fields

SIZE = mmap.PAGESIZE
_STATE_AT, _HEARTBEAT_AT = 0, SIZE - 8
_STATE = struct.Struct("<qdq18d4i2?2Q2d")
_CHECKSUM = struct.Struct("<I")
_HEARTBEAT = struct.Struct("<q")

# Exit statuses of the client process; any other is a death.
EXIT_ORDERLY, EXIT_LINK_LOST = 0, 3


@dataclass(frozen=True)
class ClientState:
    """Newest state of the robot as the client process saw it.

    Attributes
    ----------
    received_ns : int
        When it came (``time.monotonic_ns``).
    robot_time_s : float
        The robot's time stamp.
    state_ns : int
        The same on this machine's monotonic clock.
    tip_pose, tip_speed, tip_force : tuples of 6 floats
        In the base; the force is what the robot's own sensor tells.
    safety_bits, runtime_state, robot_mode, safety_mode : int
        As RTDE names them.
    connected : bool
        Both connections of the client say so.
    moving : bool
        An asynchronous motion runs.
    done, refused : int
        Numbers of the last command that was done, and of the last that was refused (0: none).
    clock_std_s : float
        Of `state_ns` [s].
    rate_hz : float
        States received in the last second.
    """

    received_ns: int
    robot_time_s: float
    state_ns: int
    tip_pose: tuple[float, ...]
    tip_speed: tuple[float, ...]
    tip_force: tuple[float, ...]
    safety_bits: int
    runtime_state: int
    robot_mode: int
    safety_mode: int
    connected: bool
    moving: bool
    done: int
    refused: int
    clock_std_s: float
    rate_hz: float


class Exchange:
    """The shared page.

    Parameters
    ----------
    descriptor : int
        Of a file of `SIZE` bytes that both processes hold open.
    """

    def __init__(self, descriptor: int) -> None:
        self._page = mmap.mmap(descriptor, SIZE)

    def write(self, state: ClientState) -> None:
        """Client: hand out a state."""
        flat: list[float] = []
        for value in astuple(state):
            flat.extend(value) if isinstance(value, tuple) else flat.append(value)
        data = _STATE.pack(*flat)
        self._page[_STATE_AT : _STATE_AT + len(data) + 4] = data + _CHECKSUM.pack(zlib.crc32(data))

    def read(self) -> ClientState | None:
        """Owner: the newest state; None before the first."""
        for _ in range(100):
            block = self._page[_STATE_AT : _STATE_AT + _STATE.size + 4]
            data = block[: _STATE.size]
            if _CHECKSUM.unpack(block[_STATE.size :])[0] == zlib.crc32(data):
                v = _STATE.unpack(data)
                return ClientState(*v[:3], v[3:9], v[9:15], v[15:21], *v[21:])
            if not any(block):
                return None
        raise RuntimeError("robot client: its memory is never in order")

    def beat(self) -> None:
        """Owner: be alive."""
        _HEARTBEAT.pack_into(self._page, _HEARTBEAT_AT, time.monotonic_ns())

    def silence_s(self) -> float:
        """Client: time since the owner's last sign of life [s]."""
        return (time.monotonic_ns() - _HEARTBEAT.unpack_from(self._page, _HEARTBEAT_AT)[0]) * 1e-9

    def close(self) -> None:
        """Unmap."""
        self._page.close()


assert len(fields(ClientState)) == 16  # the layout above is that of its fields
