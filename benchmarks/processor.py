# SPDX-License-Identifier: Apache-2.0
"""Processor time of processes, and how fast the processor is."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

LOOP = compile("n = 0\nfor _ in range(5_000_000):\n    n += 1\n", "loop", "exec")
FFT_SAMPLES, FFTS = 160_000, 20


def cpu_s(pid: int) -> float:
    """Processor time of all threads of a process so far [s] (proc(5), fields 14 and 15 of stat)."""
    fields = _stat(pid)
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def children(pid: int) -> dict[int, list[str]]:
    """Command line of each child of a process, by its id."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if int(_stat(int(path.name))[1]) == pid:
                found[int(path.name)] = (path / "cmdline").read_text().split("\0")
        except (OSError, IndexError):  # it has ended meanwhile
            continue
    return found


def loop_s() -> float:
    """Processor time of a Python loop of 5 million additions, as a script has it: on globals [s]."""
    begun_s = time.process_time()
    exec(LOOP, {})  # in a function it takes half as long
    return time.process_time() - begun_s


def fft_s() -> float:
    """Processor time of numpy's real FFT of two channels of 160000 samples in double precision [s]."""
    channels = np.random.default_rng(0).standard_normal((2, FFT_SAMPLES))
    np.fft.rfft(channels)  # makes its tables
    begun_s = time.process_time()
    for _ in range(FFTS):
        np.fft.rfft(channels)
    return (time.process_time() - begun_s) / FFTS


def _stat(pid: int) -> list[str]:
    """Fields of stat from the third on; the second is a name that may hold anything."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
