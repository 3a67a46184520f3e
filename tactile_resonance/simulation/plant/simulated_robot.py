# SPDX-License-Identifier: Apache-2.0
"""The simulated controller on its ports, stepped by the time of its bench.

The dashboard server takes one line and answers one; requests and replies: Universal Robots, "Dashboard Server
e-Series". Programs stored on the controller do not exist here: ``load`` finds none.

The control port takes orders from outside, among them faults: one JSON object a line,
``{"command": NAME, ...}``; each is answered by one line, ``{"ok": true, ...}`` or
``{"ok": false, "error": TEXT}``. Commands are listed in docs/robot.md.
"""

from __future__ import annotations

import gc
import json
import re
from collections.abc import Callable
from functools import partial
from typing import Any

from tactile_resonance.clock import PORT as TIME_PORT
from tactile_resonance.fields import number, require
from tactile_resonance.simulation.plant.bench_time import BenchTime
from tactile_resonance.simulation.plant.defaults import CONTROL_PORT
from tactile_resonance.simulation.ur5e import rtde_server
from tactile_resonance.simulation.ur5e.controller import (
    POLYSCOPE,
    SERIAL_NUMBER,
    RefusedError,
    UrController,
)
from tactile_resonance.simulation.ur5e.reactor import Connection, Reactor, Serving, Until
from tactile_resonance.simulation.ur5e.target import CYCLE_S

DASHBOARD_PORT = 29999
_REQUEST = Until(b"\n", 4096)
# What a robot in local control answers to everything that changes its state.
_LOCAL = "Command is not allowed: the robot is not in remote control"


def serve_dashboard(controller: UrController, connection: Connection) -> Serving:
    """Serve one dashboard connection: each line is answered by one."""
    c = controller
    # asked at any time
    questions: dict[str, Callable[[], str]] = {
        "robotmode": lambda: f"Robotmode: {c.robot_mode.name}",
        "safetymode": lambda: f"Safetymode: {c.safety_mode.name}",
        "safetystatus": lambda: f"Safetystatus: {c.safety_mode.name}",
        "programState": lambda: f"{'PLAYING' if c.program else 'STOPPED'} rtde_control",
        "running": lambda: f"Program running: {str(c.program is not None).lower()}",
        "is in remote control": lambda: str(c.remote_control).lower(),
        "isProgramSaved": lambda: "true",
        "get loaded program": lambda: "No program loaded",
        "get robot model": lambda: "UR5",
        "get serial number": lambda: SERIAL_NUMBER,
        "PolyscopeVersion": lambda: f"URSoftware {'.'.join(map(str, POLYSCOPE))}",
        "version": lambda: ".".join(map(str, POLYSCOPE)),
        "quit": lambda: "Disconnected",
    }
    actions: dict[str, tuple[Callable[[], None], str]] = {
        "power on": (c.power_on, "Powering on"),
        "power off": (c.power_off, "Powering off"),
        "brake release": (c.brake_release, "Brake releasing"),
        "unlock protective stop": (c.unlock_protective_stop, "Protective stop releasing"),
        "restart safety": (lambda: None, "Restarting safety"),
        "close popup": (c.close_popup, "closing popup"),
        "close safety popup": (c.close_popup, "closing safety popup"),
        "stop": (c.stop_program, "Stopped"),
        "shutdown": (c.power_off, "Shutting down"),
    }

    def answer(request: str) -> str:
        if request in questions:
            return questions[request]()
        word, _, rest = request.partition(" ")
        if word == "addToLog":
            c.log.append(rest)
            return "Added log message"
        if word == "setUserRole":
            return f"Setting user role: {rest}"
        if not c.remote_control:
            return _LOCAL
        if request in actions:
            action, done = actions[request]
            try:
                action()
            except RefusedError as error:
                return str(error)
            return done
        if word == "popup":
            c.popup = rest
            return "showing popup"
        if word == "load":
            return f"File not found: {rest}"
        if request in ("play", "pause"):
            return f"Failed to execute: {request}"
        return f"could not understand: '{request}'"

    connection.send(b"Connected: Universal Robots Dashboard Server\n")
    request = ""
    while request != "quit":
        request = (yield _REQUEST).decode("utf-8", "replace").strip()
        connection.send((answer(request) + "\n").encode())


Orders = dict[str, Callable[[dict], dict | None]]
"""Name of each command and the function that does it: takes the fields of the request, returns those of the
answer where there are any, raises ValueError where it refuses."""


def serve_orders(orders: Orders, connection: Connection) -> Serving:
    """Serve one connection to the control port."""
    while True:
        line = yield Until(b"\n")
        try:
            fields = json.loads(line)
            name = fields.get("command") if isinstance(fields, dict) else None
            if not isinstance(name, str) or name not in orders:
                raise ValueError(f"command: expected one of {', '.join(orders)}")
            answer = {"ok": True, **(orders[name](fields) or {})}
        except RecursionError:
            answer = {"ok": False, "error": "request: nested too deeply"}
        except ValueError as error:
            answer = {"ok": False, "error": str(error)}
        connection.send(json.dumps(answer).encode() + b"\n")


# Programs come in here, nothing goes out: a real controller also sends its state, which no client of this
# package reads.
SCRIPT_PORT = 30003
# The client's own has 42 kB; what has no end is searched anew with each piece that comes.
_LONGEST_PROGRAM = 1 << 18
# A program ends with a line `end` that is not indented.
_END = re.compile(rb"^end[ \t]*\r?\n", re.MULTILINE)


def serve_scripts(controller: UrController, _: Connection) -> Serving:
    """Start each program that is complete; what is refused or stays unfinished goes to the controller's log."""
    unfinished = b""
    try:
        while True:
            unfinished += yield None
            if len(unfinished) > _LONGEST_PROGRAM:
                raise ValueError(f"script: longer than {_LONGEST_PROGRAM} bytes")
            while (end := _END.search(unfinished)) is not None:
                text, unfinished = unfinished[: end.end()], unfinished[end.end() :]
                try:
                    controller.start_program(text.decode("utf-8", "replace"))
                except (ValueError, RefusedError) as error:
                    controller.log.append(str(error))
    finally:
        if unfinished.strip():
            begin = unfinished[:40].decode("utf-8", "replace")
            controller.log.append(f"program: got {begin!r}... and no line 'end': ignored")


_LONGEST_FREEZE_S = 600.0

STEPS_AT_REST = 3
"""While nothing moves or is touched states come so many at a time, so that the newest is at most 6 ms old."""


class SimulatedRobot:
    """A controller with RTDE, dashboard, script and control ports, and that of its time.

    Parameters
    ----------
    controller : UrController
    host : str
        Address of all ports; any of 127.0.0.0/8.
    simulated_time : bool
        Time goes on as those who take part in it let it (`tactile_resonance.clock`); else at the pace of the
        wall clock.
    control_port : int

    Attributes
    ----------
    controller : UrController
    reactor : Reactor
    rtde : RtdeServer
    orders : Orders
        What the control port does, by its name; parts of the plant add their own.
    time : BenchTime
    after_step : list of callables
        Called after each step of the controller: what shares its clock.

    Raises
    ------
    ValueError
        Where a port cannot be had.
    """

    def __init__(
        self,
        controller: UrController,
        host: str,
        *,
        simulated_time: bool = False,
        control_port: int = CONTROL_PORT,
    ) -> None:
        self.controller = controller
        self.after_step: list[Callable[[], None]] = []
        self._cycle = 0
        self._frozen_until_ns = self._halted_until_ns = 0
        self.rtde = rtde_server.RtdeServer(controller)
        self.orders = self._own_orders()
        self.reactor = Reactor(host)
        self.time = BenchTime(self.reactor, round(CYCLE_S * 1e9), simulated=simulated_time)
        self.time.steps.append(self._step)
        self.time.at_once = lambda: STEPS_AT_REST if controller.rests else 1
        self.time.repeats.append(self.rtde.repeat)
        self.time.stalled.append(self._stood_still)
        self.time.robot_sent_ns = self.rtde.sent_ns
        self.time.packets_arrived = lambda: None if self.reactor.frozen else self.rtde.packets
        try:
            self.reactor.listen(rtde_server.PORT, self.rtde.serve)
            self.reactor.listen(DASHBOARD_PORT, partial(serve_dashboard, controller))
            self.reactor.listen(SCRIPT_PORT, partial(serve_scripts, controller))
            self.reactor.listen(control_port, partial(serve_orders, self.orders), freezable=False)
            if simulated_time:
                self.reactor.listen(TIME_PORT, self.time.serve, freezable=False)
        except ValueError:
            self.reactor.close()
            raise

    def run(self) -> None:
        """Step and serve until `time` is stopped, then close all ports."""
        gc.collect()
        gc.freeze()  # what is there to stay needs no search for garbage
        try:
            self.time.run()
        finally:
            self.reactor.close()

    def _step(self) -> None:
        now_ns = self.time.now_ns
        if self._frozen_until_ns and now_ns >= self._frozen_until_ns:
            self._frozen_until_ns = 0
            self.reactor.freeze(False)
        if now_ns < self._halted_until_ns:
            return
        self.controller.step()
        for call in self.after_step:
            call()
        self.rtde.publish(self._cycle)
        self._cycle += 1

    def _stood_still(self, seconds: float) -> None:
        """The robot's time stamps go on with the wall clock, as if packets had been lost."""
        self.controller.stood_still_s += seconds

    def _own_orders(self) -> Orders:
        """What the control port does for the robot itself."""
        controller, rtde = self.controller, self.rtde
        return {
            "state": self._state,
            "freeze": self._freeze,
            "drop": lambda _: {"dropped": rtde.drop()},
            "protective_stop": lambda _: controller.protective_stop(),
            "emergency_stop": lambda _: controller.emergency_stop(),
            "release_emergency_stop": lambda _: controller.release_emergency_stop(),
            "remote_control": partial(_switch, controller, "remote_control"),
            "script_starts": partial(_switch, controller, "script_starts"),
            "registers_in_use": partial(_switch, rtde, "registers_in_use"),
            "log": lambda _: {"log": list(controller.log)},
        }

    def _state(self, _: dict) -> dict:
        controller = self.controller
        return {
            "time_s": controller.time_s,
            "robot_mode": controller.robot_mode.name,
            "safety_mode": controller.safety_mode.name,
            "runtime_state": controller.runtime_state.name,
            "tcp_pose": controller.outputs("actual_TCP_pose"),
            "tcp_speed": controller.outputs("actual_TCP_speed"),
            "tcp_force": controller.outputs("actual_TCP_force"),
            "rtde_connections": self.rtde.connections,
            "stalls": self.time.stalls,
            "stood_still_s": controller.stood_still_s,
            "longest_delay_s": self.time.longest_delay_s,
        }

    def _freeze(self, fields: dict) -> None:
        seconds = number(fields.get("seconds"), "seconds")
        good = 0 < seconds <= _LONGEST_FREEZE_S
        require(good, "seconds", seconds, f"above 0 to {_LONGEST_FREEZE_S:g}")
        part = fields.get("part", "network")
        require(part in ("network", "controller"), "part", part, "'network' or 'controller'")
        until_ns = self.time.now_ns + round(seconds * 1e9)
        if part == "network":  # no packet of the robot's own ports passes; the robot goes on
            self._frozen_until_ns = until_ns
            self.reactor.freeze(True)
        else:  # all of it stands still, its clock too
            self._halted_until_ns = until_ns


def _switch(target: Any, name: str, fields: dict) -> None:
    """An order that sets an attribute to its field ``value``."""
    value = fields.get("value")
    require(isinstance(value, bool), "value", value, "true or false")
    setattr(target, name, value)
