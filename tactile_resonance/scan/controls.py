# SPDX-License-Identifier: Apache-2.0
"""What somebody may ask of a running scan, from any thread."""

from __future__ import annotations

import threading
from enum import Enum

from tactile_resonance.scan.hands import Interrupted


class Request(Enum):
    """What somebody may ask of a running scan."""

    SKIP = "skip"
    REPEAT = "repeat"
    CANCEL = "cancel"


class Controls:
    """What is asked of a running scan, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._request: Request | None = None
        self.paused = threading.Event()
        self.cancelled = threading.Event()

    def ask(self, request: Request) -> None:
        """Skip or repeat the point under way (between two: the next, the last), or end the scan."""
        if request is Request.CANCEL:
            self.cancelled.set()
        else:
            with self._lock:
                self._request = request

    def take(self) -> Request | None:
        """Request that waits, once."""
        with self._lock:
            request, self._request = self._request, None
        return request

    def check(self) -> None:
        """Raise `Interrupted` where the point under way shall be left."""
        self.check_cancelled()
        if self._request is not None:
            raise Interrupted

    def check_cancelled(self) -> None:
        """Raise `Interrupted` where the scan shall end; a request about a point waits for the next one."""
        if self.cancelled.is_set():
            raise Interrupted
