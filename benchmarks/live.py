# SPDX-License-Identifier: Apache-2.0
"""What a scan takes of the processors on the wall clock, process by process.

The nodes of `tactile_resonance scan --real-time` with a simulated robot and load cell: nothing under way,
from 12 s after they came up; a contact of 1 cN held; a scan; two scans at once, each with nodes and a robot
of its own.
Shares are the processor time of all threads of a process over time: of one core. Other work of the
machine makes them larger, by what it takes of caches and clock, and the loop slower by as much. A virtual
machine whose host stands it still for 10 ms and more loses contacts by that: forces are stale then.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.processor import fft_s, loop_s
from tactile_resonance._typing import FloatArray
from tactile_resonance.commands.options import require_packages
from tactile_resonance.configuration import share_path
from tactile_resonance.processes import free_domain_id, may_take_priority
from tactile_resonance.simulation.plant.defaults import PRIORITY

if TYPE_CHECKING:
    from benchmarks.live_bench import LiveScan, Shares


GOAL_LOOP_S = 0.48
"""Goals are those of a machine on which the loop takes so long."""
GOALS = {"contact_node": 0.12, "ur_client": 0.10, "simulate-ur": 0.20}
IDLE_GOAL = 0.05
SPEEDS = 5
HOSTS = ("127.0.79.1", "127.0.79.2")
QUICK_SCENE = Path(".ci/two_points.yaml")


def run(output: Path, quick: bool) -> str:
    """Measure; return the page.

    Raises
    ------
    ValueError
        Where what a scan needs is not there.
    """
    require_packages("rclpy", "tactile_resonance.msg", "rtde_control", "can")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    seconds = 5.0 if quick else 20.0
    scene = QUICK_SCENE.resolve() if quick else share_path("config/scenes/demo.yaml")
    domain_id = free_domain_id()
    domain_ids = (domain_id, domain_id % 100 + 1)
    speeds = [_speed()]
    shares: dict[str, Shares] = {}
    with tempfile.TemporaryDirectory() as folder:
        shares["idle"], shares["holding"], lost, one = _one(
            Path(folder) / "one", scene, domain_ids[0], seconds
        )
        shares["scanning"] = one.shares
        speeds.append(_speed())
        two = _two(Path(folder), scene, domain_ids)
    for k, scan in enumerate(two, start=1):
        shares[f"two scans at once: {k}"] = scan.shares
    speeds.append(_speed())
    text = _report(shares, lost, (one, *two), seconds, scene, np.concatenate(speeds))
    return text


def _speed() -> FloatArray:
    """(n, 2) processor time of the loop and of the FFT [s]."""
    return np.array([(loop_s(), fft_s()) for _ in range(SPEEDS)])


def _one(
    folder: Path, scene: Path, domain_id: int, seconds: float
) -> tuple[Shares, Shares, int, LiveScan]:
    from benchmarks.live_bench import LiveBench

    with LiveBench(folder, scene, HOSTS[0], domain_id) as bench:
        idle = bench.idle(seconds)
        holding, lost = bench.holding(seconds)
        return idle, holding, lost, bench.scan()


def _two(folder: Path, scene: Path, domain_ids: Sequence[int]) -> list[LiveScan]:
    """Two scans begun together."""
    from benchmarks.live_bench import LiveBench

    scans: dict[int, LiveScan] = {}
    with ExitStack() as stack:
        benches = [
            stack.enter_context(LiveBench(folder / host, scene, host, domain_id))
            for host, domain_id in zip(HOSTS, domain_ids, strict=True)
        ]

        def scan(k: int) -> None:
            scans[k] = benches[k].scan()

        threads = [threading.Thread(target=scan, args=(k,)) for k in range(len(benches))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    if len(scans) < len(benches):
        raise ValueError("benchmark live: one of two scans at once did not come to its end")
    return [scans[k] for k in range(len(benches))]


def _report(
    shares: Mapping[str, Shares],
    lost: int,
    scans: Sequence[LiveScan],
    seconds: float,
    scene: Path,
    speeds: FloatArray,
) -> str:
    loop, fft = np.median(speeds, axis=0)
    fastest, slowest = speeds[:, 0].min(), speeds[:, 0].max()
    _, *how = __doc__.strip().split("\n\n")
    names = sorted(shares["scanning"], key=lambda name: -shares["scanning"][name])
    priority = may_take_priority(PRIORITY)
    lines = [
        "# What a scan takes of the processors",
        "",
        "`tools/run.sh tactile_resonance benchmark live`.",
        how[0],
        "",
        f"{os.cpu_count()} cores; a Python loop of 5 million additions on globals takes {loop:.3f} s",
        f"({fastest:.3f} to {slowest:.3f} s),",
        f"numpy's real FFT of 2 x 160000 samples in double precision {1e3 * fft:.1f} ms: medians of processor",
        "time, measured before, between and after. Real-time priority is "
        f"{'' if priority else 'not '}permitted. Idle and",
        f"holding over {seconds:g} s, scans of `{scene.name}` from the first feedback to the end.",
        "",
        "| % of one core | " + " | ".join(shares) + " |",
        "|---|" + "---:|" * len(shares),
    ]
    for name in names:
        cells = (f"{100 * column[name]:.1f}" for column in shares.values())
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    sums = (f"**{100 * sum(column.values()):.0f}**" for column in shares.values())
    lines += ["| **all** | " + " | ".join(sums) + " |", ""]
    lines.append(f"- Contacts lost before one was held for {seconds:g} s: {lost}.")
    for name, scan in zip(("One scan", "Of two, the first", "the second"), scans, strict=True):
        lines.append(
            f"- {name}: {scan.done} of {scan.points} points with poles in {scan.duration_s:.0f} s, "
            f"{scan.repeats}; the simulation stood still for more than 10 ms {scan.stalls} times."
        )
    ratio = GOAL_LOOP_S / loop
    busy = [name for name in shares if name != "idle"]
    goals = [(f"{n}, {state}", g, shares[state][n]) for n, g in GOALS.items() for state in busy]
    goals += [(f"{n}, idle", IDLE_GOAL, shares["idle"][n]) for n in names]
    missed = sum(ratio * found > goal for _, goal, found in goals)
    lines += [
        "",
        f"{missed} of {len(goals)} goals are missed. The goals hold for a slower machine, on which the loop",
        f"takes {GOAL_LOOP_S:g} s. Shares there are estimated by the ratio of the loops,",
        f"{GOAL_LOOP_S:g} / {loop:.3f} = {ratio:.2f}: these are Python programs, to which "
        "the loop is nearer than the FFT.",
        "",
        f"| Goal | % of one core | found here | with a loop of {GOAL_LOOP_S:g} s | |",
        "|---|---:|---:|---:|---|",
    ]
    for name, goal, found in goals:
        verdict = "met" if ratio * found <= goal else "missed"
        lines.append(
            f"| {name} | {100 * goal:g} | {100 * found:.1f} | {100 * ratio * found:.1f} | {verdict} |"
        )
    return "\n".join(lines) + "\n"
