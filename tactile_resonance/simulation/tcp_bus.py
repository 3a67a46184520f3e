# SPDX-License-Identifier: Apache-2.0
"""A CAN bus over TCP, whatever its text: clients, what they send to the cell, and frames to all of them."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable

from tactile_resonance.simulation.bench_time import STALL_S
from tactile_resonance.simulation.load_cell import CanFrame
from tactile_resonance.simulation.robot.reactor import Connection, Reactor

LONGEST_QUEUE = 1 << 20
"""Bytes that a client may leave unread before it is dropped."""
LONGEST_MESSAGE = 1 << 14
"""Bytes of a client without the end of a message."""

Receiver = Callable[[int, bytes], Iterable[CanFrame]]
"""Takes identifier and data of a frame of the bus; returns those that answer it."""


class BusClient(ABC):
    """One connection.

    Attributes
    ----------
    listens_from_s : float or None
        From when on it gets the bus's frames (monotonic clock); None: not yet.
    frames : int
        Of the bus, sent to it.
    """

    def __init__(self, bus: TcpBus, connection: Connection) -> None:
        self._bus, self.connection = bus, connection
        self._buffer = b""
        self.listens_from_s: float | None = None
        self.frames = 0

    def received(self, data: bytes) -> None:
        """Answer each whole message; ValueError where one has no end."""
        *messages, self._buffer = (self._buffer + data).split(self._bus.END)
        for message in messages:
            self.understand(message)
        if len(self._buffer) > LONGEST_MESSAGE:
            raise ValueError("bus: a message without end")

    def closed(self) -> None:
        """It has gone."""
        self._bus.clients.discard(self)

    def send(self, text: bytes) -> None:
        """Send an answer."""
        self.connection.send(text)

    @abstractmethod
    def understand(self, message: bytes) -> None:
        """Execute one message."""


class TcpBus(ABC):
    """One bus, any number of clients.

    Parameters
    ----------
    reactor : Reactor
        Whose port it becomes.
    port : int
        0: a free one, to be found in `port`.
    receiver : callable
        The cell.

    Attributes
    ----------
    port : int
    epoch_s : float
        Time [s] at time 0 of the frames: they are stamped with the sum. To be set by whoever owns the plant's
        clock.
    clients : set of BusClient

    Raises
    ------
    ValueError
        Where the port cannot be had.
    """

    END: bytes
    """Of a message."""

    def __init__(self, reactor: Reactor, port: int, receiver: Receiver) -> None:
        self.epoch_s = 0.0
        self.clients: set[BusClient] = set()
        self._receiver = receiver
        self.port = reactor.listen(port, self._serve, freezable=False, most_unsent=LONGEST_QUEUE)

    @abstractmethod
    def client(self, connection: Connection) -> BusClient:
        """Serve a new connection."""

    @abstractmethod
    def text_of(self, frame: CanFrame) -> bytes:
        """A frame of the bus as clients read it."""

    def take(self, can_id: int, data: bytes) -> None:
        """Hand a client's frame to the cell, and its answer to all."""
        self.send(self._receiver(can_id, data))

    def send(self, frames: Iterable[CanFrame]) -> None:
        """Hand frames of the bus to every client that listens."""
        now_s = time.monotonic()
        listening = [
            client
            for client in self.clients
            if client.listens_from_s is not None and client.listens_from_s <= now_s
        ]
        texts = [self.text_of(frame) for frame in frames] if listening else []
        if not texts:
            return
        text = b"".join(texts)
        for client in listening:
            client.frames += len(texts)
            client.connection.send(text)

    def keep_epoch(self, machine_s: float, plant_s: float) -> None:
        """Stamp frames on the plant's clock, never ahead of this machine's; anew after a stall [s]."""
        ahead_s = machine_s - plant_s
        if not self.epoch_s <= ahead_s <= self.epoch_s + STALL_S:
            self.epoch_s = ahead_s

    def frames_sent(self, port: int) -> int:
        """Frames of the bus that were sent to a client's port."""
        return max((c.frames for c in self.clients if c.connection.peer_port == port), default=0)

    def drop_clients(self) -> None:
        """Close every connection, as a server that dies does; new clients are served again."""
        for client in list(self.clients):
            client.connection.close()

    def _serve(self, connection: Connection) -> BusClient:
        client = self.client(connection)
        self.clients.add(client)
        return client
