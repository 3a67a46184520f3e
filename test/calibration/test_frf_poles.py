# SPDX-License-Identifier: Apache-2.0
"""Poles of an FRF, as poles_node gets it, through a calibrated sensor, and without where it cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from calibration.played import SKEW_S, contact_of, run_on

from benchmarks.calibrate_benches import BAND_HZ, excitation
from tactile_resonance.calibration.estimator import CalibratedEstimator, calibrated_poles
from tactile_resonance.calibration.model import Calibration
from tactile_resonance.frf.measurement import MeasurementFrf
from tactile_resonance.multisine import design_multisine
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, sensor_model
from tactile_resonance.simulation.sensor.experiments import another_sensor, true_sensor

BANDS = (PoleBand(*BAND_HZ, 2, 6),)


def frf_of(bench, contact, signal, blocks=1):
    """As frf_node makes it of the first blocks of a measurement."""
    signal = replace(signal, bands=BANDS, periods=blocks)
    run, frf = run_on(bench, contact, 3), MeasurementFrf(0)
    for _ in range(blocks):
        found = frf.add(run.block(signal), signal)
    return found


@pytest.mark.parametrize("blocks", [1, 3])
def test_blocks_of_20_ms_from_rest_give_a_pole(estimated, bench, library, blocks):
    contact = contact_of(bench, library["gel12"])
    poles = calibrated_poles(
        frf_of(bench, contact, excitation(0.02), blocks), BANDS, estimated, 0.01, 1e-4
    )
    assert poles.status is PolesStatus.OK
    assert "calibrated sensor" in poles.method
    mode = CoupledBimorph(sensor_model(bench.sensor), contact).mode_near(250.0)
    off = (poles.main.estimate - [mode.f0_hz, mode.damping_ratio]) / poles.main.std
    assert np.abs(off).max() < 4
    assert poles.main.std[0] < 0.2


def test_what_contradicts_the_sensor_is_fitted_without_it(estimated, bench, library):
    contact = contact_of(bench, library["gel12"])
    wet = replace(contact, radiation_mass_kg=contact.radiation_mass_kg + 2e-5)
    poles = calibrated_poles(frf_of(bench, wet, excitation(0.1), 3), BANDS, estimated, 0.01)
    assert "calibrated" not in poles.method
    assert "without the calibrated sensor: residuals contradict" in poles.message
    assert abs(poles.main.f0_hz - CoupledBimorph(sensor_model(bench.sensor), wet).mode_near(250.0).f0_hz) < 0.2


def test_lines_outside_of_the_band_are_named(estimated, bench, library):
    contact = contact_of(bench, library["gel12"])
    wide = design_multisine(samples_per_period=5000, band_hz=(50.0, 2000.0), level_v=0.4, seed=1)
    poles = calibrated_poles(frf_of(bench, contact, wide, 3), BANDS, estimated, 0.01)
    assert "excited lines lie outside of the bands" in poles.message
    assert "calibrated" not in poles.method


def test_poles_in_air_are_measured_and_not_taken_from_the_calibration(estimated, bench):
    poles = calibrated_poles(frf_of(bench, None, excitation(0.1), 4), BANDS, estimated)
    assert "calibrated sensor" not in poles.method
    assert "without the calibrated sensor" in poles.message


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_another_sensor_in_air_is_fitted_without_the_calibration(library):
    """Its fit runs away, and must not take the reference in air with it."""
    bench, other = (
        SimulatedBench(sensor, library.contact)
        for sensor in (read_sensor(), another_sensor(read_sensor(), 3))
    )
    size = true_sensor(other, SKEW_S).values.size
    given = Calibration(
        true_sensor(other, SKEW_S), np.zeros((size, size)), np.ones(size, bool), (10.0, 12e3), 3e-6, 1.0
    )
    wrong = CalibratedEstimator(given, bench.sensor.tip.radius_m)
    poles = calibrated_poles(frf_of(bench, None, excitation(0.1), 4), BANDS, wrong)
    assert poles.main.found
    assert "without the calibrated sensor: " in poles.message
    assert "contradict the calibration" in poles.message
    assert abs(poles.main.f0_hz - CoupledBimorph(sensor_model(bench.sensor), None).mode_near(250.0).f0_hz) < 0.1
