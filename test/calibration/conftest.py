# SPDX-License-Identifier: Apache-2.0
"""A bench, its calibration from records, and one that is given."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.calibration.estimator import CalibratedEstimator
from tactile_resonance.calibration.fit import Fitted, calibrate
from tactile_resonance.calibration.model import Calibration, SensorModel
from tactile_resonance.calibration.records import CalibrationRecord, Load
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.sensor.bench import BenchEffects, SimulatedBench
from tactile_resonance.simulation.sensor.experiments import (
    another_sensor,
    calibration_records,
    true_sensor,
)
from tactile_resonance.simulation.tissue.library import read_tissues

SKEW_S = 3e-6
MASS_KG = 5e-5


@pytest.fixture(scope="session")
def library():
    return read_tissues()


@pytest.fixture(scope="session")
def bench(library) -> SimulatedBench:
    """A sensor a few percent off the one of config/sensors."""
    return SimulatedBench(another_sensor(read_sensor(), seed=1), library.contact)


@pytest.fixture(scope="session")
def records(bench) -> list[CalibrationRecord]:
    effects = BenchEffects(channel_skew_s=SKEW_S)
    made = calibration_records(
        bench, masses_kg=[MASS_KG], springs_n_per_m=[20.0], effects=effects, seed=4
    )
    return [replace(of, value_std=0.1) if of.load is Load.SPRING else of for of in made]


@pytest.fixture(scope="session")
def fitted(records) -> Fitted:
    return calibrate(records)


@pytest.fixture(scope="session")
def estimated(bench, fitted) -> CalibratedEstimator:
    return CalibratedEstimator(fitted.calibration, bench.sensor.tip.radius_m)


@pytest.fixture(scope="session")
def truth(bench) -> SensorModel:
    return true_sensor(bench, SKEW_S)


@pytest.fixture(scope="session")
def given(truth) -> Calibration:
    """A calibration that is the truth."""
    size = truth.values.size
    noise = 5e-4 / np.sqrt(25e3)
    known = np.ones(size, bool)
    return Calibration(truth, np.zeros((size, size)), known, (10.0, 12e3), noise, 1.0)
