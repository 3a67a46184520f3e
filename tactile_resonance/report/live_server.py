# SPDX-License-Identifier: Apache-2.0
"""The page of a scan that is going on, over HTTP: for this machine alone, and to be read only.

It listens on 127.0.0.1, answers GET only, and only requests whose Host is that address: a page of another
site whose name is turned to 127.0.0.1 (DNS rebinding) names its own. Other sites cannot read its answers, for
it allows no other origin.
"""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

from tactile_resonance.report.page import as_json, content_security_policy, page, page_data

if TYPE_CHECKING:
    from typing_extensions import Self

LOOPBACK = "127.0.0.1"
MOST_READERS = 8
_WAITING = 200  # events for a reader that is slow; beyond that it begins anew
_ALIVE_S = 10.0
_WITHIN_S = 10.0  # for a request, and for a reader to take what is sent
_HEAD = (
    '<h1>Scan under way</h1><p class="note">This page only shows: nothing here reaches the robot. '
    "Figures are those of the nodes as they publish them. There is no stop on this page.</p>"
)


class LiveServer:
    """Serves the page and its events in threads of its own; a context that ends them.

    Parameters
    ----------
    port : int
        0: any that is free.
    snapshot : callable
        All of the run, for a reader that begins.

    Attributes
    ----------
    url : str
    """

    def __init__(self, port: int, snapshot: Callable[[], dict[str, Any]]) -> None:
        if not 0 <= port <= 65535:
            raise ValueError(f"--port: {port}, expected 0 to 65535")
        self._snapshot = snapshot
        self._readers: set[queue.Queue[bytes | None]] = set()
        self._lock = threading.Lock()
        data = page_data([], [], 0, "")
        self._page = page("Scan under way", _HEAD, data, live=True).encode()
        try:
            self._server = _Server((LOOPBACK, port), _Handler)
        except OSError as error:
            raise ValueError(f"--port: {port} is taken ({error.strerror})") from error
        self._server.live = self
        self.url = f"http://{LOOPBACK}:{self._server.server_port}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        with self._lock:
            for reader in self._readers:
                with contextlib.suppress(queue.Full):  # its thread ends with the process
                    reader.put_nowait(None)

    @property
    def readers(self) -> int:
        """Pages that listen."""
        return len(self._readers)

    def publish(self, name: str, data: Any) -> None:
        """Send an event to all pages that listen."""
        if not self._readers:
            return
        event = _event(name, data)
        with self._lock:
            for reader in list(self._readers):
                try:
                    reader.put_nowait(event)
                except queue.Full:  # too slow: its page connects again and then receives the whole run
                    self._readers.discard(reader)
                    reader.get_nowait()
                    reader.put_nowait(None)

    def _begin(self) -> queue.Queue[bytes | None] | None:
        """Queue of one reader more, all of the run first in it; None where there are too many."""
        reader: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        with self._lock:
            if len(self._readers) >= MOST_READERS:
                return None
            self._readers.add(reader)
        return reader

    def _end(self, reader: queue.Queue[bytes | None]) -> None:
        with self._lock:
            self._readers.discard(reader)


def _event(name: str, data: Any) -> bytes:
    return f"event: {name}\ndata: {as_json(data)}\n\n".encode()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    live: LiveServer

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A reader that has gone is no error."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _WITHIN_S
    server_version, sys_version = "tactile_resonance", ""

    def do_GET(self) -> None:
        """The page, or its events."""
        if not self._allowed():
            return
        if self.path == "/":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", self.server.live._page)
        elif self.path == "/events":
            self._events()
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"accepted are / and /events\n")

    def _refuse(self) -> None:
        if self._allowed():
            text = b"accepted is GET: this page only shows\n"
            self._answer(HTTPStatus.METHOD_NOT_ALLOWED, "text/plain", text)

    do_HEAD = do_POST = do_PUT = do_PATCH = do_DELETE = do_OPTIONS = do_TRACE = do_CONNECT = _refuse

    def _allowed(self) -> bool:
        """Whether the request names this address, once; else it is refused."""
        port = self.server.server_port
        hosts = self.headers.get_all("Host") or []
        if len(hosts) == 1 and hosts[0] in (f"{LOOPBACK}:{port}", f"localhost:{port}"):
            return True
        text = f"Host: accepted is {LOOPBACK}:{port}\n".encode()
        self._answer(HTTPStatus.MISDIRECTED_REQUEST, "text/plain", text)
        return False

    def _answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self._head(status, kind)
        self.send_header("Content-Length", str(len(content)))
        if status is HTTPStatus.METHOD_NOT_ALLOWED:
            self.send_header("Allow", "GET")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _head(self, status: HTTPStatus, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Content-Security-Policy", content_security_policy(live=True))

    def _events(self) -> None:
        live = self.server.live
        reader = live._begin()
        if reader is None:
            text = f"{MOST_READERS} pages listen already\n".encode()
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", text)
            return
        try:
            self._head(HTTPStatus.OK, "text/event-stream")
            self.end_headers()
            # what is published from now on waits in the queue: nothing is missed, some may come twice
            self.wfile.write(_event("run", live._snapshot()))
            while True:
                try:
                    event = reader.get(timeout=_ALIVE_S)
                except queue.Empty:
                    event = b": alive\n\n"
                if event is None:
                    return
                self.wfile.write(event)
        except OSError:  # the page was closed
            return
        finally:
            live._end(reader)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""
