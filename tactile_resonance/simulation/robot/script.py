# SPDX-License-Identifier: Apache-2.0
"""What a running program works with: its registers, its threads, its word on progress."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from tactile_resonance.contact.vectors import Vector
from tactile_resonance.simulation.robot.ports import LARGEST_FIGURE, Registers
from tactile_resonance.simulation.robot.target import ScriptError

# Steps once in a cycle, until it is done.
Thread = Generator[None, None, None]

# An asynchronous motion's progress word: counters of 7 bits, then a flag, then 15 bits of progress.
_COUNTER_SPAN = 128
_RUNNING = 1 << 15


class Script:
    """Registers and threads of a running program.

    Attributes
    ----------
    offset : int
        Added to all register numbers: 0 or 24.
    threads : dict of str to generator
        Running threads by name.
    watchdog_s : float or None
        Longest time without a refresh of the command register; None without a watchdog.
    internal_command : int
        Set by a thread for the main loop, where no command of the client waits.
    """

    def __init__(self, registers: Registers, offset: int) -> None:
        self.offset = offset
        self.threads: dict[str, Thread] = {}
        self.watchdog_s: float | None = None
        self.internal_command = 0
        self._registers = registers
        self._progress_writes = 0
        self._operation = 0

    def run(self, name: str, thread: Thread) -> None:
        """Start a thread; it takes its first step in this cycle, after the main loop."""
        self.threads[name] = thread

    def kill(self, name: str) -> bool:
        """End a thread and say whether it was running."""
        return self.threads.pop(name, None) is not None

    def step_threads(self) -> None:
        """Step each thread once and drop those that are done."""
        for name, thread in list(self.threads.items()):
            if self.threads.get(name) is not thread:
                continue  # ended by one that stepped before it
            try:
                next(thread)
            except StopIteration:
                self.kill(name)

    def integer(self, number: int) -> int:
        """Return an integer input register."""
        return self._registers.input_int[number + self.offset]

    def double(self, number: int) -> float:
        """Return a double input register; raises as `doubles`."""
        return self.doubles(number, 1)[0]

    def vector(self, number: int) -> Vector:
        """Return three double input registers; raises as `doubles`."""
        x, y, z = self.doubles(number, 3)
        return x, y, z

    def doubles(self, number: int, count: int = 6) -> tuple[float, ...]:
        """Return double input registers.

        Raises
        ------
        ScriptError
            If one of them is not finite or beyond +-1e6.
        """
        first = number + self.offset
        values = self._registers.input_double[first : first + count]
        for value in values:
            if not -LARGEST_FIGURE <= value <= LARGEST_FIGURE:
                raise ScriptError(
                    f"input_double_register_{first}...: {values}; accepted are numbers within "
                    f"+-{LARGEST_FIGURE:g}"
                )
        return tuple(values)

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
