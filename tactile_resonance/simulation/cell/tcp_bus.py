# SPDX-License-Identifier: Apache-2.0
"""CAN buses over TCP, each with any number of clients: as socketcand and as serial adapters (slcan) serve them.

For machines without a kernel CAN. socketcand in its raw mode (https://github.com/linux-can/socketcand,
doc/protocol.md): only what clients of a raw bus need, ``open``, ``rawmode``, ``send``, ``frame`` and ``echo``.
slcan, at ``socket://host:port`` for pyserial: commands of Lawicel's CAN232 (manual, version 3), ``Sn``, ``O``,
``L``, ``C``, ``tiiildd..``, ``V``, ``N``; each ends with CR and is answered with CR, or BELL where it fails.
"""

from __future__ import annotations

import re
import time
from abc import ABC, abstractmethod
from binascii import hexlify
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from tactile_resonance.simulation.cell.transducer import CanFrame
from tactile_resonance.simulation.plant.bench_time import STALL_S
from tactile_resonance.simulation.ur5e.reactor import Connection, Reactor, Serving, Until

LONGEST_QUEUE = 1 << 20
"""Bytes that a client may leave unread before it is dropped."""

Receiver = Callable[[int, bytes], Iterable[CanFrame]]
"""Takes identifier and data of a frame of the bus; returns those that answer it."""


@dataclass(eq=False)
class BusClient:
    """One connection.

    Attributes
    ----------
    connection : Connection
    listens_from_s : float or None
        From when on it gets the bus's frames (monotonic clock); None: not yet.
    frames : int
        Of the bus, sent to it.
    """

    connection: Connection
    listens_from_s: float | None = None
    frames: int = 0


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

    def __init__(self, reactor: Reactor, port: int, receiver: Receiver) -> None:
        self.epoch_s = 0.0
        self.clients: set[BusClient] = set()
        self._receiver = receiver
        self.port = reactor.listen(port, self.serve, freezable=False, most_unsent=LONGEST_QUEUE)

    def serve(self, connection: Connection) -> Serving:
        """Serve a new connection, a client until it ends."""
        client = BusClient(connection)
        self.clients.add(client)
        try:
            yield from self.talk(client)
        finally:
            self.clients.discard(client)

    @abstractmethod
    def talk(self, client: BusClient) -> Serving:
        """Execute the messages of a client."""

    @abstractmethod
    def text_of(self, frame: CanFrame) -> bytes:
        """A frame of the bus as it is sent."""

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


CHANNEL = "can0"
"""Of a socketcand server."""
MOST_EXTENDED = 0x1FFFFFFF
"""Largest identifier of 29 bits."""
_HEXADECIMAL = re.compile("[0-9A-Fa-f]{1,8}")
QUIET_S = 0.05
"""Clients read their last `ok` in one piece: no frame follows it for this long, or until they speak."""


class SocketcandServer(TcpBus):
    """The bus `CHANNEL`; see `TcpBus`."""

    def text_of(self, frame: CanFrame) -> bytes:
        """As it is sent, with its time."""
        time_s, can_id, data = frame
        return b"< frame %03X %.6f %s >" % (can_id, self.epoch_s + time_s, hexlify(data).upper())

    def talk(self, client: BusClient) -> Serving:
        """Execute the messages of a client."""
        send = client.connection.send
        send(b"< hi >")
        while True:
            message = yield Until(b">")
            words = message.strip(b"< \r\n").decode("ascii", "replace").split()
            if not words:
                continue
            if words[0] == "send" and client.listens_from_s is not None:
                frame = _socketcand_frame(words[1:])
                if frame is None:
                    send(b"< error syntax of send >")
                    continue
                client.listens_from_s = time.monotonic()
                self.take(*frame)
            elif words[0] == "open" and words[1:] != [CHANNEL]:
                send(b"< error could not open bus >")
            elif words[0] in ("open", "rawmode"):
                send(b"< ok >")
                if words[0] == "rawmode":
                    client.listens_from_s = time.monotonic() + QUIET_S
            elif words[0] == "echo":
                send(b"< echo >")
            else:
                send(b"< error unknown command >")


def _socketcand_frame(words: list[str]) -> tuple[int, bytes] | None:
    """Identifier and data of ``send``: identifier, length, bytes, all hexadecimal; None where they disagree."""
    if len(words) < 2 or not all(_HEXADECIMAL.fullmatch(word) for word in words):
        return None
    can_id, length, *data = (int(word, 16) for word in words)
    if can_id > MOST_EXTENDED or len(data) != length or length > 8 or any(b > 255 for b in data):
        return None
    return can_id, bytes(data)


OK, FAILED = b"\r", b"\a"
_FRAME = re.compile(r"t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")


class SlcanServer(TcpBus):
    """See `TcpBus`. Frames carry no time stamps."""

    def text_of(self, frame: CanFrame) -> bytes:
        """As it is sent, without a time."""
        return b"t%03X%d%s\r" % (frame.can_id, len(frame.data), frame.data.hex().upper().encode())

    def talk(self, client: BusClient) -> Serving:
        """Execute the lines of a client."""
        send = client.connection.send
        while True:
            line = (yield Until(b"\r")).decode("ascii", "replace")
            command = line[:1]
            if command in ("S", "s"):  # while it listens the speed stays as it is
                send(OK if client.listens_from_s is None else FAILED)
            elif command in ("O", "L"):
                client.listens_from_s = time.monotonic()
                send(OK)
            elif command == "C":
                client.listens_from_s = None
                send(OK)
            elif command == "t":
                frame = _slcan_frame(line)
                if frame is None or client.listens_from_s is None:
                    send(FAILED)
                else:
                    send(b"z" + OK)
                    self.take(*frame)
            elif command in ("V", "N"):
                send(command.encode() + b"0000" + OK)
            else:
                send(FAILED)


def _slcan_frame(line: str) -> tuple[int, bytes] | None:
    """Identifier and data of a line ``tiiildd..``; None for any other line."""
    found = _FRAME.fullmatch(line)
    if found is None:
        return None
    data = bytes.fromhex(found[3])
    return (int(found[1], 16), data) if len(data) == int(found[2]) else None
