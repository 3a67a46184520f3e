# SPDX-License-Identifier: Apache-2.0
"""A CAN bus over TCP, whatever its text: clients, their queues, and frames to all of them."""

from __future__ import annotations

import contextlib
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable

from tactile_resonance.simulation.load_cell import CanFrame

LONGEST_QUEUE = 1 << 20
"""Bytes that a client may leave unread before it is dropped."""
MOST_AT_ONCE = 1 << 14
"""Bytes of a client that are looked at before others have their turn; a message is much shorter."""
MOST_CLIENTS = 32


class Client:
    """One connection.

    Attributes
    ----------
    received : bytes
        Not yet understood.
    queue : bytes
        To be sent.
    listens_from_s : float or None
        From when on it gets the bus's frames (monotonic clock); None: not yet.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection = connection
        self.received = self.queue = b""
        self.listens_from_s: float | None = None


class TcpBus(ABC):
    """One bus, any number of clients; never waits, so that a loop of 1 kHz can serve it.

    Parameters
    ----------
    host : str
    port : int
        0: a free one, to be found in `port`.

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

    def __init__(self, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self.epoch_s = 0.0
        self._clients: list[Client] = []

    @abstractmethod
    def greeting(self) -> bytes:
        """What a new client is sent."""

    @abstractmethod
    def understand(self, client: Client) -> list[tuple[int, bytes]]:
        """Frames in what a client has sent; answers to the rest."""

    @abstractmethod
    def text_of(self, frame: CanFrame) -> bytes:
        """A frame of the bus as clients read it."""

    def poll(self) -> list[tuple[int, bytes]]:
        """Take new clients and what all have sent: identifier and data of each frame for the bus."""
        # nobody there, or no descriptor left for a client: the bus goes on with those it has
        with contextlib.suppress(OSError):
            while len(self._clients) < MOST_CLIENTS:
                client = Client(self._listener.accept()[0])
                client.queue = self.greeting()
                self._clients.append(client)
        frames: list[tuple[int, bytes]] = []
        for client in list(self._clients):
            try:
                if not self._read(client):
                    self._drop(client)
                    continue
                frames += self.understand(client)
                self._flush(client)
            except OSError:
                self._drop(client)
        return frames

    def _read(self, client: Client) -> bool:
        """Take what a client has sent, as far as it is its turn; whether it is to be kept."""
        if len(client.received) >= MOST_AT_ONCE:
            return False  # a message without end
        try:
            received = client.connection.recv(MOST_AT_ONCE - len(client.received))
        except BlockingIOError:
            return True
        client.received += received
        return bool(received)

    def send(self, frames: Iterable[CanFrame]) -> None:
        """Hand frames of the bus to every client that listens."""
        now_s = time.monotonic()
        since_s = [(client, client.listens_from_s) for client in self._clients]
        listening = [
            client for client, begun_s in since_s if begun_s is not None and begun_s <= now_s
        ]
        text = b"".join(map(self.text_of, frames)) if listening else b""
        if not text:
            return
        for client in listening:
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

    def _flush(self, client: Client) -> None:
        with contextlib.suppress(BlockingIOError):
            while client.queue:
                client.queue = client.queue[client.connection.send(client.queue) :]
        if len(client.queue) > LONGEST_QUEUE:
            self._drop(client)

    def _drop(self, client: Client) -> None:
        with contextlib.suppress(ValueError):
            self._clients.remove(client)
        client.connection.close()
