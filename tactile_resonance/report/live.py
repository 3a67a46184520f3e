# SPDX-License-Identifier: Apache-2.0
"""The page of a scan that is going on: what is heard goes in, events for the page come out, over HTTP.

Without ROS: `nodes.client.LiveListener` hears the topics. The server is for this machine alone, and to be
read only: it listens on 127.0.0.1, answers GET only, and only requests whose Host is that address: a page of
another site whose name is turned to 127.0.0.1 (DNS rebinding) names its own. Other sites cannot read its
answers, for it allows no other origin.
"""

from __future__ import annotations

import contextlib
import math
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from tactile_resonance.fields import known, require
from tactile_resonance.poles.result import Poles
from tactile_resonance.report.page import (
    MN,
    as_json,
    content_security_policy,
    listed,
    map_entry,
    page,
    page_data,
    point_entry,
)
from tactile_resonance.report.point_details import MOST_DETAILED, PointDetails
from tactile_resonance.scan.point_result import PointOutcome, PointResult, mode_columns
from tactile_resonance.scan.pole_map import GrowingMap, counts

Publish = Callable[[str, Any], None]
HOLDING = "hold"  # state of a contact in which is measured
MOST_OF_A_MAP = 500
"""Points up to which the map between them is kriged while a scan goes on."""
_CELLS = 40
_BUSY_SHARE = 0.02  # of the time, at most, that maps are kriged
_LINES = 150  # of an FRF
_MOST_FORCES = 2000  # of one contact
_UNHEARD_S = 3.0
LOOPBACK = "127.0.0.1"
MOST_READERS = 8
_WAITING = 200  # events for a reader that is slow; beyond that it begins anew
_ALIVE_S = 10.0
_WITHIN_S = 10.0  # for a request, and for a reader to take what is sent
_HEAD = (
    '<h1>Scan under way</h1><p class="note">This page only shows: nothing here reaches the robot. '
    "Figures are those of the nodes as they publish them. There is no stop on this page.</p>"
)


class LiveRun:
    """Takes what is heard, in whatever thread, and publishes events.

    Parameters
    ----------
    publish : callable
        Of the name of an event and its data; called while nothing else changes.
    clock_s : callable
        Time that goes on steadily [s].
    """

    def __init__(self, publish: Publish, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._publish, self._clock_s = publish, clock_s
        self._lock = threading.RLock()
        self._begin()

    def _begin(self) -> None:
        """Forget the scan before."""
        self._results: dict[int, PointResult] = {}
        self._details: dict[int, dict[str, Any]] = {}
        self._maps = [GrowingMap()]
        # of the measurement under way, and whether something of it is not sent yet
        self._measuring, self._label, self._found, self._is_new = 0, "", PointDetails(), False
        self._newest: int | None = None
        self._state, self._heard_s, self._message = "", -1e9, ""
        self._forces: deque[tuple[float, float]] = deque(maxlen=_MOST_FORCES)  # not sent yet
        self._contact: list[tuple[float, float]] = []  # since it was held
        self._held_from_s = 0.0
        self._map_is_old, self._map_from_s = False, 0.0

    def snapshot(self) -> dict[str, Any]:
        """All of the run, as `run_report.run_entry` gives that of one that ended."""
        with self._lock:
            results = [self._results[k] for k in sorted(self._results)]
            return {
                "name": next((r.label for r in results if r.label), "scan"),
                "simulated": any(r.simulated for r in results),
                "force_mn": None,
                "newest": self._newest,
                "bands": [
                    {
                        "name": f"band {k + 1}",
                        "points": [point_entry(r.of_band(k)) for r in results],
                        **self._surface(k),
                    }
                    for k in range(len(self._maps))
                ],
                "details": {str(index): each for index, each in self._details.items()},
            }

    def take_result(self, result: PointResult, poles: Poles | None) -> None:
        """One attempt at a point; what is discarded, or measured in air, is not shown."""
        if not counts(result):
            return
        with self._lock:
            before = self._results.get(result.index)
            if before is not None and before.time_ns == result.time_ns:
                return  # published again
            # in a run the attempts at a point are numbered, and made at one place
            another = before is not None and not (
                before.attempt < result.attempt
                and np.array_equal(before.position_m, result.position_m, equal_nan=True)
            )
            if another:
                self._begin()
            self._results[result.index], self._newest = result, result.index
            bands = max(1 + len(result.further), len(self._maps))
            wider = bands > len(self._maps)
            self._maps += [
                GrowingMap(r.of_band(k) for r in self._results.values())
                for k in range(len(self._maps), bands)
            ]
            for k, grown in enumerate(self._maps):
                grown.take(result.of_band(k))
            self._map_is_old = True
            found = self._found if self._measuring == result.measurement_id else PointDetails()
            if result.measurement_id:
                self._details.pop(result.index, None)
                self._details[result.index] = self._entry(found, poles)
            while len(self._details) > MOST_DETAILED:
                del self._details[next(iter(self._details))]
            if another or wider:
                self._publish("run", self.snapshot())
                return
            points = [point_entry(result.of_band(k)) for k in range(len(self._maps))]
            details = {str(k): each for k, each in self._details.items() if k == result.index}
            self._publish("point", {"bands": points, "details": details})

    def take_frf(self, message: Any) -> None:
        """FRF of the measurement under way, the latest counts; of ROS or of rosbags."""
        self._take(message.measurement_id, message.label, frf=message)

    def take_poles(self, poles: Poles, measurement_id: int, label: str) -> None:
        """Poles of the measurement under way, the latest count."""
        self._take(measurement_id, label, poles=poles)

    def _take(self, measurement_id: int, label: str, **found: Any) -> None:
        with self._lock:
            if self._measuring != measurement_id:
                self._measuring, self._label, self._found = measurement_id, label, PointDetails()
            self._found, self._is_new = replace(self._found, **found), True

    def _entry(self, found: PointDetails, poles: Poles | None = None) -> dict[str, Any]:
        """What a click on a point shows, with the force since it was held."""
        return replace(found, poles=poles or found.poles, force=tuple(self._contact)).entry(_LINES)

    def take_state(self, time_s: float, state: str, force_n: float, message: str = "") -> None:
        """State of the contact at a time [s] of its clock, and its force [N]; NaN: not in contact."""
        with self._lock:
            self._heard_s = self._clock_s()
            if state == HOLDING and self._state != HOLDING:
                self._contact, self._held_from_s = [], time_s
            if state == HOLDING and math.isfinite(force_n) and len(self._contact) < _MOST_FORCES:
                self._contact.append((time_s - self._held_from_s, force_n))
            self._state, self._message = state, message
            self._forces.append((time_s, force_n))

    def tick(self) -> None:
        """Publish what is new since the last one; to be called a few times a second."""
        with self._lock:
            forces = [[*listed([t], 12), known(MN * f)] for t, f in self._forces]
            self._forces.clear()
            failed = sum(
                r.failed and r.outcome is not PointOutcome.SKIPPED for r in self._results.values()
            )
            simulated = any(r.simulated for r in self._results.values())
            so_far = {"points": len(self._results), "failed": failed, "simulated": simulated}
            self._publish("now", {"text": self._text(), "forces": forces, **so_far})
            if self._is_new:
                self._is_new = False
                self._publish(
                    "measuring",
                    {
                        "title": self._label or f"measurement {self._measuring}",
                        "point": {**point_entry(_so_far(self._found.poles)), "outcome": "under way"},
                        "detail": self._entry(self._found),
                    },
                )
            if self._map_is_old and self._clock_s() >= self._map_from_s:
                self._map_is_old = False
                begun_s = self._clock_s()
                for band in range(len(self._maps)):
                    self._publish("surface", {"band": band, **self._surface(band)})
                ended_s = self._clock_s()
                self._map_from_s = ended_s + (ended_s - begun_s) / _BUSY_SHARE

    def _surface(self, band: int) -> dict[str, Any]:
        pole_map = self._maps[band].map
        surface = pole_map.surface(_CELLS) if len(pole_map.points) <= MOST_OF_A_MAP else None
        return map_entry(surface)

    def _text(self) -> str:
        """What goes on, for people."""
        if self._clock_s() - self._heard_s > _UNHEARD_S:
            return "nothing is heard of contact_node"
        told = f"contact: {self._state}"
        return f"{told}; {self._message}" if self._message else told


def _so_far(poles: Poles | None) -> PointResult:
    """A point under way, as far as it is known."""
    if poles is None:
        return PointResult(0)
    mode = mode_columns(poles.main.estimate, poles.main.covariance)
    return PointResult(0, **mode, poles_status=poles.status.value)


class LiveServer(ThreadingHTTPServer):
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

    daemon_threads = True
    block_on_close = False

    def __init__(self, port: int, snapshot: Callable[[], dict[str, Any]]) -> None:
        require(0 <= port <= 65535, "--port", port, "0 to 65535")
        self.snapshot = snapshot
        self._readers: set[queue.Queue[bytes | None]] = set()
        self._lock = threading.Lock()
        data = page_data([], [], "")
        self.page = page("Scan under way", _HEAD, data, live=True).encode()
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            raise ValueError(f"--port: {port} is taken ({error.strerror})") from error
        self.url = f"http://{LOOPBACK}:{self.server_port}/"
        self._thread = threading.Thread(target=self.serve_forever, daemon=True)

    def __enter__(self) -> LiveServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()
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

    def begin(self) -> queue.Queue[bytes | None] | None:
        """Queue of one reader more, all of the run first in it; None where there are too many."""
        reader: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        with self._lock:
            if len(self._readers) >= MOST_READERS:
                return None
            self._readers.add(reader)
        return reader

    def end(self, reader: queue.Queue[bytes | None]) -> None:
        """One reader less."""
        with self._lock:
            self._readers.discard(reader)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A reader that has gone is no error."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


def _event(name: str, data: Any) -> bytes:
    return f"event: {name}\ndata: {as_json(data)}\n\n".encode()


class _Handler(BaseHTTPRequestHandler):
    server: LiveServer
    timeout = _WITHIN_S
    server_version, sys_version = "tactile_resonance", ""

    def do_GET(self) -> None:
        """The page, or its events."""
        if not self._allowed():
            return
        if self.path == "/":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
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
        reader = self.server.begin()
        if reader is None:
            text = f"{MOST_READERS} pages listen already\n".encode()
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", text)
            return
        try:
            self._head(HTTPStatus.OK, "text/event-stream")
            self.end_headers()
            # what is published from now on waits in the queue: nothing is missed, some may come twice
            self.wfile.write(_event("run", self.server.snapshot()))
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
            self.server.end(reader)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""
