# SPDX-License-Identifier: Apache-2.0
"""The program that serves an RTDE client: its command loop, its threads, its registers.

The client uploads a URScript program that waits for command numbers in an input register. The
simulated controller does not interpret URScript; it runs this loop, which keeps the same protocol:
command in integer input 0, output 0 says 1 (ready) or 2 (done), results in integer output 1 and double
outputs 0 to 5, progress of asynchronous motions in integer output 2. All numbers are shifted by 24
where the program was made for the upper range.
"""

from __future__ import annotations

import re
from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.commands import Commands
from tactile_resonance.simulation.robot.machine import Machine
from tactile_resonance.simulation.robot.registers import Registers

FloatArray = NDArray[np.float64]
Thread = Generator[None, None, None]

READY, DONE = 1, 2
STOP_SCRIPT = 255

# An asynchronous motion's progress word: counters of 7 bits, then a flag, then 15 bits of progress.
_COUNTER_SPAN = 128
_RUNNING = 1 << 15


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
    found = re.search(r"reg_offset_int\s*=\s*(?:#[^\n]*\n\s*)?(\d+)", text)
    if found is None or int(found[1]) not in (0, 24):
        raise ValueError("program: reg_offset_int not found; accepted are offsets of 0 and 24")
    return int(found[1])


class Program:
    """A running control program.

    Attributes
    ----------
    machine : Machine
    threads : dict of str to generator
        Running threads: speed, servo, move, stop, contact, jog.
    watchdog_s : float or None
        Longest time without a refresh of the command register; None without a watchdog.
    internal_command : int
        Set by a thread for the main loop, where no command of the client waits.
    """

    def __init__(self, machine: Machine, registers: Registers, offset: int) -> None:
        self.machine = machine
        self.offset = offset
        self.threads: dict[str, Thread] = {}
        self.watchdog_s: float | None = None
        self.internal_command = 0
        self._registers = registers
        self._progress_writes = 0
        self._operation = 0
        self._commands = Commands(self)
        self._main = self._loop()

    @property
    def command_register(self) -> str:
        """RTDE name of the register that carries the commands."""
        return f"input_int_register_{self.offset}"

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
        for name, thread in list(self.threads.items()):
            if self.threads.get(name) is not thread:
                continue
            try:
                next(thread)
            except StopIteration:
                self.kill(name)
        return True

    def run(self, name: str, thread: Thread) -> None:
        """Start a thread; it takes its first step in this cycle, after the main loop."""
        self.threads[name] = thread

    def kill(self, name: str) -> bool:
        """End a thread and say whether it was running."""
        return self.threads.pop(name, None) is not None

    def integer(self, number: int) -> int:
        """Return an integer input register."""
        return self._registers.input_int[number + self.offset]

    def double(self, number: int) -> float:
        """Return a double input register."""
        return self._registers.input_double[number + self.offset]

    def doubles(self, number: int, count: int = 6) -> FloatArray:
        """Return double input registers, shape (count,)."""
        first = number + self.offset
        return np.array(self._registers.input_double[first : first + count], dtype=float)

    def answer(self, value: int) -> None:
        """Write an integer result."""
        self._registers.output_int[1 + self.offset] = int(value)

    def answer_doubles(self, values: FloatArray) -> None:
        """Write a vector result."""
        for place, value in enumerate(values.tolist()):
            self._registers.output_double[place + self.offset] = value

    def begin_asynchronous(self) -> None:
        """Tell that an asynchronous operation begins."""
        self._operation = (self._operation + 1) % _COUNTER_SPAN
        self._write_progress(_RUNNING)

    def end_asynchronous(self) -> None:
        """Tell that no asynchronous operation runs."""
        self._write_progress(0)

    def _write_progress(self, state: int) -> None:
        self._progress_writes = (self._progress_writes + 1) % _COUNTER_SPAN
        word = (self._operation << 24) + (self._progress_writes << 16) + state
        self._registers.output_int[2 + self.offset] = word

    def _status(self, value: int) -> None:
        self._registers.output_int[self.offset] = value

    def _loop(self) -> Thread:
        """Serve commands until told to stop: one look at the command register in each cycle.

        A streaming command is done anew as long as it stands in the register; any other once, until
        the client has taken it away.
        """
        self.machine.force_mode.gain_scaling = 0.5
        self.machine.force_mode.damping = 0.025
        self.end_asynchronous()
        self._status(READY)
        executing = False
        while True:
            command = self.integer(0)
            if command == 0:
                command, self.internal_command = self.internal_command, 0
            if command in self._commands.STREAMING:
                yield from self._commands.execute(command)
                self._status(READY)
            elif command == 0:
                executing = False
                self._status(READY)
            else:
                if not executing:
                    if command == STOP_SCRIPT:
                        return
                    yield from self._commands.execute(command)
                    self._status(DONE)
                executing = True
            yield
