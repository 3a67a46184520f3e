# SPDX-License-Identifier: Apache-2.0
"""A scan whose nodes are killed at random moments: what is finished stays, and all of it comes to its end.

`tools/run.sh python -m benchmarks.kills --kills 50` kills each node in turn, and all at once, with SIGKILL.
What was killed is started anew and a scan that was killed is resumed. After every kill the run is read from its
files alone, by rosbags with the definitions in them. At its end it is compared with one that nobody disturbed,
where contacts are ideal; with a robot they creep, and no two are alike.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import textwrap
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.killed_scan import ALL, MANAGER, Kill, KilledScan
from tactile_resonance.processes import free_domain_id


def victims_of(nodes: Sequence[str], kills: int, random: np.random.Generator) -> list[str]:
    """Each node in turn, the manager too, and all at once, in an order that changes every round."""
    candidates = [*nodes, MANAGER, ALL]
    rounds = -(-kills // len(candidates))
    drawn = [str(name) for _ in range(rounds) for name in random.permutation(candidates)]
    return drawn[:kills]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=" ".join(__doc__.split()))
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--longest", type=float, default=float("inf"), metavar="S", help="no more kills after this"
    )
    parser.add_argument(
        "--robot-host",
        default="",
        metavar="127.X.Y.Z",
        help="with a simulated robot and load cell (default: ideal contact)",
    )
    parser.add_argument("--folder", type=Path, help="receives runs and logs (default: a new one)")
    parser.add_argument("--output", type=Path, help="file that receives the table")
    options = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    random = np.random.default_rng(options.seed)
    begun_s = time.monotonic()
    points = (2, 2) if options.robot_host else (4, 3)
    folder = options.folder or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    with KilledScan(folder, points, options.robot_host) as scan:
        expected = None if options.robot_host else scan.undisturbed()
        victims = victims_of(scan.nodes, options.kills, random)
        scans = scan.disturbed(victims, random, options.longest)
        kills = scan.kills
    for poles in scans:
        assert expected is None or poles == expected, (
            "poles differ from those of an undisturbed scan"
        )
    text = _report(kills, scans, options.robot_host, time.monotonic() - begun_s)
    if options.output:
        options.output.write_text(text, encoding="utf-8")
    print(text)


def _report(kills: Sequence[Kill], scans: Sequence[Mapping], robot: str, took_s: float) -> str:
    points = sum(len(scan) for scan in scans)
    what, *how = __doc__.strip().split("\n\n")
    lines = [
        "# Kills, with a simulated robot and load cell" if robot else "# Kills",
        "",
        *textwrap.wrap(what, 112),
        "",
        *textwrap.wrap(" ".join(how), 112),
        "",
        *(
            [f"With `--robot-host {robot} --kills {len(kills)}`, in simulated time:", ""]
            if robot
            else []
        ),
        "| killed | times | while a point or reference was being recorded |",
        "|---|---|---|",
    ]
    for victim in dict.fromkeys(sorted(kill.victim for kill in kills)):
        mine = [kill for kill in kills if kill.victim == victim]
        lines.append(f"| {victim} | {len(mine)} | {sum(kill.in_the_midst for kill in mine)} |")
    same = "" if robot else " with the very poles of an undisturbed scan, to the bit,"
    found = (
        f"{len(kills)} kills in {took_s:.0f} s; {len(scans)} scans of {len(scans[0])} points came to their "
        f"end. All {points} points were finished once,{same} every file readable to its end and unchanged from "
        "when it was first seen, with as many records, FRFs and poles as blocks were measured. No point failed."
    )
    lines += ["", *textwrap.wrap(found, 112)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
