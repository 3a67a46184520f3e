# SPDX-License-Identifier: Apache-2.0
"""The demo under loads of the machine: its results against the truth, and its duration.

In simulated time a load may make the demo slower and change nothing else: every point is measured at the
first attempt, the same tissues are called, and every force and every pole is within 4 of its standard
deviations of the truth. On the wall clock every point must be measured, and the demo may take 1.5 times as
long beside the busy loops and twice as long without real-time priority. `make load` refuses what exceeds
that, and writes this page. All of it is simulated; none of it is a measurement on a sensor.
"""

from __future__ import annotations

import os
import signal
import tempfile
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.load_case import (
    BRIEFLY,
    NODES,
    Demonstration,
    Findings,
    Load,
    demonstrate,
    faults,
    findings,
)
from benchmarks.processor import fft_s, loop_s
from tactile_resonance.commands.benchmark import write_page
from tactile_resonance.configuration import share_path
from tactile_resonance.processes import free_domain_id

HOST = "127.0.81.1"
IDLE = Load("no load")
LOADS = (
    Load("two busy loops", busy_loops=2),
    Load("without real-time priority", without_priority=True),
    Load("all on one core", pinned=True),
    Load("one core and two busy loops", pinned=True, busy_loops=2),
    Load("throttled to a quarter", throttled=True),
    Load("each process stopped once", stopped=(*NODES, *BRIEFLY)),
)
REAL_TIME = (
    (Load("real time, no load"), 1.0),
    (Load("real time, a busy loop on each core", busy_loops=len(os.sched_getaffinity(0))), 1.5),
    (Load("real time, without real-time priority", without_priority=True), 2.0),
)
INTERRUPTIONS = 12
INTERRUPTED = 130
QUICK_SCENE = Path(".ci/two_points.yaml")


def run(output: Path, quick: bool) -> str:
    """Run all of it; return the page.

    Raises
    ------
    ValueError
        If a result is wrong; the page states which, and is written all the same.
    """
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    scene = QUICK_SCENE.resolve() if quick else share_path("config/scenes/demo.yaml")
    rows: list[tuple[str, ...]] = []
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        idle = demonstrate(folder, scene, HOST, IDLE)
        expected = findings(idle.run_folder)
        wrong += _note(rows, IDLE.name, idle, expected, idle, faults(idle, expected, expected))
        for load in LOADS:
            shown = demonstrate(folder, scene, HOST, load)
            found = findings(shown.run_folder)
            wrong += _note(rows, load.name, shown, found, idle, faults(shown, found, expected))
        wrong += _real_time(rows, folder, scene, expected)
        moments = 3 if quick else INTERRUPTIONS
        wrong += _interrupted(folder, scene, np.linspace(0.3, 1.1 * idle.seconds, moments))
    page = _page(rows, wrong, scene, moments)
    if wrong:
        write_page(output, "load", page)
        raise ValueError("benchmark load: " + "; ".join(wrong))
    return page


def _note(
    rows: list[tuple[str, ...]],
    name: str,
    shown: Demonstration,
    found: Findings,
    idle: Demonstration,
    wrong: Sequence[str],
) -> list[str]:
    share = shown.seconds / idle.seconds
    figures = f"{shown.seconds:.0f}", f"{share:.2f}", f"{found.points}", f"{found.repeats}"
    rows.append((name, *figures, f"{found.poles:.1f}", f"{found.forces:.1f}"))
    print(" | ".join(rows[-1]), *wrong, flush=True)
    return [f"{name}: {text}" for text in wrong]


def _real_time(
    rows: list[tuple[str, ...]], folder: Path, scene: Path, expected: Findings
) -> list[str]:
    wrong: list[str] = []
    idle: Demonstration | None = None
    for load, most in REAL_TIME:
        shown = demonstrate(folder, scene, HOST, load, ["--real-time"])
        idle = idle or shown
        found = findings(shown.run_folder)
        mine = []
        if shown.status != 0 or found.points != expected.points:
            mine.append(f"{found.points} of {expected.points} points")
        if not shown.seconds <= most * idle.seconds:
            mine.append(f"{shown.seconds / idle.seconds:.2f} times as long, {most} is accepted")
        wrong += _note(rows, load.name, shown, found, idle, mine)
    return wrong


def _interrupted(folder: Path, scene: Path, moments_s: np.ndarray) -> list[str]:
    """Ctrl-C and SIGTERM at these moments."""
    wrong = []
    for k, after_s in enumerate(moments_s):
        number = (signal.SIGINT, signal.SIGTERM)[k % 2]
        name = f"{number.name} after {after_s:.1f} s"
        shown = demonstrate(folder, scene, HOST, Load(name), interrupt=(float(after_s), number))
        said = shown.errors.strip().split("\n")
        ended = shown.status == 0 and not shown.errors.strip()  # it was faster
        if not ended and (shown.status != INTERRUPTED or len(said) != 1):
            wrong.append(f"{name}: status {shown.status}, printed {said}")
        if shown.left:
            wrong.append(f"{name}: left processes behind: {shown.left}")
        print(name, shown.status, said, flush=True)
    return wrong


def _page(rows: Sequence[Sequence[str]], wrong: Sequence[str], scene: Path, moments: int) -> str:
    summary, text = (__doc__ or "").split("\n\n")
    lines = [
        "# Load",
        "",
        *textwrap.wrap(summary, 112),
        "",
        *textwrap.wrap(text, 112),
        "",
        *textwrap.wrap(
            f"Scene `{scene.name}`; {len(os.sched_getaffinity(0))} cores, a Python loop of 5 million additions "
            f"takes {loop_s():.2f} s, a float64 rfft of 2 x 160000 samples {1e3 * fft_s():.1f} ms. "
            "Poles and forces: largest deviation of all points from the truth, in standard deviations.",
            112,
        ),
        "",
        "| load | time [s] | time / time without load | points | repeats | poles | forces |",
        "|---|---|---|---|---|---|---|",
        *("| " + " | ".join(row) + " |" for row in rows),
        "",
        *textwrap.wrap(
            f"Ctrl-C and SIGTERM at {moments} moments between start and end: each ends it with one line and "
            "leaves no process behind."
            if not wrong
            else "Wrong: " + "; ".join(wrong) + ".",
            112,
        ),
    ]
    return "\n".join(lines) + "\n"
