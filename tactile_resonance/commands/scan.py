# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance demo`, `scan` and `resume`: scans on the simulated bench, with all nodes."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from tactile_resonance.commands.bench_scan import (
    Job,
    add_options,
    add_scene_options,
    checked_calibration,
    new_job,
    run_job,
)

NEW_RUNS = {
    "demo": (
        "demo.yaml",
        "a short scan over a hidden inclusion, on the simulated bench",
        "What `scan` does, on a scene that takes little more than a minute: a simulated robot brings the "
        "sensor to 1 cN at up to 16 points of a gelatine phantom, chosen for the boundary of something stiffer "
        "hidden in it; boundary, poles, map and table follow, beside the simulation's truth. Nothing here is a "
        "measurement.",
    ),
    "scan": (
        "inclusion_scan.yaml",
        "a scan on the simulated bench, with robot, load cell and map",
        "Start the nodes, a simulated robot and load cell as processes on loopback; touch every point of a "
        "scene at its force, measure until it is precise enough, record. Nothing here is a measurement.",
    ),
}
"""Scene, help and description of the commands that begin a run."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the three commands."""
    for name, (scene, text, description) in NEW_RUNS.items():
        parser = commands.add_parser(name, help=text, description=description)
        add_scene_options(parser, scene, name)
        parser.set_defaults(run=partial(_begin, scene=scene, name=name))
    parser = commands.add_parser(
        "resume",
        help="go on with a scan that was ended or killed",
        description="Go on with the next point of a run on the simulated bench.",
    )
    parser.add_argument("output", type=Path, metavar="RUN", help="folder of the run")
    add_options(parser)
    parser.set_defaults(run=_resume)


def _begin(options: argparse.Namespace, scene: str, name: str) -> int:
    return run_job(new_job(options, scene, name))


def _resume(options: argparse.Namespace) -> int:
    from tactile_resonance.scan.goal import ScanGoal, resumed_run

    run = resumed_run(ScanGoal(run_directory=str(options.output.resolve()), resume=True))
    host, real_time = options.robot_host, options.real_time
    sensor = checked_calibration(options.calibration)
    return run_job(
        Job(run / "scene.yaml", run, host, resume=True, real_time=real_time, calibration=sensor)
    )
