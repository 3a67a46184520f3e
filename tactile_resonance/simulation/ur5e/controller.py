# SPDX-License-Identifier: Apache-2.0
"""A simulated UR5e with its e-series controller, stepped in robot time.

Here are power, brakes and stops of the robot, and what brings registers, program, arm and outputs together.
Numbers of modes and bits: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".

What it is not: URScript is not interpreted (the client's control program is known by its name, other
programs are refused), paths with blends, teach mode, freedrive and direct torque are not modelled. The
arm has no dynamics beyond dead time, lag and vibration: nothing makes it deviate but force mode, no
collision is detected but by the measured force. Where the maker publishes no figure (force mode's
gains, the threshold of tool contact, servoj's gain, currents) the model's own stands beside its name.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from enum import IntEnum

import numpy as np

from tactile_resonance.contact.vectors import largest
from tactile_resonance.simulation.noise import Seed
from tactile_resonance.simulation.ur5e.commands import Program
from tactile_resonance.simulation.ur5e.machine import Environment, Machine, MachineConfig
from tactile_resonance.simulation.ur5e.target import CYCLE_S, ProtectiveStop, ScriptError
from tactile_resonance.simulation.ur5e.variables import (
    INT_INPUTS,
    LARGEST_FIGURE,
    OUTPUTS,
    InputValue,
    OutputValue,
    Registers,
)

# Lines of the controller's log that are kept.
_LOG_LINES = 200
# Joints slower than this are at rest when power is removed [rad/s]; above their wander.
_AT_REST_RAD_S = 0.05
# Measured force at the TCP beyond which the robot stops [N]; a setting of the safety configuration.
_TOOL_FORCE_N = 150.0
# Major, minor, bugfix, build.
POLYSCOPE = (5, 21, 0, 0)
SERIAL_NUMBER = "20265500001"


class RobotMode(IntEnum):
    """RTDE output ``robot_mode``."""

    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """RTDE output ``safety_mode``."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


# Bits of RTDE output ``safety_status_bits``.
_STATUS_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}

# After a protective stop the robot refuses to be unlocked for this long [s] (dashboard server manual).
UNLOCK_DELAY_S = 5.0
# Time that powering on and releasing the brakes take each [s]; seconds on a real robot.
SWITCHING_S = 0.2


class RefusedError(Exception):
    """The controller refuses what was asked of it, as its dashboard would answer."""


class RuntimeState(IntEnum):
    """RTDE output ``runtime_state``."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2


class UrController:
    """A UR5e and its controller.

    Between steps clients write inputs and read outputs; `step` advances robot time by 2 ms.

    Attributes
    ----------
    machine : Machine
        The arm.
    robot_mode : RobotMode
    safety_mode : SafetyMode
    registers : Registers
    program : Program or None
        The program that runs.
    stood_still_s : float
        What the time stamps are ahead of robot time [s]: how long the simulation stood still.
    runtime_state : RuntimeState
    remote_control : bool
        Whether a network client may start programs.
    script_starts : bool
        False: an uploaded program is taken and never starts (a fault to be injected).
    popup : str or None
        Open on the pendant.
    log : deque of str
        Newest lines of the controller's log, time stamped.
    """

    def __init__(
        self,
        config: MachineConfig | None = None,
        environment: Environment | None = None,
        seed: Seed = 0,
    ) -> None:
        self.machine: Machine = Machine(
            config or MachineConfig(), environment, np.random.default_rng(seed)
        )
        self.robot_mode: RobotMode = RobotMode.RUNNING
        self.safety_mode: SafetyMode = SafetyMode.NORMAL
        self.registers: Registers = Registers()
        self.program: Program | None = None
        self.runtime_state: RuntimeState = RuntimeState.STOPPED
        self.remote_control = True
        self.script_starts = True
        self.popup: str | None = None
        self.log: deque[str] = deque(maxlen=_LOG_LINES)
        self.stood_still_s: float = 0.0
        self._cycles = 0
        self._refreshed_s = 0.0
        self._next_mode: RobotMode | None = None
        self._due_s = 0.0  # when that is reached
        self._stopped_s = 0.0

    @property
    def time_s(self) -> float:
        """Robot time since power-up [s]."""
        return self._cycles * CYCLE_S

    def reseed(self, seed: Seed) -> None:
        """Let all noise from the next step on be that of a seed, whatever was drawn before.

        Vibration and drift begin anew, somewhere in their stationary distribution; the offset of the
        flange's sensor is no noise and stays.
        """
        self.machine.reseed(np.random.default_rng(seed))

    @property
    def may_move(self) -> bool:
        """Brakes released, no stop in force."""
        return self.powered and self.safety_mode is SafetyMode.NORMAL

    @property
    def powered(self) -> bool:
        """Whether motors, not brakes, hold the joints."""
        return self.robot_mode is RobotMode.RUNNING

    @property
    def status_bits(self) -> int:
        """RTDE output ``robot_status_bits``: power in bit 0, a running program in bit 1."""
        powered = self.robot_mode is not RobotMode.POWER_OFF
        return int(powered) | int(self.program is not None) << 1

    @property
    def safety_status_bits(self) -> int:
        """RTDE output of this name."""
        return _STATUS_BITS[self.safety_mode]

    @property
    def rests(self) -> bool:
        """Whether nothing has moved for a while, and nothing is touched."""
        return self.machine.rests and self.runtime_state is not RuntimeState.STOPPING

    def write_inputs(self, values: Mapping[str, InputValue]) -> None:
        """Take one package of RTDE inputs, by name; raises as `Registers.write`.

        The way to write registers: a watchdog counts what is written here, whatever the value.
        """
        self.registers.write(values)
        if "external_force_torque" in values:
            wrench = np.array(values["external_force_torque"], dtype=float).tolist()
            if all(abs(value) <= LARGEST_FIGURE for value in wrench):
                self.machine.external_wrench = tuple(wrench)
            elif self.machine.external is not None:
                self.protective_stop(f"external_force_torque {wrench}")

    def outputs(self, name: str) -> OutputValue:
        """Return an RTDE output: an int or a float, for vectors a list of them.

        Raises
        ------
        KeyError
            Where the output is not known.
        """
        if name not in OUTPUTS:
            raise KeyError(f"RTDE output {name!r}: not known")
        value = OUTPUTS[name][1](self)
        return list(value) if isinstance(value, tuple) else value

    def start_program(self, text: str) -> None:
        """Run the client's control program, in place of one that runs.

        Raises
        ------
        ValueError
            Where the text is another program.
        RefusedError
            Not in remote control, without power, or during a stop.
        """
        offset = _register_offset(text)
        if not self.remote_control:
            raise RefusedError("not in remote control: the program is ignored")
        if not self.may_move:
            raise RefusedError(
                f"robot mode {self.robot_mode.name}, safety mode {self.safety_mode.name}: "
                "the program is ignored"
            )
        if not self.script_starts:
            self._note("program taken, not started")
            return
        self._end_program("replaced by another program")
        self.program = Program(self.machine, self.registers, offset)
        self.runtime_state = RuntimeState.PLAYING
        self._note("program started")

    def stop_program(self) -> None:
        """End the program and brake."""
        self._end_program("stopped")

    def power_on(self) -> None:
        """Power the arm; its brakes stay closed. Raises RefusedError during a stop."""
        self._require_normal("power on")
        if self.robot_mode is RobotMode.POWER_OFF:
            self.robot_mode = RobotMode.POWER_ON
            self._switch(RobotMode.IDLE)

    def brake_release(self) -> None:
        """Release the brakes, powering the arm first where it is off. Raises RefusedError during a stop."""
        self._require_normal("release brakes")
        if self.robot_mode is RobotMode.POWER_OFF:
            self.robot_mode = RobotMode.POWER_ON
        if not self.powered:
            self._switch(RobotMode.RUNNING)

    def power_off(self) -> None:
        """Close the brakes and remove power; ends the program."""
        self._end_program("power off")
        self.robot_mode, self._next_mode = RobotMode.POWER_OFF, None
        self.machine.catch_with_brakes()

    def protective_stop(self, reason: str = "injected") -> None:
        """Stop, power kept, until unlocked; ends the program."""
        if self.safety_mode is SafetyMode.NORMAL:
            self.safety_mode = SafetyMode.PROTECTIVE_STOP
            self._stopped_s = self.time_s
        self._end_program(f"protective stop: {reason}")

    def unlock_protective_stop(self) -> None:
        """End a protective stop.

        Raises
        ------
        RefusedError
            Within 5 s of the stop.
        """
        if self.safety_mode is not SafetyMode.PROTECTIVE_STOP:
            return
        if self.time_s - self._stopped_s < UNLOCK_DELAY_S:
            raise RefusedError(
                "Cannot unlock protective stop until 5s after occurrence. "
                "Always inspect cause of protective stop before unlocking"
            )
        self.safety_mode = SafetyMode.NORMAL

    def emergency_stop(self) -> None:
        """Press the emergency stop: brake, then remove power; ends the program."""
        self.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP
        self._end_program("emergency stop")

    def release_emergency_stop(self) -> None:
        """Release the button; the arm stays without power."""
        if self.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP:
            self.safety_mode = SafetyMode.NORMAL

    def close_popup(self) -> None:
        """Close the popup on the pendant."""
        self.popup = None

    def step(self) -> None:
        """Advance robot time by one cycle of 2 ms."""
        self._cycles += 1
        target = self.machine.target
        target.begin_cycle()
        target.pace = self.registers.speed_slider
        self._watch()
        if self.program is not None:
            self._run_program()
        self.machine.step(self.powered)
        force = self.machine.pressed_n
        if force > _TOOL_FORCE_N and self.may_move:
            self.protective_stop(f"force of {force:.0f} N at the tool")
        if self._next_mode is not None and self.time_s >= self._due_s:
            self.robot_mode, self._next_mode = self._next_mode, None
        if self.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP:
            at_rest = not any(target.qd) and largest(self.machine.qd) < _AT_REST_RAD_S
            if at_rest and self.robot_mode is not RobotMode.POWER_OFF:
                self.power_off()
        if self.runtime_state is RuntimeState.STOPPING and not any(target.qd):
            self.runtime_state = RuntimeState.STOPPED

    def _run_program(self) -> None:
        assert self.program is not None
        try:
            if not self.program.step():
                self._end_program("ended by its client")
            if self.machine.force_mode.task is not None:
                self.machine.force_mode.step(self.machine.tcp_force)
        except ProtectiveStop as stop:
            self.protective_stop(str(stop))
        except ScriptError as error:
            self.popup = f"Runtime error: {error}"
            self._end_program(str(error))

    def _watch(self) -> None:
        """End the program where its client refreshes the command register too seldom."""
        program = self.program
        if program is not None and program.watchdog_s is not None:
            if INT_INPUTS[program.offset] in self.registers.refreshed:
                self._refreshed_s = self.time_s
            elif self.time_s - self._refreshed_s > program.watchdog_s + CYCLE_S / 2:
                self._end_program("RTDE watchdog: the command register was not refreshed in time")
        else:
            self._refreshed_s = self.time_s
        self.registers.refreshed.clear()

    def _end_program(self, reason: str) -> None:
        if self.program is not None:
            self.program = None
            self.machine.force_mode.end()
            self.runtime_state = RuntimeState.STOPPING
            self._note(f"program: {reason}")

    def _require_normal(self, action: str) -> None:
        if self.safety_mode is not SafetyMode.NORMAL:
            raise RefusedError(f"cannot {action} in safety mode {self.safety_mode.name}")

    def _switch(self, mode: RobotMode) -> None:
        self._next_mode, self._due_s = mode, self.time_s + SWITCHING_S

    def _note(self, line: str) -> None:
        self.log.append(f"{self.time_s:.3f} s {line}")


def _register_offset(text: str) -> int:
    """Return the register offset of a client's control program.

    Raises
    ------
    ValueError
        Where the text is not that program, or its offset is neither 0 nor 24.
    """
    if "def rtde_control():" not in text or not text.rstrip().endswith("end"):
        raise ValueError(
            f"program: got {text[:40]!r}...; accepted is a complete program 'def rtde_control():' ... "
            "'end', as RTDE clients of ur_rtde upload it"
        )
    found = re.search(r"reg_offset_int\s*=\s*(?:#[^\n]*\n\s*)?(\d{1,9})", text)
    if found is None or int(found[1]) not in (0, 24):
        raise ValueError("program: reg_offset_int not found; accepted are offsets of 0 and 24")
    return int(found[1])
