# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance check-robot`: whether a robot is ready and its link fit for contact. Moves nothing."""

from __future__ import annotations

import argparse
import dataclasses
from importlib.util import find_spec

from tactile_resonance.commands.options import add_file
from tactile_resonance.fields import require


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "check-robot",
        help="whether a Universal Robots arm is ready and its link fit",
        description="Identify the robot, upload the control program, set TCP, payload and watchdog as the "
        "configuration states, watch the states for some seconds, disconnect. Nothing moves. docs/robot.md "
        "states what to set at the robot.",
    )
    parser.add_argument(
        "--host", help="name or address of the robot (default: the configuration's)"
    )
    add_file(parser, "--config", "default: config/devices/ur5e.yaml")
    parser.add_argument("--seconds", type=float, default=5.0, help="to watch (default: 5)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
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
