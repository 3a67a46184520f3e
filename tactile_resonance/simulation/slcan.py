# SPDX-License-Identifier: Apache-2.0
"""A CAN bus as serial adapters serve it (slcan), over TCP: ``socket://host:port`` for pyserial.

Commands of Lawicel's CAN232 (manual, version 3): ``Sn``, ``O``, ``L``, ``C``, ``tiiildd..``, ``V``, ``N``; each
ends with CR and is answered with CR, or BELL where it fails.
"""

from __future__ import annotations

import re
import time

from tactile_resonance.simulation.load_cell import CanFrame
from tactile_resonance.simulation.robot.reactor import Connection
from tactile_resonance.simulation.tcp_bus import BusClient, TcpBus

OK, FAILED = b"\r", b"\a"
_FRAME = re.compile(r"t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")


class SlcanServer(TcpBus):
    """See `TcpBus`. Frames carry no time stamps."""

    END = b"\r"

    def client(self, connection: Connection) -> BusClient:
        """Serve a new connection."""
        return _SlcanClient(self, connection)

    def text_of(self, frame: CanFrame) -> bytes:
        """A frame of the bus as clients read it."""
        return b"t%03X%d%s\r" % (frame.can_id, len(frame.data), frame.data.hex().upper().encode())


class _SlcanClient(BusClient):
    def understand(self, message: bytes) -> None:
        """Execute one line."""
        line = message.decode("ascii", "replace")
        command = line[:1]
        if command in ("S", "s"):  # while it listens the speed stays as it is
            self.send(OK if self.listens_from_s is None else FAILED)
        elif command in ("O", "L"):
            self.listens_from_s = time.monotonic()
            self.send(OK)
        elif command == "C":
            self.listens_from_s = None
            self.send(OK)
        elif command == "t":
            frame = _frame(line)
            if frame is None or self.listens_from_s is None:
                self.send(FAILED)
            else:
                self.send(b"z" + OK)
                self._bus.take(*frame)
        elif command in ("V", "N"):
            self.send(command.encode() + b"0000" + OK)
        else:
            self.send(FAILED)


def _frame(line: str) -> tuple[int, bytes] | None:
    """Identifier and data of a line ``tiiildd..``; None for any other line."""
    found = _FRAME.fullmatch(line)
    if found is None:
        return None
    data = bytes.fromhex(found[3])
    return (int(found[1], 16), data) if len(data) == int(found[2]) else None
