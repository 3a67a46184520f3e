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

from tactile_resonance.simulation.ur5e.commands import commands
from tactile_resonance.simulation.ur5e.machine import Machine
from tactile_resonance.simulation.ur5e.registers import Registers, Script, Thread
from tactile_resonance.simulation.ur5e.target import ScriptError

# Commands that are done anew in every cycle in which they stand in the command register.
STREAMING = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58})

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


class Program(Script):
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
        super().__init__(registers, offset)
        self._commands = commands(self, machine)
        self._main = self._loop()

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
        self.step_threads()
        return True

    def _loop(self) -> Thread:
        """Serve commands until the stop command: one look at the command register in each cycle.

        A streaming command is done anew as long as it stands in the register; any other once, until
        the client has taken it away.
        """
        self.end_asynchronous()
        self.status(READY)
        executing = False
        while True:
            command = self.integer(0)
            if command == 0:
                command, self.internal_command = self.internal_command, 0
            if command in STREAMING:
                yield from self._execute(command)
                self.status(READY)
            elif command == 0:
                executing = False
                self.status(READY)
            elif not executing:
                if command == STOP_SCRIPT:
                    return
                yield from self._execute(command)
                self.status(DONE)
                executing = True
            yield

    def _execute(self, command: int) -> Thread:
        """Do a command; raises ScriptError where the model has none such, or refuses its arguments."""
        if command not in self._commands:
            raise ScriptError(f"command {command}: not modelled")
        work = self._commands[command]()
        if work is not None:
            yield from work
