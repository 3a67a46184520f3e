# SPDX-License-Identifier: Apache-2.0
"""A CAN bus over TCP as socketcand serves it, in its raw mode: for machines without a kernel CAN.

Protocol: https://github.com/linux-can/socketcand, doc/protocol.md. Only what clients of a raw bus need:
``open``, ``rawmode``, ``send``, ``frame`` and ``echo``.
"""

from __future__ import annotations

import time

from tactile_resonance.simulation.load_cell import CanFrame
from tactile_resonance.simulation.tcp_bus import Client, TcpBus

QUIET_S = 0.05
"""Clients read their last `ok` in one piece: no frame follows it for this long, or until they speak."""


class SocketcandServer(TcpBus):
    """The bus `channel`; see `TcpBus`."""

    def __init__(self, host: str = "127.0.0.1", port: int = 29536, channel: str = "can0") -> None:
        super().__init__(host, port)
        self._channel = channel

    def greeting(self) -> bytes:
        """What a new client is sent."""
        return b"< hi >"

    def understand(self, client: Client) -> list[tuple[int, bytes]]:
        """Frames in what a client has sent; answers to the rest."""
        frames = []
        while (end := client.received.find(b">")) >= 0:
            words = client.received[:end].strip(b"< \r\n").decode("ascii").split()
            client.received = client.received[end + 1 :]
            if not words:
                continue
            if words[0] == "send":
                length = int(words[2], 16)
                data = bytes(int(word, 16) for word in words[3:])
                if len(data) != length or length > 8:
                    raise ValueError("send: length and data disagree")
                frames.append((int(words[1], 16), data))
                client.listens_from_s = time.monotonic()
            elif words[0] == "open" and words[1:] != [self._channel]:
                client.queue += b"< error could not open bus >"
            elif words[0] in ("open", "rawmode"):
                client.queue += b"< ok >"
                if words[0] == "rawmode":
                    client.listens_from_s = time.monotonic() + QUIET_S
            elif words[0] == "echo":
                client.queue += b"< echo >"
            else:
                client.queue += b"< error unknown command >"
        return frames

    def text_of(self, frame: CanFrame) -> bytes:
        """A frame of the bus as clients read it."""
        stamp = self.epoch_s + frame.time_s
        return b"< frame %03X %.6f %s >" % (frame.can_id, stamp, frame.data.hex().upper().encode())
