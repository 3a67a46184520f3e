# SPDX-License-Identifier: Apache-2.0
"""What the tip is in contact with as the bench begins to play."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tactile_resonance.simulation.bench import SimulatedBench
from tactile_resonance.simulation.bimorph import CoupledBimorph, couple
from tactile_resonance.simulation.contact import contact_of_radius
from tactile_resonance.simulation.tissue import Tissue


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
