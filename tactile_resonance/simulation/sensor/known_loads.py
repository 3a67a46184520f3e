# SPDX-License-Identifier: Apache-2.0
"""Records from which a sensor is calibrated, and what a calibration of a simulated sensor should find."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.calibration.model import SensorModel
from tactile_resonance.multisine import Excitation
from tactile_resonance.sensor import SensorParameters
from tactile_resonance.simulation.sensor.acquisition import BenchEffects
from tactile_resonance.simulation.sensor.bench import DEFAULT_EFFECTS, BenchRun, SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import couple
from tactile_resonance.simulation.sensor.experiments import Progress
from tactile_resonance.simulation.sensor.linear import PoleResidueModel
from tactile_resonance.simulation.tissue.hertz import HertzContact, Tissue

SPREAD = 0.03
"""Relative standard deviation of every parameter between sensors of one kind."""


def another_sensor(sensor: SensorParameters, seed: int, spread: float = SPREAD) -> SensorParameters:
    """Return a sensor of the same kind, all parameters of beam, tip and electronics a few percent off."""
    rng = np.random.default_rng([seed, 3])

    def off(part: object, *but: str) -> dict[str, float]:
        names = [field.name for field in fields(part) if field.name not in but]  # type: ignore[arg-type]
        return {
            name: getattr(part, name) * float(np.exp(spread * rng.standard_normal()))
            for name in names
        }

    return replace(
        sensor,
        beam=replace(sensor.beam, **off(sensor.beam, "mode_count")),  # type: ignore[arg-type]
        tip=replace(sensor.tip, **off(sensor.tip)),
        electric=replace(sensor.electric, **off(sensor.electric)),
    )


def true_sensor(bench: SimulatedBench, delay_s: float = 0.0) -> SensorModel:
    """Return the parameters that a calibration of a bench should find, its channels so far apart."""
    air = bench.coupled(None)
    beam = air.beam
    sign = np.sign(beam.coupling)
    return SensorModel(
        beam.natural_rad_s,
        np.full(beam.natural_rad_s.size, beam.damping_ratio),
        np.abs(beam.coupling) / np.sqrt(beam.capacitance_f),
        beam.tip_deflection * sign,
        np.array(air.feedthrough),
        np.array(1 / (air.input_resistance_ohm * beam.capacitance_f)),
        np.array(1.0),
        np.array(delay_s),
    )


def records_of_calibration(
    bench: SimulatedBench,
    *,
    masses_kg: Iterable[float] = (5e-5,),
    springs_n_per_m: Iterable[float] = (),
    seed: int = 1,
    effects: BenchEffects = DEFAULT_EFFECTS,
    progress: Progress = lambda text: None,
) -> tuple[list[tuple[str, float, FloatArray, FloatArray]], IntArray, float]:
    """Records in air, with masses and springs at the tip, and of a loop-back, in the steady state.

    Lines of 0.5 Hz up to 1 kHz, of 2 Hz up to 12 kHz, above the highest of ten modes; 1 V rms; the first
    4 s are left out, then four periods of 2 s.

    Returns
    -------
    records : list of (str, float, (P, N) float, (P, N) float)
        What the tip touches (air, mass, spring, loopback), its value [kg or N/m], actuator and sensor [V].
    harmonics : (F,) int
    sample_rate_hz : float
    """
    rate_hz, samples, settling, periods = 50e3, 100_000, 2, 4
    low, high = np.arange(20, 2000), np.arange(2000, 24_001, 4)
    harmonics = np.concatenate([low, high]).astype(np.int64)
    rng = np.random.default_rng([seed, 11])
    excitation = Excitation(
        harmonics,
        np.full(harmonics.size, np.sqrt(2 / harmonics.size)),
        rng.uniform(0, 2 * np.pi, harmonics.size),
        rate_hz,
        samples,
    )
    loads = [
        ("air", 0.0),
        *(("mass", m) for m in masses_kg),
        *(("spring", k) for k in springs_n_per_m),
    ]
    made = []
    for index, (kind, value) in enumerate([*loads, ("loopback", 0.0)]):
        progress(f"{kind} {value:g}" if value else kind)
        coupled = couple(bench.sensor, _known_load(kind, value) if value else None)
        if kind == "loopback":
            nothing = np.zeros(0, complex)
            coupled = _Wire(PoleResidueModel(nothing, nothing, 1.0))  # type: ignore[assignment]
        run = BenchRun(bench.sensor, coupled, seed + index, effects, False)
        run.block(excitation, settling)
        block = run.block(excitation, periods)
        u, y = (
            np.asarray(part.volts(), float).reshape(periods, samples)
            for part in (block.actuator, block.sensor)
        )
        made.append((kind, value, u, y))
    return made, harmonics, rate_hz


@dataclass(frozen=True)
class _Wire:
    """Both channels on the generator."""

    modal: PoleResidueModel


def _known_load(kind: str, value: float) -> HertzContact:
    """A mass [kg] or a spring [N/m] at the tip."""
    # a trace of relaxation, and of stiffness beside a mass: without any, a state would be seen by nothing
    mass_kg, stiffness = (value, 1e-6) if kind == "mass" else (0.0, value)
    elastic = Tissue(kind, 1.0, (1.0,), (1e-8,))
    return HertzContact(elastic, 0.0, 0.0, 0.0, stiffness, 0.0, mass_kg)
