# SPDX-License-Identifier: Apache-2.0
"""Where the time of points went: parts that add up to what was measured, from states, results and old runs."""

import csv
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.goal import State
from tactile_resonance.report.run_report import as_page, summary
from tactile_resonance.scan.point_outcome import (
    BETWEEN,
    StateTimes,
    budget_sentence,
    time_budget,
)
from tactile_resonance.scan.point_result import PointOutcome, PointResult

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import Bench, scan, scene

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
    times.begin()
    times.take("travel", round(10e9))
    assert times.fields == {}


def test_states_may_come_while_another_contact_begins():
    times, over = StateTimes(), threading.Event()

    def begin_again_and_again():
        while not over.is_set():
            times.begin()

    beside = threading.Thread(target=begin_again_and_again)
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    beside.start()
    try:
        for k in range(30_000):
            times.take("hold", k)
    finally:
        over.set()
        beside.join()
        sys.setswitchinterval(interval_s)
    assert set(times.fields) <= set(SPENT)


def test_parts_of_the_time_add_up_to_the_points_and_the_time_between_them():
    results = [POINT, replace(POINT, index=1, duration_s=2.5, between_s=0.2)]
    budget = time_budget(results)
    np.testing.assert_allclose(np.sum(list(budget.values()), axis=0), [2.4, 2.7])
    np.testing.assert_allclose(budget["waiting in contact"], 0.1)
    np.testing.assert_allclose(budget["requests and answers"], [0.1, 0.3])
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
