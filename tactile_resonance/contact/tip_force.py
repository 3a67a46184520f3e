# SPDX-License-Identifier: Apache-2.0
"""A cell, where it sits and where the arm is, together: the force source at the tip."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from tactile_resonance.contact.interfaces import Cell, ForceInfo
from tactile_resonance.contact.mounting import Motion, Mounting
from tactile_resonance.contact.samples import ArmSample, WrenchSample


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
        self._cell, self._mounting, self._arm_state = cell, mounting, arm_state
        self._window_ns = inertia_window_s * 1e9
        self._states: deque[ArmSample] = deque()

    @property
    def info(self) -> ForceInfo:
        """What the cell can do."""
        return self._cell.info

    def start(self) -> None:
        """Start the cell. Raises `ForceError`."""
        self._states.clear()
        self._cell.start()

    def read(self) -> list[WrenchSample]:
        """Wrenches since the last call, oldest first, with the newest pose. Raises `ForceError`."""
        samples = self._cell.read()
        motion = self._motion()
        if not samples:
            return []
        wrenches = self._mounting.to_tip(np.array([sample.wrench for sample in samples]), motion)
        return [
            WrenchSample(sample.time_ns, wrench[:3], wrench[3:], sample.overload)
            for sample, wrench in zip(samples, wrenches, strict=True)
        ]

    def close(self) -> None:
        """Close the cell."""
        self._cell.close()

    def _motion(self) -> Motion:
        state = self._arm_state()
        at_rest = Motion.at_rest(state.tip)
        if not self._window_ns:
            return at_rest
        if not self._states or state.time_ns > self._states[-1].time_ns:
            self._states.append(state)
        while state.time_ns - self._states[0].time_ns > self._window_ns:
            self._states.popleft()
        if len(self._states) < 3:
            return at_rest
        t = np.array([s.time_ns - state.time_ns for s in self._states]) * 1e-9
        velocity = np.array([s.tip_velocity for s in self._states])  # (n, 6)
        t = t - t.mean()
        slope = t @ velocity / (t @ t)
        return Motion(at_rest.position_m, at_rest.rotation, slope[:3], velocity[-1, 3:], slope[3:])
