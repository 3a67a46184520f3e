# SPDX-License-Identifier: Apache-2.0
"""What `UrArm` and its client process share: one page of memory, and names of faults.

The client writes its newest state, the owner a sign of life; neither waits for the other. States go to two
places in turn: where the client is stopped or killed in the middle of one, told by its checksum, the state
before it is still whole.
"""

from __future__ import annotations

import mmap
import struct
import time
import zlib
from dataclasses import astuple, dataclass, fields

SIZE = mmap.PAGESIZE
_PLACES, _HEARTBEAT_AT = (0, SIZE // 2), SIZE - 8
_STATE = struct.Struct("<qdq18d4i2?2Q2d")
_CHECKSUM = struct.Struct("<I")
_HEARTBEAT = struct.Struct("<q")

# Exit statuses of the client process; any other is a death.
EXIT_ORDERLY, EXIT_BROKEN, EXIT_LINK_LOST = 0, 1, 3


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
        self._next = 0

    def write(self, state: ClientState) -> None:
        """Client: hand out a state."""
        flat: list[float] = []
        for value in astuple(state):
            flat.extend(value) if isinstance(value, tuple) else flat.append(value)
        data = _STATE.pack(*flat)
        at = _PLACES[self._next]
        self._next = 1 - self._next
        self._page[at : at + len(data) + 4] = data + _CHECKSUM.pack(zlib.crc32(data))

    def read(self) -> ClientState | None:
        """Owner: the newest whole state; None before the first."""
        # the client may overwrite one place while the other is read: look again then
        for _ in range(3):
            found = [state for at in _PLACES if (state := self._at(at)) is not None]
            if found:
                return max(found, key=lambda state: state.received_ns)
        return None

    def _at(self, at: int) -> ClientState | None:
        block = self._page[at : at + _STATE.size + 4]
        data = block[: _STATE.size]
        # the checksum of nothing but zeros is not zero
        if _CHECKSUM.unpack(block[_STATE.size :])[0] != zlib.crc32(data):
            return None
        v = _STATE.unpack(data)
        return ClientState(*v[:3], v[3:9], v[9:15], v[15:21], *v[21:])

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
