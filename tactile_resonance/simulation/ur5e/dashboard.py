# SPDX-License-Identifier: Apache-2.0
"""Dashboard server of the simulated controller (port 29999): one line in, one line out.

Requests and replies: Universal Robots, "Dashboard Server e-Series". Programs stored on the controller
do not exist here: ``load`` finds none.
"""

from __future__ import annotations

from collections.abc import Callable

from tactile_resonance.simulation.ur5e.controller import (
    POLYSCOPE,
    SERIAL_NUMBER,
    RuntimeState,
    UrController,
)
from tactile_resonance.simulation.ur5e.reactor import Connection, MessageService
from tactile_resonance.simulation.ur5e.safety import RefusedError

PORT = 29999
# What a robot in local control answers to everything that changes its state.
_LOCAL = "Command is not allowed: the robot is not in remote control"


class DashboardService(MessageService):
    """One dashboard connection."""

    LONGEST = 4096

    def __init__(self, controller: UrController, connection: Connection) -> None:
        super().__init__(connection)
        connection.send(b"Connected: Universal Robots Dashboard Server\n")
        self._controller = c = controller
        # asked at any time
        self._questions: dict[str, Callable[[], str]] = {
            "robotmode": lambda: f"Robotmode: {c.safety.robot_mode.name}",
            "safetymode": lambda: f"Safetymode: {c.safety.safety_mode.name}",
            "safetystatus": lambda: f"Safetystatus: {c.safety.safety_mode.name}",
            "programState": lambda: f"{'PLAYING' if self._running() else 'STOPPED'} rtde_control",
            "running": lambda: f"Program running: {str(self._running()).lower()}",
            "is in remote control": lambda: str(c.remote_control).lower(),
            "isProgramSaved": lambda: "true",
            "get loaded program": lambda: "No program loaded",
            "get robot model": lambda: "UR5",
            "get serial number": lambda: SERIAL_NUMBER,
            "PolyscopeVersion": lambda: f"URSoftware {'.'.join(map(str, POLYSCOPE))}",
            "version": lambda: ".".join(map(str, POLYSCOPE)),
        }
        self._actions: dict[str, tuple[Callable[[], None], str]] = {
            "power on": (c.safety.power_on, "Powering on"),
            "power off": (c.power_off, "Powering off"),
            "brake release": (c.safety.brake_release, "Brake releasing"),
            "unlock protective stop": (
                c.safety.unlock_protective_stop,
                "Protective stop releasing",
            ),
            "restart safety": (lambda: None, "Restarting safety"),
            "close popup": (c.close_popup, "closing popup"),
            "close safety popup": (c.close_popup, "closing safety popup"),
            "stop": (c.stop_program, "Stopped"),
            "shutdown": (c.power_off, "Shutting down"),
        }

    def understand(self, message: bytes) -> None:
        """Answer one line."""
        request = message.decode("utf-8", "replace").strip()
        self.connection.send((self._answer(request) + "\n").encode())
        if request == "quit":
            self.connection.close()

    def _answer(self, request: str) -> str:
        if request in self._questions:
            return self._questions[request]()
        if request == "quit":
            return "Disconnected"
        word, _, rest = request.partition(" ")
        if word == "addToLog":
            self._controller.log.append(rest)
            return "Added log message"
        if word == "setUserRole":
            return f"Setting user role: {rest}"
        if not self._controller.remote_control:
            return _LOCAL
        if request in self._actions:
            action, answer = self._actions[request]
            try:
                action()
            except RefusedError as error:
                return str(error)
            return answer
        if word == "popup":
            self._controller.popup = rest
            return "showing popup"
        if word == "load":
            return f"File not found: {rest}"
        if request in ("play", "pause"):
            return f"Failed to execute: {request}"
        return f"could not understand: '{request}'"

    def _running(self) -> bool:
        return self._controller.runtime_state is RuntimeState.PLAYING
