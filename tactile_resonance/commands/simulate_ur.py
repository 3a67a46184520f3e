# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance simulate-ur`: a simulated UR5e on the ports of a real one."""

from __future__ import annotations

import argparse
import ipaddress
import math
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_resonance.processes import take_priority
from tactile_resonance.simulation.plant.defaults import CAN_PORT, READY, TABLE_IN_BASE

if TYPE_CHECKING:
    from tactile_resonance.simulation.plant.simulated_robot import SimulatedRobot


BENCH_DEFAULTS = {
    "table": TABLE_IN_BASE,
    "surface_height": 0.2,
    "tilt": 0.0,
    "rigid_tip": False,
    "cell": None,
    "mount": "table",
    "can_port": CAN_PORT,
}
"""Options that define what the tool touches."""


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
        "--simulated-time",
        action="store_true",
        help="simulated time: it goes on only as far as the participants on port 30021 allow; without "
        "participants at the pace of real time (default: the wall clock)",
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
    bench = parser.add_argument_group("what the tool touches, on the robot's clock")
    bench.add_argument(
        "--tissue", metavar="NAME", help="of config/tissues.yaml; puts it on the table"
    )
    bench.add_argument(
        "--scene", type=Path, metavar="FILE", help="in its place: a scene of config/scenes"
    )
    bench.add_argument(
        "--table",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "RX", "RY", "RZ"),
        help="frame of the scene in the robot's base: metres and rotation vector",
    )
    bench.add_argument(
        "--surface-height",
        type=float,
        metavar="M",
        help="of the tissue above the robot's base (default: 0.2)",
    )
    bench.add_argument("--tilt", type=float, metavar="DEG", help="(default: 0)")
    bench.add_argument(
        "--rigid-tip", action="store_true", help="the ball without the sensor's beam"
    )
    bench.add_argument(
        "--cell", type=Path, metavar="FILE", help="load cell (default: config/load_cells/fine.yaml)"
    )
    bench.add_argument("--mount", choices=("table", "tool"), help="of the cell (default: table)")
    bench.add_argument("--can-port", type=int, help="its socketcand port (default: 29536)")
    parser.set_defaults(run=run, **BENCH_DEFAULTS)


def run(options: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM, then report how well the pace was kept."""
    _check(options)
    from tactile_resonance.simulation.plant.simulated_robot import SimulatedRobot
    from tactile_resonance.simulation.plant.tabletop import TIP_IN_FLANGE
    from tactile_resonance.simulation.ur5e.controller import ControllerConfig, UrController
    from tactile_resonance.simulation.ur5e.machine import MachineConfig

    nothing = options.tissue is None and options.scene is None
    bench = None if nothing else _Bench(options)
    controller = UrController(
        ControllerConfig(MachineConfig(tip_in_flange=TIP_IN_FLANGE.vector)),
        None if bench is None else bench.tabletop.plant,
        seed=options.seed,
    )
    robot = SimulatedRobot(
        controller,
        options.host,
        simulated_time=options.simulated_time,
        control_port=options.control_port,
    )
    robot.time.seeds.append(lambda seed: controller.reseed((options.seed, *seed)))
    ready = f"{READY} {options.host}, control port {options.control_port}"
    if bench is not None:
        bench.attach(robot)
        ready += f"; {options.tissue or options.scene} under it, load cell: socketcand port {options.can_port}"
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: robot.time.stop())
    if options.priority:
        take_priority(options.priority)
    print(ready, flush=True)
    robot.run()
    print(
        f"ended after {robot.controller.time_s:.1f} s of robot time"
        + ("" if options.simulated_time else f", {robot.time.pace}")
    )
    return 0


class _Bench:
    """Tissue and load cell as the options want them."""

    def __init__(self, options: argparse.Namespace) -> None:
        import numpy as np

        from tactile_resonance.contact.interfaces import Mount
        from tactile_resonance.contact.samples import Pose
        from tactile_resonance.sensor import read_sensor
        from tactile_resonance.simulation.plant.tabletop import BenchSetup, LaidScene, Tabletop
        from tactile_resonance.simulation.tissue.library import read_tissues
        from tactile_resonance.simulation.tissue.scene import read_scene

        library = read_tissues()
        laid = None
        if options.scene is not None:
            table = Pose.from_vector(np.array(options.table))
            laid = LaidScene(read_scene(library, options.scene), table)
        setup = BenchSetup(
            tissue=options.tissue or BenchSetup.tissue,
            surface_height_m=options.surface_height,
            tilt_rad=math.radians(options.tilt),
            rigid_tip=options.rigid_tip,
            mount=Mount(options.mount),
        )
        self.tabletop = Tabletop(setup, library, read_sensor(), laid)
        self._options = options

    def attach(self, robot: SimulatedRobot) -> None:
        """Serve the cell's bus and take orders for both at the robot's control port."""
        from tactile_resonance.simulation.cell.load_cell import LoadCell
        from tactile_resonance.simulation.cell.tcp_bus import SocketcandServer
        from tactile_resonance.simulation.cell.transducer import CellParameters
        from tactile_resonance.simulation.plant.tabletop import attach, attach_cell

        options = self._options
        cell = LoadCell(CellParameters.from_yaml(options.cell), options.seed + 1)
        try:
            bus = SocketcandServer(robot.reactor, options.can_port, cell.receive)
        except ValueError as error:
            raise ValueError(f"--can-port: {error}") from error
        robot.time.seeds.append(lambda seed: cell.reseed((options.seed + 1, *seed)))
        attach(robot, self.tabletop)
        attach_cell(robot, self.tabletop.plant, cell, bus)


def require_loopback(host: str) -> None:
    """Raise ``ValueError`` unless an address is of this machine alone: nobody else may move anything."""
    try:
        loopback = ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise ValueError(f"--host: {host!r}, expected an address 127.x.y.z")


def _check(options: argparse.Namespace) -> None:
    require_loopback(options.host)
    for name in ("control_port", "can_port"):
        port = getattr(options, name)
        if not 1024 <= port <= 65535:
            raise ValueError(f"--{name.replace('_', '-')}: {port}, expected 1024 to 65535")
    if not all(abs(value) <= 10.0 for value in options.table):
        raise ValueError(f"--table: {options.table}, expected numbers within +-10")
    if not 0 <= options.priority <= 99:
        raise ValueError(f"--priority: {options.priority}, expected 0 to 99")
    if options.tissue is not None and options.scene is not None:
        raise ValueError("--tissue, --scene: both given, expected one of them")
    if options.seed < 0:
        raise ValueError(f"--seed: {options.seed}, expected at least 0")
    _check_used(options)


def _check_used(options: argparse.Namespace) -> None:
    """Refuse what would be passed over in silence."""
    needed = {
        **dict.fromkeys(("rigid_tip", "cell", "mount", "can_port"), ("tissue", "scene")),
        **dict.fromkeys(("surface_height", "tilt"), ("tissue",)),
        "table": ("scene",),
    }
    for name, others in needed.items():
        given = getattr(options, name) != BENCH_DEFAULTS[name]
        if given and all(getattr(options, other) is None for other in others):
            wanted = " or ".join(f"--{other}" for other in others)
            raise ValueError(f"--{name.replace('_', '-')}: serves only with {wanted}")
