# SPDX-License-Identifier: Apache-2.0
"""Whole experiments on the simulated bench: drive levels, repeated records, calibration; truth over a surface.

The spreads between positions and preparations are chosen (mark C) so that the order of the paper's figure 9
(arXiv 1805.00682) shows around the mode: periods < repetitions < positions < preparations, the last near
-30 dB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.calibration.model import SensorModel
from tactile_resonance.calibration.records import CalibrationRecord, Load
from tactile_resonance.fields import require
from tactile_resonance.multisine import Excitation, Grid, design_multisine
from tactile_resonance.sensor import SensorParameters
from tactile_resonance.simulation.sensor.bench import (
    DEFAULT_EFFECTS,
    BenchEffects,
    BenchRun,
    SimulatedBench,
)
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, sensor_model
from tactile_resonance.simulation.sensor.response import PoleResidueModel
from tactile_resonance.simulation.tissue.library import HertzContact, Tissue, read_tissues
from tactile_resonance.simulation.tissue.scene import PhantomScene

# Standard deviations; C.
PREPARATION_PERCENT = 0.25  # of the concentration [% w/w] between two castings
POSITION_PERCENT = 0.15  # of the concentration [% w/w] within one dish
FORCE_N = 1.5e-4  # of the preload between repetitions [N]
SPREAD = 0.03
"""Relative standard deviation of every parameter between sensors of one kind."""

Progress = Callable[[str], None]


def records_at_levels(
    levels_v: Iterable[float],
    *,
    realisations: int = 4,
    periods: int = 3,
    progress: Progress = lambda text: None,
) -> dict[float, tuple[FloatArray, FloatArray, IntArray, float]]:
    """Records of an odd random multisine at several drive levels on 10 % gelatine, nonlinearity switched on.

    Returns
    -------
    dict
        Per level [V rms]: actuator and sensor (M, P, N) [V], excited harmonics, sample rate [Hz].
    """
    bench = SimulatedBench.from_configuration()
    tissue = read_tissues().gelatine(10.0)
    records = {}
    for level_v in levels_v:
        channels = []
        for m in range(realisations):
            progress(f"{level_v:g} V, realisation {m + 1} of {realisations}")
            excitation = design_multisine(
                grid=Grid.ODD_RANDOM,
                level_v=level_v,
                seed=1,
                realisation=m,
                realisations=realisations,
            )
            run = bench.start(tissue, seed=1 + m, effects=BenchEffects(nonlinearity=True))
            block = run.block(excitation, periods)
            channels.append([block.actuator.volts(), block.sensor.volts()])
        u, y = np.moveaxis(np.array(channels), 1, 0).reshape(2, realisations, periods, -1)
        records[level_v] = (u, y, excitation.harmonics, excitation.sample_rate_hz)
    return records


def repeated_records(
    *,
    preparations: int = 3,
    positions: int = 4,
    repetitions: int = 4,
    periods: int = 4,
    seed: int = 1,
    progress: Progress = lambda text: None,
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    """Records of the same excitation on several preparations of 12 % gelatine, positions and repetitions.

    Returns
    -------
    u, y : (preparations, positions, repetitions, periods, N) float
        Actuator and sensor [V]; the first period of each repetition, not settled, is left out.
    harmonics : (F,) int
    sample_rate_hz : float
    """
    bench = SimulatedBench.from_configuration()
    library = read_tissues()
    rng = np.random.default_rng(seed)
    excitation = design_multisine(seed=seed)
    n = excitation.samples_per_period
    u, y = np.empty((2, preparations, positions, repetitions, periods, n))
    for i in range(preparations):
        casting = 12.0 + PREPARATION_PERCENT * rng.standard_normal()
        for j in range(positions):
            progress(f"preparation {i + 1} of {preparations}, position {j + 1} of {positions}")
            tissue = library.gelatine(casting + POSITION_PERCENT * rng.standard_normal())
            for k in range(repetitions):
                force_n = bench.contact.force_n + FORCE_N * rng.standard_normal()
                run = bench.start(tissue, force_n=force_n, seed=int(rng.integers(2**62)))
                block = run.block(excitation, periods + 1)
                for target, channel in ((u, block.actuator), (y, block.sensor)):
                    target[i, j, k] = channel.volts().reshape(periods + 1, n)[1:]
    return u, y, excitation.harmonics, excitation.sample_rate_hz


def truth_over(
    bench: SimulatedBench, scene: PhantomScene, position_m: ArrayLike, *, hold_time_s: float = 1.0
) -> NDArray[np.object_]:
    """Return the exact linear sensor at positions (..., 2 or 3) [m], at the scene's force.

    Parameters
    ----------
    bench, scene
    position_m : (..., 2 or 3) array
    hold_time_s : float
        As in `hertz_contact`.

    Returns
    -------
    (...) array of CoupledBimorph
        None where there is nothing.
    """
    position = np.asarray(position_m, dtype=float)
    sensors = np.full(position.shape[:-1], None)
    for at in np.ndindex(sensors.shape):
        tissue = scene.tissue_at(position[at])
        if tissue is not None:
            sensors[at] = bench.coupled(tissue, force_n=scene.force_n, hold_time_s=hold_time_s)
    require(bool(np.any(sensors)), "position_m", position.shape, "a position on the phantoms")
    return sensors


def another_sensor(sensor: SensorParameters, seed: int) -> SensorParameters:
    """Return a sensor of the same kind, all parameters of beam, tip and electronics a few percent off."""
    rng = np.random.default_rng([seed, 3])

    def off(part: object, *but: str) -> dict[str, float]:
        names = [field.name for field in fields(part) if field.name not in but]  # type: ignore[arg-type]
        return {
            name: getattr(part, name) * float(np.exp(SPREAD * rng.standard_normal()))
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
    return replace(sensor_model(bench.sensor), delay_s=np.array(delay_s))


def records_of_calibration(
    bench: SimulatedBench,
    *,
    masses_kg: Iterable[float] = (5e-5,),
    springs_n_per_m: Iterable[float] = (),
    seed: int = 1,
    effects: BenchEffects = DEFAULT_EFFECTS,
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
    made, loads = [], [*loads, ("loopback", 0.0)]
    noise_seeds = np.random.SeedSequence([seed, 12]).generate_state(len(loads), np.uint64).tolist()
    for noise_seed, (kind, value) in zip(noise_seeds, loads, strict=True):
        coupled = CoupledBimorph(sensor_model(bench.sensor), _known_load(kind, value) if value else None)
        if kind == "loopback":
            nothing = np.zeros(0, complex)
            wire = PoleResidueModel(nothing, nothing, 1.0)  # both channels on the generator
            coupled = SimpleNamespace(modal=wire)  # type: ignore[assignment]
        run = BenchRun(bench.sensor, coupled, noise_seed, effects)
        run.block(excitation, settling)
        block = run.block(excitation, periods)
        u, y = (
            np.asarray(part.volts(), float).reshape(periods, samples)
            for part in (block.actuator, block.sensor)
        )
        made.append((kind, value, u, y))
    return made, harmonics, rate_hz


def calibration_records(bench: SimulatedBench, **options: Any) -> list[CalibrationRecord]:
    """Those of `records_of_calibration`, whose options they are; loads are known to a thousandth."""
    made, harmonics, rate_hz = records_of_calibration(bench, **options)
    known: dict[str, Any] = {"sample_rate_hz": rate_hz, "harmonics": harmonics}
    return [
        CalibrationRecord.of_samples(
            u, y, **known, load=Load(kind), value=value, value_std=1e-3 * value, name=kind
        )
        for kind, value, u, y in made
    ]


def _known_load(kind: str, value: float) -> HertzContact:
    """A mass [kg] or a spring [N/m] at the tip."""
    # a trace of relaxation, and of stiffness beside a mass: without any, a state would be seen by nothing
    mass_kg, stiffness = (value, 1e-6) if kind == "mass" else (0.0, value)
    elastic = Tissue(kind, 1.0, (1.0,), (1e-8,))
    return HertzContact(elastic, 0.0, 0.0, 0.0, stiffness, 0.0, mass_kg)
