# SPDX-License-Identifier: Apache-2.0
"""What the owner of `UrArm`'s client process asks of it, without what a later request has overtaken."""

from __future__ import annotations

import json
import select
import socket
from typing import Any

LONGEST_MESSAGE = 8192


class OwnerGoneError(Exception):
    """The owner's end is closed: nobody asks any more."""


class Requests:
    """Requests in the order in which they are to be done.

    Parameters
    ----------
    commands : socket.socket
        Of messages; one JSON object each.
    """

    def __init__(self, commands: socket.socket) -> None:
        self._commands = commands
        self._waiting: list[dict] = []

    def take(self, wait_s: float) -> dict | None:
        """Return the next request, None where none comes within a time. Raises `OwnerGoneError`."""
        if not self._waiting:
            select.select([self._commands], [], [], wait_s)
        self._receive()
        return self._waiting.pop(0) if self._waiting else None

    def stop_waits(self) -> bool:
        """Whether a stop is among those to come. Raises `OwnerGoneError`."""
        self._receive()
        return any(request["name"] == "stop" for request in self._waiting)

    def answer(self, answer: dict[str, Any]) -> None:
        """Tell the owner what became of a request that he waits for."""
        self._commands.send(json.dumps(answer).encode())

    def owner_gone(self) -> bool:
        """Whether the owner's end is closed; may be asked by another thread."""
        try:
            return self._commands.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
        except BlockingIOError:
            return False
        except OSError:
            return True

    def _receive(self) -> None:
        while True:
            try:
                data = self._commands.recv(LONGEST_MESSAGE, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                raise OwnerGoneError
            self._waiting.append(json.loads(data))
        self._waiting = _newest(self._waiting)


def _newest(requests: list[dict]) -> list[dict]:
    """Leave out speeds that a later command has overtaken, and all motion before a stop."""
    kept: list[dict] = []
    for request in requests:
        if request["name"] == "stop":
            kept = [r for r in kept if r["name"] not in ("speed", "move")]
        elif request["name"] == "speed" and kept and kept[-1]["name"] == "speed":
            kept.pop()
        kept.append(request)
    return kept
