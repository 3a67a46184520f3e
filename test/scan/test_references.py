# SPDX-License-Identifier: Apache-2.0
"""Poles against free air, the sensor's drift, and notes of a session."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.poles.result import Poles
from tactile_resonance.scan.references import SensorHealth, judge_drift, relative_to_air
from tactile_resonance.scan.scene import DriftLimits, Notes, parse_notes

LIMITS = DriftLimits(f0_hz=0.05, damping_ratio=5e-5)


def reference(f0_hz=246.6, damping_ratio=0.012, f0_std_hz=0.002, damping_std=4e-6):
    return mode(np.array([f0_hz, damping_ratio]), np.diag([f0_std_hz**2, damping_std**2]))


def mode(estimate, covariance):
    return replace(Poles().main, estimate=estimate, covariance=covariance)


def test_uncertainty_relative_to_air_is_that_of_both():
    """Against draws of both estimates."""
    rng = np.random.default_rng(5)
    air, covariance = reference(f0_std_hz=0.3, damping_std=3e-4), np.diag([0.4**2, 4e-4**2])
    mean, n = np.array([254.0, 0.034]), 20_000
    drawn = [
        relative_to_air(
            mean + rng.standard_normal(2) * np.sqrt(np.diag(covariance)),
            covariance,
            mode(air.estimate + rng.standard_normal(2) * air.std, air.covariance),
        )
        for _ in range(n)
    ]
    stated = relative_to_air(mean, covariance, air)
    assert stated["f0_shift_hz"] == pytest.approx(254.0 - 246.6)
    assert stated["f0_over_air"] == pytest.approx(254.0 / 246.6)
    assert stated["damping_shift"] == pytest.approx(0.022)
    for value, std in (
        ("f0_shift_hz", "f0_shift_std_hz"),
        ("f0_over_air", "f0_over_air_std"),
        ("damping_shift", "damping_shift_std"),
    ):
        scatter = np.std([d[value] for d in drawn])
        # the scatter of n draws is itself known to 1 / sqrt(2 n)
        assert scatter == pytest.approx(stated[std], rel=4 / np.sqrt(2 * n))


@pytest.mark.parametrize(
    ("after", "health"),
    [
        ({}, SensorHealth.STEADY),
        ({"f0_hz": 246.53}, SensorHealth.DRIFTED),
        ({"damping_ratio": 0.01210}, SensorHealth.DRIFTED),
        ({"f0_hz": 246.56}, SensorHealth.STEADY),  # significant, and less than anybody minds
        ({"f0_hz": 246.3, "f0_std_hz": 0.2}, SensorHealth.STEADY),  # large, and nothing but noise
        ({"f0_std_hz": np.nan}, SensorHealth.UNKNOWN),
    ],
)
def test_drift_is_a_change_beyond_uncertainty_and_limit(after, health):
    judged, sentence = judge_drift(reference(), reference(**after), LIMITS)
    assert judged is health
    assert "f0 in air 246.600 Hz before" in sentence
    assert ("warning" in sentence) == (health is SensorHealth.DRIFTED)


def test_without_a_reference_nothing_is_known():
    for before, after, missing in (
        (None, reference(), "before"),
        (reference(), None, "after"),
        (None, None, "before and after"),
    ):
        health, sentence = judge_drift(before, after, LIMITS)
        assert health is SensorHealth.UNKNOWN
        assert sentence.endswith(f"no poles in air {missing}")


def test_noise_alone_is_no_drift():
    """One of the two quantities beyond four standard deviations once in 8000, limits aside."""
    rng, limits = np.random.default_rng(2), DriftLimits(1e-9, 1e-12)
    healths = [
        judge_drift(
            *(
                mode(r.estimate + rng.standard_normal(2) * r.std, r.covariance)
                for r in (reference(), reference())
            ),
            limits,
        )[0]
        for _ in range(2000)
    ]
    assert healths.count(SensorHealth.DRIFTED) <= 3


def test_notes_are_read_and_what_is_none_is_refused():
    notes = parse_notes("{temperature_c: 21, tip_wetness: wet, adhesion: sticks a little}", "notes")
    assert notes == Notes(21.0, "wet", "sticks a little")
    assert notes.as_json() == {
        "temperature_c": 21.0,
        "tip_wetness": "wet",
        "adhesion": "sticks a little",
    }
    assert parse_notes("", "notes").as_json() == {}
    for text, reason in (
        ("{temperature_c: warm}", "notes.temperature_c: got 'warm'"),
        ("{temperature_c: 300}", "temperature_c: got 300.0; accepted is -50 to 150"),
        ("{tip_wetness: damp}", "one of dry, wet"),
        ("{humidity: 3}", "notes.humidity"),
        ("wet", "a YAML mapping"),
    ):
        with pytest.raises(ValueError, match=reason):
            parse_notes(text, "notes")
