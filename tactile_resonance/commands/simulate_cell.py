# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance simulate-cell`: a load cell on CAN, as a process of its own."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from tactile_resonance.commands.simulate_ur import require_loopback
from tactile_resonance.fields import number
from tactile_resonance.simulation.cell.load_cell import LoadCell
from tactile_resonance.simulation.cell.tcp_bus import (
    Receiver,
    SlcanServer,
    SocketcandServer,
    TcpBus,
)
from tactile_resonance.simulation.cell.transducer import SAMPLE_PERIOD_S, CellParameters
from tactile_resonance.simulation.plant.bench_time import BenchTime
from tactile_resonance.simulation.ur5e.reactor import Reactor

BUSES: dict[str, Callable[[Reactor, int, Receiver], TcpBus]] = {
    "socketcand": SocketcandServer,
    "slcan": SlcanServer,
}


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "simulate-cell",
        help="a simulated load cell on CAN",
        description="Serve a simulated six-axis load cell with the frames of Robotous on a CAN bus over TCP, "
        "until interrupted. Lines on standard input change it: 'force 0.01' presses 10 mN on "
        "its z axis; 'silent 1', 'stuck 1', 'lose_second_every 2', 'invalid 1', 'saturated 1', 'flipped 1', "
        "'bias_step_n 0.02' make it faulty, and 0 ends the fault.",
    )
    parser.add_argument("--host", default="127.0.1.1", help="any 127.x.y.z (default: 127.0.1.1)")
    parser.add_argument("--port", type=int, default=29536, help="0: a free one (default: 29536)")
    parser.add_argument(
        "--bus",
        choices=tuple(BUSES),
        default="socketcand",
        help="how it is served over TCP: as a socketcand with the bus can0, or as a serial adapter at "
        "socket://HOST:PORT (default: socketcand)",
    )
    parser.add_argument(
        "--cell",
        type=Path,
        metavar="FILE",
        help="its scale and errors (default: config/load_cells/fine.yaml)",
    )
    parser.add_argument("--seed", type=int, default=1, help="of its noise (default: 1)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve until interrupted or terminated."""
    require_loopback(options.host)
    if not 0 <= options.port <= 65535:
        raise ValueError(f"--port: {options.port}, expected 0 to 65535")
    if options.seed < 0:
        raise ValueError(f"--seed: {options.seed}, expected 0 or above")
    cell = LoadCell(CellParameters.from_yaml(options.cell), options.seed)
    reactor = Reactor(options.host)
    bus = BUSES[options.bus](reactor, options.port, cell.receive)
    pace = BenchTime(reactor, round(SAMPLE_PERIOD_S * 1e9), simulated=False)
    for which in (signal.SIGINT, signal.SIGTERM):
        signal.signal(which, lambda *_: pace.stop())
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
