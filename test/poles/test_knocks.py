# SPDX-License-Identifier: Apache-2.0
"""A knock within a record: the mode begins to ring at some instant, and its poles stay right."""

import numpy as np
import pytest
from poles.mode_at_250_hz import (
    HARMONICS,
    PERIODS,
    RATE_HZ,
    SAMPLES,
    W0,
    from_record,
    record,
)
from scipy import stats

from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

TIME_S = np.arange(PERIODS * SAMPLES) / RATE_HZ
POLE_RAD_S = W0 * (-0.02 + 1j * np.sqrt(1 - 0.02**2))
TRUTH = 250.0, 0.02
DEFAULT = ModelStructure()


def ringing(at_s, size, seed, pole_rad_s=POLE_RAD_S):
    """(P, N) of a mode that rings freely from an instant on, with some phase."""
    phase = np.exp(2j * np.pi * np.random.default_rng(seed).random())
    age_s = TIME_S - at_s
    ring = np.real(size * phase * np.exp(pole_rad_s * age_s.clip(0))) * (age_s >= 0)
    return ring.reshape(PERIODS, SAMPLES)


def poles_of(seed, *added, structure=DEFAULT):
    """Of a record with noise of its own, and what is added to the sensor."""
    u, y = record(noise=0.0)
    rng = np.random.default_rng([7, seed])
    u = u + 1e-4 * rng.standard_normal(u.shape)
    y = y + 1e-3 * rng.standard_normal(y.shape) + sum(added)
    return from_record(u=u, y=y, structure=structure)


def squared_distance(poles):
    error = poles.main.estimate - TRUTH
    return error @ np.linalg.solve(poles.main.covariance, error)


@pytest.mark.parametrize("structure", [DEFAULT, ModelStructure(2, 2)], ids=["default", "bare"])
def test_a_knock_near_the_start_is_no_other_mode(structure):
    """A thousand times the noise. Before: ok with .3 to .7 of the damping ratio, model errors, no resonance."""
    squared, instants_s = [], np.arange(0.01, 0.07, 0.003)
    for seed, at_s in enumerate(instants_s):
        poles = poles_of(seed, ringing(at_s, 1.0, seed), structure=structure)
        assert poles.status is PolesStatus.OK
        assert "knock" in poles.message
        squared.append(squared_distance(poles))
    # chi-square of two degrees of freedom each
    assert np.sum(squared) < stats.chi2.isf(1e-3, 2 * instants_s.size)


def test_a_knock_costs_no_precision_wherever_it_is():
    """Before: noise of the whole record, and deviations some ten times as large."""
    alone, rng = poles_of(0).main.std, np.random.default_rng(2)
    squared, stated = [], []
    for seed in range(20):
        poles = poles_of(seed, ringing(rng.uniform(0.1, 1.1), 0.1, seed))
        stated.append(poles.main.std / alone)
        squared.append(squared_distance(poles))
    assert np.all(np.median(stated, axis=0) < 1.2)
    assert np.sum(squared) < stats.chi2.isf(1e-3, 40)


def test_a_knock_that_makes_two_modes_ring_is_found():
    """With as many directions as a model of one mode has, it was in none of these, or next to none."""
    other_rad_s = 2 * np.pi * 258 * (-0.02 + 1j * np.sqrt(1 - 0.02**2))
    u, _ = record(noise=0.0)
    s = 2j * np.pi * np.fft.rfftfreq(SAMPLES, 1 / RATE_HZ)
    second = 0.03 * np.abs(other_rad_s) ** 2 / ((s - other_rad_s) * (s - np.conj(other_rad_s)))
    of_second = np.fft.irfft(second * np.fft.rfft(u), SAMPLES)
    structure, squared = ModelStructure.with_residual(4, 6), []
    for seed, at_s in enumerate(np.arange(0.1, 1.1, 0.1)):
        knock = ringing(at_s, 0.3, seed) + ringing(at_s, 0.3, seed + 100, other_rad_s)
        poles = poles_of(seed, of_second, knock, structure=structure)
        assert poles.status is PolesStatus.OK
        assert "knock" in poles.message
        for k, truth in enumerate((TRUTH, (258.0, 0.02))):
            error = np.array([poles.f0_hz[k], poles.damping_ratio[k]]) - truth
            squared.append(error @ np.linalg.solve(poles.best_covariance[k], error))
    assert np.sum(squared) < stats.chi2.isf(1e-3, 2 * len(squared))


def test_hum_beside_a_knock_is_left_out():
    hum = 0.02 * np.cos(2 * np.pi * 251.3 * TIME_S).reshape(PERIODS, SAMPLES)
    poles = poles_of(0, hum, ringing(0.03, 0.3, 0))
    assert poles.status is PolesStatus.OK
    assert "knock" in poles.message
    assert "251.3" in poles.message
    assert squared_distance(poles) < stats.chi2.isf(1e-4, 2)


def test_a_tone_alone_and_a_clean_record_are_no_knocks():
    hum = 0.02 * np.cos(2 * np.pi * 251.3 * TIME_S).reshape(PERIODS, SAMPLES)
    for seed in range(20):
        assert "knock" not in poles_of(seed, hum).message
        assert "knock" not in poles_of(seed).message


def test_hum_between_bins_is_no_knock():
    """It stands out at some instants, too; taken off as tones it leaves less noise."""
    for seed in range(10):
        rng = np.random.default_rng([5, seed])
        hum = sum(
            10 ** rng.uniform(-1.5, -0.5) * np.cos(2 * np.pi * (49.9 * n * TIME_S + rng.random()))
            for n in (4, 5, 6)
        )
        poles = poles_of(seed, hum.reshape(PERIODS, SAMPLES), structure=ModelStructure(2, 2))
        assert "tone" in poles.message
        assert "knock" not in poles.message


def test_three_knocks_are_named_in_one_sentence():
    instants_s = 0.9, 0.25, 0.6
    knocks = [
        ringing(at_s, size, 3) for at_s, size in zip(instants_s, (1.0, 0.1, 0.03), strict=True)
    ]
    poles = poles_of(0, *knocks)
    assert poles.status is PolesStatus.OK
    assert "from about 0.25, 0.6, 0.9 s after" in poles.message
    assert poles.message.count("knock") == 1
    assert squared_distance(poles) < stats.chi2.isf(1e-4, 2)


def test_what_rings_from_the_start_outside_of_the_band_leaves_poles_as_they_are():
    """A mode at 320 Hz, ten times the noise."""
    outside_rad_s = 2j * np.pi * 320 - 60
    for seed in range(10):
        poles = poles_of(seed, ringing(0.0, 1e-2, seed, outside_rad_s))
        assert poles.status is PolesStatus.OK
        assert squared_distance(poles) < stats.chi2.isf(1e-4, 2)


def test_a_knock_at_the_start_is_the_transient():
    """No term is fitted twice, and those of the first transient stay what they are."""
    kind = (RATE_HZ, SAMPLES, PERIODS, HARMONICS, (200.0, 300.0))
    alone, same, later = (JointPlan(*kind, knocks_s=t) for t in ((), (0.0,), (0.5,)))
    terms = alone.structure.transient_terms
    assert same.transient_on_bins.shape[1] == terms
    assert later.transient_on_bins.shape[1] == 2 * terms
    for plan in (same, later):
        both = np.abs(plan.transient_on_bins[:, :terms])
        assert both == pytest.approx(np.abs(alone.transient_on_bins), rel=1e-9)
