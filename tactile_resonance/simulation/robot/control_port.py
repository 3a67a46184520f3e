# SPDX-License-Identifier: Apache-2.0
"""Control port of the simulated robot: faults to order, and how it fares.

One JSON object a line, ``{"command": NAME, ...}``; each is answered by one line, ``{"ok": true, ...}`` or
``{"ok": false, "error": TEXT}``. Commands are listed in docs/robot.md.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tactile_resonance.simulation.robot.reactor import Connection

if TYPE_CHECKING:
    from tactile_resonance.simulation.robot.simulated_robot import SimulatedRobot

PORT = 30020
_LONGEST_LINE = 1 << 16
_LONGEST_FREEZE_S = 600.0


class ControlPort:
    """Makes the service of each connection; other parts of the plant add commands of their own.

    Attributes
    ----------
    commands : dict
        Name of each command and the function that does it: takes the fields of the request, returns
        those of the answer, raises ValueError where it refuses.
    """

    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot = robot
        controller = robot.controller
        self.commands: dict[str, Callable[[dict], dict]] = {
            "state": self._state,
            "freeze": self._freeze,
            "drop": lambda _: {"dropped": robot.rtde.drop()},
            "protective_stop": _plain(controller.protective_stop),
            "emergency_stop": _plain(controller.emergency_stop),
            "release_emergency_stop": _plain(controller.release_emergency_stop),
            "remote_control": lambda fields: self._set(controller, "remote_control", fields),
            "script_starts": lambda fields: self._set(controller, "script_starts", fields),
            "registers_in_use": lambda fields: self._set(robot.rtde, "registers_in_use", fields),
            "log": lambda _: {"log": list(controller.log)},
        }

    def serve(self, connection: Connection) -> ControlService:
        """Serve a new connection."""
        return ControlService(self, connection)

    def answer(self, line: bytes) -> dict:
        """Do one request and return its answer."""
        try:
            fields = json.loads(line)
            name = fields.get("command") if isinstance(fields, dict) else None
            if not isinstance(name, str) or name not in self.commands:
                raise ValueError(f"command: expected one of {', '.join(self.commands)}")
            return {"ok": True, **self.commands[name](fields)}
        except RecursionError:
            return {"ok": False, "error": "request: nested too deeply"}
        except ValueError as error:
            return {"ok": False, "error": str(error)}

    def _state(self, _: dict) -> dict:
        controller, pace = self._robot.controller, self._robot.pace
        return {
            "time_s": controller.time_s,
            "robot_mode": controller.robot_mode.name,
            "safety_mode": controller.safety_mode.name,
            "runtime_state": controller.runtime_state.name,
            "tcp_pose": controller.outputs("actual_TCP_pose"),
            "tcp_speed": controller.outputs("actual_TCP_speed"),
            "tcp_force": controller.outputs("actual_TCP_force"),
            "rtde_connections": self._robot.rtde.connections,
            "stalls": pace.stalls,
            "stood_still_s": controller.stood_still_s,
            "longest_delay_s": pace.longest_s,
        }

    def _freeze(self, fields: dict) -> dict:
        seconds: Any = fields.get("seconds")
        if type(seconds) not in (int, float) or not 0 < seconds <= _LONGEST_FREEZE_S:
            raise ValueError(f"seconds: {seconds!r}, expected above 0 to {_LONGEST_FREEZE_S:g}")
        part = fields.get("part", "network")
        if part == "network":
            self._robot.freeze_network(seconds)
        elif part == "controller":
            self._robot.freeze_controller(seconds)
        else:
            raise ValueError(f"part: {part!r}, expected 'network' or 'controller'")
        return {}

    def _set(self, target: Any, name: str, fields: dict) -> dict:
        value = fields.get("value")
        if not isinstance(value, bool):
            raise ValueError(f"value: {value!r}, expected true or false")
        setattr(target, name, value)
        return {}


class ControlService:
    """One connection to the control port."""

    def __init__(self, port: ControlPort, connection: Connection) -> None:
        self._port = port
        self._connection = connection
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Answer each complete line."""
        self._buffer += data
        if len(self._buffer) > _LONGEST_LINE:
            raise ValueError("control port: line too long")
        *lines, self._buffer = self._buffer.split(b"\n")
        for line in lines:
            self._connection.send(json.dumps(self._port.answer(line)).encode() + b"\n")

    def closed(self) -> None:
        """Nothing to free."""


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


def _plain(action: Callable[[], None]) -> Callable[[dict], dict]:
    """A command without fields and without an answer."""

    def command(_: dict) -> dict:
        action()
        return {}

    return command
