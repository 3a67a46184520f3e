# SPDX-License-Identifier: Apache-2.0
"""Faults of nodes and messages, one point after the other of scans with robot and load cell."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.faults_inject import FLOODED, HOPS, Hop
from benchmarks.killed_scan import BLOCKS, UP_WITHIN_S, KilledScan
from benchmarks.kills_reader import finished_points
from tactile_resonance.processes import end_with_parent
from tactile_resonance.report.point_details import deviations, truths_of
from tactile_resonance.scan.point_result import PointOutcome
from tactile_resonance.scan.run_content import RunContent, read_run
from tactile_resonance.simulation.plant.defaults import order

HUNG_AFTER_S = 20.0
"""In place of the 60 s of `hung_after_s`: what is waited for so long ends sooner, all else is the same."""
MOST_DEVIATIONS = 5.0
HARD_FORCE_N = 0.05
HEARD_WITHIN_S = 5.0
ENDS_WITHIN_S = 300.0
ASKED_AGAIN_S = 2.0
POINTS = (8, 1)


@dataclass(frozen=True)
class Row:
    """What came of one fault.

    Attributes
    ----------
    name : str
    happened : str
        How the scan went on or ended, as it was told.
    way_on : str
        What a person does; empty: nothing.
    reported_s, ended_s : float
        From the fault until it was told, and until the scan had ended; NaN: not told, for nothing was lost.
    force_n : float
        Largest true force on the tissue; NaN: no robot took part.
    wrong : str
        What should not be; empty: nothing.
    """

    name: str
    happened: str
    way_on: str = ""
    reported_s: float = float("nan")
    ended_s: float = float("nan")
    force_n: float = float("nan")
    wrong: str = ""


def true_force_n(host: str) -> float:
    """Largest force on the tissue since the plant was started; NaN where it does not answer."""
    try:
        return float(order(host, "truth", timeout_s=5.0)["largest_force_n"])
    except (OSError, ValueError):
        return float("nan")


def what_is_wrong(run: RunContent, points: Sequence[int], force_n: float) -> list[str]:
    """The same for all rows: these points there once, readable, with poles that agree with the truth."""
    wrong = [f"damaged: {problem}" for problem in run.problems]
    mine = [result for result in run.latest if result.index in points]
    done = [result for result in mine if result.outcome is PointOutcome.DONE]
    if len(done) != len(points):
        others = [
            f"point {r.index + 1} {r.outcome.value}: {r.reason}" for r in mine if r not in done
        ]
        wrong.append("; ".join([f"{len(done)} of {len(points)} points have poles", *others]))
    if len(run.results) != len(run.latest):
        wrong.append("points were measured twice")
    found = deviations(done, truths_of(run))
    if len(found) < len(done):
        wrong.append("points without a truth")
    if not np.max(np.abs(found), initial=0.0) <= MOST_DEVIATIONS:
        wrong.append(f"poles {np.max(np.abs(found)):.1f} deviations from the truth, not said")
    if force_n > HARD_FORCE_N:
        wrong.append(f"true force {1e3 * force_n:.0f} mN")
    return wrong


class FaultyScan(KilledScan):
    """Scans whose messages go through relays.

    Parameters
    ----------
    folder : Path
        Receives runs and logs.
    robot_host : str
        127.x.y.z of the simulated robot.
    """

    def __init__(self, folder: Path, robot_host: str) -> None:
        prefix = (sys.executable, "-m", "benchmarks.faults_inject", "node")
        super().__init__(folder, POINTS, robot_host, prefix)
        self._host, self._asked, self._pausing = robot_host, False, False
        for node in ("excitation_node", "scan_node"):
            self.parameters[node]["hung_after_s"] = HUNG_AFTER_S

    def __enter__(self) -> FaultyScan:
        self._relay = _Injector("relay")
        self._relay.wait_for("ready")
        super().__enter__()
        return self

    def __exit__(self, *of: object) -> None:
        super().__exit__(*of)
        self._relay.close()

    # rows

    def messages(self, hop: Hop, mode: str) -> Row:
        """One hop, disturbed at one point."""
        index = self._next_point()
        self._relay.tell(f"{hop.name}: {mode}")
        self._go(index)
        row = self._watch(f"{hop.name}: {mode}", index, lambda: self._relay.acted_s)
        self._relay.tell(f"{hop.name}: ")
        return row()

    def second_clock(self) -> Row:
        """Somebody else publishes ``/clock`` too."""
        return self._beside("/clock: a second publisher jumps", "clock")

    def flooded(self, node: str) -> Row:
        """One node, with all that it listens to."""
        return self._beside(f"{node} flooded", "flood", node)

    def killed(self, node: str) -> Row:
        """One node, started again as a person or a launch file does."""
        return self._spoilt(node, "killed", signal.SIGKILL, 3.0)

    def hung(self, node: str) -> Row:
        """One node stopped; once the scan has ended, or goes on without it, it is started again."""
        return self._spoilt(node, "hung", signal.SIGSTOP, 4 * HUNG_AFTER_S)

    def _spoilt(self, node: str, what: str, number: int, until_s: float) -> Row:
        index = self._next_point()
        self._go(index)
        deadline = time.monotonic() + ENDS_WITHIN_S
        while self.phase != "measure" and time.monotonic() < deadline:
            self._step(index)
        os.kill(self.processes.pids[node], number)
        at_s = time.monotonic()
        row = self._watch(f"{node} {what}", index, lambda: at_s, until_s)
        self.processes.kill(node)
        self.start((node,))
        return row("the node is started again")

    def _beside(self, name: str, *command: str) -> Row:
        index = self._next_point()
        other = _Injector(*command)
        try:
            other.wait_for("acted")
            self._go(index)
            row = self._watch(name, index, lambda: other.acted_s)
        finally:
            other.close()
        return row()

    def _next_point(self) -> int:
        """A scan that is paused before a point that shall meet a fault; its number."""
        self._hear_all()
        if self._asked and self.finished + 1 >= self._points:
            self.client.tactile.resume()
            self.to_the_end()
            self._asked = False
        if not self._asked:
            self.begin()
            self._asked = True
            self._go(0)
            while self.finished == 0:
                self._step(0)
        self.look()
        return self.finished

    def _hear_all(self) -> None:
        for _ in range(100):
            self.client.spin(0.0)

    def _go(self, index: int) -> None:
        """On with the scan, that was paused."""
        self._hear_all()
        self._pausing, self.phase = False, ""
        self._go_again()

    def _go_again(self) -> None:
        self._asked_s = time.monotonic()
        self.client.tactile.resume()

    def _step(self, index: int) -> None:
        """Hear; the scan pauses after this point, so that the next one has its own fault."""
        self.client.spin(0.02)
        if self.finished != index:
            return
        if self.phase in ("contact", "measure") and not self._pausing:
            self._pausing = True
            self.client.tactile.pause()
        elif self.phase == "paused" and time.monotonic() - self._asked_s > ASKED_AGAIN_S:
            self._pausing = False  # it shall repeat this point first
            self._go_again()

    def _watch(
        self,
        name: str,
        index: int,
        acted_s: Callable[[], float | None],
        until_s: float = ENDS_WITHIN_S,
    ) -> Callable[..., Row]:
        """Wait for the end of the point or of the scan, for so long."""
        told_s, deadline, repeats = float("nan"), time.monotonic() + ENDS_WITHIN_S, self.repeats
        self.waiting_for = ""
        while not self._over(index) and time.monotonic() < deadline:
            begun_s = acted_s()
            if begun_s is not None:
                deadline = begun_s + until_s
                if np.isnan(told_s) and (self.waiting_for or self.repeats > repeats):
                    told_s = time.monotonic() - begun_s
            self._step(index)
        last = time.monotonic() + HEARD_WITHIN_S
        while acted_s() is None and time.monotonic() < last:  # a result is published when its point is over
            self.client.spin(0.02)
        at_s = acted_s()
        return lambda way_on="": self._row(name, index, at_s, told_s, way_on)

    def _over(self, index: int) -> bool:
        return self.result.done() or self.finished > index

    def _row(self, name: str, index: int, acted_s: float | None, told_s: float, way_on: str) -> Row:
        """After the fault: the point comes to its end, the scan resumed where it has ended."""
        wrong, said, deadline = [], "", time.monotonic() + ENDS_WITHIN_S
        since_s = float("nan") if acted_s is None else acted_s
        if acted_s is None:
            wrong.append("the fault met no message")
        while self.finished <= index:
            if not self.result.done():
                if time.monotonic() > deadline:
                    raise RuntimeError(f"{name}: the point does not end: {self.client.why()}")
                self._step(index)
                continue
            result = self.result.result()
            safe = len(finished_points(self.run / "recording"))
            if result.done is None:  # the client heard of it
                far = f", {safe} of "
                wrong += [] if far in result.message else [f"told {result.message}, {safe} are there"]
            elif result.done + result.failed != safe:
                wrong.append(f"told {result.done} points with poles, {safe} are there")
            if self.finished > index:
                break
            if said:
                wrong.append(f"resumed, it ends: {result.message}")
                self._asked = False
                break
            said = result.message
            told_s = time.monotonic() - since_s if np.isnan(told_s) else told_s
            way_on = "; ".join(filter(None, (way_on, "`resume`")))
            self._pausing = False
            self.ask(resume=True)
        ended_s, force_n = time.monotonic() - since_s, true_force_n(self._host)
        run = read_run(self.run)
        try:
            for file in self.look().values():
                if file.index == index and file.counts != (BLOCKS,) * 3:
                    wrong.append(
                        f"records, FRFs, poles of {BLOCKS} blocks in the file: {file.counts}"
                    )
        except AssertionError as error:
            wrong.append(str(error))
        wrong += what_is_wrong(run, [index], force_n)
        row = Row(
            name,
            _happened(run, index, said, self.waiting_for),
            way_on,
            told_s,
            ended_s,
            force_n,
            "; ".join(wrong),
        )
        print(row, file=sys.stderr, flush=True)
        return row


def _happened(run: RunContent, index: int, said: str, waiting_for: str) -> str:
    text = f"ends: {said}" if said else "goes on"
    if waiting_for and not said:
        text += f", waits for {waiting_for.partition(',')[0]}"
    kinds = [
        result.disturbances for result in run.latest if result.index == index and result.repeats
    ]
    if kinds:
        text += f"; point repeated: {kinds[0]}"
    return text.replace(str(run.path), "RUN")


class _Injector:
    """A process of `faults_inject`."""

    def __init__(self, *command: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.faults_inject", *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=end_with_parent,
        )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._heard = ""
        self._from = 0

    def wait_for(self, word: str, within_s: float = UP_WITHIN_S) -> None:
        deadline = time.monotonic() + within_s
        while word not in self._read():
            if time.monotonic() > deadline or self._process.poll() is not None:
                raise RuntimeError(f"no {word!r} from {self._process.args}: {self._heard}")
            time.sleep(0.05)

    def tell(self, line: str) -> None:
        """An order to a relay; what it has done so far does not count any more."""
        assert self._process.stdin is not None
        self._from = len(self._read())
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    @property
    def acted_s(self) -> float | None:
        """When it first did what it was told last; None: not yet."""
        words = self._read()[self._from :].split()
        return float(words[words.index("acted") + 1]) if "acted" in words[:-1] else None

    def close(self) -> None:
        self._process.kill()
        self._process.wait()

    def _read(self) -> str:
        assert self._process.stdout is not None
        with suppress(BlockingIOError, TypeError):
            self._heard += os.read(self._process.stdout.fileno(), 65536).decode()
        return self._heard


def session_rows() -> dict[str, Callable[[FaultyScan], Row]]:
    """Each row by its name."""
    rows: dict[str, Callable[[FaultyScan], Row]] = {}
    for hop in HOPS:
        for mode in hop.modes:
            rows[f"{hop.name}: {mode}"] = partial(FaultyScan.messages, hop=hop, mode=mode)
    rows["/clock: a second publisher jumps"] = FaultyScan.second_clock
    kinds = {
        "flooded": FaultyScan.flooded,
        "killed": FaultyScan.killed,
        "hung": FaultyScan.hung,
    }
    for what, meet in kinds.items():
        for node in FLOODED:
            rows[f"{node} {what}"] = partial(meet, node=node)
    return rows


QUICK = (
    "bench/block to excitation_node: dropped",
    "record to frf_node: NaN",
    "poles to scan_node: duplicated",
    "contact_state to scan_node: NaN",
    "frf_node flooded",
    "poles_node killed",
)
