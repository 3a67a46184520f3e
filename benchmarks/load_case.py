# SPDX-License-Identifier: Apache-2.0
"""One run of the demo under a load of the machine, and its results against the truth."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactile_resonance.processes import end_with_parent
from tactile_resonance.report.point_details import deviations, truths_of
from tactile_resonance.scan.point_result import PointOutcome
from tactile_resonance.scan.run_content import read_run

LONGEST_S = 1800.0
MOST_DEVIATIONS = 4.0
NODES = (
    *("fake_hardware_node", "excitation_node", "frf_node", "poles_node", "contact_node"),
    *("pole_map_node", "scan_node", "manager_node"),
)
BRIEFLY = ("ur_client", "simulate-ur")
"""Processes that ur_rtde runs in or waits for: its own time limits allow no more than a second."""
STOP_S, STOP_BRIEFLY_S = 5.0, 1.0
WORK_S, REST_S = 0.1, 0.3
"""Throttled to a quarter: processes run and stand in turn [s]."""
_PR_CAPBSET_DROP, _CAP_SYS_NICE = 24, 23  # linux/prctl.h, linux/capability.h


@dataclass(frozen=True)
class Load:
    """What else the machine does, or what is kept from the demo.

    Attributes
    ----------
    name : str
    busy_loops : int
        Number of processes at normal priority that only compute.
    pinned : bool
        All on one core, the busy loops too.
    without_priority : bool
        As a user who may take no real-time priority.
    throttled : bool
        To a quarter: all processes run for 0.1 s and are stopped for 0.3 s.
    stopped : tuple of str
        Processes that are stopped once, one after the other: `BRIEFLY` for 1 s, others for 5 s.
    """

    name: str
    busy_loops: int = 0
    pinned: bool = False
    without_priority: bool = False
    throttled: bool = False
    stopped: tuple[str, ...] = ()


@dataclass(frozen=True)
class Demonstration:
    """A run of the demo.

    Attributes
    ----------
    seconds : float
        Its duration [s].
    status : int
        Its exit status.
    printed, errors : str
    left : tuple of int
        Ids of processes that it left behind.
    run_folder : Path
    stopped : tuple of str
        Processes that were stopped.
    """

    seconds: float
    status: int
    printed: str
    errors: str
    left: tuple[int, ...]
    run_folder: Path
    stopped: tuple[str, ...]


@dataclass(frozen=True)
class Findings:
    """What the run of a demo holds.

    Attributes
    ----------
    points, repeats : int
        Points with poles, and attempts beyond the first.
    calls : tuple of (int, str)
        Point and tissue.
    poles, forces : float
        Largest deviation from the truth, in standard deviations.
    """

    points: int
    repeats: int
    calls: tuple[tuple[int, str], ...]
    poles: float
    forces: float


def demonstrate(
    folder: Path,
    scene: Path,
    host: str,
    load: Load,
    options: Sequence[str] = (),
    *,
    interrupt: tuple[float, int] | None = None,
) -> Demonstration:
    """Run ``tactile_resonance demo`` under a load.

    Parameters
    ----------
    folder : Path
        Receives the run.
    scene : Path
    host : str
        127.x.y.z of the simulated robot.
    load : Load
    options : sequence of str
        More of the command's.
    interrupt : (float, int), optional
        After so many seconds it receives that signal.
    """
    run_folder = folder / load.name.replace(" ", "-")
    command = [sys.executable, "-m", "tactile_resonance.cli", "demo", "--output", str(run_folder)]
    command += ["--scene", str(scene), "--robot-host", host, *options]
    cores = {min(os.sched_getaffinity(0))} if load.pinned else os.sched_getaffinity(0)

    def prepare() -> None:
        end_with_parent()
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's background job inherits it ignored
        os.sched_setaffinity(0, cores)
        if load.without_priority:
            ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)

    with ExitStack() as stack:
        for _ in range(load.busy_loops):
            stack.enter_context(busy_loop(cores))
        begun_s = time.monotonic()
        demo = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=prepare,
        )
        watch = _Watch(demo)
        if load.throttled:
            stack.enter_context(_beside(lambda: _throttle(demo)))
        if load.stopped:
            stack.enter_context(_beside(lambda: watch.stop_each(load.stopped)))
        if interrupt is not None:
            after_s, number = interrupt
            stack.enter_context(_beside(lambda: _interrupt(demo, after_s, number)))
        try:
            watch.wait(LONGEST_S)
        finally:
            if demo.poll() is None:
                demo.kill()
        seconds = time.monotonic() - begun_s
    left = tuple(pid for pid in watch.seen if _alive(pid))
    return Demonstration(
        seconds,
        demo.returncode,
        watch.printed,
        watch.errors,
        left,
        run_folder,
        tuple(watch.stopped),
    )


def findings(run_folder: Path) -> Findings:
    """What a run holds, against the truth of the simulated bench; no points where the run has no results."""
    if not (run_folder / "run.json").exists():
        return Findings(0, 0, (), np.nan, np.nan)
    run = read_run(run_folder)
    truths = truths_of(run)
    done = [result for result in run.latest if result.outcome is PointOutcome.DONE]
    forces = [(r.force_n - truths[r.index].force_n) / r.force_std_n for r in done]
    return Findings(
        len(done),
        len(run.results) - len(run.latest),
        tuple((result.index, result.tissue_class) for result in done),
        _largest(deviations(done, truths)),
        _largest(forces),
    )


def faults(demonstration: Demonstration, found: Findings, expected: Findings) -> list[str]:
    """What is wrong with a demo in simulated time, compared with one on an idle machine; empty: nothing."""
    wrong = []
    if demonstration.status != 0:
        wrong.append(f"ended with status {demonstration.status}: {demonstration.errors.strip()}")
    if demonstration.left:
        wrong.append(f"left processes behind: {demonstration.left}")
    if found.repeats:
        wrong.append(f"{found.repeats} repeats of points")
    if found.calls != expected.calls:
        wrong.append(f"points and tissues {found.calls}, on an idle machine {expected.calls}")
    for name, value in (("poles", found.poles), ("forces", found.forces)):
        if not value <= MOST_DEVIATIONS:
            wrong.append(f"{name} up to {value:.1f} standard deviations from the truth")
    return wrong


def _largest(values: object) -> float:
    """Largest absolute value; NaN where one of them is NaN."""
    return float(np.max(np.abs(np.asarray(values, float)), initial=0.0))


class _Watch:
    """Reads what a demo prints, and keeps the ids of its processes."""

    def __init__(self, demo: subprocess.Popen) -> None:
        self._demo = demo
        self.seen: set[int] = set()
        self.stopped: list[str] = []
        self.printed = self.errors = ""
        self._readers = [
            threading.Thread(target=self._read, args=(name,)) for name in ("stdout", "stderr")
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, name: str) -> None:
        for line in getattr(self._demo, name):
            if name == "stdout":
                self.printed += line
            else:
                self.errors += line

    def wait(self, longest_s: float) -> None:
        """Wait until it has ended."""
        end_s = time.monotonic() + longest_s
        while self._demo.poll() is None and time.monotonic() < end_s:
            self.seen.update(descendants(self._demo.pid))
            time.sleep(0.2)
        if self._demo.poll() is None:
            return
        for reader in self._readers:
            reader.join()

    def stop_each(self, names: Sequence[str]) -> None:
        """Stop processes one after the other, from the first point on."""
        while self._demo.poll() is None and not re.search(r"^[1-9]\d* of ", self.printed, re.M):
            time.sleep(0.1)
        for name in names:
            found = [pid for pid in descendants(self._demo.pid) if runs(pid, name)]
            if self._demo.poll() is not None or not found:
                return
            self.stopped.append(name)
            for pid in found:
                _send(pid, signal.SIGSTOP)
            time.sleep(STOP_BRIEFLY_S if name in BRIEFLY else STOP_S)
            for pid in found:
                _send(pid, signal.SIGCONT)
            time.sleep(0.5)


def descendants(pid: int) -> list[int]:
    """Ids of all processes below one."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        children.setdefault(int(fields[1]), []).append(int(entry.parent.name))
    found, wanted = [], [pid]
    while wanted:
        below = children.get(wanted.pop(), [])
        found += below
        wanted += below
    return found


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


def runs(pid: int, name: str) -> bool:
    """Whether a process is that node, or that command."""
    words = _command(pid).split()
    return any(word == name or word.endswith(f".{name}") for word in words)


def _send(pid: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, number)


def _interrupt(demo: subprocess.Popen, after_s: float, number: int) -> None:
    time.sleep(after_s)
    if demo.poll() is None:
        demo.send_signal(number)


def _throttle(demo: subprocess.Popen) -> None:
    """Let all processes run a quarter of the time."""
    while demo.poll() is None:
        time.sleep(WORK_S)
        stopped = [demo.pid, *descendants(demo.pid)]
        for pid in stopped:
            _send(pid, signal.SIGSTOP)
        time.sleep(REST_S)
        for pid in stopped:
            _send(pid, signal.SIGCONT)


@contextmanager
def busy_loop(cores: set[int]) -> Iterator[None]:
    process = subprocess.Popen(
        [sys.executable, "-c", "while True: pass"],
        preexec_fn=lambda: (end_with_parent(), os.sched_setaffinity(0, cores)),
    )
    try:
        yield
    finally:
        process.kill()
        process.wait()


@contextmanager
def _beside(action: Callable[[], None]) -> Iterator[None]:
    """Do something in a thread; it ends with the demonstration."""
    thread = threading.Thread(target=action)
    thread.start()
    try:
        yield
    finally:
        thread.join()
