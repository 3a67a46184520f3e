# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance simulate-ur`: a simulated UR5e on the ports of a real one."""

from __future__ import annotations

import argparse
import ipaddress
import signal

from tactile_resonance.processes import take_priority

READY = "simulated UR5e ready at"


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "simulate-ur",
        help="a simulated UR5e that ur_rtde connects to",
        description="Serve RTDE (30004), dashboard (29999), scripts (30003) and a port for faults on one "
        "address, at 500 Hz, until interrupted. Nothing here is a robot.",
    )
    parser.add_argument(
        "--host", default="127.0.1.1", help="any 127.x.y.z, one for each robot (default: 127.0.1.1)"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, help="robot time over wall time (default: 1)"
    )
    parser.add_argument(
        "--control-port", type=int, default=30020, help="for faults and queries (default: 30020)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of noise and wander (default: 0)")
    parser.add_argument(
        "--priority",
        type=int,
        default=0,
        metavar="N",
        help="real-time priority 1 to 99 (SCHED_FIFO; needs the right to it)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM, then say how well the pace was kept."""
    _check(options)
    from tactile_resonance.simulation.robot.controller import UrController
    from tactile_resonance.simulation.robot.simulated_robot import SimulatedRobot

    robot = SimulatedRobot(
        UrController(seed=options.seed),
        options.host,
        speed=options.speed,
        control_port=options.control_port,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: robot.stop())
    if options.priority:
        take_priority(options.priority)
    print(f"{READY} {options.host}, control port {options.control_port}", flush=True)
    robot.run()
    print(
        f"ended after {robot.controller.time_s:.1f} s of robot time, {robot.pace.stalls} stalls, "
        f"longest delay {robot.pace.longest_s * 1e3:.1f} ms"
    )
    return 0


def _check(options: argparse.Namespace) -> None:
    try:
        loopback = ipaddress.IPv4Address(options.host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise ValueError(f"host: {options.host!r}, expected an address 127.x.y.z")
    if not 1024 <= options.control_port <= 65535:
        raise ValueError(f"control-port: {options.control_port}, expected 1024 to 65535")
    if not 0 <= options.priority <= 99:
        raise ValueError(f"priority: {options.priority}, expected 0 to 99")
    if options.seed < 0:
        raise ValueError(f"seed: {options.seed}, expected at least 0")
