# SPDX-License-Identifier: Apache-2.0
"""The simulated controller on its ports, at the pace of the wall clock."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tactile_resonance.fields import number
from tactile_resonance.simulation.robot import dashboard, rtde_server, script_server
from tactile_resonance.simulation.robot.control_port import PORT as CONTROL_PORT
from tactile_resonance.simulation.robot.control_port import ControlPort
from tactile_resonance.simulation.robot.controller import UrController
from tactile_resonance.simulation.robot.reactor import Reactor
from tactile_resonance.simulation.robot.target import CYCLE_S

# A step that begins later than this is a stall: what ran meanwhile is not to be trusted.
STALL_S = 0.010
_LONGEST_FREEZE_S = 600.0


@dataclass
class Pace:
    """How well the simulation kept its pace.

    Attributes
    ----------
    stalls : int
        Steps that began more than 10 ms late, for no fault that was asked for.
    longest_s : float
        Longest delay of a step [s].
    """

    stalls: int = 0
    longest_s: float = 0.0


class SimulatedRobot:
    """A controller with RTDE, dashboard, script and control ports.

    Parameters
    ----------
    controller : UrController
    host : str
        Address of all ports; any of 127.0.0.0/8.
    speed : float
        Robot time over wall time.
    control_port : int

    Attributes
    ----------
    controller : UrController
    reactor : Reactor
    rtde : RtdeServer
    control : ControlPort
    pace : Pace
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
        speed: float = 1.0,
        control_port: int = CONTROL_PORT,
    ) -> None:
        if not 0.01 <= speed <= 10.0:
            raise ValueError(f"speed: {speed:g}, expected 0.01 to 10")
        self.controller = controller
        self.pace = Pace()
        self.after_step: list[Callable[[], None]] = []
        self._cycle_ns = round(CYCLE_S / speed * 1e9)
        self._frozen_until_ns = 0
        self._halted_until_ns = 0
        self._stopping = False
        self.rtde = rtde_server.RtdeServer(controller)
        self.control = ControlPort(self._orders())
        self.reactor = Reactor(host)
        try:
            self.reactor.listen(rtde_server.PORT, self.rtde.serve)
            self.reactor.listen(dashboard.PORT, dashboard.DashboardServer(controller).serve)
            self.reactor.listen(script_server.PORT, script_server.ScriptServer(controller).serve)
            self.reactor.listen(control_port, self.control.serve, freezable=False)
        except ValueError:
            self.reactor.close()
            raise

    def freeze_network(self, seconds: float) -> None:
        """Let no packet of the robot's own ports pass for a time; the robot goes on."""
        self._frozen_until_ns = time.perf_counter_ns() + round(seconds * 1e9)
        self.reactor.freeze(True)

    def freeze_controller(self, seconds: float) -> None:
        """Let the whole controller stand still for a time, its clock too."""
        self._halted_until_ns = time.perf_counter_ns() + round(seconds * 1e9)

    def stop(self) -> None:
        """Let `run` return after its step."""
        self._stopping = True

    def run(self) -> None:
        """Step and serve until stopped, then close all ports."""
        gc.collect()
        gc.freeze()  # what is there to stay needs no search for garbage
        due_ns = time.perf_counter_ns()
        cycle = 0
        try:
            while not self._stopping:
                self.reactor.serve_until(due_ns)
                now_ns = time.perf_counter_ns()
                if now_ns < self._halted_until_ns:
                    due_ns = min(self._halted_until_ns, now_ns + self._cycle_ns)
                    continue
                if self._frozen_until_ns and now_ns >= self._frozen_until_ns:
                    self._frozen_until_ns = 0
                    self.reactor.freeze(False)
                due_ns = self._next(due_ns, now_ns)
                self.controller.step()
                for call in self.after_step:
                    call()
                self.rtde.publish(cycle)
                cycle += 1
        finally:
            self.reactor.close()

    def _next(self, due_ns: int, now_ns: int) -> int:
        """When the step after the one that is due begins.

        Short delays are made up for, so that robot time keeps to wall time. After a stall they are not:
        steps in quick succession would show clients what no robot does. The robot's time stamps go on
        with the wall clock, as if packets had been lost.
        """
        late_ns = now_ns - due_ns
        if late_ns <= STALL_S * 1e9:
            self.pace.longest_s = max(self.pace.longest_s, late_ns * 1e-9)
            return due_ns + self._cycle_ns
        if self._halted_until_ns:
            self._halted_until_ns = 0
        else:
            self.pace.stalls += 1
            self.pace.longest_s = max(self.pace.longest_s, late_ns * 1e-9)
            self.controller.stood_still_s += late_ns * 1e-9
        return now_ns + self._cycle_ns

    def _orders(self) -> dict[str, Callable[[dict], dict]]:
        """What the control port does for the robot itself."""
        controller, rtde = self.controller, self.rtde
        return {
            "state": self._state,
            "freeze": self._freeze,
            "drop": lambda _: {"dropped": rtde.drop()},
            "protective_stop": _plain(controller.protective_stop),
            "emergency_stop": _plain(controller.emergency_stop),
            "release_emergency_stop": _plain(controller.release_emergency_stop),
            "remote_control": _switch(controller, "remote_control"),
            "script_starts": _switch(controller, "script_starts"),
            "registers_in_use": _switch(rtde, "registers_in_use"),
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
            "stalls": self.pace.stalls,
            "stood_still_s": controller.stood_still_s,
            "longest_delay_s": self.pace.longest_s,
        }

    def _freeze(self, fields: dict) -> dict:
        seconds = number(fields.get("seconds"), "seconds")
        if not 0 < seconds <= _LONGEST_FREEZE_S:
            raise ValueError(f"seconds: {seconds!r}, expected above 0 to {_LONGEST_FREEZE_S:g}")
        part = fields.get("part", "network")
        if part == "network":
            self.freeze_network(seconds)
        elif part == "controller":
            self.freeze_controller(seconds)
        else:
            raise ValueError(f"part: {part!r}, expected 'network' or 'controller'")
        return {}


def _plain(action: Callable[[], None]) -> Callable[[dict], dict]:
    """An order without fields and without an answer."""

    def order(_: dict) -> dict:
        action()
        return {}

    return order


def _switch(target: Any, name: str) -> Callable[[dict], dict]:
    """An order that sets an attribute to its field ``value``."""

    def order(fields: dict) -> dict:
        value = fields.get("value")
        if not isinstance(value, bool):
            raise ValueError(f"value: {value!r}, expected true or false")
        setattr(target, name, value)
        return {}

    return order
