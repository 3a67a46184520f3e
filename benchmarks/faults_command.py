# SPDX-License-Identifier: Apache-2.0
"""Faults around the command: disk, folder, signals, terminal, domain, wall clock, nodes that end or hang.

Each begins ``tactile_resonance demo``, as a person does, and goes on with ``resume`` where that is offered.
"""

from __future__ import annotations

import json
import mmap
import os
import pty
import re
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from benchmarks.faults_session import Row, true_force_n, what_is_wrong
from benchmarks.killed_scan import BLOCKS, SCENE
from benchmarks.load_case import descendants, runs
from tactile_resonance.processes import end_with_parent, free_domain_id
from tactile_resonance.scan.run_content import read_run

POINTS, LONGER_POINTS = 2, 14
WITHIN_S = 600.0
DISK = "64m"
STEP_S = 3600.0
CLOCK = Path(__file__).with_name("faults_clock.c")


class Command:
    """One ``demo`` or ``resume`` as a process, with what it prints.

    Parameters
    ----------
    words : sequence of str
    host : str
        Of the simulated robot.
    more : mapping
        Of the environment.
    terminal : bool
        On a terminal of its own.
    """

    def __init__(
        self,
        words: Sequence[str],
        host: str,
        more: Mapping[str, str] | None = None,
        terminal: bool = False,
    ) -> None:
        self.host = host
        self.terminal, inner = pty.openpty() if terminal else (-1, -1)
        self._said = Path(mkdtemp()) / "said"
        command = [sys.executable, "-m", "tactile_resonance.cli", *words]
        command += ["--robot-host", host] if host else []
        with self._said.open("wb") as file:
            out = inner if terminal else file
            self.process = subprocess.Popen(
                command,
                stdin=inner if terminal else subprocess.DEVNULL,
                stdout=out,
                stderr=file,
                env={**os.environ, **(more or {})},
                start_new_session=True,
                preexec_fn=_on_terminal if terminal else end_with_parent,
            )
        if terminal:
            os.close(inner)
        self.seen: set[int] = set()
        self.force_n = float("nan")

    @property
    def said(self) -> str:
        """So far."""
        return self._said.read_text(errors="replace")

    @property
    def last(self) -> str:
        """The last line."""
        return next((line for line in self.said.split("\n")[::-1] if line.strip()), "")

    def look(self) -> bool:
        """Remember its processes and the largest force; whether it runs."""
        self.seen.update(descendants(self.process.pid))
        if self.host:
            self.force_n = float(np.fmax(self.force_n, true_force_n(self.host)))
        time.sleep(0.1)
        return self.process.poll() is None

    def until(self, holds: Callable[[], object], within_s: float = WITHIN_S) -> bool:
        """Wait until something holds; False where it ends before."""
        deadline = time.monotonic() + within_s
        while not holds():
            if not self.look():
                return False
            if time.monotonic() > deadline:
                raise RuntimeError(f"nothing for {within_s:g} s: {self.last}")
        return True

    def measures(self) -> bool:
        """Whether one point is finished, or more."""
        return bool(re.search(r"^[1-9]\d* of ", self.said, re.M))

    def end(self, within_s: float = WITHIN_S) -> int:
        """Its status."""
        self.until(lambda: False, within_s)
        return self.process.returncode

    def node(self, name: str) -> int:
        """Process id of one of its nodes."""
        found = [pid for pid in descendants(self.process.pid) if runs(pid, name)]
        return found[0]

    def left(self) -> list[int]:
        """Processes that are there although it has ended."""
        return [pid for pid in self.seen if Path(f"/proc/{pid}").exists() and not _ended(pid)]

    def close(self) -> None:
        """End it, whatever it does."""
        if self.process.poll() is None:
            for pid in descendants(self.process.pid):
                os.kill(pid, signal.SIGKILL)
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self._said.parent)


def _on_terminal() -> None:
    import fcntl
    import termios

    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    end_with_parent()


def _ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


class Scene:
    """Where a row works, and what it begins there: a scan of `points`."""

    def __init__(self, folder: Path, host: str, points: int = POINTS) -> None:
        self.host, self.points = host, points
        self.file, self.run = folder / "scene.yaml", folder / "run"
        self.file.write_text(SCENE.format(size_x=0.003 * (points - 1), size_y=0.0, blocks=BLOCKS))

    def demo(self, **how: object) -> Command:
        """Begin it."""
        return Command(
            ["demo", "--scene", str(self.file), "--output", str(self.run)], self.host, **how
        )

    def resume(self, **how: object) -> Command:
        """Go on."""
        return Command(["resume", str(self.run)], self.host, **how)

    def row(
        self,
        name: str,
        command: Command,
        begun_s: float,
        *,
        told_s: float = float("nan"),
        meant: str = "",
        wrong: Sequence[str] = (),
    ) -> Row:
        """After the fault: how it ended, what a person does, and what is there then."""
        found = list(wrong)
        status = command.end()
        ended_s, force_n = time.monotonic() - begun_s, command.force_n
        said = command.last.removeprefix("tactile_resonance: ")
        if command.left():
            found.append(f"left processes behind: {command.left()}")
        way_on = ""
        if status != 0:
            told_s = ended_s if np.isnan(told_s) else told_s
            errors = [line for line in command.said.split("\n") if "tactile_resonance: " in line]
            if len(errors) != 1 or "Traceback" in command.said:
                found.append(f"{len(errors)} lines of error")
            if meant not in said:
                found.append(f"does not say {meant!r}")
            happened = f"ends: {said}"
            way_on = "`resume`" if self.run.joinpath("run.json").exists() else "`demo` again"
            if way_on == "`resume`" and "resume" not in command.said:
                found.append("does not say how to go on")
            again = self.resume() if way_on == "`resume`" else self.demo()
            if again.end() != 0:
                found.append(f"{way_on} ends: {again.last}")
            force_n = float(np.fmax(force_n, again.force_n))
            again.close()
        else:
            happened = "finishes"
        command.close()
        found += what_is_wrong(read_run(self.run), range(self.points), force_n)
        happened = happened.replace(str(self.run), "RUN")
        return Row(name, happened, way_on, told_s, ended_s, force_n, "; ".join(found))


def _signalled(name: str, act: Callable[[Command], None], **how: object) -> Callable[[Scene], Row]:
    def run(scene: Scene) -> Row:
        command = scene.demo(**how)
        command.until(command.measures if not how.get("terminal") else lambda: _points(scene.run))
        begun_s = time.monotonic()
        act(command)
        return scene.row(name, command, begun_s)

    return run


def _points(run: Path) -> int:
    return len(list(run.glob("recording/point-*.mcap")))


def _full(scene: Scene) -> Row:
    """Fill the disk in the second point; a resume while it is full says so; then there is room again."""
    command = scene.demo()
    command.until(command.measures)
    filler = scene.run.parent / "filler"
    begun_s = time.monotonic()
    _fill(filler)
    status, ended_s = command.end(), time.monotonic() - begun_s
    safe, said = _points(scene.run), command.last
    wrong = [] if status else ["a full disk is not noticed"]
    for word in (str(scene.run), "No space left", f"{safe} point{'' if safe == 1 else 's'}", "resume"):
        if word not in said:
            wrong.append(f"does not say {word!r}: {said}")
    _fill(filler)
    again = scene.resume()
    if again.end() == 0:
        wrong.append("resumed on a full disk")
    full = "No space left" in again.last or "MB free" in again.last
    if not (full and str(scene.run) in again.last):
        wrong.append(f"resumed on a full disk it says: {again.last}")
    again.close()
    filler.unlink()
    row = scene.row("disk full in the second point", command, begun_s, told_s=ended_s, wrong=wrong)
    return row


def _fill(filler: Path) -> None:
    """Leave nothing."""
    with filler.open("ab", buffering=0) as file:
        for size in (1 << 16, 1 << 10, 1):
            try:
                while True:
                    file.write(b"\0" * size)
            except OSError:
                continue


def _read_only_before(scene: Scene) -> Row:
    """The folder of the run is on a disk that takes no writes; then it does."""
    folder = scene.run.parent / "disk"
    folder.mkdir()
    scene.run = folder / "run"
    _mount("--bind", str(folder), str(folder))
    _mount("-o", "remount,bind,ro", str(folder))
    begun_s = time.monotonic()
    command = scene.demo()
    command.end()
    _mount("-o", "remount,bind,rw", str(folder))
    return scene.row(
        "read-only folder before the start", command, begun_s, meant="Read-only file system"
    )


def _read_only_during(scene: Scene) -> Row:
    command = scene.demo()
    command.until(command.measures)
    _mount("--bind", str(scene.run), str(scene.run))
    begun_s = time.monotonic()
    _mount("-o", "remount,bind,ro", str(scene.run))
    command.end()
    told_s = time.monotonic() - begun_s
    _mount("-o", "remount,bind,rw", str(scene.run))
    name = "read-only folder in the second point"
    return scene.row(name, command, begun_s, told_s=told_s, meant="Read-only file system")


def _mount(*words: str) -> None:
    subprocess.run(["mount", *words], check=True)


def _two_demos(scene: Scene) -> Row:
    """Without a domain or an address given, as two people would."""
    environment = {"ROS_DOMAIN_ID": ""}
    scene.host = ""
    other = scene.run.with_name("other")
    words = ["demo", "--scene", str(scene.file), "--output", str(other)]
    begun_s = time.monotonic()
    beside = Command(words, "", environment)
    command = scene.demo(more=environment)
    wrong = [] if beside.end() == 0 else [f"the other one ends: {beside.last}"]
    command.end()
    wrong += what_is_wrong(read_run(other), range(POINTS), float("nan")) if not wrong else []
    beside.close()
    return scene.row("two demos at once", command, begun_s, wrong=wrong)


def _domain_in_use(scene: Scene) -> Row:
    """A second demo in the domain of the first one, at another address; the first one shall last longer."""
    scene = Scene(scene.file.parent, scene.host, LONGER_POINTS)
    first = scene.demo()
    first.until(first.measures)
    begun_s = time.monotonic()
    words = ["demo", "--scene", str(scene.file), "--output", str(scene.run.with_name("other"))]
    second = Command(words, scene.host + "9")
    wrong = [] if second.end() else ["begins beside it"]
    told_s = time.monotonic() - begun_s
    said = second.last.removeprefix("tactile_resonance: ")
    wrong += [] if "ROS_DOMAIN_ID" in said else [f"does not say ROS_DOMAIN_ID: {said}"]
    wrong += [f"left processes behind: {second.left()}"] if second.left() else []
    second.close()
    row = scene.row("ROS_DOMAIN_ID that a session uses", first, begun_s, told_s=told_s, wrong=wrong)
    happened = f"refused: {said}; the first one {row.happened}"
    return Row(**{**asdict(row), "happened": happened, "way_on": "unset it, or name another"})


def _clock_steps(scene: Scene) -> Row:
    """The wall clock of all processes goes an hour ahead in the second point, and back two hours."""
    folder = scene.run.parent
    library, offset = folder / "clock.so", folder / "offset"
    subprocess.run(["cc", "-shared", "-fPIC", "-O2", "-o", str(library), str(CLOCK)], check=True)
    offset.write_bytes(struct.pack("q", 0))
    command = scene.demo(more={"LD_PRELOAD": str(library), "FAULTS_CLOCK": str(offset)})
    with offset.open("r+b") as file, mmap.mmap(file.fileno(), 8) as shared:
        command.until(command.measures)
        begun_s = time.monotonic()
        for step_s in (STEP_S, -STEP_S):
            shared[:] = struct.pack("q", int(1e9 * step_s))
            time.sleep(1.0)
        return scene.row("wall clock steps by +1 h, then -2 h", command, begun_s)


def _killed(node: str) -> Callable[[Scene], Row]:
    return _signalled(f"demo: {node} killed", lambda c: os.kill(c.node(node), signal.SIGKILL))


def _hung(node: str) -> Callable[[Scene], Row]:
    return _signalled(f"demo: {node} hung", lambda c: os.kill(c.node(node), signal.SIGSTOP))


ROWS: dict[str, Callable[[Scene], Row]] = {
    "disk full in the second point": _full,
    "read-only folder before the start": _read_only_before,
    "read-only folder in the second point": _read_only_during,
    "SIGHUP": _signalled("SIGHUP", lambda command: command.process.send_signal(signal.SIGHUP)),
    "terminal closed": _signalled(
        "terminal closed", lambda command: os.close(command.terminal), terminal=True
    ),
    "two demos at once": _two_demos,
    "ROS_DOMAIN_ID that a session uses": _domain_in_use,
    "wall clock steps by +1 h, then -2 h": _clock_steps,
    "demo: poles_node killed": _killed("poles_node"),
    "demo: excitation_node hung": _hung("excitation_node"),
    "demo: scan_node hung": _hung("scan_node"),
}
QUICK = ("disk full in the second point", "ROS_DOMAIN_ID that a session uses")
OWN_DISK = tuple(name for name in ROWS if name.startswith(("disk", "read-only")))


def command_row(name: str, folder: Path, host: str) -> Row:
    """One row, in a process of its own; those of disks in a namespace, where this user may mount one."""
    command = [sys.executable, "-m", "benchmarks.faults_command", name, str(folder), host]
    if name in OWN_DISK:
        command = ["unshare", "--user", "--map-root-user", "--mount", *command]
    ended = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if ended.returncode:
        return Row(name, "not tried: " + ended.stdout.strip(), wrong="the row itself failed")
    row = Row(**json.loads(ended.stdout.strip().split("\n")[-1]))
    print(row, file=sys.stderr, flush=True)
    return row


def main() -> None:
    """One row: its name, a folder, the address of the robot."""
    name, folder, host = sys.argv[1:]
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id({}))
    if name in OWN_DISK:
        _mount("-t", "tmpfs", "-o", f"size={DISK}", "faults", folder)
    print(json.dumps(asdict(ROWS[name](Scene(Path(folder), host)))))


if __name__ == "__main__":
    main()
