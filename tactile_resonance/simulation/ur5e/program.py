# SPDX-License-Identifier: Apache-2.0
"""The program that serves an RTDE client.

The client uploads a URScript program that waits for command numbers in an input register. The
simulated controller does not interpret URScript; it runs this loop, which keeps the same protocol:
command in integer input 0, output 0 says 1 (ready) or 2 (done), results in integer output 1 and double
outputs 0 to 5, progress of asynchronous motions in integer output 2. All numbers are shifted by 24
where the program was made for the upper range.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from tactile_resonance.simulation.ur5e.commands import (
    CONTACT_FOUND,
    MotionCommands,
    SettingCommands,
)
from tactile_resonance.simulation.ur5e.machine import Machine
from tactile_resonance.simulation.ur5e.registers import Registers, Script, Thread
from tactile_resonance.simulation.ur5e.target import ScriptError

# Commands that are done anew in every cycle in which they stand in the command register.
STREAMING = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58})


def _commands(script: Script, machine: Machine) -> dict[int, Callable[[], Thread | None]]:
    """What the client's program does, by the number of the command."""
    moves = MotionCommands(script, machine)
    settings = SettingCommands(script, machine)
    return {
        1: moves.movej, 2: moves.movej_pose, 3: moves.movel, 4: moves.movel_joints,
        6: settings.force_mode, 7: settings.end_force_mode, 8: machine.sensor.zero,
        9: moves.speedj, 10: moves.speedl, 11: moves.servoj, 15: moves.speed_stop,
        16: moves.servo_stop, 17: settings.set_payload, 20: settings.set_damping,
        21: settings.set_gain, 24: moves.servol, 25: settings.tool_contact,
        26: settings.step_time, 27: settings.past_joints, 29: settings.set_tcp,
        30: settings.inverse_near, 31: settings.protective_stop, 33: moves.stop,
        34: moves.stop, 35: settings.set_watchdog, 36: settings.pose_within_limits,
        37: settings.joints_within_limits, 38: settings.joint_torques,
        39: settings.pose_trans, 40: settings.tcp_offset, 41: moves.start_jog,
        42: moves.stop_jog, 43: settings.actual_forward, 44: settings.forward,
        46: settings.inverse, 47: settings.steady, 51: moves.move_until_contact,
        56: settings.external_sensor, 57: settings.external_sensor,
        58: settings.flange_pose, 59: settings.set_gravity, 60: settings.has_inverse,
        61: settings.has_inverse, 62: moves.start_contact, 63: moves.stop_contact,
        64: moves.read_contact, 65: settings.set_target_payload,
        CONTACT_FOUND: moves.back_to_contact,
    }  # fmt: skip


READY, DONE = 1, 2
STOP_SCRIPT = 255

# Force mode as the client's program sets it when it starts.
_GAIN_SCALING, _DAMPING = 0.5, 0.025


def register_offset(text: str) -> int:
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


class Program:
    """A running control program.

    Parameters
    ----------
    machine : Machine
        The arm that it moves.
    registers : Registers
    offset : int
        As `register_offset` returns it.
    """

    def __init__(self, machine: Machine, registers: Registers, offset: int) -> None:
        machine.force_mode.gain_scaling = _GAIN_SCALING
        machine.force_mode.damping = _DAMPING
        self._script = Script(registers, offset)
        self._commands = _commands(self._script, machine)
        self._main = self._loop()

    @property
    def command_register(self) -> str:
        """RTDE name of the register that carries the commands."""
        return f"input_int_register_{self._script.offset}"

    @property
    def watchdog_s(self) -> float | None:
        """Longest time without a refresh of the command register; None without a watchdog."""
        return self._script.watchdog_s

    def step(self) -> bool:
        """Run one cycle, the main loop before the threads; False once the program has ended.

        Raises
        ------
        ScriptError, ProtectiveStop
            See `Target.command`; the program is over then.
        """
        try:
            next(self._main)
        except StopIteration:
            return False
        self._script.step_threads()
        return True

    def _loop(self) -> Thread:
        """Serve commands until the stop command: one look at the command register in each cycle.

        A streaming command is done anew as long as it stands in the register; any other once, until
        the client has taken it away.
        """
        script = self._script
        script.end_asynchronous()
        script.status(READY)
        executing = False
        while True:
            command = script.integer(0)
            if command == 0:
                command, script.internal_command = script.internal_command, 0
            if command in STREAMING:
                yield from self._execute(command)
                script.status(READY)
            elif command == 0:
                executing = False
                script.status(READY)
            elif not executing:
                if command == STOP_SCRIPT:
                    return
                yield from self._execute(command)
                script.status(DONE)
                executing = True
            yield

    def _execute(self, command: int) -> Thread:
        """Do a command; raises ScriptError where the model has none such, or refuses its arguments."""
        if command not in self._commands:
            raise ScriptError(f"command {command}: not modelled")
        work = self._commands[command]()
        if work is not None:
            yield from work
