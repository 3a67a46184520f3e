# SPDX-License-Identifier: Apache-2.0
"""TCP ports of a simulated device, served by one thread in the gaps between its steps."""

from __future__ import annotations

import selectors
import socket
import struct
import time
from collections.abc import Callable
from typing import Protocol

# What a client may leave unread before data for it are dropped: about 0.2 s of all RTDE variables.
MOST_UNSENT = 64 * 1024
# Of a port at a time; select takes descriptors below 1024 only.
MOST_CONNECTIONS = 100
# Bytes that are read and answered before others, and the next step, have their turn.
MOST_AT_ONCE = 4096


class Service(Protocol):
    """Serves one connection."""

    def received(self, data: bytes) -> None:
        """Take bytes as they come; raises ValueError where they make no sense."""
        ...

    def closed(self) -> None:
        """Forget the connection."""
        ...


class Connection:
    """One client.

    Attributes
    ----------
    port : int
        To which it came.
    frozen : bool
        Nothing is read or written meanwhile, as if no packet passed the network.
    """

    def __init__(
        self, reactor: Reactor, channel: socket.socket, port: int, freezable: bool
    ) -> None:
        self._reactor = reactor
        self.port = port
        self._socket = channel
        self._unsent = bytearray()
        self.freezable = freezable
        self.frozen = False
        self.is_open = True
        self.service: Service | None = None

    def fileno(self) -> int:
        """Return the descriptor, for select."""
        return self._socket.fileno()

    def send(self, data: bytes, droppable: bool = False) -> bool:
        """Send, or keep what the network does not take at once.

        `droppable` data are not sent at all while earlier data wait. False if they were dropped.
        """
        if not self.is_open or (droppable and (self._unsent or self.frozen)):
            return False
        if len(self._unsent) > MOST_UNSENT:
            self.close()
            return False
        self._unsent += data
        self.flush()
        return True

    def flush(self) -> None:
        """Send what waits, as far as the network takes it."""
        if self.frozen or not self._unsent:
            return
        try:
            del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def read(self) -> None:
        """Hand what came to the service."""
        try:
            data = self._socket.recv(MOST_AT_ONCE)
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


class Reactor:
    """Listens on ports of one address and serves their connections.

    Parameters
    ----------
    host : str
        Address to listen on.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        # select: epoll of Python 3.12 and before waits in whole milliseconds
        self._selector = selectors.SelectSelector()
        self._listeners: dict[socket.socket, tuple[bool, Callable[[], None]]] = {}
        self._connections: set[Connection] = set()
        self._frozen = False

    def listen(
        self, port: int, serve: Callable[[Connection], Service], freezable: bool = True
    ) -> None:
        """Listen on a port; `serve` makes the service of each connection.

        Raises
        ------
        ValueError
            Where the port cannot be had.
        """
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((self.host, port))
            listener.listen(16)
        except OSError as error:
            listener.close()
            raise ValueError(
                f"port {port} of {self.host}: {error.strerror}; does another simulated robot run "
                "there? --host takes any address 127.x.y.z"
            ) from error
        listener.setblocking(False)

        def accept() -> None:
            try:
                channel, _ = listener.accept()
            except OSError:
                return
            if sum(other.port == port for other in self._connections) >= MOST_CONNECTIONS:
                channel.close()
                return
            channel.setblocking(False)
            channel.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection = Connection(self, channel, port, freezable)
            self._connections.add(connection)
            self._selector.register(connection, selectors.EVENT_READ, connection.read)
            connection.service = serve(connection)

        self._listeners[listener] = (freezable, accept)
        self._selector.register(listener, selectors.EVENT_READ, accept)

    def serve_until(self, deadline_ns: int) -> None:
        """Serve until a time of ``time.perf_counter_ns``, but look at every port at least once."""
        for connection in list(self._connections):
            connection.flush()
        while True:
            wait_s = max(0.0, (deadline_ns - time.perf_counter_ns()) * 1e-9)
            for key, _ in self._selector.select(wait_s):
                key.data()
            if time.perf_counter_ns() >= deadline_ns:
                return

    def freeze(self, frozen: bool) -> None:
        """Let no packet of the freezable ports pass, or let them pass again."""
        if frozen == self._frozen:
            return
        self._frozen = frozen
        ends: list[tuple[socket.socket | Connection, Callable[[], None]]] = []
        for listener, (freezable, accept) in self._listeners.items():
            if freezable:
                ends.append((listener, accept))
        for connection in self._connections:
            if connection.freezable:
                connection.frozen = frozen
                ends.append((connection, connection.read))
        for end, callback in ends:
            if frozen:
                self._selector.unregister(end)
            else:
                self._selector.register(end, selectors.EVENT_READ, callback)

    def forget(self, connection: Connection) -> None:
        """Stop serving a connection that is about to close."""
        self._connections.discard(connection)
        if not (self._frozen and connection.freezable):
            self._selector.unregister(connection)

    def close(self) -> None:
        """Close all connections and ports."""
        for connection in list(self._connections):
            connection.close()
        for listener in self._listeners:
            listener.close()
        self._listeners.clear()
        self._selector.close()
