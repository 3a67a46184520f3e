# SPDX-License-Identifier: Apache-2.0
"""Simulated time as a control loop leads it, one period after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from tactile_resonance.clock import Demand
from tactile_resonance.contact.interfaces import Cell
from tactile_resonance.drivers.can_wrench import CanWrench

if TYPE_CHECKING:
    from tactile_resonance.drivers.ur_arm import UrArm


class LedClock:
    """A `Clock` that a loop leads: when it returns, the data that arm and cell sent until then have been read.

    Parameters
    ----------
    arm : UrArm
        Connected; while this clock is open, its time goes on only as the loop asks for.
    cell : Cell
    while_waiting : callable
        Called every tenth of a second of this machine's time while simulated time stands; what it raises ends
        the wait.
    """

    simulated = True

    def __init__(self, arm: UrArm, cell: Cell, while_waiting: Callable[[], None]) -> None:
        self._arm, self._while_waiting = arm, while_waiting
        self._cell = cell if isinstance(cell, CanWrench) else None
        arm.lead(self._bus_port)
        if self._cell is not None:
            self._cell.clock = arm.clock

    def now_ns(self) -> int:
        """Time now [ns]."""
        return self._arm.clock.now_ns()

    def ros_ns(self, time_ns: int) -> int:
        """The same: simulated time is ROS time."""
        return time_ns

    def own_ns(self, ros_ns: int) -> int:
        """The same."""
        return ros_ns

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        """Let time go on to a time, and wait for all data that robot and cell have sent until then."""
        self._arm.wait_until(time_ns, demand, self._while_waiting)
        if self._cell is not None:
            self._cell.catch_up(self._arm.frames)

    def ask_ns(self) -> int:
        """Time now [ns], asked of the bench: it may have gone on without this clock."""
        return self._arm.ask_ns()

    def hurry(self) -> None:
        """Make a wait that does not demand time demand it: something needs it now. From any thread."""
        self._arm.hurry()

    def close(self) -> None:
        """Lead no more: time goes on without the loop."""
        self._arm.follow()

    def _bus_port(self) -> int:
        return 0 if self._cell is None else self._cell.local_port
