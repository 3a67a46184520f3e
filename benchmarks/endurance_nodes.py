# SPDX-License-Identifier: Apache-2.0
"""A long scan with the simulated robot, load cell and all nodes: its processes and its points, by tenths.

`tools/run.sh python -m benchmarks.endurance_nodes --robot 500` scans so many points in simulated time, and
`--hours 1` for so long on the wall clock beside a busy loop on each core: the demo's scene, on a fine grid.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.load_case import MOST_DEVIATIONS, busy_loop, descendants
from tactile_resonance.configuration import dump_yaml, parse_yaml, share_path
from tactile_resonance.files import write_whole
from tactile_resonance.processes import end_with_parent, free_domain_id
from tactile_resonance.report.point_details import deviations, truths_of
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.run_content import RunContent, read_run

HOST = "127.0.83.1"
ROBOT_TITLE = "A long scan with the robot, in simulated time"
ROBOT = (
    "`tools/run.sh python -m benchmarks.endurance_nodes --robot POINTS`: the scene of the demo on a "
    "fine grid, with the simulated robot, its load cell and all nodes as processes; none of it is a "
    "measurement. By tenths of the points: medians of a point on the wall clock, which counts all else "
    "that this machine does, and on the scan's own."
)
HOUR_TITLE = "A long scan with the robot, on the wall clock beside load"
HOUR = (
    "`tools/run.sh python -m benchmarks.endurance_nodes --hours 1`: the scene of the demo on a fine grid with "
    "`scan --real-time`, the simulated robot, its load cell and all nodes as processes, beside a busy "
    "loop on each core; none of it is a measurement. By tenths of the points: medians of a point."
)
LEAST_POINT_S = 1.3
"""What a point takes at least on the wall clock."""
PARTS = 10
SIDE_M = 0.0152
SAMPLE_EVERY_S = 5.0


@dataclass(frozen=True)
class Sample:
    """What the processes of a scan held at one moment.

    Attributes
    ----------
    wall_s : float
        Since the scan was started.
    finished : int
        Points.
    memory_mb : dict of str to float
        Resident, by process.
    files : dict of str to int
        Open descriptors, by process.
    """

    wall_s: float
    finished: int
    memory_mb: dict[str, float] = field(default_factory=dict)
    files: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class LongScan:
    """A scan that has ended.

    Attributes
    ----------
    status : int
        Of the command.
    printed, errors : str
    samples : tuple of Sample
    run : RunContent
    """

    status: int
    printed: str
    errors: str
    samples: tuple[Sample, ...]
    run: RunContent


def demo_grid(folder: Path, points: int, scan_s: float) -> Path:
    """The scene of the demo with a square grid over its region in place of chosen touches, as a file.

    Parameters
    ----------
    folder : Path
        Receives the file.
    points : int
        About so many.
    scan_s : float
        After so long the scan ends [s].
    """
    scene = parse_yaml(share_path("config/scenes/demo.yaml").read_text(encoding="utf-8"))
    columns = max(2, round(points**0.5))
    grid = {"center_m": [0.0, 0.0], "size_m": [SIDE_M, SIDE_M], "spacing_m": SIDE_M / (columns - 1)}
    scene["positions"] = {"grid": grid}
    scene["time_limits"] = {"point_s": 60.0, "scan_s": scan_s}
    path = folder / "scene.yaml"
    path.write_text(dump_yaml(scene))
    return path


def long_scan(folder: Path, scene: Path, host: str, *, real_time: bool, busy_loops: int = 0) -> LongScan:
    """Scan with ``tactile_resonance scan``; its processes are looked at every 5 s.

    Parameters
    ----------
    folder : Path
        Receives the run.
    scene : Path
    host : str
        127.x.y.z of the simulated robot.
    real_time : bool
        On the wall clock; else in simulated time.
    busy_loops : int, optional
        Processes beside it at normal priority that only compute.
    """
    target = folder / "run"
    command = [sys.executable, "-m", "tactile_resonance.cli", "scan", "--scene", str(scene)]
    command += ["--output", str(target), "--robot-host", host, *["--real-time"] * real_time]
    samples: list[Sample] = []
    printed: list[str] = []
    errors: list[str] = []
    finished = 0
    with ExitStack() as stack:
        for _ in range(busy_loops):
            stack.enter_context(busy_loop(os.sched_getaffinity(0)))
        begun_s = time.monotonic()
        scan = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=end_with_parent,
        )

        def read_errors() -> None:
            assert scan.stderr is not None
            errors.extend(scan.stderr)

        def read_lines() -> None:
            nonlocal finished
            assert scan.stdout is not None
            for line in scan.stdout:
                if found := re.match(r"(\d+) of \d+ points", line):
                    finished = int(found[1])
                else:
                    printed.append(line)
                    print(line, end="", flush=True)

        readers = [threading.Thread(target=each) for each in (read_lines, read_errors)]
        for reader in readers:
            reader.start()
        while scan.poll() is None:
            sample = _sample(scan.pid, time.monotonic() - begun_s, finished)
            samples.append(sample)
            if len(samples) % 24 == 0:
                print(sample, flush=True)
            time.sleep(SAMPLE_EVERY_S)
        for reader in readers:
            reader.join()
    return LongScan(scan.returncode, "".join(printed), "".join(errors), tuple(samples), read_run(target))


def _sample(pid: int, wall_s: float, finished: int) -> Sample:
    sample = Sample(wall_s, finished)
    for each in descendants(pid):
        try:
            words = Path(f"/proc/{each}/cmdline").read_bytes().decode(errors="replace").split("\0")
            pages = int(Path(f"/proc/{each}/statm").read_text().split()[1])
            files = len(os.listdir(f"/proc/{each}/fd"))
        except OSError:  # it has just ended
            continue
        name = _name(words)
        size_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        sample.memory_mb[name] = sample.memory_mb.get(name, 0.0) + size_mb
        sample.files[name] = sample.files.get(name, 0) + files
    return sample


def _name(words: list[str]) -> str:
    """Of a process: its node, or what the command line says it runs."""
    if node := re.search(r"tactile_resonance\.nodes\.(\w+)", " ".join(words)):
        return node[1]
    if "-m" in words:
        module = words[words.index("-m") + 1].rpartition(".")[2]
        return f"{module} {words[words.index('-m') + 2]}"
    return " ".join(Path(word).name for word in words if word)[:40]


def results_table(scan: LongScan) -> list[str]:
    """Of each tenth of the points: times of a point, attempts beyond the first, deviations from the truth."""
    results = sorted(scan.run.latest, key=lambda result: result.time_ns)
    truths = truths_of(scan.run)
    rows = [
        "| points | wall clock of a point [s] | scan's own clock [s] | repeated | failed | poles | forces |",
        "|---:|---:|---:|---:|---:|---:|---:|",
    ]
    wall_s = np.diff([result.time_ns / 1e9 for result in results], prepend=np.nan)
    own_s = np.array([result.duration_s + result.between_s for result in results])
    for chosen in np.array_split(np.arange(len(results)), PARTS):
        some = [results[k] for k in chosen]
        rows.append(
            f"| {chosen[-1] + 1} | {np.nanmedian(wall_s[chosen]):.2f} | {np.nanmedian(own_s[chosen]):.2f} | "
            f"{sum(each.repeats for each in some)} | {sum(each.failed for each in some)} | "
            f"{_largest(deviations(some, truths)):.1f} | {_largest(_forces(some, truths)):.1f} |"
        )
    return rows


def beyond_the_limit(scan: LongScan) -> tuple[int, int, int]:
    """Points, and how many poles and forces are more than 4 standard deviations from the truth."""
    done = [each for each in scan.run.latest if each.outcome is PointOutcome.DONE]
    truths = truths_of(scan.run)
    poles, forces = np.abs(deviations(done, truths)), np.abs(_forces(done, truths))
    return (
        len(done),
        int(np.sum(~np.all(poles <= MOST_DEVIATIONS, axis=-1))),
        int(np.sum(~(forces <= MOST_DEVIATIONS))),
    )


def processes_table(scan: LongScan) -> list[str]:
    """Of each tenth of the points: resident memory and open descriptors of each process at its end."""
    last = max(sample.finished for sample in scan.samples)
    ends = [round(last * (k + 1) / PARTS) for k in range(PARTS)]
    chosen = [next(s for s in scan.samples if s.finished >= end) for end in ends]
    names = sorted(set.intersection(*(set(sample.memory_mb) for sample in chosen)))
    return [
        "| process | " + " | ".join(str(sample.finished) for sample in chosen) + " |",
        "|---|" + "---:|" * PARTS,
        *(
            f"| {name} | " + " | ".join(f"{s.memory_mb[name]:.0f}, {s.files[name]}" for s in chosen) + " |"
            for name in names
        ),
    ]


def page(scan: LongScan, title: str, setting: str) -> str:
    """What a long scan shows, for people."""
    done, poles, forces = beyond_the_limit(scan)
    told = scan.run.latest
    repeats = sum(each.repeats for each in told)
    failed = sum(each.failed for each in told)
    end = [line.replace(str(scan.run.path), "RUN") for line in scan.printed.strip().splitlines()]
    return "\n".join(
        [
            f"# {title}",
            "",
            *textwrap.wrap(setting, 112),
            "",
            *results_table(scan),
            "",
            *textwrap.wrap(
                f"{len(told)} points: {done} with poles, {failed} failed, {repeats} repeats. Largest "
                "deviations from the simulation's truth are in standard deviations; beyond "
                f"{MOST_DEVIATIONS:g} are the poles of {poles} points and the forces of {forces} (of so "
                f"many normal figures, f0 and damping of each point, "
                f"{2 * done * 6.33e-5:.1f} and {done * 6.33e-5:.1f} are expected).",
                112,
            ),
            "",
            "Resident memory [MB] and open descriptors of each process, after so many points:",
            "",
            *processes_table(scan),
            "",
            f"The command ended with status {scan.status}.",
            "",
            *(f"    {line}" for line in [*end, *scan.errors.splitlines()][-3:]),
            "",
        ]
    )


def _forces(results: list[PointResult], truths: dict) -> np.ndarray:
    """Deviations of forces from the truth in standard deviations, where both are known."""
    known = [each for each in results if each.index in truths]
    return np.array([(r.force_n - truths[r.index].force_n) / r.force_std_n for r in known])


def _largest(values: np.ndarray) -> float:
    return float(np.max(np.abs(values), initial=0.0))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=" ".join((__doc__ or "").split()))
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--robot", type=int, metavar="POINTS", help="in simulated time")
    what.add_argument("--hours", type=float, help="on the wall clock, beside busy loops")
    parser.add_argument("--folder", type=Path, help="receives the run (default: a temporary one)")
    parser.add_argument("--output", type=Path, default=Path("docs/benchmarks"))
    options = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if options.robot:
            scene = demo_grid(folder, options.robot, 1e6)
            scan = long_scan(folder, scene, HOST, real_time=False)
            text, name = page(scan, ROBOT_TITLE, ROBOT), "endurance_robot.md"
        else:
            seconds = 3600.0 * options.hours
            scene = demo_grid(folder, max(9, round(seconds / LEAST_POINT_S)), seconds)
            loops = len(os.sched_getaffinity(0))
            scan = long_scan(folder, scene, HOST, real_time=True, busy_loops=loops)
            text, name = page(scan, HOUR_TITLE, HOUR), "endurance_hour.md"
    write_whole(options.output / name, text.encode())
    print(text)


if __name__ == "__main__":
    main()
