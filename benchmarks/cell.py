# SPDX-License-Identifier: Apache-2.0
"""The load cell's driver on the wall clock: wrenches lost, their age, CPU, and how soon faults are found.

The simulated cell is a process of its own (`tactile_resonance simulate-cell`); the driver uses python-can as it
is installed, on a socketcand bus over loopback, and is read as a control loop of 500 Hz reads it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.processor import cpu_s
from tactile_resonance.contact.interfaces import ForceError
from tactile_resonance.drivers.can_wrench import CanWrench
from tactile_resonance.drivers.force_config import CanForce, read_force_config

HOST = "127.0.6.5"
LOOP_S = 0.002
FAULTS = (
    ("silent 1", "silent"),
    ("stuck 1", "stuck"),
    ("lose_second_every 1", "second frame of every wrench lost"),
    ("invalid 1", "count of an invalid value"),
    ("saturated 1", "full scale"),
    ("flipped 1", "sign flipped (30 mN on the cell)"),
    ("bias_step_n 0.03", "bias step of 30 mN"),
)


class Cell:
    """The simulated cell's process."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tactile_resonance.cli", "simulate-cell"]
        self.process = subprocess.Popen(
            [*command, "--host", HOST, "--port", "0"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline().rsplit(":", 1)[1])

    def say(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def end(self) -> None:
        self.process.terminate()
        self.process.wait(5.0)


def run(output: Path, quick: bool) -> str:
    """Measure; return the page."""
    seconds, repeats = (5.0, 3) if quick else (60.0, 20)
    cell = Cell()
    try:
        config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
        assert isinstance(config, CanForce)
        bus = {**config.bus, "host": HOST, "port": cell.port}
        config = replace(config, bus=bus)
        text = _stream(config, cell, seconds) + _faults(config, cell, repeats)
    finally:
        cell.end()
    return text


def _stream(config: CanForce, cell: Cell, seconds: float) -> str:
    # a stalled machine is measured here, not called a fault
    source = CanWrench(replace(config, limits=replace(config.limits, silent_s=1.0)))
    source.start()
    own, its = cpu_s(os.getpid()), cpu_s(cell.process.pid)
    begin_s = due_s = time.monotonic()
    stamps: list[int] = []
    ages_s: list[float] = []
    first = source.received
    while (now_s := time.monotonic()) < begin_s + seconds:
        samples = source.read()
        if samples:
            ages_s.append((time.monotonic_ns() - samples[-1].time_ns) * 1e-9)
            stamps += [sample.time_ns for sample in samples]
        due_s = max(due_s + LOOP_S, now_s)
        time.sleep(max(0.0, due_s - time.monotonic()))
    elapsed_s = time.monotonic() - begin_s
    own, its = cpu_s(os.getpid()) - own, cpu_s(cell.process.pid) - its
    count, lost = source.received - first, source.lost
    clock_s = source.clock_uncertainty_s
    source.close()
    # the cell sends one each millisecond of its own clock, which the stamps follow
    sent = round((stamps[-1] - stamps[0]) * 1e-6) + 1
    middle, high, top = np.quantile(ages_s, [0.5, 0.99, 1.0]) * 1e3
    return f"""# Load cell on CAN

`tactile_resonance benchmark cell`: the simulated cell in a process of its own, read through python-can and
socketcand on loopback by a loop of 500 Hz. Simulated: nothing here was measured on a sensor.

| Figure | Value |
|---|---|
| time | {elapsed_s:.1f} s |
| wrenches received | {count} ({count / elapsed_s:.1f} /s) |
| wrenches in the loop, of those that the cell sent meanwhile | {len(stamps)} of {sent} |
| of which a frame was lost | {lost} |
| age of the newest wrench in the loop, median / 99 % / largest | {middle:.2f} / {high:.2f} / {top:.2f} ms |
| stated uncertainty of the time stamps | {clock_s * 1e3:.3f} ms |
| CPU of one core, driver with its loop / simulated cell | {own / elapsed_s:.0%} / {its / elapsed_s:.0%} |

"""


def _faults(config: CanForce, cell: Cell, repeats: int) -> str:
    rows = [
        "From the line that makes the cell faulty to the error in the loop of 500 Hz "
        f"({repeats} times each):\n",
        "| Fault | error | median ms | largest ms |",
        "|---|---|---|---|",
    ]
    source = CanWrench(config)
    for line, name in FAULTS:
        waits_s: list[float] = []
        errors: set[str] = set()
        while len(waits_s) < repeats:
            found = _time_to_fault(source, cell, line)
            cell.say(f"{line.split()[0]} 0")
            time.sleep(0.05)
            if found is not None:
                waits_s.append(found[0])
                errors.add(found[1])
        middle, top = np.median(waits_s) * 1e3, np.max(waits_s) * 1e3
        rows.append(f"| {name} | {', '.join(sorted(errors))} | {middle:.1f} | {top:.1f} |")
    source.close()
    return "\n".join(rows) + "\n"


def _time_to_fault(source: CanWrench, cell: Cell, line: str) -> tuple[float, str] | None:
    """Seconds and name; None where this machine stalled before the fault."""
    try:
        source.start()
        _read_for(source, 0.05)
    except ForceError:
        return None
    cell.say(line)
    begin_s = time.monotonic()
    try:
        _read_for(source, 2.0)
    except ForceError as error:
        return time.monotonic() - begin_s, error.fault.value
    raise RuntimeError(f"{line}: no error within 2 s")


def _read_for(source: CanWrench, seconds: float) -> None:
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        source.read()
        time.sleep(LOOP_S)
