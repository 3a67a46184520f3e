# SPDX-License-Identifier: Apache-2.0
"""What modes outside the band do to the poles: exact records of the simulated bench."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np

from benchmarks.poles_plant import BAND_HZ, HARMONICS, SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD
from tactile_resonance._typing import FloatArray
from tactile_resonance.configuration import share_path
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.simulation.sensor.bench import BenchEffects, SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues

TISSUES = ("gel10", "gel12", "gel14", "gel16", "cortex", "white", "liver")
PERIODS = 8


def tissue_bias(structures: Sequence[ModelStructure]) -> dict[str, list[FloatArray]]:
    """Error of noise-free fits over the noise standard deviation of noisy ones.

    Returns
    -------
    dict
        Of each tissue a list over structures of (2,) [f0, damping].
    """
    bench = SimulatedBench.from_configuration()
    library = read_tissues(share_path("config/tissues.yaml"))
    rng = np.random.default_rng(0)
    excitation = SimpleNamespace(
        harmonics=HARMONICS,
        amplitude_v=np.full(HARMONICS.size, np.sqrt(2 / HARMONICS.size)),
        phase_rad=rng.uniform(0, 2 * np.pi, HARMONICS.size),
        sample_rate_hz=SAMPLE_RATE_HZ,
        samples_per_period=SAMPLES_PER_PERIOD,
    )
    plans = [
        JointPlan(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, PERIODS, HARMONICS, BAND_HZ, structure)
        for structure in structures
    ]
    result: dict[str, list[FloatArray]] = {}
    for name in TISSUES:
        records = []
        for effects in (BenchEffects.none(), BenchEffects()):
            run = bench.start(library[name], seed=0, effects=effects)
            blocks = [run.block(excitation) for _ in range(PERIODS)]
            records.append([np.stack([b.actuator.volts().ravel() for b in blocks]),
                            np.stack([b.sensor.volts().ravel() for b in blocks])])  # fmt: skip
        mode = run.coupled.mode_near(250.0)
        truth = np.array([mode.f0_hz, mode.damping_ratio])
        result[name] = []
        for plan in plans:
            exact, noisy = (plan(*record) for record in records)
            estimate = np.array([exact.f0_hz[0], exact.damping_ratio[0]])
            result[name].append((estimate - truth) / np.sqrt(np.diagonal(noisy.covariance[0])))
    return result
