# SPDX-License-Identifier: Apache-2.0
"""A load cell and its bus on the wall clock, without a robot beside them."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.load_cell import LoadCell
from tactile_resonance.simulation.tcp_bus import TcpBus
from tactile_resonance.simulation.transducer import SAMPLE_PERIOD_S

STALL_S = 0.010


class CellLoop:
    """Steps a cell every millisecond and serves its bus.

    Parameters
    ----------
    cell : LoadCell
    bus : TcpBus
    wrench_at : callable
        From the time since the start [s] to the wrench on the cell (6,) [N, N m].

    Attributes
    ----------
    stalls : int
        How often the loop itself was more than 10 ms late: what readers saw then is no property of
        the cell.
    """

    def __init__(
        self, cell: LoadCell, bus: TcpBus, wrench_at: Callable[[float], NDArray[np.float64]]
    ) -> None:
        self._cell, self._bus, self._wrench_at = cell, bus, wrench_at
        self.stalls = 0

    def run(self, stopped: Callable[[], bool]) -> None:
        """Run until `stopped` says so."""
        start_s = time.monotonic()
        self._bus.epoch_s = time.time()
        due_s = start_s
        while not stopped():
            for can_id, data in self._bus.poll():
                self._bus.send(self._cell.receive(can_id, data))
            now_s = time.monotonic()
            self.stalls += now_s - due_s > STALL_S
            elapsed_s = now_s - start_s
            self._bus.send(self._cell.step(self._wrench_at(elapsed_s), elapsed_s))
            due_s = max(due_s + SAMPLE_PERIOD_S, now_s)
            time.sleep(max(0.0, due_s - time.monotonic()))
