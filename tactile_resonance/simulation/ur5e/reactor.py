# SPDX-License-Identifier: Apache-2.0
"""TCP ports of a simulated device, served by one thread in the gaps between its steps."""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Callable, Generator
from inspect import GEN_RUNNING, getgeneratorstate
from typing import NamedTuple

# What a client may leave unread before it is closed, where its port says nothing else: about 0.2 s of all
# RTDE variables.
MOST_UNSENT = 64 * 1024
# Of a port at a time; select takes descriptors below 1024 only.
MOST_CONNECTIONS = 100
# Bytes that are read and answered before others, and the next step, have their turn.
MOST_AT_ONCE = 4096


class Until(NamedTuple):
    """A message that ends with something; the connection is closed after so many bytes without it."""

    end: bytes
    longest: int = 1 << 16


Serving = Generator[Until | int | None, bytes, None]
"""Serves one connection, message by message.

It yields what ends the next message, or how many bytes it has, or None for whatever comes next, and is sent
that message. It raises ValueError where one makes no sense, and returns to close the connection; it is closed
with the connection, however that ends.
"""


class Service:
    """Cuts what comes on a connection into the messages that its generator asks for.

    Parameters
    ----------
    connection : Connection
    serving : Serving
        Begins at once.
    """

    def __init__(self, connection: Connection, serving: Serving) -> None:
        self._connection, self._serving = connection, serving
        self._buffer = b""
        self._wanted = next(serving)
        if not connection.is_open:  # its greeting found nobody
            serving.close()

    def received(self, data: bytes) -> None:
        """Hand over each whole message; ValueError where one has no end or makes no sense."""
        self._buffer += data
        while self._connection.is_open:
            wanted, rest = self._wanted, self._buffer
            whole: bytes | bool
            if isinstance(wanted, int):
                message, whole, rest = rest[:wanted], len(rest) >= wanted, rest[wanted:]
            elif wanted is None:
                message, whole, rest = rest, rest, b""
            else:
                message, whole, rest = rest.partition(wanted.end)
                if not whole and len(message) > wanted.longest:
                    raise ValueError(f"port {self._connection.port}: a message without end")
            if not whole:
                break
            self._buffer = rest
            try:
                self._wanted = self._serving.send(message)
            except StopIteration:
                self._connection.close()
        else:
            self._serving.close()

    def closed(self) -> None:
        """End the generator; where it is what closes the connection, it ends with its message."""
        if getgeneratorstate(self._serving) != GEN_RUNNING:
            self._serving.close()


class Connection:
    """One client.

    Attributes
    ----------
    port : int
        To which it came.
    peer_port : int
        From which it came.
    frozen : bool
        Nothing is read or written meanwhile, as if no packet passed the network.
    """

    def __init__(self, reactor: Reactor, channel: socket.socket, listener: _Listener) -> None:
        self._reactor = reactor
        self.port, self.peer_port = listener.port, int(channel.getpeername()[1])
        self._socket = channel
        self._unsent = bytearray()
        self._most_unsent = listener.most_unsent
        self.freezable = listener.freezable
        self.frozen = self._patient = False
        self.is_open = True
        self.service: Service | None = None

    def fileno(self) -> int:
        """Return the descriptor, for select."""
        return self._socket.fileno()

    @property
    def patient(self) -> bool:
        """What it sends counts from the next step on: on the wall clock it is read then, and wakes nobody."""
        return self._patient

    @patient.setter
    def patient(self, value: bool) -> None:
        if value != self._patient:
            self._patient = value
            self._reactor.renew()

    def send(self, data: bytes, droppable: bool = False) -> bool:
        """Send, or keep what the network does not take at once.

        `droppable` data are not sent at all while earlier data wait. False if they were dropped.
        """
        late = self in self._reactor.unsent
        if not self.is_open or (droppable and (late or self.frozen)):
            return False
        if late and len(self._unsent) > self._most_unsent:
            self.close()
            return False
        self._unsent += data
        if self._reactor.gathers:
            self._reactor.gathered.add(self)
        else:
            self.flush()
        return self.is_open

    def flush(self) -> None:
        """Send what waits, as far as the network takes it."""
        try:
            if not self.frozen:
                del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self.close()
            return
        if self._unsent:
            self._reactor.unsent.add(self)
        else:
            self._reactor.unsent.discard(self)

    def read(self) -> None:
        """Hand what came to the service."""
        try:
            data = self._socket.recv(MOST_AT_ONCE)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data or self.service is None:
            self.close()
            return
        try:
            self.service.received(data)
        except ValueError:
            self.close()  # as a controller does with a client that does not speak its protocol

    def close(self, reset: bool = False) -> None:
        """Close; `reset` aborts the connection, as a robot that lost its power and came back does."""
        if not self.is_open:
            return
        self.is_open = False
        self._reactor.forget(self)
        if reset:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()
        if self.service is not None:
            self.service.closed()


class _Listener(NamedTuple):
    """One port."""

    channel: socket.socket
    port: int
    serve: Callable[[Connection], Serving]
    freezable: bool
    most_unsent: int


class Reactor:
    """Listens on ports of one address and serves their connections.

    Parameters
    ----------
    host : str
        Address to listen on.

    Attributes
    ----------
    frozen : bool
        Nothing passes the freezable ports.
    unsent : set of Connection
        Those whose network does not take all data at once, or passes none.
    gathered : set of Connection
        Those for which data wait to be sent together.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.frozen = self._gathers = False
        self.unsent: set[Connection] = set()
        self.gathered: set[Connection] = set()
        self._listeners: list[_Listener] = []
        self._connections: set[Connection] = set()
        # what is called where a descriptor can be read, and the descriptors as select takes them
        self._readers: dict[int, Callable[[], None]] = {}
        self._descriptors: list[int] = []
        self._impatient: list[int] = []

    @property
    def gathers(self) -> bool:
        """Whether what is sent waits until this is off again, and then goes out together."""
        return self._gathers

    @gathers.setter
    def gathers(self, value: bool) -> None:
        self._gathers = value
        while self.gathered and not value:
            self.gathered.pop().flush()

    def listen(
        self,
        port: int,
        serve: Callable[[Connection], Serving],
        freezable: bool = True,
        most_unsent: int = MOST_UNSENT,
    ) -> int:
        """Listen on a port, 0 for a free one; `serve` begins to serve a connection.

        Returns
        -------
        int
            The port.

        Raises
        ------
        ValueError
            Where the port cannot be had.
        """
        channel = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            channel.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            channel.bind((self.host, port))
            channel.listen(16)
        except OSError as error:
            channel.close()
            raise ValueError(
                f"port {port} of {self.host}: {error.strerror}; does another simulation run "
                "there? --host takes any address 127.x.y.z"
            ) from error
        channel.setblocking(False)
        listener = _Listener(
            channel, int(channel.getsockname()[1]), serve, freezable, most_unsent
        )
        self._listeners.append(listener)
        self.renew()
        return listener.port

    def serve(self, wait_s: float, *, patient: bool = True) -> None:
        """Wait for at most so long until somebody has sent something, and serve all who have.

        `patient` false: without the connections that are patient.
        """
        if self.unsent:
            for connection in list(self.unsent):
                connection.flush()
        readers = self._readers
        heard = self._descriptors if patient else self._impatient
        for descriptor in select.select(heard, [], [], wait_s)[0]:
            # one served before may have closed another
            if descriptor in readers:
                readers[descriptor]()

    def freeze(self, frozen: bool) -> None:
        """Let no packet of the freezable ports pass, or let them pass again."""
        self.frozen = frozen
        for connection in self._connections:
            connection.frozen = frozen and connection.freezable
        self.renew()

    def forget(self, connection: Connection) -> None:
        """Stop serving a connection that is about to close."""
        for connections in (self._connections, self.unsent, self.gathered):
            connections.discard(connection)
        self.renew()

    def close(self) -> None:
        """Close all connections and ports."""
        for connection in list(self._connections):
            connection.close()
        for listener in self._listeners:
            listener.channel.close()
        self._listeners.clear()
        self.renew()

    def _accept(self, listener: _Listener) -> None:
        try:
            channel, _ = listener.channel.accept()
            here = sum(other.port == listener.port for other in self._connections)
            if here >= MOST_CONNECTIONS:
                channel.close()
                return
            channel.setblocking(False)
            channel.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection = Connection(self, channel, listener)
        except OSError:  # gone again already
            return
        self._connections.add(connection)
        connection.service = Service(connection, listener.serve(connection))
        self.renew()

    def renew(self) -> None:
        """Find anew who is listened to."""
        self._readers = {
            listener.channel.fileno(): lambda listener=listener: self._accept(listener)  # type: ignore[misc]
            for listener in self._listeners
            if not (self.frozen and listener.freezable)
        }
        patient = set()
        for connection in self._connections:
            if not connection.frozen:
                self._readers[connection.fileno()] = connection.read
                if connection.patient:
                    patient.add(connection.fileno())
        self._descriptors = list(self._readers)
        self._impatient = [each for each in self._descriptors if each not in patient]
