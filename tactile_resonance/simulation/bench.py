# SPDX-License-Identifier: Apache-2.0
"""The simulated bench: an excitation in, blocks of sampled actuator and sensor voltage out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tactile_resonance.fields import require
from tactile_resonance.sensor import SensorParameters, read_sensor
from tactile_resonance.simulation.acquisition import BenchEffects
from tactile_resonance.simulation.bench_run import BenchRun
from tactile_resonance.simulation.bimorph import CoupledBimorph, couple
from tactile_resonance.simulation.contact import HertzParameters, hertz_contact
from tactile_resonance.simulation.contact_history import ContactHistory
from tactile_resonance.simulation.library import read_tissues
from tactile_resonance.simulation.tissue import Tissue

DEFAULT_EFFECTS = BenchEffects()


@dataclass(frozen=True)
class SimulatedBench:
    """A sensor on a bench; `start` brings it into contact and returns a run.

    Examples
    --------
    >>> bench = SimulatedBench.from_configuration()
    >>> run = bench.start(read_tissues()["gel10"], seed=1)  # doctest: +SKIP
    >>> for block in run.play(excitation, periods=8):       # doctest: +SKIP
    ...     block.actuator.volts, block.sensor.volts
    """

    sensor: SensorParameters
    contact: HertzParameters

    @classmethod
    def from_configuration(cls) -> SimulatedBench:
        """Return the bench of ``config/sensors/bimorph.yaml`` and ``config/tissues.yaml``."""
        return cls(read_sensor(), read_tissues().contact)

    def coupled(
        self, tissue: Tissue | None, *, force_n: float | None = None, hold_time_s: float = 1.0
    ) -> CoupledBimorph:
        """Return the linear sensor in air (`tissue` None) or on tissue."""
        if tissue is None:
            return couple(self.sensor, None)
        contact = hertz_contact(
            tissue,
            self.sensor.tip.radius_m,
            self.contact,
            force_n=force_n,
            hold_time_s=hold_time_s,
        )
        return couple(self.sensor, contact)

    def start(
        self,
        tissue: Tissue | None,
        *,
        force_n: float | None = None,
        hold_time_s: float = 1.0,
        seed: int = 0,
        effects: BenchEffects = DEFAULT_EFFECTS,
        keep_parts: bool = False,
    ) -> BenchRun:
        """Return a run of the sensor at rest.

        Parameters
        ----------
        tissue : Tissue or None
            None: in air.
        force_n : float, optional
            Preload [N]; that of the contact parameters by default. Not used in air.
        hold_time_s : float
            How long the preload has been held [s]; the contact creeps with it.
        seed : int
            Of everything random. The same seed gives the same samples however they are divided
            into blocks.
        effects : BenchEffects
        keep_parts : bool
            Keep clean signal, distortion, disturbance and noise apart in every block.
        """
        coupled = self.coupled(tissue, force_n=force_n, hold_time_s=hold_time_s)
        return BenchRun(self.sensor, coupled, seed, effects, keep_parts)

    def start_varying(
        self,
        history: ContactHistory,
        *,
        seed: int = 0,
        effects: BenchEffects = DEFAULT_EFFECTS,
        keep_parts: bool = False,
    ) -> BenchRun:
        """Return a run whose contact changes as `history` says, from its first time on.

        Raises
        ------
        ValueError
            If the nonlinearity is asked for: it is not modelled on a changing contact.
        """

        def coupled_at(time_s: float) -> CoupledBimorph:
            return history.coupled_at(self.sensor, time_s)

        return self.start_following(coupled_at, seed=seed, effects=effects, keep_parts=keep_parts)

    def start_following(
        self,
        coupled_at: Callable[[float], CoupledBimorph],
        *,
        seed: int = 0,
        effects: BenchEffects = DEFAULT_EFFECTS,
        keep_parts: bool = False,
    ) -> BenchRun:
        """Return a run whose linear sensor at each time [s] since its start is that of `coupled_at`.

        It is asked for no time beyond the block that is made.

        Raises
        ------
        ValueError
            As `start_varying`.
        """
        require(not effects.nonlinearity, "nonlinearity", True, "off while the contact changes")
        return BenchRun(self.sensor, coupled_at(0.0), seed, effects, keep_parts, coupled_at)
