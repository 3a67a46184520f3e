# SPDX-License-Identifier: Apache-2.0
"""What the plant's process and those who start it agree on, and how they order something of it.

Apart from the plant, which takes half a second to load: those who start it need none of it.
"""

from __future__ import annotations

import json
import socket
from typing import Any

READY = "simulated UR5e ready at"
"""First words of the line that is printed when all ports are open."""

PRIORITY = 30
"""SCHED_FIFO priority of the simulated controller, above the control loop's: a real one has its own cores."""

TABLE_IN_BASE = [-0.49, -0.13, 0.2, 0.0, 0.0, -1.5707963267948966]
"""Frame of a scene in the robot's base, position [m] and rotation vector [rad]: under the tip as the
simulated robot starts, x of the scene along its beam."""

STALLS_S = 0.05
"""So long a simulated robot without that priority may stand still on the wall clock, and be waited for."""

HOST = "127.0.1.1"
"""Address at which the simulated robot answers where none is given."""

CAN_PORT = 29536
"""Of the socketcand server of the simulated load cell, at the robot's address."""

CONTROL_PORT = 30020
"""Of orders, at the robot's address; docs/robot.md lists them."""

MOST_STEPS = 250
"""Steps or parts in one answer about what was: to write more would hold the plant up."""


def order(
    host: str, command: str, port: int = CONTROL_PORT, timeout_s: float = 5.0, **fields: Any
) -> dict:
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
