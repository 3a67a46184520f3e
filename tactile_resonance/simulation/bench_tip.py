# SPDX-License-Identifier: Apache-2.0
"""What the tip is in contact with while the bench plays."""

from __future__ import annotations

from dataclasses import dataclass

from tactile_resonance.simulation.acquisition import BenchEffects
from tactile_resonance.simulation.bench import SimulatedBench
from tactile_resonance.simulation.bench_run import BenchRun
from tactile_resonance.simulation.bimorph import CoupledBimorph
from tactile_resonance.simulation.contact_history import ContactHistory
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
    creeping : bool
        The contact grows on while it is measured; else it stays as it is after `since_s`.
    """

    tissue: Tissue | None
    force_n: float
    since_s: float
    creeping: bool = False

    def coupled(self, bench: SimulatedBench) -> CoupledBimorph:
        """The linear sensor on it."""
        return bench.coupled(self.tissue, force_n=self.force_n or None, hold_time_s=self.since_s)

    def start(
        self, bench: SimulatedBench, duration_s: float, seed: int, effects: BenchEffects
    ) -> BenchRun:
        """A run from rest, the tissue creeping meanwhile; the nonlinearity takes the contact as fixed."""
        if self.tissue is None or not self.creeping or effects.nonlinearity:
            return bench.start(
                self.tissue,
                force_n=self.force_n or None,
                hold_time_s=self.since_s,
                seed=seed,
                effects=effects,
            )
        history = ContactHistory.under_force(
            self.tissue,
            bench.sensor.tip.radius_m,
            bench.contact,
            force_n=self.force_n,
            since_s=self.since_s,
            duration_s=duration_s,
        )
        return bench.start_varying(history, seed=seed, effects=effects)
