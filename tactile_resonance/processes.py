# SPDX-License-Identifier: Apache-2.0
"""Starting node processes and leaving none behind; their priority."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

END_WITHIN_S = 20.0
"""A node must end within this after a signal; it draws the tip back first [s]."""
GRACE_S = 5.0
ORPHAN_POLL_S = 0.05
ENDING = tuple(
    number
    for name in ("SIGINT", "SIGTERM", "SIGHUP")  # there is no SIGHUP on Windows; nohup ignores it
    if (number := getattr(signal, name, None)) is not None
    and (name != "SIGHUP" or signal.getsignal(number) is not signal.SIG_IGN)
)
"""Signals that ask a process to end: Ctrl-C, kill, and a terminal that is closed."""
_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK = 1, 29  # linux/prctl.h
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
_TAKEN: dict[int, socket.socket] = {}  # ROS domains that this process took, until it ends


class NodeProcesses(contextlib.AbstractContextManager["NodeProcesses"]):
    """Nodes of this package as processes; a context that ends them all.

    Parameters
    ----------
    log_folder : Path
        Receives the output of each node.
    prefix : sequence of str
        Before each command: what runs it elsewhere, in a network namespace for example.
    """

    def __init__(self, log_folder: Path, prefix: Sequence[str] = ()) -> None:
        self._log_folder = log_folder
        self._prefix = tuple(prefix)
        self._processes: dict[str, subprocess.Popen] = {}

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(
        self, node: str, parameters: Mapping[str, object] | None = None, niceness: int = 0
    ) -> None:
        """Start a node as its console script does, with parameters of its own; see `start_child`."""
        program = f"from tactile_resonance.nodes.{node} import main; main()"
        nice = ["nice", "-n", str(niceness)] if niceness else []
        command = [*nice, *self._prefix, sys.executable, "-c", program, "--ros-args"]
        for name, value in (parameters or {}).items():
            command += ["-p", f"{name}:={json.dumps(value, default=str)}"]  # JSON is YAML
        self._log_folder.mkdir(parents=True, exist_ok=True)
        with (self._log_folder / f"{node}.log").open("wb") as log:
            self._processes[node] = start_child(command, stdout=log)

    def bring_up(
        self,
        nodes: Sequence[str],
        parameters: Mapping[str, Mapping[str, object]] | None = None,
        niceness: Mapping[str, int] | None = None,
    ) -> None:
        """Start nodes and the manager that configures and activates them in this order."""
        given = dict(parameters or {})
        given["manager_node"] = {"nodes": list(nodes)}
        for node in (*nodes, "manager_node"):
            self.start(node, given.get(node), (niceness or {}).get(node, 0))

    @property
    def pids(self) -> dict[str, int]:
        """Process id of each node."""
        return {node: process.pid for node, process in self._processes.items()}

    def kill(self, *nodes: str) -> None:
        """End nodes as a crash would, with SIGKILL, all before the first is waited for."""
        killed = [self._processes.pop(node) for node in nodes]
        for process in killed:
            process.kill()
        for process in killed:
            process.wait()

    def check(self) -> None:
        """RuntimeError if nodes have ended without being stopped, with the last line that each printed."""
        ended = {node for node, process in self._processes.items() if process.poll() is not None}
        texts = []
        for node in sorted(ended):
            lines = (self._log_folder / f"{node}.log").read_text(errors="replace").split("\n")
            last = next((line for line in reversed(lines) if line.strip()), "no output")
            status = self._processes[node].returncode
            texts.append(f"{node} ended with exit status {status}: {last.strip()}")
        if texts:
            raise RuntimeError("; ".join(texts))

    def stop(self) -> None:
        """Interrupt, and kill what has not ended though its own time to end is over.

        Child processes of a killed node end soon after it; they are waited for, too.
        """
        for process in self._processes.values():
            process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + END_WITHIN_S + GRACE_S
        orphans: list[Path] = []
        for process in self._processes.values():
            orphans += _children(process.pid)
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                orphans += _children(process.pid)
                process.kill()
                process.wait()
        self._processes.clear()
        deadline = time.monotonic() + GRACE_S
        while any(map(_runs, orphans)) and time.monotonic() < deadline:
            time.sleep(ORPHAN_POLL_S)


@contextlib.contextmanager
def noting_signals() -> Iterator[Callable[[], None]]:
    """`ENDING` signals take effect only where what it gives is called, and at its end.

    So what is under way ends in order, also where a shell made this process ignore Ctrl-C. What it gives raises
    `KeyboardInterrupt` once for all that have come, so that this end may be waited for; later each interrupts
    at once.
    """
    come: list[int] = []
    for number in ENDING:
        signal.signal(number, lambda number, _: come.append(number))

    def check() -> None:
        if come:
            come.clear()
            raise KeyboardInterrupt

    try:
        yield check
    finally:
        for number in ENDING:
            signal.signal(number, signal.default_int_handler)
        check()  # also where an error ends what was under way


def free_domain_id(environment: Mapping[str, str] = os.environ) -> int:
    """ROS_DOMAIN_ID where it is set, else one without participants, taken for this process until it ends.

    Nodes take seconds to come up: of two processes that look at a free domain meanwhile, one takes it.
    Not free is also a domain whose last participant is just ending.
    """
    given = environment.get("ROS_DOMAIN_ID", "")
    if given:
        if not (given.isascii() and given.isdigit() and int(given) <= 232):
            raise ValueError(f"ROS_DOMAIN_ID: {given!r}, expected a number from 0 to 232")
        return int(given)
    first = os.getpid() % 100
    for step in range(100):
        domain = 1 + (first + step) % 100  # 1..100: portable, below the ephemeral ports
        if not domain_is_free(domain):
            continue
        if domain in _TAKEN:
            return domain
        if taken := hold_domain(domain):
            _TAKEN[domain] = taken
            return domain
    raise RuntimeError("ROS_DOMAIN_ID: none of 1..100 is free on this machine, set one")


def hold_domain(domain: int) -> socket.socket | None:
    """What keeps a ROS domain from `free_domain_id` of others until it is closed; None where one is taken.

    It is the TCP port of the domain's first UDP port, to which no participant listens.
    """
    taken = socket.socket()
    try:
        taken.bind(("127.0.0.1", 7400 + 250 * domain))
    except OSError:
        taken.close()
        return None
    return taken


def domain_is_free(domain: int) -> bool:
    """Whether no participant of a ROS domain is on this machine.

    Ports follow the DDS interoperability wire protocol (OMG DDSI-RTPS 2.2, section 9.6.1.1): unicast
    discovery of participant n listens on 7400 + 250 domain + 10 + 2 n.
    """
    ports = range(7410 + 250 * domain, min(7400 + 250 * (domain + 1), 65536), 2)
    return all(map(_port_is_free, ports))


def _port_is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def may_take_priority(priority: int) -> bool:
    """Whether this process may run under SCHED_FIFO with a priority; tried, and left as it was."""
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        os.sched_setscheduler(0, *before)
    except (AttributeError, OSError):
        return False
    return True


def take_priority(priority: int) -> None:
    """Run this process under SCHED_FIFO.

    Raises
    ------
    ValueError
        Where that is not allowed.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError) as error:
        raise ValueError(
            f"priority: {priority} refused ({error}); it needs Linux and an rtprio limit "
            "(/etc/security/limits.d) or root"
        ) from error


def keep_memory() -> None:
    """Let this process keep what it frees, where its C library can (glibc).

    Else every array above some hundred kB is mapped anew, and the system makes its pages one by one as they
    are touched: for a record of 3 MB that takes longer than its Fourier transform.
    """
    with contextlib.suppress(AttributeError, TypeError):
        for option, size in ((_M_TRIM_THRESHOLD, 1 << 28), (_M_MMAP_THRESHOLD, 1 << 25)):
            ctypes.CDLL(None).mallopt(option, size)


@contextlib.contextmanager
def loose_timers(slack_ns: int) -> Iterator[None]:
    """Start threads whose timers may be late by so much [ns] while they have no real-time priority.

    This one has none meanwhile, and those that it starts begin without: with priority there is no slack to hand
    on. Linux only, elsewhere nothing is changed.
    """
    if sys.platform != "linux":
        yield
        return
    before, prctl = (os.sched_getscheduler(0), os.sched_getparam(0)), ctypes.CDLL(None).prctl
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack_ns))
    try:
        yield
    finally:
        prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(0))  # as when it began
        os.sched_setscheduler(0, *before)


def thread_ids() -> set[int]:
    """Of this process, as `os.sched_setscheduler` takes them; none where the system does not tell."""
    with contextlib.suppress(OSError):
        return {int(name) for name in os.listdir("/proc/self/task")}
    return set()


def start_child(command: Sequence[str], **options: Any) -> subprocess.Popen:
    """Start a process that is told to end should this one die.

    It does not hear the terminal's Ctrl-C: this process ends it in order. `options` are those of `Popen`.
    """
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        preexec_fn=end_with_parent if sys.platform == "linux" else None,
        **options,
    )


def end_with_parent() -> None:
    """Ask Linux to end this new process when its parent dies."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _children(pid: int) -> list[Path]:
    """What a process has started and has not ended, as folders of /proc (Linux)."""
    started: list[Path] = []
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            started += [Path("/proc") / child for child in children.read_text().split()]
    return started


def _runs(process: Path) -> bool:
    """Whether a process of /proc has not ended; one of which nobody took the status has."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
