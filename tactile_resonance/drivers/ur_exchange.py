# SPDX-License-Identifier: Apache-2.0
"""What `UrArm` and its client process exchange: commands over a socket, signs of life on a page.

Each value on the page has one writer and eight bytes of its own; neither side waits for the other.
"""

from __future__ import annotations

import mmap
import struct
import time
from typing import NamedTuple

SIZE = mmap.PAGESIZE
_BEAT, _SEEN, _DONE, _REFUSED, _HEARD = range(5)

SPEED, STOP, NOTHING = b"s", b"t", b"-"
_COMMAND = struct.Struct("<cxxxxxxxqqq7d")
REST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

# Exit statuses of the client process; any other is a death.
EXIT_ORDERLY, EXIT_BROKEN, EXIT_LINK_LOST = 0, 1, 3


class UrCommand(NamedTuple):
    """One message of the owner.

    Attributes
    ----------
    kind : bytes
        `SPEED`, `STOP` or `NOTHING`.
    number : int
    until_ns : int
        In simulated time: up to when it may go on after the command; 0: not stated.
    demand : int
        A `tactile_resonance.clock.Demand`.
    twist : tuple of 6 floats
    acceleration : float
    """

    kind: bytes
    number: int = 0
    until_ns: int = 0
    demand: int = 0
    twist: tuple[float, ...] = REST
    acceleration: float = 0.0

    def pack(self) -> bytes:
        """As it is sent."""
        return _COMMAND.pack(*self[:4], *self.twist, self.acceleration)

    @classmethod
    def unpack(cls, data: bytes) -> UrCommand:
        """From what was sent."""
        values = _COMMAND.unpack(data)
        return cls(*values[:4], values[4:10], values[10])


# What the owner sees of the robot: its newest state is fresh enough to command on; that state forbids motion; a
# program runs that is not ours. Plain integers: the operators of an enum cost a period tens of times as much.
FRESH, FAULTY, REVIVED = 1, 2, 4


class Exchange:
    """The shared page.

    Parameters
    ----------
    descriptor : int
        Of a file of `SIZE` bytes that both processes hold open.
    """

    def __init__(self, descriptor: int) -> None:
        self._page = mmap.mmap(descriptor, SIZE)
        self._values = memoryview(self._page).cast("q")
        self._reported = 0

    def beat(self, seen: int | None = None) -> int:
        """Owner: give a sign of life, and state what is seen of the robot: `FRESH`, `FAULTY`, `REVIVED`.

        Returns when, by this machine's monotonic clock [ns].
        """
        self._values[_BEAT] = now_ns = time.monotonic_ns()
        if seen is not None:
            self._values[_SEEN] = seen
        return now_ns

    def silence_s(self) -> float:
        """Client: time since the owner's last sign of life [s]."""
        return (time.monotonic_ns() - self._values[_BEAT]) * 1e-9

    @property
    def seen(self) -> int:
        """Client: what the owner sees of the robot."""
        return self._values[_SEEN]

    def report(self, number: int, done: bool) -> None:
        """Client: report that a command was done, or refused."""
        if not done:
            self._values[_REFUSED] = number
        self._reported = max(number, self._reported)
        self._values[_DONE] = self._reported

    @property
    def answered(self) -> tuple[int, int]:
        """Owner: numbers of the last command that was done or refused, and of the last refused; 0: none."""
        return self._values[_DONE], self._values[_REFUSED]

    def hear(self, until_ns: int) -> None:
        """Client: state the time up to which it has let simulated time go on for the owner."""
        self._values[_HEARD] = until_ns

    @property
    def heard_ns(self) -> int:
        """Owner: the time that the client has let go on to last."""
        return self._values[_HEARD]

    def close(self) -> None:
        """Unmap."""
        self._values.release()
        self._page.close()
