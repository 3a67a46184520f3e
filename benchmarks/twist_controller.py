# SPDX-License-Identifier: Apache-2.0
"""A Cartesian velocity controller with its arm on the bench, as others' controllers behave (docs/twist.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_resonance.contact.samples import CellSample, Pose
from tactile_resonance.simulation.plant.contact_bench import ContactBench

TIMEOUT_NS = 50_000_000
"""A command older than this counts no more."""
ACCELERATION_M_S2 = 2.0


class TwistController:
    """Follows the newest twist, under a limit of acceleration; zero where none has come for a while.

    Parameters
    ----------
    bench : ContactBench
    rate_hz : float
        Of its steps; a whole number of the bench's periods each.

    Attributes
    ----------
    wrenches : list of CellSample
        What the cell sent in the newest step; the newest was measured a period of the bench before its end.
    active : bool
        False: somebody has switched to another controller; commands are not followed.
    force_n : list of (float, float)
        Time [s] and true normal force of every period of the bench [N].
    height_m : list of float
        Of the tip in the base at the same times [m].
    """

    def __init__(self, bench: ContactBench, rate_hz: float) -> None:
        self.active = True
        self.force_n: list[tuple[float, float]] = []
        self.height_m: list[float] = []
        self._bench, self._period_ns = bench, round(1e9 / rate_hz)
        self._commanded_ns, self._twist = 0, np.zeros(6)
        self.wrenches: list[CellSample] = []
        bench.on_step.append(self._record)
        self.step()

    @property
    def time_ns(self) -> int:
        """Time of the newest step [ns]."""
        return self._bench.time_ns

    @property
    def pose(self) -> Pose:
        """Of the tool, as the encoders say."""
        return self._bench.motion.reported

    def command(self, stamp_ns: int, twist: Sequence[float]) -> None:
        """Take a twist (6,) of the tool in the base [m/s, rad/s]."""
        self._commanded_ns, self._twist = stamp_ns, np.array(twist, dtype=float)

    def step(self) -> None:
        """Go on by one step."""
        late = self.time_ns - self._commanded_ns > TIMEOUT_NS
        twist = np.zeros(6) if late or not self.active else self._twist
        bench = self._bench
        bench.motion.speed(twist, ACCELERATION_M_S2)
        bench.wait_until(bench.time_ns + self._period_ns)
        self.wrenches = bench.cell.read()

    def _record(self) -> None:
        plant = self._bench.plant
        self.force_n.append((self.time_ns * 1e-9, plant.normal_force_n))
        self.height_m.append(plant.tip_m[2])
