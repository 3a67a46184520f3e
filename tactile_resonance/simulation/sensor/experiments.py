# SPDX-License-Identifier: Apache-2.0
"""Whole experiments on the simulated bench: drive levels, repeated records; and the truth over a surface.

The spreads between positions and preparations are chosen (mark C) so that the order of the paper's figure 9
(arXiv 1805.00682) shows around the mode: periods < repetitions < positions < preparations, the last near
-30 dB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.fields import require
from tactile_resonance.multisine import Grid, design_multisine
from tactile_resonance.simulation.sensor.acquisition import BenchEffects
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import PhantomScene

# Standard deviations; C.
PREPARATION_PERCENT = 0.25  # of the concentration [% w/w] between two castings
POSITION_PERCENT = 0.15  # of the concentration [% w/w] within one dish
FORCE_N = 1.5e-4  # of the preload between repetitions [N]

Progress = Callable[[str], None]


def records_at_levels(
    levels_v: Iterable[float],
    *,
    gelatine_percent: float = 10.0,
    realisations: int = 4,
    periods: int = 3,
    seed: int = 1,
    progress: Progress = lambda text: None,
) -> dict[float, tuple[FloatArray, FloatArray, IntArray, float]]:
    """Records of an odd random multisine at several drive levels, nonlinearity switched on.

    Returns
    -------
    dict
        Per level [V rms]: actuator and sensor (M, P, N) [V], excited harmonics, sample rate [Hz].
    """
    bench = SimulatedBench.from_configuration()
    tissue = read_tissues().gelatine(gelatine_percent)
    records = {}
    for level_v in levels_v:
        channels = []
        for m in range(realisations):
            progress(f"{level_v:g} V, realisation {m + 1} of {realisations}")
            excitation = design_multisine(
                grid=Grid.ODD_RANDOM,
                level_v=level_v,
                seed=seed,
                realisation=m,
                realisations=realisations,
            )
            run = bench.start(tissue, seed=seed + m, effects=BenchEffects(nonlinearity=True))
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
    gelatine_percent: float = 12.0,
    seed: int = 1,
    progress: Progress = lambda text: None,
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    """Records of the same excitation on several preparations, positions and repetitions.

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
        casting = gelatine_percent + PREPARATION_PERCENT * rng.standard_normal()
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
