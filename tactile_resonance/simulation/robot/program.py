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

from tactile_resonance.simulation.robot.commands import Commands
from tactile_resonance.simulation.robot.machine import Machine
from tactile_resonance.simulation.robot.registers import Registers
from tactile_resonance.simulation.robot.script import Script, Thread

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
        self._commands = Commands(self._script, machine)
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
            if command in self._commands.STREAMING:
                yield from self._commands.execute(command)
                script.status(READY)
            elif command == 0:
                executing = False
                script.status(READY)
            elif not executing:
                if command == STOP_SCRIPT:
                    return
                yield from self._commands.execute(command)
                script.status(DONE)
                executing = True
            yield
