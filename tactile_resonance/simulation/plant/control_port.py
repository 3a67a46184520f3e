# SPDX-License-Identifier: Apache-2.0
"""Control port of the simulated plant: orders from outside, among them faults.

One JSON object a line, ``{"command": NAME, ...}``; each is answered by one line, ``{"ok": true, ...}`` or
``{"ok": false, "error": TEXT}``. Commands are listed in docs/robot.md.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from typing import Any

from tactile_resonance.simulation.ur5e.reactor import Connection, MessageService

PORT = 30020


class ControlService(MessageService):
    """One connection to the control port.

    Parameters
    ----------
    connection : Connection
    orders : dict
        Name of each command and the function that does it: takes the fields of the request, returns
        those of the answer, raises ValueError where it refuses.
    """

    def __init__(self, connection: Connection, orders: dict[str, Callable[[dict], dict]]) -> None:
        super().__init__(connection)
        self._orders = orders

    def understand(self, message: bytes) -> None:
        """Answer one line."""
        self.connection.send(json.dumps(self._answer(message)).encode() + b"\n")

    def _answer(self, line: bytes) -> dict:
        try:
            fields = json.loads(line)
            name = fields.get("command") if isinstance(fields, dict) else None
            if not isinstance(name, str) or name not in self._orders:
                raise ValueError(f"command: expected one of {', '.join(self._orders)}")
            return {"ok": True, **self._orders[name](fields)}
        except RecursionError:
            return {"ok": False, "error": "request: nested too deeply"}
        except ValueError as error:
            return {"ok": False, "error": str(error)}


def order(host: str, command: str, port: int = PORT, timeout_s: float = 5.0, **fields: Any) -> dict:
    """Send one command to a simulated robot and return its answer.

    Raises
    ------
    ValueError
        Where the robot refuses it.
    OSError
        Where nothing listens or answers in time.
    """
    with socket.create_connection((host, port), timeout_s) as channel:
        channel.sendall(json.dumps({"command": command, **fields}).encode() + b"\n")
        with channel.makefile() as lines:
            line = lines.readline()
    if not line:
        raise ConnectionError(f"control port {port} of {host}: closed without an answer")
    answer = json.loads(line)
    if not answer.pop("ok"):
        raise ValueError(answer["error"])
    return answer
