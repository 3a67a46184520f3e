# SPDX-License-Identifier: Apache-2.0
"""Script port of the simulated controller (30003): programs come in, nothing goes out.

A real controller also sends its state here, which no client of this package reads.
"""

from __future__ import annotations

import re

from tactile_resonance.simulation.robot.controller import UrController
from tactile_resonance.simulation.robot.reactor import Connection
from tactile_resonance.simulation.robot.safety import RefusedError

PORT = 30003
# The client's own has 42 kB; what has no end is searched anew with each piece that comes.
_LONGEST_PROGRAM = 1 << 18
# A program ends with a line `end` that is not indented.
_END = re.compile(rb"^end[ \t]*\r?\n", re.MULTILINE)


class ScriptServer:
    """Makes the service of each connection to the script port."""

    def __init__(self, controller: UrController) -> None:
        self._controller = controller

    def serve(self, connection: Connection) -> ScriptService:
        """Serve a new connection."""
        return ScriptService(self._controller)


class ScriptService:
    """Collects a program and hands it to the controller."""

    def __init__(self, controller: UrController) -> None:
        self._controller = controller
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Start each program that is complete; what is refused goes to the controller's log."""
        self._buffer += data
        if len(self._buffer) > _LONGEST_PROGRAM:
            raise ValueError(f"script: longer than {_LONGEST_PROGRAM} bytes")
        while (end := _END.search(self._buffer)) is not None:
            text, self._buffer = self._buffer[: end.end()], self._buffer[end.end() :]
            try:
                self._controller.start_program(text.decode("utf-8", "replace"))
            except (ValueError, RefusedError) as error:
                self._controller.log.append(str(error))

    def closed(self) -> None:
        """An unfinished program is forgotten, and that is logged."""
        if self._buffer.strip():
            begin = self._buffer[:40].decode("utf-8", "replace")
            self._controller.log.append(f"program: got {begin!r}... and no line 'end': ignored")
