# SPDX-License-Identifier: Apache-2.0
"""What the tip touches on the bench, as one contact or part by part as a plant reports it; poles over time."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from tactile_resonance._typing import ComplexArray
from tactile_resonance.fields import require
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, couple
from tactile_resonance.simulation.tissue.hertz import Tissue, contact_of_radius


def pole_trajectory(sensors: Iterable[CoupledBimorph]) -> ComplexArray:
    """Return the pole of one resonance of each of some sensors, one after another in time [rad/s].

    The resonance is that of the first whose natural frequency is nearest to 250 Hz, and then the nearest
    to itself.
    """
    poles: list[complex] = []
    for coupled in sensors:
        if poles:
            found = min((m.pole_rad_s for m in coupled.modes), key=lambda p: abs(p - poles[-1]))
        else:
            found = coupled.mode_near(250.0).pole_rad_s
        poles.append(found)
    return np.array(poles)


@dataclass(frozen=True)
class BenchTip:
    """What the tip is in contact with.

    Attributes
    ----------
    tissue : Tissue or None
        None: air.
    force_n : float
    since_s : float
        How long the force has been held [s].
    contact_radius_m, depth_m : float
        As a plant has them [m]; NaN: those of Hertz under the force after `since_s`.
    """

    tissue: Tissue | None
    force_n: float
    since_s: float
    contact_radius_m: float = math.nan
    depth_m: float = math.nan

    def coupled(self, bench: SimulatedBench) -> CoupledBimorph:
        """The linear sensor on it."""
        if self.tissue is None or math.isnan(self.contact_radius_m):
            return bench.coupled(
                self.tissue, force_n=self.force_n or None, hold_time_s=self.since_s
            )
        contact = contact_of_radius(
            self.tissue,
            self.contact_radius_m,
            bench.contact,
            force_n=self.force_n,
            indentation_m=self.depth_m,
        )
        return couple(bench.sensor, contact)


LEAST_RADIUS_M = 1e-6
"""A contact that is lost stays one of this radius: its stiffness is below a hundredth of that at 1 cN."""

ContactState = tuple[float, float, float]
"""Mean force [N], contact radius and depth [m] along the normal over a part of time; 0 out of contact."""


class ContactSoFar:
    """Contact over time, constant in each part; beyond the last part it stays.

    A small vibration sees the contact radius alone, whatever force and motion brought it about.

    Parameters
    ----------
    bench : SimulatedBench
    start : BenchTip
        On tissue, at time 0.

    Attributes
    ----------
    parts : list of CoupledBimorph
        The linear sensor on each part so far.
    """

    def __init__(self, bench: SimulatedBench, start: BenchTip) -> None:
        self._bench, self._tip = bench, start
        self._start = start.coupled(bench)
        self._ends_s: list[float] = []
        self.parts: list[CoupledBimorph] = []

    def extend(self, length_s: float, states: Iterable[ContactState | None]) -> None:
        """Take in what followed: equal parts over `length_s`; None: the plant stood still."""
        states = list(states)
        require(length_s > 0, "length_s", length_s, "a number above 0")
        begin = self._ends_s[-1] if self._ends_s else 0.0
        for number, state in enumerate(states, 1):
            last = self.parts[-1] if self.parts else self._start
            self.parts.append(last if state is None else self._coupled(state))
            self._ends_s.append(begin + length_s * number / len(states))

    def coupled_at(self, time_s: float) -> CoupledBimorph:
        """Return the linear sensor on the contact of one time [s]."""
        if not self.parts:
            return self._start
        return self.parts[min(bisect_right(self._ends_s, time_s), len(self.parts) - 1)]

    def _coupled(self, state: ContactState) -> CoupledBimorph:
        force_n, radius_m, depth_m = state
        radius_m = max(radius_m, LEAST_RADIUS_M)
        tip = replace(self._tip, force_n=force_n, contact_radius_m=radius_m, depth_m=depth_m)
        return tip.coupled(self._bench)
