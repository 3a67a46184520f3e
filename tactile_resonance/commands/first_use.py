# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance check-robot` and `compile`: what is done before a robot, and fits, are first used."""

from __future__ import annotations

import argparse
import dataclasses
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from tactile_resonance.commands.options import add_option
from tactile_resonance.fields import require

STEPPED = tuple(
    f"tactile_resonance.{name}"
    for name in (
        *("contact.contact_filter", "simulation.cell.transducer"),
        *("simulation.noise", "simulation.sensor.nonlinear", "simulation.tissue.indenter"),
        "simulation.ur5e.kinematics",
    )
)
"""Modules of what is stepped hundreds of times a second, compiled as they are imported."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of both commands."""
    parser = commands.add_parser(
        "check-robot",
        help="whether a Universal Robots arm is ready and its link fit",
        description="Identify the robot, upload the control program, set TCP, payload and watchdog as the "
        "configuration states, watch the states for some seconds, disconnect. Nothing moves. docs/robot.md "
        "states what to set at the robot.",
    )
    text = "name or address of the robot (default: the configuration's)"
    add_option(parser, "--host", str, text)
    add_option(parser, "--config FILE", Path, "default: config/devices/ur5e.yaml")
    add_option(parser, "--seconds", 5.0, "to watch")
    parser.set_defaults(run=_check_robot)
    parser = commands.add_parser(
        "compile",
        help="compile fits, contact control and the simulated robot ahead of their first use",
        description="Compile the fits of poles and mechanical tests, the filter of contacts and what a "
        "simulated robot steps into numba's cache, which takes about a minute and is done once per "
        "installation. 'make setup' does it; after 'pip install' or colcon the first use does it otherwise.",
    )
    parser.set_defaults(run=_compile)


def _check_robot(options: argparse.Namespace) -> int:
    """Print what was found; status 1 where the link does not serve."""
    require(0.5 <= options.seconds <= 3600, "--seconds", options.seconds, "0.5 to 3600")
    if find_spec("rtde_control") is None:
        raise ValueError("check-robot: ur_rtde is not installed: pip install 'ur-rtde>=1.6.5,<1.7'")
    from tactile_resonance.configuration import share_path
    from tactile_resonance.contact.interfaces import ArmError
    from tactile_resonance.drivers.ur_check import identify, watch
    from tactile_resonance.drivers.ur_config import read_ur_config

    config = read_ur_config(options.config or share_path("config/devices/ur5e.yaml"))
    if options.host is not None:
        config = dataclasses.replace(config, host=options.host)
    try:
        if config.check_dashboard:
            print(identify(config.host))
        lines, fit = watch(config, options.seconds)
    except ArmError as error:
        raise ValueError(f"{error} ({error.fault.value})") from error
    print(lines)
    if not fit:
        print("NOT FIT: states came too late; see 'The network' in docs/robot.md")
        return 1
    print("fit: no state came too late")
    return 0


def _compile(options: argparse.Namespace) -> int:
    """Compile what is not in the cache yet."""
    # only here: numba takes a second to load
    from tactile_resonance.mechanics import course
    from tactile_resonance.poles import compiled

    missing = compiled.compiled() + course.compiled() + sum(map(_compiled_in, STEPPED))
    print(f"fits: {missing} kernels compiled" if missing else "fits: compiled already")
    return 0


def _compiled_in(name: str) -> int:
    """How many functions of a module were not in the cache and had to be compiled."""
    from numba.core.dispatcher import Dispatcher

    members = vars(import_module(name)).values()
    kernels = [each for each in members if isinstance(each, Dispatcher)]
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels)
