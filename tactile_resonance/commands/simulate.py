# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance simulate-ur` and `simulate-cell`: a UR5e and a load cell on the ports of real ones."""

from __future__ import annotations

import argparse
import ipaddress
import math
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_resonance.commands.options import add_option
from tactile_resonance.contact.vectors import six
from tactile_resonance.fields import number, require
from tactile_resonance.processes import take_priority
from tactile_resonance.simulation.cell.tcp_bus import (
    Receiver,
    SlcanServer,
    SocketcandServer,
    TcpBus,
)
from tactile_resonance.simulation.cell.transducer import SAMPLE_PERIOD_S, CellParameters, LoadCell
from tactile_resonance.simulation.plant.bench_time import BenchTime
from tactile_resonance.simulation.plant.defaults import CAN_PORT, READY, TABLE_IN_BASE
from tactile_resonance.simulation.ur5e.reactor import Reactor

if TYPE_CHECKING:
    from tactile_resonance.simulation.plant.plant import Plant
    from tactile_resonance.simulation.plant.simulated_robot import SimulatedRobot

BUSES: dict[str, Callable[[Reactor, int, Receiver], TcpBus]] = {
    "socketcand": SocketcandServer,
    "slcan": SlcanServer,
}


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of both commands."""
    parser = commands.add_parser(
        "simulate-ur",
        help="a simulated UR5e that ur_rtde connects to",
        description="Serve RTDE (30004), dashboard (29999), scripts (30003) and a port for faults on one "
        "address, at 500 Hz, until interrupted. Nothing here is a robot.",
    )
    add_option(parser, "--host", "127.0.1.1", "any 127.x.y.z, one for each robot")
    add_option(
        parser, "--simulated-time", False,
        "simulated time: it goes on only as far as the participants on port 30021 allow; without "
        "participants at the pace of real time (default: the wall clock)",
    )
    add_option(parser, "--control-port", 30020, "for faults and queries")
    add_option(parser, "--seed", 0, "of noise and wander")
    text = "real-time priority 1 to 99 (SCHED_FIFO; needs the right to it)"
    add_option(parser, "--priority N", int, text, default=0)
    bench = parser.add_argument_group("what the tool touches, on the robot's clock")
    add_option(bench, "--tissue NAME", str, "of config/tissues.yaml; puts it on the table")
    add_option(bench, "--scene FILE", Path, "in its place: a scene of config/scenes")
    text = "frame of the scene in the robot's base: metres and rotation vector"
    add_option(bench, "--table X Y Z RX RY RZ", float, text, default=TABLE_IN_BASE)
    add_option(bench, "--surface-height M", 0.2, "of the tissue above the robot's base")
    add_option(bench, "--tilt DEG", float, "(default: 0)", default=0.0)
    add_option(bench, "--rigid-tip", False, "the ball without the sensor's beam")
    add_option(bench, "--cell FILE", Path, "load cell (default: config/load_cells/fine.yaml)")
    add_option(bench, "--mount", "table", "of the cell", choices=("table", "tool"))
    add_option(bench, "--can-port", CAN_PORT, "its socketcand port")
    parser.set_defaults(run=_simulate_ur, default_of=parser.get_default)
    parser = commands.add_parser(
        "simulate-cell",
        help="a simulated load cell on CAN",
        description="Serve a simulated six-axis load cell with the frames of Robotous on a CAN bus over TCP, "
        "until interrupted. Lines on standard input change it: 'force 0.01' presses 10 mN on "
        "its z axis; 'silent 1', 'stuck 1', 'lose_second_every 2', 'invalid 1', 'saturated 1', 'flipped 1', "
        "'bias_step_n 0.02' make it faulty, and 0 ends the fault.",
    )
    add_option(parser, "--host", "127.0.1.1", "any 127.x.y.z")
    add_option(parser, "--port", 29536, "0: a free one")
    add_option(
        parser, "--bus", "socketcand",
        "how it is served over TCP: as a socketcand with the bus can0, or as a serial adapter at "
        "socket://HOST:PORT",
        choices=tuple(BUSES),
    )
    text = "its scale and errors (default: config/load_cells/fine.yaml)"
    add_option(parser, "--cell FILE", Path, text)
    add_option(parser, "--seed", 1, "of its noise")
    parser.set_defaults(run=_simulate_cell)


def _simulate_ur(options: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM, then report how well the pace was kept."""
    _check_ur(options)
    from tactile_resonance.simulation.plant.simulated_robot import SimulatedRobot
    from tactile_resonance.simulation.plant.tabletop import TIP_IN_FLANGE
    from tactile_resonance.simulation.ur5e.controller import UrController
    from tactile_resonance.simulation.ur5e.machine import MachineConfig

    nothing = options.tissue is None and options.scene is None
    plant = None if nothing else _plant(options)
    controller = UrController(
        MachineConfig(tip_in_flange=six(TIP_IN_FLANGE.vector)),
        plant,
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
    if plant is not None:
        _attach(robot, plant, options)
        ready += f"; {options.tissue or options.scene} under it, load cell: socketcand port {options.can_port}"
    _stop_when_asked(robot.time)
    if options.priority:
        take_priority(options.priority)
    print(ready, flush=True)
    robot.run()
    print(
        f"ended after {robot.controller.time_s:.1f} s of robot time"
        + ("" if options.simulated_time else f", {robot.time.pace}")
    )
    return 0


def _plant(options: argparse.Namespace) -> Plant:
    """Tissue and load cell as the options want them."""
    import numpy as np

    from tactile_resonance.contact.payload import Mount
    from tactile_resonance.contact.samples import Pose
    from tactile_resonance.sensor import read_sensor
    from tactile_resonance.simulation.plant.tabletop import bench_surface, table_plant
    from tactile_resonance.simulation.tissue.library import read_tissues
    from tactile_resonance.simulation.tissue.scene import LaidScene, read_scene

    library, sensor = read_tissues(), read_sensor()
    how: dict[str, Any] = {"rigid_tip": options.rigid_tip, "mount": Mount(options.mount)}
    if options.scene is not None:
        table = Pose.from_vector(np.array(options.table))
        laid = LaidScene(read_scene(library, options.scene), table)
        # what is computed once must not hold up the first touch
        laid.tissue_at(laid.table.position_m)
        return table_plant(library, sensor, laid.surface(), laid.tissue_at, laid.scene.motion, **how)
    tissue = library[options.tissue]
    surface = bench_surface(options.surface_height, math.radians(options.tilt))
    return table_plant(library, sensor, surface, lambda _: tissue, **how)


def _attach(robot: SimulatedRobot, plant: Plant, options: argparse.Namespace) -> None:
    """Serve the cell's bus and take orders for tissue and cell at the robot's control port."""
    from tactile_resonance.simulation.plant.tabletop import attach, attach_cell
    from tactile_resonance.simulation.tissue.library import read_tissues

    cell = LoadCell(CellParameters.from_yaml(options.cell), options.seed + 1)
    try:
        bus = SocketcandServer(robot.reactor, options.can_port, cell.receive)
    except ValueError as error:
        raise ValueError(f"--can-port: {error}") from error
    robot.time.seeds.append(lambda seed: cell.reseed((options.seed + 1, *seed)))
    attach(robot, plant, read_tissues())
    attach_cell(robot, plant, cell, bus)


def _check_ur(options: argparse.Namespace) -> None:
    _check_host_and_seed(options)
    for name in ("control_port", "can_port"):
        port = getattr(options, name)
        require(1024 <= port <= 65535, _option(name), port, "1024 to 65535")
    near = all(abs(value) <= 10.0 for value in options.table)
    require(near, "--table", options.table, "numbers within +-10")
    require(0 <= options.priority <= 99, "--priority", options.priority, "0 to 99")
    both = options.tissue is not None and options.scene is not None
    require(not both, "--tissue, --scene", (options.tissue, str(options.scene)), "one of them")
    # what would be passed over in silence
    needed = {
        **dict.fromkeys(("rigid_tip", "cell", "mount", "can_port"), ("tissue", "scene")),
        **dict.fromkeys(("surface_height", "tilt"), ("tissue",)),
        "table": ("scene",),
    }
    for name, others in needed.items():
        given = getattr(options, name) != options.default_of(name)
        if given and all(getattr(options, other) is None for other in others):
            wanted = " or ".join(f"--{other}" for other in others)
            raise ValueError(f"{_option(name)}: serves only with {wanted}")


def _check_host_and_seed(options: argparse.Namespace) -> None:
    try:
        loopback = ipaddress.IPv4Address(options.host).is_loopback
    except ValueError:
        loopback = False
    # of this machine alone: nobody else may move anything
    require(loopback, "--host", options.host, "an address 127.x.y.z")
    require(options.seed >= 0, "--seed", options.seed, "0 or above")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _stop_when_asked(pace: BenchTime) -> None:
    for which in (signal.SIGINT, signal.SIGTERM):
        signal.signal(which, lambda *_: pace.stop())


def _simulate_cell(options: argparse.Namespace) -> int:
    """Serve until interrupted or terminated."""
    _check_host_and_seed(options)
    require(0 <= options.port <= 65535, "--port", options.port, "0 to 65535")
    cell = LoadCell(CellParameters.from_yaml(options.cell), options.seed)
    reactor = Reactor(options.host)
    bus = BUSES[options.bus](reactor, options.port, cell.receive)
    pace = BenchTime(reactor, round(SAMPLE_PERIOD_S * 1e9), simulated=False)
    _stop_when_asked(pace)
    wrench = [0.0] * 6
    threading.Thread(target=_listen, args=(cell, wrench), daemon=True).start()
    began_ns = pace.now_ns

    def step() -> None:
        elapsed_s = (pace.now_ns - began_ns) * 1e-9
        bus.keep_epoch(time.time(), elapsed_s)
        bus.send(cell.step(wrench, elapsed_s))

    pace.steps.append(step)
    print(f"load cell: {options.bus} {options.host}:{bus.port}", flush=True)
    try:
        pace.run()
    finally:
        reactor.close()
    if pace.stalls:
        print(f"load cell: {pace.pace}", file=sys.stderr)
    return 0


def _listen(cell: LoadCell, wrench: list[float]) -> None:
    """Do what the lines on standard input say."""
    for line in sys.stdin:
        words = line.split()
        try:
            if len(words) != 2:
                raise ValueError("expected a name and a number, such as 'force 0.01'")
            value = float(words[1])
            if words[0] == "force":
                wrench[2] = number(value, "force")
            else:
                cell.faults.inject(words[0], value)
        except ValueError as error:
            print(f"load cell: {line.strip()!r}: {error}", file=sys.stderr, flush=True)
