# SPDX-License-Identifier: Apache-2.0
"""A load cell on a bus over TCP in simulated time, which the test leads."""

import threading
from dataclasses import replace
from pathlib import Path

from tactile_resonance.clock import Demand, SimulatedClock
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.simulation.cell.tcp_bus import SocketcandServer
from tactile_resonance.simulation.cell.transducer import SAMPLE_PERIOD_S, CellParameters, LoadCell
from tactile_resonance.simulation.plant.bench_time import BenchTime
from tactile_resonance.simulation.ur5e.reactor import Reactor

HOST = "127.0.6.4"
STEP_NS = round(SAMPLE_PERIOD_S * 1e9)


def cell_config(host, port, **changes):
    """The shipped configuration of a simulated cell, at another address."""
    config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
    bus = {**config.bus, "host": host, "port": port}
    return replace(config, **{"bus": bus, **changes})


class CellBench:
    """The bench, run by a thread, and the clock that the test leads it by.

    `wrench` acts on the cell and may be exchanged while time stands.
    """

    def __init__(self, parameters=None, wrench=(0.0,) * 6):
        self.wrench = wrench
        self.cell = LoadCell(parameters or CellParameters.from_yaml(None), 1)
        self._reactor = Reactor(HOST)
        self.bus = SocketcandServer(self._reactor, 0, self.cell.receive)
        self._time = BenchTime(self._reactor, STEP_NS, simulated=True)
        self._time.frames_sent = self.bus.frames_sent
        self._time.steps.append(self._step)
        port = self._reactor.listen(0, self._time.serve)
        self._thread = threading.Thread(target=self._time.run)
        self._thread.start()
        self.clock = SimulatedClock(f"{HOST}:{port}", "test")
        self.clock.hold(self.clock.now_ns(), Demand.NONE)
        self.clock.ask_ns()

    @property
    def port(self):
        return self.bus.port

    def config(self, **changes):
        return cell_config(HOST, self.port, **changes)

    def go(self, source, ticks, steps=1):
        """Samples of `ticks` looks at a cell, or at a source that has one, `steps` wrenches apart."""
        cell = getattr(source, "cell", source)
        self.clock.ports(0, cell.local_port)
        samples = []
        for _ in range(ticks):
            self.clock.wait_until(self.clock.now_ns() + steps * STEP_NS)
            cell.catch_up(self.clock.frames)
            samples += source.read()
        return samples

    def close(self):
        self.clock.close()
        self._time.stop()
        self._thread.join()
        self._reactor.close()

    def _step(self):
        now_s = self._time.now_ns * 1e-9
        self.bus.send(self.cell.step(self.wrench, now_s))
