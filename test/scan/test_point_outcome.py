# SPDX-License-Identifier: Apache-2.0
"""Poles of points against free air, the sensor's drift and notes; where their time went, also in old runs."""

import csv
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_resonance.cli import main
from tactile_resonance.configuration import share_path
from tactile_resonance.contact.goal import State
from tactile_resonance.poles.result import Poles
from tactile_resonance.report.run_report import as_page, summary
from tactile_resonance.scan import point_outcome
from tactile_resonance.scan.messages import make_message, to_cdr
from tactile_resonance.scan.point_outcome import (
    BETWEEN,
    SensorHealth,
    StateTimes,
    budget_sentence,
    is_calibrated,
    judge_drift,
    relative_to_air,
    sensor_health,
    time_budget,
)
from tactile_resonance.scan.point_result import POLES_TYPE, PointOutcome, PointResult
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.scene import DriftLimits, Notes, parse_notes

sys.path.insert(0, str(Path(__file__).resolve().parent))
import run_tables
from bench_hands import Bench, scan, scene
from run_tables import START_NS, plan, record_point

LIMITS = DriftLimits(f0_hz=0.05, damping_ratio=5e-5)


def reference(f0_hz=246.6, damping_ratio=0.012, f0_std_hz=0.002, damping_std=4e-6):
    return mode(np.array([f0_hz, damping_ratio]), np.diag([f0_std_hz**2, damping_std**2]))


def mode(estimate, covariance):
    return replace(Poles().main, estimate=estimate, covariance=covariance)


@pytest.mark.parametrize(
    ("method", "message", "calibrated"),
    [
        ("joint", "", False),
        ("calibrated sensor, standard linear solid", "", True),
        ("joint", "model error; without the calibrated sensor: nothing is touched", True),
    ],
)
def test_a_run_tells_whether_its_poles_come_through_a_calibrated_sensor(
    tmp_path, capsys, method, message, calibrated
):
    text = share_path("config/scenes/demo.yaml").read_text()
    with RunDirectory.create(tmp_path / "run", text, plan(4), {}) as run:
        record_point(run, 0)
        assert is_calibrated(run.content) is None
        for index, modes in enumerate(([], [250.0]), start=1):  # where nothing was estimated nothing is said
            said = {"method": method, "message": message} if modes else {}
            poles = make_message(POLES_TYPE, f0_hz=np.array(modes), **said)
            with run.begin_point(index) as recording:
                recording.write("/poles", POLES_TYPE, START_NS, to_cdr(poles))
                recording.finish(run_tables.result(index))
        assert is_calibrated(run.content) is calibrated
    if calibrated:  # it is not read as a run without calibration
        assert main(["resume", str(run.path)]) == 1
        refused = "--calibration: got 'none'; accepted is the file with which the run began"
        assert refused in capsys.readouterr().err


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
        # beyond the limit: may be noise, and as well a drift by two limits
        ({"f0_hz": 246.51, "f0_std_hz": 0.04}, SensorHealth.UNKNOWN),
        # a change by ten limits would look alike
        ({"f0_hz": 246.3, "f0_std_hz": 0.2}, SensorHealth.UNKNOWN),
        ({"damping_std": 6e-5}, SensorHealth.UNKNOWN),
        ({"f0_hz": 245.0, "f0_std_hz": 0.2}, SensorHealth.DRIFTED),
        ({"f0_std_hz": np.nan}, SensorHealth.UNKNOWN),
    ],
)
def test_drift_is_a_change_beyond_uncertainty_and_limit(after, health):
    judged, sentence = judge_drift(reference(), reference(**after), LIMITS)
    assert judged is health
    assert "f0 in air 246.600 Hz before" in sentence
    assert ("warning" in sentence) == (health is SensorHealth.DRIFTED)


@pytest.mark.parametrize(("measured", "outside"), [("B01A", 0), ("0B1A", 1), ("B0A1", 1), ("0BA1", 2)])
def test_references_vouch_for_the_points_between_them(monkeypatch, measured, outside):
    """One that failed, or was damaged, is taken as the run is resumed; the clock may be set meanwhile."""
    monkeypatch.setattr(point_outcome, "read_reference", lambda run, name: reference())
    names = {
        **{"B": "reference-00-air-before.mcap", "A": "reference-01-air-after.mcap"},
        **{"0": "point-00000-00.mcap", "1": "point-00001-00.mcap"},
    }
    ends_ns = (7, 8, 2, 3)
    run = SimpleNamespace(
        path=".",
        files=[
            SimpleNamespace(name=names[of], end_ns=end_ns)
            for of, end_ns in zip(measured, ends_ns, strict=True)
        ],
        latest=[PointResult(k, time_ns=ends_ns[measured.index(f"{k}")]) for k in range(2)]
        + [PointResult(2, outcome=PointOutcome.SKIPPED, time_ns=1)],
    )
    health, sentence = sensor_health(run, LIMITS)
    assert health is (SensorHealth.UNKNOWN if outside else SensorHealth.STEADY)
    assert "f0 in air 246.600 Hz before" in sentence
    assert outside == 0 or f"{outside} point" in sentence


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


SPENT = {
    "travel_s": 0.3,
    "tare_s": 0.0,
    "approach_s": 0.4,
    "press_s": 0.2,
    "hold_s": 0.9,
    "retract_s": 0.4,
}
POINT = PointResult(0, duration_s=2.3, vibration_s=0.8, between_s=0.1, **SPENT)


def test_times_of_states_are_those_between_their_beginnings():
    times = StateTimes()
    assert times.fields == {}
    course = [
        (0.0, "travel"),
        (0.3, "tare"),
        (0.7, "approach"),
        (0.7, "approach"),
        (1.5, "contact"),
    ]
    course += [(1.6, "settle"), (1.75, "hold"), (2.0, "hold"), (2.75, "retract"), (3.2, "idle")]
    for seconds, state in course:
        assert state in [each.value for each in State]
        times.take(state, round(1e9 * seconds))
    expected = SPENT | {"tare_s": 0.4, "approach_s": 0.8, "press_s": 0.25, "hold_s": 1.0}
    expected["retract_s"] = 0.45
    assert times.fields == pytest.approx(expected)
    times.take("idle", round(9e9))
    assert sum(times.fields.values()) == pytest.approx(3.2)
    times = StateTimes()
    times.take("travel", round(10e9))
    assert times.fields == {}


def test_parts_of_the_time_add_up_to_the_points_and_the_time_between_them():
    results = [POINT, replace(POINT, index=1, duration_s=2.5, between_s=0.2)]
    budget = time_budget(results)
    np.testing.assert_allclose(np.sum(list(budget.values()), axis=0), [2.4, 2.7])
    np.testing.assert_allclose(budget["waiting in contact"], 0.1)
    np.testing.assert_allclose(budget["tests, requests and answers"], [0.1, 0.3])
    np.testing.assert_allclose(budget[BETWEEN], [0.1, 0.2])
    sentence = budget_sentence(results)
    assert sentence.startswith("A point took 2.55 s (mean): vibration 0.80, approach 0.40,")
    assert "tare" not in sentence


def test_points_whose_times_are_unknown_do_not_count():
    old = PointResult(1, duration_s=4.0)
    failed = replace(POINT, index=2, outcome=PointOutcome.FAILED)
    assert len(time_budget([POINT, old, failed])["travel"]) == 1
    assert budget_sentence([old, failed]) == ""


@pytest.mark.parametrize("spent", [None, SPENT])
def test_a_scan_keeps_the_times_of_each_point(tmp_path, spent):
    bench = Bench(spent=spent)
    _, run, _ = scan(tmp_path / "run", scene(3), bench)
    for result in run.latest:
        assert result.vibration_s == pytest.approx(0.4 * result.blocks)
        assert (result.between_s >= 0) == (result.index > 0)
        for name, seconds in SPENT.items():
            kept = getattr(result, name)
            assert kept == seconds if spent else np.isnan(kept)
    with (run.path / "results.csv").open() as file:
        told = next(csv.DictReader(file))
    assert told["approach_s"] == ("0.4" if spent else "nan")


@pytest.mark.parametrize("spent", [None, SPENT])
def test_report_shows_where_the_time_went_where_that_is_known(tmp_path, spent):
    _, run, _ = scan(tmp_path / "run", scene(3), Bench(spent=spent))
    page = as_page(run, [], [], {}, {})
    assert ("<h2>Time</h2>" in page) == (spent is not None)
    assert any(line.startswith("A point took") for line in summary(run)) == (spent is not None)
    if spent:
        # three points, 0.4 s of approach each
        assert '<td class="text">approach</td><td>0.40</td><td>0.40</td><td>1.20</td>' in page
