# SPDX-License-Identifier: Apache-2.0
"""Scans whose nodes are killed: what is finished is looked at after every kill, from the files alone."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kills_reader import Finished, finished_points
from tactile_resonance.commands.bench_scan import Job, node_parameters
from tactile_resonance.processes import NodeProcesses

STREAM = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node")
OTHERS = ("pole_map_node", "scan_node")
MANAGER = "manager_node"
HOST = "127.0.80.1"  # of the bench's time where no robot is
ALL = "all at once"
UP_WITHIN_S = 240.0  # of a machine that may have other work
SCAN_WITHIN_S = 300.0
LOST_WITHIN_S = 60.0
LONGEST_WAIT_S = 3.0
BLOCKS = 3
SCENE = """
name: to be killed
force_n: 0.01
regions:
  - {{name: gelatine 10 %, gelatine_percent: 10.0, disc: {{center_m: [0.0, 0.0], radius_m: 0.025}}}}
positions:
  grid: {{center_m: [0.0, 0.0], size_m: [{size_x}, {size_y}], spacing_m: 0.003}}
blocks: {{least: {blocks}, most: {blocks}}}
"""


@dataclass(frozen=True)
class Kill:
    """One kill.

    Attributes
    ----------
    victim : str
        Name of a node, or `ALL`.
    finished : int
        Points that were finished then.
    in_the_midst : bool
        A point or reference was being recorded.
    phase : str
        That the scan had told last.
    """

    victim: str
    finished: int
    in_the_midst: bool
    phase: str


def without_robot(parameters: dict[str, dict[str, object]]) -> None:
    """Make parameters of `node_parameters` those of ideal contact: the tip is where the scan says."""
    parameters["fake_hardware_node"]["robot_host"] = ""
    del parameters["scan_node"]["table_in_base"]  # places are in the frame of the scene
    parameters["scan_node"]["contact"] = "none"


class KilledScan:
    """Scans of one scene, one after the other, whose nodes are killed; a context that ends them.

    Parameters
    ----------
    folder : Path
        Receives runs and logs.
    points : (columns, rows)
        Of the grid that is scanned.
    robot_host : str
        127.x.y.z of a simulated robot with load cell; empty: ideal contact. Either in simulated time.
    prefix : sequence of str
        Before the command of each node: see `NodeProcesses`.

    Attributes
    ----------
    processes : NodeProcesses
    client : ScanClient
    parameters : dict
        Of each node, to be changed before the context is entered.
    run : Path
        Folder of the scan under way.
    result : Future
        Its outcome.
    phase, finished, waiting_for, repeats
        What its feedback has told last.
    """

    def __init__(
        self,
        folder: Path,
        points: tuple[int, int],
        robot_host: str = "",
        prefix: Sequence[str] = (),
    ) -> None:
        self._folder, self._prefix = folder, prefix
        self._points = points[0] * points[1]
        scene = folder / "scene.yaml"
        size = [0.003 * (n - 1) for n in points]
        scene.write_text(SCENE.format(size_x=size[0], size_y=size[1], blocks=BLOCKS))
        self.scene = scene
        self.nodes = (*STREAM, *(["contact_node"] if robot_host else []), *OTHERS)
        self.parameters = node_parameters(Job(scene, folder, robot_host or HOST), False, folder)
        self.parameters[MANAGER] = {"nodes": list(self.nodes)}
        if not robot_host:
            without_robot(self.parameters)
        self._known: dict[str, Finished] = {}
        self.run = folder / "run-0"
        self._runs = 0
        self.phase, self.finished, self._heard = "", 0, False
        self.waiting_for, self.repeats = "", 0
        self.kills: list[Kill] = []

    def __enter__(self) -> KilledScan:
        from tactile_resonance.nodes.client import ScanClient

        self.processes = NodeProcesses(self._folder / "log", self._prefix)
        self.client = ScanClient(self.processes.check)
        self.client.__enter__()
        self.start((*self.nodes, MANAGER))
        return self

    def __exit__(self, *_: object) -> None:
        self.processes.stop()
        self.client.__exit__()

    def undisturbed(self) -> dict[int, tuple[float, ...]]:
        """Poles by point of a scan from beginning to end."""
        self.begin()
        return self.to_the_end()

    def disturbed(
        self, victims: Sequence[str], random: np.random.Generator, longest_s: float = float("inf")
    ) -> list[dict[int, tuple[float, ...]]]:
        """Kill these one after the other, for so long at most; poles by point of every scan that it took.

        Raises
        ------
        AssertionError
            If a finished point is lost, changed, repeated or not readable, or a scan does not come to its end.
        """
        scans = []
        over_s = time.monotonic() + longest_s
        self.begin()
        for victim in victims:
            if time.monotonic() > over_s:
                break
            # every other time the scan may first finish a point; else it is met again while it recovers
            wanted = self.finished + int(random.integers(2))
            wait_s = float(random.uniform(0.0, LONGEST_WAIT_S))
            end_s = time.monotonic() + wait_s
            while time.monotonic() < end_s:
                self.client.spin(0.02)
                if self.result.done():
                    scans.append(self.to_the_end())
                    self.begin()
                    wanted = 0
                if self.finished < wanted:
                    end_s = time.monotonic() + wait_s
            self.kill(victim)
        scans.append(self.to_the_end())
        return scans

    def kill(self, victim: str) -> None:
        killed = (*self.nodes, MANAGER) if victim == ALL else (victim,)
        self.processes.kill(*killed)
        found = self.look()
        hidden = self.run / ".unfinished"
        midst = hidden.is_dir() and any(hidden.iterdir())
        self.kills.append(Kill(victim, len(found), midst, self.phase))
        print(f"kill {len(self.kills)}: {self.kills[-1]}", file=sys.stderr, flush=True)
        self.start(killed)
        if "scan_node" in killed:
            self.ask(resume=True)

    def start(self, nodes: Sequence[str]) -> None:
        for _ in range(10):  # what those that were killed had told
            self.client.spin(0.02)
        states = self.client.states
        states.clear()
        for node in nodes:
            self.processes.start(node, self.parameters.get(node))

        def up() -> bool:
            # each tells of itself: the manager may not have noticed yet that one was away
            return all(states.get(node, "").startswith("active") for node in (*nodes, MANAGER))

        self.client.wait(up, UP_WITHIN_S, "the nodes to come up")

    def begin(self) -> None:
        self.run = self._folder / f"run-{self._runs}"
        self._runs += 1
        self._known, self.finished = {}, 0
        self.waiting_for, self.repeats = "", 0
        self.ask(resume=False)

    def ask(self, *, resume: bool) -> None:
        # a scan that was killed before it had a folder cannot be resumed
        goal: dict[str, Any] = {"scene": self.scene}
        if resume:
            self._heard = False

            def known() -> bool:
                return self._heard or self.result.done()

            self.client.wait(known, LOST_WITHIN_S, "the fate of the scan")
            if self._heard:  # its goal was not accepted before the kill, and is now
                return
            if (self.run / "run.json").exists():
                goal = {"resume": True}
        scan = self.client.tactile.scan
        self.result = scan(**goal, run_directory=self.run, on_feedback=self._hear)

    def _hear(self, feedback) -> None:
        self._heard = True
        self.phase, self.finished = feedback.phase, feedback.finished
        self.waiting_for, self.repeats = feedback.waiting_for or self.waiting_for, feedback.repeats

    def look(self) -> dict[str, Finished]:
        """Every finished file, readable to its end, none of them lost, changed or repeated."""
        found = finished_points(self.run / "recording")
        for name, before in self._known.items():
            assert found.get(name) == before, f"{name} was finished and is lost or changed"
        twice = [i for i, n in Counter(point.index for point in found.values()).items() if n > 1]
        assert not twice, f"points {twice} were finished more than once"
        self._known = found
        return found

    def to_the_end(self) -> dict[int, tuple[float, ...]]:
        from tactile_resonance.client import Ending

        self.client.wait(self.result.done, SCAN_WITHIN_S, "the scan")
        result = self.result.result()
        assert result.ending is Ending.COMPLETE, result.message
        assert (result.done, result.failed, result.skipped) == (self._points, 0, 0), result.message
        found = self.look()
        assert sorted(point.index for point in found.values()) == list(range(self._points))
        for name, point in found.items():
            assert point.counts == (BLOCKS, BLOCKS, BLOCKS), f"{name}: {point.counts}"
        if "contact_node" in self.nodes:  # without a robot nobody lifts the tip into free air
            references = sorted(path.stem[13:] for path in self.run.glob("recording/reference-*"))
            assert references == ["air-after", "air-before"], references
        return {point.index: point.poles for point in found.values()}
