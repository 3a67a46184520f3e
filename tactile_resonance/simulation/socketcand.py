# SPDX-License-Identifier: Apache-2.0
"""A CAN bus over TCP as socketcand serves it, in its raw mode: for machines without a kernel CAN.

Protocol: https://github.com/linux-can/socketcand, doc/protocol.md. Only what clients of a raw bus need:
``open``, ``rawmode``, ``send``, ``frame`` and ``echo``.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterable

from tactile_resonance.simulation.load_cell import CanFrame

QUIET_S = 0.05
"""Clients read their last `ok` in one piece: no frame follows it for this long, or until they speak."""
LONGEST_QUEUE = 1 << 20
"""Bytes that a client may leave unread before it is dropped."""


class _Client:
    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection = connection
        self.received = b""
        self.queue = b"< hi >"
        self.raw_from_s: float | None = None


class SocketcandServer:
    """One bus, any number of clients; never waits, so that a loop of 1 kHz can serve it.

    Parameters
    ----------
    host : str
    port : int
        0: a free one, to be found in `port`.
    channel : str
        Name of the bus that clients open.

    Attributes
    ----------
    port : int
    epoch_s : float
        UNIX time [s] at time 0 of the frames: they are stamped with the sum. To be set by whoever owns the
        plant's clock.

    Raises
    ------
    OSError
        Where the port cannot be had.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 29536,
        channel: str = "can0",
        epoch_s: float = 0.0,
    ) -> None:
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._channel = channel
        self.epoch_s = 0.0
        self._clients: list[_Client] = []

    def poll(self) -> list[tuple[int, bytes]]:
        """Take new clients and what all have sent: identifier and data of each frame for the bus."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self._clients.append(_Client(self._listener.accept()[0]))
        frames: list[tuple[int, bytes]] = []
        for client in list(self._clients):
            try:
                with contextlib.suppress(BlockingIOError):
                    while received := client.connection.recv(4096):
                        client.received += received
                    self._drop(client)
                    continue
                frames += self._take(client)
                self._flush(client)
            except (OSError, ValueError):
                self._drop(client)
        return frames

    def send(self, frames: Iterable[CanFrame]) -> None:
        """Hand frames of the bus to every client in raw mode."""
        text = b"".join(
            b"< frame %03X %.6f %s >"
            % (frame.can_id, self.epoch_s + frame.time_s, frame.data.hex().upper().encode())
            for frame in frames
        )
        if not text:
            return
        now_s = time.monotonic()
        for client in list(self._clients):
            if client.raw_from_s is None or now_s < client.raw_from_s:
                continue
            client.queue += text
            try:
                self._flush(client)
            except OSError:
                self._drop(client)

    def drop_clients(self) -> None:
        """Close every connection, as a server that dies does; new clients are served again."""
        for client in list(self._clients):
            self._drop(client)

    def close(self) -> None:
        """Close the connections and stop listening."""
        self._listener.close()
        self.drop_clients()

    def _take(self, client: _Client) -> list[tuple[int, bytes]]:
        """Frames in what a client has sent; answers to the rest."""
        frames = []
        while (end := client.received.find(b">")) >= 0:
            words = client.received[:end].strip(b"< \r\n").decode("ascii").split()
            client.received = client.received[end + 1 :]
            if not words:
                continue
            if words[0] == "send":
                length = int(words[2])
                data = bytes(int(word, 16) for word in words[3:])
                if len(data) != length or length > 8:
                    raise ValueError("send: length and data disagree")
                frames.append((int(words[1], 16), data))
                client.raw_from_s = time.monotonic()
            elif words[0] == "open" and words[1:] != [self._channel]:
                client.queue += b"< error could not open bus >"
            elif words[0] in ("open", "rawmode"):
                client.queue += b"< ok >"
                if words[0] == "rawmode":
                    client.raw_from_s = time.monotonic() + QUIET_S
            elif words[0] == "echo":
                client.queue += b"< echo >"
            else:
                client.queue += b"< error unknown command >"
        return frames

    def _flush(self, client: _Client) -> None:
        with contextlib.suppress(BlockingIOError):
            while client.queue:
                client.queue = client.queue[client.connection.send(client.queue) :]
        if len(client.queue) > LONGEST_QUEUE:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        with contextlib.suppress(ValueError):
            self._clients.remove(client)
        client.connection.close()
