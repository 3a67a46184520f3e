# SPDX-License-Identifier: Apache-2.0
"""Frames of a CAN bus without waiting: of any interface that python-can knows, and of socketcand in batches."""

from __future__ import annotations

import re
import select
import socket
import threading
import time
from binascii import Error as HexError
from binascii import unhexlify
from collections import deque
from concurrent.futures import Future, wait
from functools import lru_cache
from typing import Any, NamedTuple

import can

from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.fields import one_line

OPEN_WITHIN_S = 3.5  # serial adapters are given two seconds to wake up
LATE = f"not open after {OPEN_WITHIN_S:g} s"
RATE_WINDOW_S = 0.5
LEAST_SHARE = 0.9
"""Of the wrenches of a window that must arrive; fewer in two on end, and they pile up on the way."""
KEPT_FRAMES = 20000
READER_HUNG_S = 0.25
_LONGEST_MESSAGE = 4096
_AT_ONCE = 1 << 16
_FRAME = re.compile(rb"<\s*(frame|error)\s+([^\s>]+)\s+([^\s>]+)([^>]*)>")

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
"""Flags of identifiers (linux/can.h): of 29 bits; a request for data; an error reported by the interface."""


class Frame(NamedTuple):
    """One frame of the bus.

    Attributes
    ----------
    can_id : int
        Identifier with its flags.
    data : bytes
    stamp_s : float
        Time stamp of the adapter [s].
    arrival_ns : int
        When it was taken from the interface (monotonic clock) [ns].
    """

    can_id: int
    data: bytes
    stamp_s: float
    arrival_ns: int


@lru_cache(maxsize=64)  # few on a bus, again and again
def _can_id(kind: bytes, number: bytes) -> int:
    """Return the identifier of a message, with its flags; ``ValueError`` where it is not hexadecimal."""
    flags = EXTENDED | ERROR if kind != b"frame" else EXTENDED if len(number) > 3 else 0
    return int(number, 16) | flags


class SocketcandBus:
    """A bus over TCP (socketcand, raw mode): all frames that have come with one look at the socket.

    python-can's own client serves the same protocol frame by frame. Protocol: linux-can/socketcand,
    doc/protocol.md.

    Parameters
    ----------
    host, port, channel : str, int, str

    Attributes
    ----------
    local_port : int
    frames : int
        Received since it was opened.
    drained : bool
        Whether no more frames were waiting after the last read.

    Raises
    ------
    OSError
        Where no answer comes, or not in time.
    """

    def __init__(self, host: str, port: int, channel: str) -> None:
        self._socket = socket.create_connection((host, port), OPEN_WITHIN_S)
        self.local_port = int(self._socket.getsockname()[1])
        self.frames = 0
        self._buffer, self.drained = b"", False
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._expect(b"< hi >", b"")
            self._expect(b"< ok >", f"< open {channel} >".encode())
            self._expect(b"< ok >", b"< rawmode >")
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)

    def read(self) -> list[Frame]:
        """Frames since the last call, oldest first, without waiting. Raises what the interface raises."""
        try:
            data = self._socket.recv(_AT_ONCE)
        except BlockingIOError:
            self.drained = True
            return []
        self.drained = len(data) < _AT_ONCE
        if not data:
            raise ConnectionError("the server has closed the connection")
        received = self._buffer + data
        end = received.rfind(b">") + 1
        self._buffer = received[end:]
        if len(self._buffer) > _LONGEST_MESSAGE:
            raise ConnectionError("the server sends a message without end")
        found, arrival_ns = _FRAME.findall(received, 0, end), time.monotonic_ns()
        try:
            frames = [
                Frame(
                    _can_id(kind, number),
                    unhexlify(text.replace(b" ", b"")) if kind == b"frame" else b"",
                    float(stamp),
                    arrival_ns,
                )
                for kind, number, stamp, text in found
            ]
        except (ValueError, HexError) as error:
            said = b" ".join(b" ".join(words) for words in found)[:200].decode("ascii", "replace")
            raise ConnectionError(f"the server sends {said!r}") from error
        self.frames += len(frames)
        return frames

    def wait(self, seconds: float) -> None:
        """Return when frames have come, after a time at the latest."""
        select.select([self._socket], [], [], seconds)

    def send(self, can_id: int, data: bytes, extended: bool) -> None:
        """Send a frame. Raises what the interface raises."""
        name = f"{can_id:08X}" if extended else f"{can_id:03X}"
        values = " ".join(f"{byte:02X}" for byte in data)
        self._socket.sendall(f"< send {name} {len(data):X} {values} >".encode())

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()

    def _expect(self, answer: bytes, request: bytes) -> None:
        if request:
            self._socket.sendall(request)
        while answer not in self._buffer:
            part = self._socket.recv(256)
            if not part:
                raise ConnectionError("the server has closed the connection")
            self._buffer += part
            if b"< error" in self._buffer:
                raise ConnectionError(self._buffer.decode("ascii", "replace"))
        self._buffer = self._buffer.partition(answer)[2]


class AnyBus:
    """A bus of python-can, read by a thread that waits for its frames, one by one.

    Parameters
    ----------
    bus : can.BusABC
    request : tuple of int, bytes, bool and float, or None
        Identifier, data, whether extended, and period [s] of a frame that is sent again and again.
    look_s : float
        After so long without a frame nothing waits [s].

    Attributes
    ----------
    drained : bool
        See `SocketcandBus`.
    """

    def __init__(
        self, bus: can.BusABC, request: tuple[int, bytes, bool, float] | None, look_s: float
    ) -> None:
        self._bus, self._request, self._look_s = bus, request, look_s
        self.drained = False
        self._frames: deque[Frame] = deque(maxlen=KEPT_FRAMES)
        self._came = threading.Event()
        self._ended = threading.Event()
        self._error: Exception | None = None
        self._alive_s = time.monotonic()
        self._thread = threading.Thread(target=self._receive, name="can", daemon=True)
        self._thread.start()

    def read(self) -> list[Frame]:
        """See `SocketcandBus`."""
        self._came.clear()
        frames = []
        while self._frames:
            frames.append(self._frames.popleft())
        if not frames and self._error is not None:
            raise self._error
        if not frames and time.monotonic() - self._alive_s > READER_HUNG_S:
            raise ConnectionError("the interface hangs")
        return frames

    def wait(self, seconds: float) -> None:
        """See `SocketcandBus`."""
        self._came.wait(seconds)

    def send(self, can_id: int, data: bytes, extended: bool) -> None:
        """See `SocketcandBus`."""
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=extended))

    def close(self) -> None:
        """See `SocketcandBus`."""
        self._ended.set()
        self._thread.join(1.0)
        self._bus.shutdown()

    def _receive(self) -> None:
        """Body of the thread."""
        due_s = time.monotonic()
        try:
            while not self._ended.is_set():
                now_s = self._alive_s = time.monotonic()
                wait_s = self._look_s
                if self._request is not None:
                    can_id, data, extended, period_s = self._request
                    if now_s >= due_s:
                        due_s = max(due_s + period_s, now_s)
                        self.send(can_id, data, extended)
                    wait_s = min(wait_s, max(0.0, due_s - now_s))
                message = self._bus.recv(wait_s)
                self.drained = message is None
                if message is None:
                    continue
                can_id = message.arbitration_id
                can_id |= EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame
                can_id |= ERROR * message.is_error_frame
                data, now_ns = bytes(message.data), time.monotonic_ns()
                self._frames.append(Frame(can_id, data, message.timestamp, now_ns))
                self._came.set()
        except Exception as error:  # each interface has errors of its own
            self._error = error
            self._came.set()


Bus = SocketcandBus | AnyBus


def open_bus(
    settings: dict[str, Any],
    where: str,
    request: tuple[int, bytes, bool, float] | None,
    look_s: float,
) -> Bus:
    """Open a bus within a time: some interfaces try for long, or wait for ever.

    Parameters
    ----------
    settings : dict
        Arguments of ``can.Bus``.
    where : str
        Name for messages.
    request, look_s : tuple or None, float
        See `AnyBus`.

    Raises
    ------
    ForceError
        `LINK_LOST`.
    """
    plain = set(settings) <= {"interface", "host", "port", "channel", "tcp_tune"}
    try:
        if settings["interface"] == "socketcand" and plain and request is None:
            try:
                return SocketcandBus(settings["host"], settings["port"], settings["channel"])
            except TimeoutError:
                raise TimeoutError(LATE) from None
        return AnyBus(_opened(settings), request, look_s)
    except Exception as error:  # each interface has errors of its own
        raise ForceError(ForceFault.LINK_LOST, f"{where}: {one_line(error)}") from error


def _opened(settings: dict[str, Any]) -> can.BusABC:
    """A bus of python-can; `TimeoutError` where it is not open in time, and then let go once it is."""
    opening: Future[can.BusABC] = Future()

    def open_it() -> None:
        try:
            opening.set_result(can.Bus(**settings))
        except Exception as error:
            opening.set_exception(error)

    threading.Thread(target=open_it, name="can_open", daemon=True).start()
    if wait([opening], OPEN_WITHIN_S).not_done:
        opening.add_done_callback(lambda late: late.exception() or late.result().shutdown())
        raise TimeoutError(LATE)
    return opening.result()


class Flow:
    """Whether as many wrenches arrive as the cell sends."""

    def __init__(self, nominal_hz: float, now_s: float) -> None:
        self._nominal_hz = nominal_hz
        self._begin_s, self._count, self._short = now_s, 0, 0

    def short(self, now_s: float, count: int) -> float | None:
        """Rate [Hz] where two windows on end were short: a reader held up in one catches up in the next."""
        span_s = now_s - self._begin_s
        if span_s < RATE_WINDOW_S:
            return None
        rate_hz = (count - self._count) / span_s
        self._begin_s, self._count = now_s, count
        self._short = self._short + 1 if rate_hz < LEAST_SHARE * self._nominal_hz else 0
        return rate_hz if self._short > 1 else None
