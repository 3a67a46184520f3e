# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance demo`: a short scan over a hidden inclusion, on the simulated bench."""

from __future__ import annotations

import argparse

from tactile_resonance.commands.bench_scan import add_scene_options, new_job, run_job

SCENE = "demo.yaml"


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "demo",
        help="a short scan over a hidden inclusion, on the simulated bench",
        description="What `scan` does, on a scene that takes little more than a minute: a simulated robot "
        "brings the sensor to 1 cN at 16 points of a gelatine phantom with something stiffer hidden in it; "
        "poles, map and table follow, beside the simulation's truth. Nothing here is a measurement.",
    )
    add_scene_options(parser, SCENE, "demo")
    parser.set_defaults(run=lambda options: run_job(new_job(options, SCENE, "demo")))
