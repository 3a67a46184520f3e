# SPDX-License-Identifier: Apache-2.0
"""A CAN bus over TCP as socketcand serves it, in its raw mode: for machines without a kernel CAN.

Protocol: https://github.com/linux-can/socketcand, doc/protocol.md. Only what clients of a raw bus need:
``open``, ``rawmode``, ``send``, ``frame`` and ``echo``.
"""

from __future__ import annotations

import re
import time

from tactile_resonance.simulation.load_cell import CanFrame
from tactile_resonance.simulation.robot.reactor import Connection, Reactor
from tactile_resonance.simulation.tcp_bus import BusClient, Receiver, TcpBus

MOST_EXTENDED = 0x1FFFFFFF
"""Largest identifier of 29 bits."""
_HEXADECIMAL = re.compile("[0-9A-Fa-f]{1,8}")
QUIET_S = 0.05
"""Clients read their last `ok` in one piece: no frame follows it for this long, or until they speak."""


class SocketcandServer(TcpBus):
    """The bus `channel`; see `TcpBus`."""

    END = b">"

    def __init__(
        self, reactor: Reactor, port: int, receiver: Receiver, channel: str = "can0"
    ) -> None:
        super().__init__(reactor, port, receiver)
        self.channel = channel

    def client(self, connection: Connection) -> BusClient:
        """Serve a new connection."""
        return _SocketcandClient(self, connection)

    def text_of(self, frame: CanFrame) -> bytes:
        """A frame of the bus as clients read it."""
        stamp = self.epoch_s + frame.time_s
        return b"< frame %03X %.6f %s >" % (frame.can_id, stamp, frame.data.hex().upper().encode())


class _SocketcandClient(BusClient):
    def __init__(self, bus: SocketcandServer, connection: Connection) -> None:
        super().__init__(bus, connection)
        self._server = bus
        self.send(b"< hi >")

    def understand(self, message: bytes) -> None:
        """Execute one message."""
        words = message.strip(b"< \r\n").decode("ascii", "replace").split()
        if not words:
            return
        if words[0] == "send" and self.listens_from_s is not None:
            frame = _frame(words[1:])
            if frame is None:
                self.send(b"< error syntax of send >")
                return
            self.listens_from_s = time.monotonic()
            self._server.take(*frame)
        elif words[0] == "open" and words[1:] != [self._server.channel]:
            self.send(b"< error could not open bus >")
        elif words[0] in ("open", "rawmode"):
            self.send(b"< ok >")
            if words[0] == "rawmode":
                self.listens_from_s = time.monotonic() + QUIET_S
        elif words[0] == "echo":
            self.send(b"< echo >")
        else:
            self.send(b"< error unknown command >")


def _frame(words: list[str]) -> tuple[int, bytes] | None:
    """Identifier and data of ``send``: identifier, length, bytes, all hexadecimal; None where they disagree."""
    if len(words) < 2 or not all(_HEXADECIMAL.fullmatch(word) for word in words):
        return None
    can_id, length, *data = (int(word, 16) for word in words)
    if can_id > MOST_EXTENDED or len(data) != length or length > 8 or any(b > 255 for b in data):
        return None
    return can_id, bytes(data)
