# SPDX-License-Identifier: Apache-2.0
"""A run of ten thousand points: what a point, its map and its summaries cost, memory, open files; simulated.

With nodes it is `benchmarks.endurance_nodes`.
"""

from __future__ import annotations

import os
import textwrap
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.skip_hands import VirtualHands
from tactile_resonance.commands.report import report_run
from tactile_resonance.configuration import dump_yaml
from tactile_resonance.scan.hands import Controls
from tactile_resonance.scan.map_messages import cloud_message, marker_message, surface_message
from tactile_resonance.scan.messages import header_message, message_types, to_cdr
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.point_file import FileContent
from tactile_resonance.scan.point_result import TYPE, PointResult, from_message, serialised
from tactile_resonance.scan.pole_map import GrowingMap, PoleMap
from tactile_resonance.scan.run_content import (
    RECORDING,
    entry_of,
    file_of,
    read_index,
    read_run,
    write_entries,
)
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene

POINTS, PARTS, QUICK = 10_000, 10, 100
FILLED = (
    "With `--quick`: only a hundredth of the points at the beginning and at the end are scanned, as a run "
    "that is opened again; those between are copies of one, and their rows here are missing. Memory is "
    "then that of a process that has read the whole run several times, not of one that has scanned it."
)
SPACING_M = 5e-4


@dataclass(frozen=True)
class Part:
    """A tenth of the points.

    Attributes
    ----------
    points : int
        Finished at its end.
    wall_ms : float
        Median of a point on this machine's clock [ms].
    point_ms, poles_ms, summary_ms, map_ms : float
        Median processor time of a point [ms]: all of the scan, of it from samples to poles and for summaries
        (``results.csv``, and the bag's metadata, which are a mean), and beside it what a map node does.
    drawn_ms : tuple of float
        Processor time of one cloud, one array of markers, one surface [ms].
    memory_mb, map_mb : float
        Resident at its end [MB]: of the scan, and of the process with the map, once it is drawn.
    files : int
        Open at its end.
    """

    points: int
    wall_ms: float
    point_ms: float
    poles_ms: float
    summary_ms: float
    map_ms: float
    drawn_ms: tuple[float, ...]
    memory_mb: float
    map_mb: float
    files: int


class TimedRun(RunDirectory):
    """A run that tells the processor time of its summaries [s]."""

    summaries_s = 0.0

    def _add(self, file: FileContent, result: PointResult | None) -> None:
        begun_s = time.process_time()
        super()._add(file, result)
        self.summaries_s += time.process_time() - begun_s


def content(points: int) -> dict[str, object]:
    """A square grid of so many points on gelatine, one block of a short period each."""
    side_m = SPACING_M * (round(points**0.5) - 1)
    square = {"center_m": [0.0, 0.0], "size_m": [side_m, side_m], "spacing_m": SPACING_M}
    return {
        "force_n": 0.01,
        "regions": [{"gelatine_percent": 10.0, "disc": {"center_m": [0, 0], "radius_m": side_m}}],
        "sensor": {"band_low_hz": 200.0, "band_high_hz": 620.0, "samples_per_period": "auto"},
        "positions": {"grid": square},
        "blocks": {"least": 2, "most": 2},
        "time_limits": {"point_s": 60.0, "scan_s": 1e6},
    }


def memory_mb() -> float:
    """Resident memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def map_node(pipe: Connection) -> None:
    """Take serialised results as a map node does; at an empty one answer what they took and what drawing takes.

    The answer is the median processor time of a result [ms], that of each drawing [ms], and the memory [MB].
    """
    grown, times_ms = GrowingMap(), []
    while True:
        try:
            cdr = pipe.recv_bytes()
        except EOFError:
            return
        if cdr:
            begun_s = time.process_time()
            grown.take(from_message(message_types().deserialize_cdr(cdr, TYPE)))
            times_ms.append(1e3 * (time.process_time() - begun_s))
            continue
        pipe.send((float(np.median(times_ms)), tuple(drawn_ms(grown.map)), memory_mb()))
        times_ms.clear()


class Course:
    """Notes what each point of a scan took, in parts of so many; the results go to a process that maps them."""

    def __init__(self, each: int) -> None:
        self._each, self.before = each, 0
        self._times: list[tuple[float, ...]] = []
        self.parts: list[Part] = []
        spawning = get_context("spawn")
        self._map, far = spawning.Pipe()
        spawning.Process(target=map_node, args=(far,), daemon=True).start()
        far.close()

    def close(self) -> None:
        """End the process of the map."""
        self._map.close()

    def show(self, cdr: bytes) -> None:
        """Hand a result to the map."""
        self._map.send_bytes(cdr)

    def take(self, cdr: bytes, *others_s: float) -> None:
        """After a point; clocks of the scan beside those of this process [s]."""
        self.show(cdr)
        self._times.append((time.perf_counter(), time.process_time(), *others_s))
        if len(self._times) == self._each:
            self._end_part()
            self._times.clear()

    def _end_part(self) -> None:
        files, held_mb = len(os.listdir("/proc/self/fd")), memory_mb()
        steps_ms = 1e3 * np.diff(self._times, axis=0)  # (points - 1, clocks)
        wall, point, poles, _ = np.median(steps_ms, axis=0).tolist()
        summary = float(np.mean(steps_ms[:, 3]))
        self._map.send_bytes(b"")
        on_map, drawn, map_mb = self._map.recv()
        self.before += self._each
        figures = wall, point, poles, summary, on_map
        self.parts.append(Part(self.before, *figures, drawn, held_mb, map_mb, files))
        print(self.parts[-1], flush=True)


def drawn_ms(pole_map: PoleMap) -> Iterator[float]:
    """Processor time of the messages of a map [ms]: cloud, markers, surface."""
    header = header_message("table", 1)
    for make in (
        lambda: cloud_message(pole_map, (), header),
        lambda: marker_message(pole_map, pole_map.ellipse_scale(), 0.95, header),
        lambda: surface_message(pole_map, 40, header),
    ):
        begun_s = time.process_time()
        to_cdr(make())
        yield 1e3 * (time.process_time() - begun_s)


def run(output: Path, quick: bool, points: int = POINTS) -> str:
    """Scan, resume, read, report; return the page."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        path, target = Path(folder) / "scene.yaml", Path(folder) / "run"
        text = dump_yaml(content(points))
        path.write_text(text)
        plan = make_plan(read_scan_scene(path))
        hands = VirtualHands(read_scene(read_tissues(), path), 1.2)
        count = len(plan.points)
        course = stack.enter_context(closing(Course(max(2, count // (QUICK if quick else PARTS)))))

        def scan(made: TimedRun, until: int) -> None:
            controls = Controls()

            def publish(cdr: bytes) -> None:
                course.take(cdr, hands.computing_s, made.summaries_s)
                if len(course.parts) == until:
                    controls.cancelled.set()

            with made:
                ScanRunner(plan, made, hands, controls, lambda progress: None, 1, publish).run()

        scan(TimedRun.create(target, text, plan.points, {"seed": 1}), 1 if quick else PARTS)
        if quick:
            course.before = fill(target, count - count // QUICK)
            for result in read_run(target).latest:
                course.show(serialised(result))
            scan(TimedRun.open(target), 2)
        size_mb = sum(file.stat().st_size for file in target.rglob("*") if file.is_file()) / 1e6
        clocks_s = []
        for action in (
            lambda: RunDirectory.open(target).close(),
            lambda: read_run(target),
            *([] if quick else [lambda: report_run(target)]),
        ):
            begun_s, begun_cpu_s = time.perf_counter(), time.process_time()
            with redirect_stdout(StringIO()):
                action()
            clocks_s += [time.perf_counter() - begun_s, time.process_time() - begun_cpu_s]
            print(clocks_s, flush=True)
    page = _page(course.parts, size_mb, clocks_s, quick)
    return page


def fill(run: Path, points: int) -> int:
    """Finish the points of a run up to so many, each with the file of the last one; the number of points."""
    content, entries = read_run(run), list(read_index(run)[0].values())
    like, kept = content.latest[-1], content.files[-1]
    file = file_of(run, like).read_bytes()
    for point in content.points[len(content.latest) : points]:
        x_m, y_m, z_m = point.position_m
        result = replace(like, index=point.index, attempt=0, x_m=x_m, y_m=y_m, z_m=z_m)
        result = replace(result, measurement_id=like.measurement_id + point.index, label=point.label)
        path = file_of(run, result)
        path.write_bytes(file)
        name = f"{RECORDING}/{path.name}"
        entries.append(entry_of(path, name, replace(kept, name=path.name), serialised(result)))
    write_entries(run, entries)
    return points


def _page(
    parts: Sequence[Part], size_mb: float, clocks_s: Sequence[float], quick: bool
) -> str:
    rows = [
        f"| {p.points} | {p.wall_ms:.1f} | {p.point_ms:.1f} | {p.poles_ms:.1f} | {p.summary_ms:.2f} | "
        f"{p.map_ms:.2f} | {' | '.join(f'{ms:.0f}' for ms in p.drawn_ms)} | "
        f"{p.memory_mb:.0f} | {p.map_mb:.0f} | {p.files} |"
        for p in parts
    ]
    first, last = parts[0], parts[-1]
    ratios = [
        getattr(last, name) / getattr(first, name) for name in ("point_ms", "map_ms", "summary_ms")
    ]
    return "\n".join(
        [
            "# Endurance",
            "",
            *textwrap.wrap((__doc__ or "").split("\n")[0], 112),
            "",
            *(textwrap.wrap(FILLED, 112) + [""] if quick else []),
            *textwrap.wrap(
                "Simulated, in virtual time: the runner, the folder and the estimator in one process, as "
                "scan_node, frf_node and poles_node use them, and the map in another, as in pole_map_node; "
                "no robot, no nodes (those: [on the wall clock](endurance_hour.md)). Medians over each "
                "tenth of processor times, which other work on the machine changes less than those of its "
                "clock. Memory of the map's process is that once all is drawn. Summaries are the row of "
                "`results.csv` and, after each twentieth of the points, the bag's metadata: their mean. "
                "Map: what a map node does with each result. It draws the messages (cloud, markers, "
                "surface) only where somebody listens, and for at most a tenth of its time.",
                112,
            ),
            "",
            "| points | a point, clock [ms] | processor [ms] | of it poles [ms] | of it summaries [ms] | "
            "map [ms] | cloud [ms] | markers [ms] | surface [ms] | memory [MB] | "
            "memory, map [MB] | open files |",
            "|" + "---:|" * 12,
            *rows,
            "",
            *textwrap.wrap(
                f"Last tenth over first: point {ratios[0]:.2f}, map {ratios[1]:.2f}, summaries "
                f"{ratios[2]:.2f}; memory {last.memory_mb - first.memory_mb:+.0f} MB, "
                f"of the map's process {last.map_mb - first.map_mb:+.0f} MB.",
                112,
            ),
            "",
            *textwrap.wrap(
                f"The folder has {size_mb:.0f} MB. Times on the clock, of the processor in brackets: "
                f"opened again to go on {clocks_s[0]:.1f} s ({clocks_s[1]:.1f} s), every byte of the "
                f"recording compared with its checksum; read {clocks_s[2]:.1f} s ({clocks_s[3]:.1f} s)"
                + ("." if quick else f"; `report` {clocks_s[4]:.0f} s ({clocks_s[5]:.0f} s)."),
                112,
            ),
            "",
        ]
    )
