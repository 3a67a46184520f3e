# SPDX-License-Identifier: Apache-2.0
"""How the program that serves an RTDE client waits for commands and does them.

The client uploads a URScript program that waits for command numbers in an input register. The
simulated controller does not interpret URScript; it runs this loop, which keeps the same protocol:
command in integer input 0, output 0 says 1 (ready) or 2 (done), results in integer output 1 and double
outputs 0 to 5, progress of asynchronous motions in integer output 2. All numbers are shifted by 24
where the program was made for the upper range.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable

from tactile_resonance.contact.vectors import Vector
from tactile_resonance.simulation.ur5e.poses import Transform, transform_from_pose
from tactile_resonance.simulation.ur5e.target import ScriptError, Thread
from tactile_resonance.simulation.ur5e.variables import (
    DOUBLE_INPUTS,
    INT_INPUTS,
    LARGEST_FIGURE,
    Registers,
)

# Commands that are done anew in every cycle in which they stand in the command register.
STREAMING = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58})

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
    found = re.search(r"reg_offset_int\s*=\s*(?:#[^\n]*\n\s*)?(\d{1,9})", text)
    if found is None or int(found[1]) not in (0, 24):
        raise ValueError("program: reg_offset_int not found; accepted are offsets of 0 and 24")
    return int(found[1])


Command = Callable[[], Thread | None]
"""What a command does; a generator where that takes time."""


class CommandLoop:
    """A running control program: its registers, its threads and its loop.

    Parameters
    ----------
    registers : Registers
    offset : int
        As `register_offset` returns it.

    Attributes
    ----------
    offset : int
        Added to all register numbers: 0 or 24.
    commands : dict of int to Command
        What it does, by the number of the command; whoever has them sets it.
    threads : dict of str to generator
        Running threads by name.
    watchdog_s : float or None
        Longest time without a refresh of the command register; None without a watchdog.
    internal_command : int
        Set by a thread for the main loop, where no command of the client waits.
    """

    def __init__(self, registers: Registers, offset: int) -> None:
        self.offset = offset
        self.commands: dict[int, Command] = {}
        self.threads: dict[str, Thread] = {}
        self.watchdog_s: float | None = None
        self.internal_command = 0
        self._registers = registers
        self._progress_writes = 0
        self._operation = 0
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
        for name, thread in list(self.threads.items()):
            if self.threads.get(name) is not thread:
                continue  # ended by one that stepped before it
            try:
                next(thread)
            except StopIteration:
                self.kill(name)
        return True

    def _loop(self) -> Thread:
        """Serve commands until the stop command: one look at the command register in each cycle.

        A streaming command is done anew as long as it stands in the register; any other once, until
        the client has taken it away.
        """
        self.tell_asynchronous(begins=False)
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
        if command not in self.commands:
            raise ScriptError(f"command {command}: not modelled")
        work = self.commands[command]()
        if work is not None:
            yield from work

    def run(self, name: str, thread: Thread) -> None:
        """Start a thread; it takes its first step in this cycle, after the main loop."""
        self.threads[name] = thread

    def kill(self, name: str) -> bool:
        """End a thread and say whether it was running."""
        return self.threads.pop(name, None) is not None

    def integer(self, number: int) -> int:
        """Return an integer input register."""
        return self._registers.inputs[INT_INPUTS[number + self.offset]]  # type: ignore[return-value]

    def double(self, number: int) -> float:
        """Return a double input register; raises as `doubles`."""
        return self.doubles(number, 1)[0]

    def vector(self, number: int) -> Vector:
        """Return three double input registers; raises as `doubles`."""
        x, y, z = self.doubles(number, 3)
        return x, y, z

    def pose(self, number: int = 0) -> Transform:
        """Return the transform of a pose in six double input registers; raises as `doubles`."""
        return transform_from_pose(self.doubles(number))

    def doubles(self, number: int = 0, count: int = 6) -> tuple[float, ...]:
        """Return double input registers.

        Raises
        ------
        ScriptError
            If one of them is not finite or beyond +-1e6.
        """
        first, inputs = number + self.offset, self._registers.inputs
        values = tuple([inputs[name] for name in DOUBLE_INPUTS[first : first + count]])
        if not (math.isfinite(sum(values)) and max(map(abs, values)) <= LARGEST_FIGURE):
            raise ScriptError(
                f"input_double_register_{first}...: {list(values)}; accepted are numbers within "
                f"+-{LARGEST_FIGURE:g}"
            )
        return values

    def status(self, value: int) -> None:
        """Write the state of the command loop."""
        self._registers.output_int[self.offset] = value

    def answer(self, value: int) -> None:
        """Write an integer result."""
        self._registers.output_int[1 + self.offset] = int(value)

    def answer_doubles(self, values: Iterable[float]) -> None:
        """Write a vector result."""
        for place, value in enumerate(values):
            self._registers.output_double[place + self.offset] = value

    def tell_asynchronous(self, *, begins: bool) -> None:
        """Tell that an asynchronous operation begins, or that none runs."""
        self._operation = (self._operation + begins) % _COUNTER_SPAN
        self._progress_writes = (self._progress_writes + 1) % _COUNTER_SPAN
        word = (self._operation << 24) + (self._progress_writes << 16) + begins * _RUNNING
        self._registers.output_int[2 + self.offset] = word
