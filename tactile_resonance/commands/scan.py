# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance scan` and `resume`: a scan on the simulated bench, through robot, load cell and nodes."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactile_resonance.commands.bench_scan import (
    Job,
    add_options,
    add_scene_options,
    new_job,
    run_job,
)

SCENE = "inclusion_scan.yaml"


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of both commands."""
    parser = commands.add_parser(
        "scan",
        help="a scan on the simulated bench, with robot, load cell and map",
        description="Start the nodes, a simulated robot and load cell as processes on loopback; touch every "
        "point of a scene at its force, measure until it is precise enough, record. Nothing here is a "
        "measurement.",
    )
    add_scene_options(parser, SCENE, "scan")
    parser.set_defaults(run=lambda options: run_job(new_job(options, SCENE, "scan")))
    parser = commands.add_parser(
        "resume",
        help="go on with a scan that was ended or killed",
        description="Go on with the next point of a run on the simulated bench.",
    )
    parser.add_argument("output", type=Path, metavar="RUN", help="folder of the run")
    add_options(parser)
    parser.set_defaults(run=_resume)


def _resume(options: argparse.Namespace) -> int:
    from tactile_resonance.scan.goal import ScanGoal, resumed_run

    run = resumed_run(ScanGoal(run_directory=str(options.output.resolve()), resume=True))
    host, real_time = options.robot_host, options.real_time
    return run_job(Job(run / "scene.yaml", run, host, resume=True, real_time=real_time))
