# SPDX-License-Identifier: Apache-2.0
"""A calibrated sensor against its poles in air: as it was, warmer, or damaged."""

from dataclasses import replace

import numpy as np
import pytest
from calibration.played import SKEW_S, contact_of, played

from tactile_resonance.calibration.estimator import CalibratedEstimator
from tactile_resonance.calibration.validity import (
    SensorState,
    at_shift,
    check_in_air,
    poles_in_air,
)
from tactile_resonance.simulation.sensor.bench import SimulatedBench

STD = np.array([0.004, 1.5e-5])
"""Of f0 relative to 250 Hz, and of the damping ratio: two periods of 0.4 s."""


def measured(bench, modes, seed=0):
    """Poles of a bench in air, with noise."""
    rng = np.random.default_rng(seed)
    true = [bench.coupled(None).modes[k] for k in modes]
    scale = [np.array([mode.f0_hz / 250, 1.0]) * STD for mode in true]
    estimates = [
        np.array([mode.f0_hz, mode.damping_ratio]) + std * rng.standard_normal(2)
        for mode, std in zip(true, scale, strict=True)
    ]
    return estimates, [np.diag(std**2) for std in scale]


def with_beam(bench, **factors):
    beam = bench.sensor.beam
    changed = {name: getattr(beam, name) * factor for name, factor in factors.items()}
    return SimulatedBench(replace(bench.sensor, beam=replace(beam, **changed)), bench.contact)


def test_poles_in_air_are_those_of_the_bench(fitted, bench):
    poles, covariance = poles_in_air(fitted.calibration)
    true = np.array([[mode.f0_hz, mode.damping_ratio] for mode in bench.coupled(None).modes])
    off = (poles - true) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs(off).max() < 4.5


@pytest.mark.parametrize("modes", [(1,), (1, 2), (0, 1, 2, 3)])
def test_the_same_sensor_is_as_calibrated(fitted, bench, modes):
    for seed in range(50):
        found = check_in_air(fitted.calibration, *measured(bench, modes, seed))
        assert found.state is SensorState.AS_CALIBRATED
        assert found.usable


def test_a_warmer_sensor_moves_as_a_whole(fitted, bench):
    """Softer by half a percent: all frequencies fall by a quarter of one."""
    warm = with_beam(bench, piezo_modulus_pa=0.995, shim_modulus_pa=0.995)
    found = check_in_air(fitted.calibration, *measured(warm, (1, 2, 3)))
    assert found.state is SensorState.TEMPERATURE
    assert found.usable
    assert found.shift == pytest.approx(-0.0025, rel=0.1)


def test_one_mode_does_not_tell_temperature_from_damage(fitted, bench):
    warm = with_beam(bench, piezo_modulus_pa=0.995, shim_modulus_pa=0.995)
    found = check_in_air(fitted.calibration, *measured(warm, (1,)))
    assert found.state is SensorState.SHIFTED
    assert not found.usable


def test_a_mode_that_may_have_stayed_does_not_tell_temperature_from_damage(fitted):
    """Mode 2 shifted by .2 %, mode 3 known to .3 %: it is as near to 0 as to .2 %."""
    expected, _ = poles_in_air(fitted.calibration)
    own, shifts, stds = expected[1:3], np.array([0.002, 0.0]), np.array([1e-5, 3e-3])
    damping = np.diag([0.0, 1e-10])
    covariances = [damping + np.diag([(f * s) ** 2, 0.0]) for (f, _), s in zip(own, stds, strict=True)]
    for seed in range(20):
        noise = stds * np.random.default_rng(seed).standard_normal(2)
        estimates = own * np.stack([1 + shifts + noise, np.ones(2)], axis=1)
        found = check_in_air(fitted.calibration, list(estimates), covariances)
        assert found.state is SensorState.SHIFTED
        assert "whether the others shifted alike is too uncertain" in found.message


def test_noise_of_one_damping_is_no_damage_that_another_shows(fitted):
    """Mode 2 damps 6 % more, surely, as when warm; mode 3 is known to 20 %."""
    expected, _ = poles_in_air(fitted.calibration)
    own, stds = expected[1:3], np.array([3e-3, 0.2])
    covariances = [np.diag([(1e-5 * f) ** 2, (d * s) ** 2]) for (f, d), s in zip(own, stds, strict=True)]
    for seed in range(20):
        noise = stds * np.random.default_rng(seed).standard_normal(2)
        estimates = own * np.stack([np.ones(2), 1 + np.array([0.06, 0.0]) + noise], axis=1)
        found = check_in_air(fitted.calibration, list(estimates), covariances)
        assert found.state is SensorState.AS_CALIBRATED


def test_dirt_on_the_tip_moves_each_mode_by_itself(fitted, bench):
    tip = replace(bench.sensor.tip, mass_kg=bench.sensor.tip.mass_kg + 5e-6)
    dirty = SimulatedBench(replace(bench.sensor, tip=tip), bench.contact)
    found = check_in_air(fitted.calibration, *measured(dirty, (1, 2, 3)))
    assert found.state is SensorState.CHANGED
    assert not found.usable


def test_a_clamp_that_rubs_is_damage_though_no_mode_moved(fitted, bench):
    loose = with_beam(bench, modal_damping_ratio=1.3)
    found = check_in_air(fitted.calibration, *measured(loose, (1, 2)))
    assert found.state is SensorState.CHANGED


def test_without_a_covariance_nothing_is_said(fitted):
    found = check_in_air(fitted.calibration, [np.array([250.0, 0.012])], [np.full((2, 2), np.nan)])
    assert found.state is SensorState.UNKNOWN
    assert not found.usable


@pytest.mark.parametrize(("relative_std", "blind"), [(1.5e-3, False), (5e-3, True), (0.03, True)])
def test_poles_too_uncertain_to_tell_are_neither_damage_nor_as_calibrated(fitted, relative_std, blind):
    """200 draws of an unchanged sensor; damage by chance, 1e-4 a test, at most once at 99.9 %."""
    (expected, *_), _ = poles_in_air(fitted.calibration)
    std = np.array([relative_std * expected[0], relative_std])
    states = []
    for seed in range(200):
        noise = std * np.random.default_rng(seed).standard_normal(2)
        states.append(
            check_in_air(fitted.calibration, [expected + noise], [np.diag(std**2)]).state
        )
    assert states.count(SensorState.CHANGED) <= 1
    right = SensorState.UNKNOWN if blind else SensorState.AS_CALIBRATED
    assert states.count(right) >= 199
    # and damage that the poles do show is stated
    far = check_in_air(fitted.calibration, [expected * [1.2, 1]], [np.diag(std**2)])
    assert far.state is SensorState.CHANGED


def test_a_shifted_calibration_finds_the_contact_of_the_warmer_sensor(fitted, bench, library):
    warm = with_beam(bench, piezo_modulus_pa=0.995, shim_modulus_pa=0.995)
    tissue = library["gel12"]
    contact = contact_of(bench, tissue)
    record = played(warm, contact, 0.1, seed=3, periods=2, skew_s=SKEW_S)
    air = check_in_air(fitted.calibration, *measured(warm, (1, 2, 3)))
    shifted = at_shift(fitted.calibration, air.shift, air.shift_std)
    radius_m = bench.sensor.tip.radius_m
    cold, right = (
        CalibratedEstimator(of, radius_m)(record, 0.01) for of in (fitted.calibration, shifted)
    )
    true = complex(contact.dynamic_stiffness(2j * np.pi * right.poles.f0_hz[0]))
    assert abs(right.stiffness_n_per_m - true) < 4 * np.sqrt(np.trace(right.stiffness_total))
    assert abs(cold.stiffness_n_per_m - true) > 4 * abs(right.stiffness_n_per_m - true)
