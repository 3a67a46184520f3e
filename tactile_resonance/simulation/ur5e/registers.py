# SPDX-License-Identifier: Apache-2.0
"""RTDE inputs of the controller, and what a running program works with: its registers and threads."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable, Mapping, Sequence

from tactile_resonance.contact.vectors import Vector
from tactile_resonance.simulation.ur5e.poses import Transform, transform_from_pose
from tactile_resonance.simulation.ur5e.target import ScriptError

# Numbers 0 to 23 are the lower range, 24 to 47 the upper one.
REGISTER_COUNT = 48
# Larger figures are refused: sums and squares of them would not be finite.
LARGEST_FIGURE = 1e6


# RTDE names of the inputs, by number.
INT_INPUTS = tuple(f"input_int_register_{n}" for n in range(REGISTER_COUNT))
DOUBLE_INPUTS = tuple(f"input_double_register_{n}" for n in range(REGISTER_COUNT))
_REGISTERS = frozenset({*INT_INPUTS, *DOUBLE_INPUTS})


class Registers:
    """Registers of a controller.

    Attributes
    ----------
    inputs : dict
        Written by clients, by their RTDE names: of `INT_INPUTS` integers, of `DOUBLE_INPUTS` floats.
    output_int, output_double : lists of 48
        Written by the program.
    refreshed : set of str
        Names of inputs written since the last cycle, with whatever value: what a watchdog watches.
    """

    def __init__(self) -> None:
        self.inputs: dict[str, float] = dict.fromkeys(INT_INPUTS, 0)
        self.inputs.update(dict.fromkeys(DOUBLE_INPUTS, 0.0))
        self.output_int = [0] * REGISTER_COUNT
        self.output_double = [0.0] * REGISTER_COUNT
        self.refreshed: set[str] = set()


# Types of all inputs, as the RTDE guide names them.
INPUT_TYPES: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    **dict.fromkeys(INT_INPUTS, "INT32"),
    **dict.fromkeys(DOUBLE_INPUTS, "DOUBLE"),
}

# Groups of digital outputs and their first bit in the word of all.
_DIGITAL = {"standard": 0, "configurable": 8, "tool": 16}

InputValue = float | int | Sequence[float]


class Ports:
    """Digital and analogue outputs and the speed slider.

    Attributes
    ----------
    digital_inputs, digital_outputs : int
        Bits 0-7 standard, 8-15 configurable, 16-17 tool.
    analog_outputs : list of 2 floats
        As written, 0 to 1 of the range.
    speed_slider : float
        Above 0 to 1.
    """

    def __init__(self) -> None:
        self.digital_inputs = 0
        self.digital_outputs = 0
        self.analog_outputs = [0.0, 0.0]
        self.speed_slider = 1.0

    def write(self, values: Mapping[str, InputValue]) -> None:
        """Take the inputs of one package; only what its masks select is written."""
        if _REGISTERS.issuperset(values):
            return

        def number(name: str) -> float:
            value = values.get(name, 0)
            assert not isinstance(value, Sequence)
            return value

        for group, first in _DIGITAL.items():
            mask = int(number(f"{group}_digital_output_mask")) << first
            bits = int(number(f"{group}_digital_output")) << first
            self.digital_outputs = (self.digital_outputs & ~mask) | (bits & mask)
        for channel in range(2):
            if int(number("standard_analog_output_mask")) >> channel & 1:
                self.analog_outputs[channel] = number(f"standard_analog_output_{channel}")
        if int(number("speed_slider_mask")):
            self.speed_slider = min(1.0, max(0.0, number("speed_slider_fraction")))


def write_registers(registers: Registers, values: Mapping[str, InputValue]) -> None:
    """Write general purpose registers by their RTDE names, and note them as refreshed."""
    if not _REGISTERS.issuperset(values):
        values = {name: value for name, value in values.items() if name in _REGISTERS}
    registers.inputs.update(values)  # type: ignore[arg-type]
    registers.refreshed.update(values)


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

    def doubles(self, number: int, count: int = 6) -> tuple[float, ...]:
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
