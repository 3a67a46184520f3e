# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the simulation's tests."""

from collections.abc import Callable

import numpy as np
import pytest

from tactile_resonance.multisine import Excitation
from tactile_resonance.sensor import SensorParameters, read_sensor
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.response import Lines
from tactile_resonance.simulation.tissue.library import TissueLibrary, read_tissues


@pytest.fixture(scope="session")
def sensor() -> SensorParameters:
    return read_sensor()


@pytest.fixture(scope="session")
def library() -> TissueLibrary:
    return read_tissues()


@pytest.fixture(scope="session")
def bench(sensor, library) -> SimulatedBench:
    return SimulatedBench(sensor, library.contact)


@pytest.fixture(scope="session")
def silence() -> Callable[[float, int], Lines]:
    """Return a maker of excitations of zero amplitude: sample rate, samples of a period."""
    return lambda rate_hz, samples: Lines(np.ones(1, int), np.zeros(1, complex), rate_hz, samples)


@pytest.fixture(scope="session")
def multisine() -> Callable[..., Excitation]:
    """Return a maker of flat random-phase multisines."""

    def make(
        seed=0,
        *,
        level_v=1.0,
        band_hz=(20.0, 10e3),
        samples_per_period=5000,
        sample_rate_hz=50e3,
        step=1,
    ):
        spacing = sample_rate_hz / samples_per_period
        harmonics = np.arange(1, samples_per_period // 2, step)
        inside = (harmonics * spacing >= band_hz[0]) & (harmonics * spacing <= band_hz[1])
        harmonics = harmonics[inside]
        return Excitation(
            harmonics=harmonics,
            amplitude_v=np.full(harmonics.size, level_v * np.sqrt(2 / harmonics.size)),
            phase_rad=np.random.default_rng(seed).uniform(0, 2 * np.pi, harmonics.size),
            sample_rate_hz=sample_rate_hz,
            samples_per_period=samples_per_period,
        )

    return make
