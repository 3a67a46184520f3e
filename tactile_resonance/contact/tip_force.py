# SPDX-License-Identifier: Apache-2.0
"""A cell, where it sits and where the arm is, together: the force source at the tip."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from operator import mul

from tactile_resonance.contact.interfaces import Cell, ForceInfo
from tactile_resonance.contact.mounting import Motion, Mounting
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import turn_from_vector


class TipForce:
    """Wrenches at the tip (a `ForceSource`).

    Parameters
    ----------
    cell : Cell
    mounting : Mounting
    arm_state : callable
        Newest state of the arm, without waiting; what it raises is passed on.
    inertia_window_s : float
        The tip's acceleration, for the inertia of the payload, is the slope of its velocity over this long;
        it is half of that late, and its noise is that of the velocity times ``sqrt(12 / n) / window`` for n
        states. 0: inertia is left in the force.

    Attributes
    ----------
    cell : Cell

    Raises
    ------
    ValueError
        If the cell says that it is mounted elsewhere.
    """

    def __init__(
        self,
        cell: Cell,
        mounting: Mounting,
        arm_state: Callable[[], ArmSample],
        inertia_window_s: float = 0.0,
    ) -> None:
        if cell.info.mount is not mounting.mount:
            raise ValueError(
                f"mount: {cell.info.mount.value} for the cell, {mounting.mount.value} for its frame"
            )
        if not 0 <= inertia_window_s <= 1:
            raise ValueError(f"inertia_window_s: {inertia_window_s!r}, expected 0 to 1 s")
        self.cell, self._mounting, self._arm_state = cell, mounting, arm_state
        # without a payload there is no inertia to take off
        self._window_ns = 0.0 if mounting.payload is None else inertia_window_s * 1e9
        self._states: deque[ArmSample] = deque()

    @property
    def info(self) -> ForceInfo:
        """What the cell can do."""
        return self.cell.info

    def start(self) -> None:
        """Start the cell. Raises `ForceError`."""
        self._states.clear()
        self.cell.start()

    def read(self) -> list[WrenchSample]:
        """Wrenches since the last call, oldest first, with the newest pose. Raises `ForceError`."""
        samples = self.cell.read()
        state = self._arm_state()
        if self._window_ns:
            self._remember(state)
        if not samples:
            return []
        return self._mounting.to_tip(samples, self._motion(state))

    def close(self) -> None:
        """Close the cell."""
        self.cell.close()

    def _remember(self, state: ArmSample) -> None:
        states = self._states
        if not states or state.time_ns > states[-1].time_ns:
            states.append(state)
        while state.time_ns - states[0].time_ns > self._window_ns:
            states.popleft()

    def _motion(self, state: ArmSample) -> Motion:
        turn, states = turn_from_vector(state.rotation_rad), self._states
        if len(states) < 3:
            return Motion(state.position_m, turn)
        times_s = [(other.time_ns - state.time_ns) * 1e-9 for other in states]
        middle_s = sum(times_s) / len(times_s)
        times_s = [time_s - middle_s for time_s in times_s]
        power = sum(map(mul, times_s, times_s))
        axes = zip(*(other.velocity for other in states), strict=True)
        ax, ay, az, bx, by, bz = (sum(map(mul, times_s, axis)) / power for axis in axes)
        spin = states[-1].velocity[3:]
        return Motion(state.position_m, turn, (ax, ay, az), spin, (bx, by, bz))
