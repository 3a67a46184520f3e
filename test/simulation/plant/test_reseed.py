# SPDX-License-Identifier: Apache-2.0
"""After a reseed all noise is that of the seed, whatever came before, and no transient tells when it was."""

import numpy as np
import pytest
from scipy.stats import chi2

from tactile_resonance.contact.vectors import ZEROS
from tactile_resonance.simulation.cell.transducer import CellParameters, LoadCell, Transducer
from tactile_resonance.simulation.noise import ROWS, Jitter
from tactile_resonance.simulation.ur5e.controller import UrController
from tactile_resonance.simulation.ur5e.forces import ACCURACY, DRIFT_SHARE, PRECISION, FtSensor
from tactile_resonance.simulation.ur5e.machine import TrackingParameters

SEEDS = (7, [3, 1, 4], np.random.SeedSequence([3, 1, 4]))
# so many counts that their step is far below the noise; neither bias nor drift
CELL = CellParameters("noisy", 1e6, 1e7, 1e-3, 1e-5, 5.0, 0.3)


def steps(controller, count):
    """Raw wrench (count, 6) and vibration (count, 3)."""
    wrenches, trembles = [], []
    for _ in range(count):
        controller.step()
        wrenches.append(controller.outputs("ft_raw_wrench"))
        trembles.append(controller.machine.tremble_m)
    return np.array(wrenches), np.array(trembles)


def readings(transducer, count):
    return np.array([transducer.convert_once(ZEROS)[:6] for _ in range(count)])


def assert_variance(samples, variance):
    """Assert the variance of independent normal samples of mean 0, at 1e-5 a side."""
    low, high = chi2.ppf([1e-5, 1 - 1e-5], np.size(samples))
    assert low < np.sum(np.square(samples)) / variance < high


@pytest.mark.parametrize("seed", SEEDS, ids=str)
def test_robots_with_different_histories_have_the_noise_of_one_seed(seed):
    found = []
    for construction, before in ((1, 10), (1, 3 * ROWS + 5), (2, 77)):
        controller = UrController(seed=construction)
        steps(controller, before)
        controller.reseed(seed)
        found.append(steps(controller, 3 * ROWS))
    (wrench, tremble), *others = found
    for other_wrench, other_tremble in others:
        np.testing.assert_array_equal(other_tremble, tremble)
        # the offset belongs to the sensor and stays: what it is built with
        offset = other_wrench[0] - wrench[0]
        np.testing.assert_allclose(
            other_wrench - wrench, np.tile(offset, (3 * ROWS, 1)), atol=1e-12
        )
    np.testing.assert_array_equal(others[0][0], wrench)
    again = UrController(seed=1)
    again.reseed([3, 1, 5])
    assert not np.any(steps(again, 3)[1] == tremble[:3])


def test_vibration_and_drift_begin_anew_in_their_stationary_state():
    parameters = TrackingParameters()
    sensor = FtSensor(np.random.default_rng(1))
    jitter = Jitter(parameters.jitter_rms_m, parameters.jitter_corner_rad_s, 0.002, 1)
    offset = ACCURACY / 2 * np.random.default_rng(1).standard_normal(6)
    drifts, places = [], []
    for seed in range(400):
        sensor.reseed(np.random.default_rng([5, seed]))
        jitter.reseed([6, seed])
        errors = [sensor.error() for _ in range(40)]
        drifts.append(np.mean(errors, axis=0) - offset)
        places.append(jitter.step())
    sigma = PRECISION / 2
    # 40 steps are short against the drift's 60 s, and their white noise is averaged
    variance = sigma**2 * (DRIFT_SHARE + (1 - DRIFT_SHARE) / 40)
    assert_variance(np.array(drifts) / np.sqrt(variance), 1.0)
    assert_variance(places, parameters.jitter_rms_m**2)


@pytest.mark.parametrize("cutoff_hz", [0.0, 5.0])
@pytest.mark.parametrize("seed", SEEDS, ids=str)
def test_transducers_with_different_histories_have_the_noise_of_one_seed(seed, cutoff_hz):
    found = []
    for construction, before in ((1, 10), (2, 3 * ROWS + 5)):
        transducer = Transducer(CELL, construction)
        transducer.set_low_pass(cutoff_hz)
        readings(transducer, before)
        transducer.reseed(seed)
        found.append(readings(transducer, 3 * ROWS))
    assert len(np.unique(found[0][:, 2])) > ROWS
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.parametrize("cutoff_hz", [0.0, 5.0])
def test_what_the_filter_remembers_of_the_noise_is_stationary_from_the_first_reading(cutoff_hz):
    transducer = Transducer(CELL)
    transducer.set_low_pass(cutoff_hz)
    keep = np.exp(-2 * np.pi * cutoff_hz * 0.001) if cutoff_hz else 0.0
    first, later = [], []
    for seed in range(400):
        transducer.reseed(seed)
        found = readings(transducer, 10)[:, :3] / CELL.force_divisor
        first.append(found[0])
        later.append(found[-1])
    # of a first-order low-pass: sigma^2 (1 - k) / (1 + k)
    variance = CELL.force_noise_rms_n**2 * (1 - keep) / (1 + keep)
    assert_variance(first, variance)
    assert_variance(later, variance)


def test_the_present_reading_can_be_taken_as_zero_just_after_a_reseed():
    cell = LoadCell(CellParameters("quiet", 1e3, 1e4, 0.0, 0.0, 5.0, 0.3))
    for command in (b"\x0f\x08", b"\x0b"):
        cell.receive(0x64, command)
    load = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    cell.step(load, 0.0)
    cell.step(load, 0.002)
    cell.reseed(1)
    cell.receive(0x64, b"\x11\x01")
    frames = cell.step(load, 0.004)
    assert frames[0].data[5:7] == b"\x00\x00"


def test_a_cell_is_reseeded_while_it_streams():
    found = []
    for construction in (1, 2):
        cell = LoadCell(CELL, construction)
        for command in (b"\x0f\x08", b"\x0b"):
            cell.receive(0x64, command)
        cell.step(ZEROS, 0.0)
        cell.step(ZEROS, 0.01 * construction)
        cell.reseed([8, 9])
        found.append([frame.data for frame in cell.step(ZEROS, 0.01 * construction + 0.05)])
    assert len(found[0]) == 100
    assert found[0] == found[1]
