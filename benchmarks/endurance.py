# SPDX-License-Identifier: Apache-2.0
"""A run of ten thousand points: time of a point, memory, open files, resuming, map; simulated, in virtual time.

`tools/run.sh python -m benchmarks.endurance [POINTS]` writes ``docs/benchmarks/endurance.md``.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.skip_hands import VirtualHands
from tactile_resonance.files import write_whole
from tactile_resonance.scan.map_messages import cloud_message, marker_message, surface_message
from tactile_resonance.scan.messages import header_message, to_cdr
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.pole_map import MapPoint, PoleMap
from tactile_resonance.scan.progress import Controls
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene
from tactile_resonance.strict_yaml import dump_yaml

POINTS, PARTS = 10_000, 10
SPACING_M = 5e-4


@dataclass(frozen=True)
class Part:
    """A tenth of the points.

    Attributes
    ----------
    points : int
        Finished at its end.
    point_ms, computing_ms : float
        Median of a point on this machine's clock [ms]: in all, and from samples to poles.
    memory_mb : float
        Resident at its end.
    files : int
        Open at its end.
    """

    points: int
    point_ms: float
    computing_ms: float
    memory_mb: float
    files: int


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


def run(output: Path, points: int = POINTS) -> str:
    """Scan, resume, draw; write ``endurance.md`` into `output`, and return the page."""
    parts: list[Part] = []
    times_s, computing_s = [time.perf_counter()], [0.0]
    with TemporaryDirectory() as folder:
        path, target = Path(folder) / "scene.yaml", Path(folder) / "run"
        text = dump_yaml(content(points))
        path.write_text(text)
        plan = make_plan(read_scan_scene(path))
        count = len(plan.points)
        hands = VirtualHands(read_scene(read_tissues(), path), 1.2)

        def publish(_: bytes) -> None:
            """After each point."""
            times_s.append(time.perf_counter())
            computing_s.append(hands.computing_s)
            done = len(times_s) - 1
            if done * PARTS % count < PARTS:
                own = slice(-(count // PARTS) - 1, None)
                point_ms, poles_ms = (
                    1e3 * float(np.median(np.diff(each[own]))) for each in (times_s, computing_s)
                )
                files = len(list(Path("/proc/self/fd").iterdir()))
                parts.append(Part(done, point_ms, poles_ms, memory_mb(), files))
                print(parts[-1], flush=True)

        with RunDirectory.create(target, text, plan.points, {"seed": 1}) as made:
            ScanRunner(plan, made, hands, Controls(), lambda progress: None, 1, publish).run()
        size_mb = sum(file.stat().st_size for file in target.rglob("*") if file.is_file()) / 1e6
        begun_s = time.perf_counter()
        with RunDirectory.open(target):
            resumed_s = time.perf_counter() - begun_s
        begun_s = time.perf_counter()
        pole_map = PoleMap(tuple(MapPoint.planned(each) for each in read_run(target).latest))
        read_s = time.perf_counter() - begun_s
        header, drawn_s = header_message("table", 1), []
        for make in (
            lambda: cloud_message(pole_map, (), header),
            lambda: marker_message(pole_map, pole_map.ellipse_scale(), 0.95, header),
            lambda: surface_message(pole_map, 40, header),
        ):
            begun_s = time.perf_counter()
            to_cdr(make())
            drawn_s.append(time.perf_counter() - begun_s)
    page = "\n".join(
        [
            f"# A run of {count} points",
            "",
            "`tools/run.sh python -m benchmarks.endurance`. Simulated, in virtual time and one process: the",
            "runner, the folder and the estimator as scan_node, frf_node and poles_node use them; no robot,",
            "no nodes. Times are of this machine's clock, medians over each tenth.",
            "",
            "| points | a point [ms] | of it samples to poles [ms] | memory [MB] | open files |",
            "|---:|---:|---:|---:|---:|",
            *(
                f"| {p.points} | {p.point_ms:.1f} | {p.computing_ms:.1f} | {p.memory_mb:.0f} | {p.files} |"
                for p in parts
            ),
            "",
            f"The folder has {size_mb:.0f} MB. Opened again to go on: {resumed_s:.1f} s, every byte of the "
            f"recording compared with its checksum. Read for the map: {read_s:.1f} s.",
            f"Messages for rviz: cloud {drawn_s[0]:.2f} s, ellipses {drawn_s[1]:.1f} s, kriged surface "
            f"{drawn_s[2]:.1f} s.",
            "",
        ]
    )
    write_whole(output / "endurance.md", page.encode())
    return page


if __name__ == "__main__":
    print(run(Path("docs/benchmarks"), int(sys.argv[1]) if len(sys.argv) > 1 else POINTS))
