# SPDX-License-Identifier: Apache-2.0
"""The clock relation against clocks whose relation is known."""

import math

import numpy as np
import pytest

from tactile_resonance.contact.clocks import ClockTracker

START_NS = 1_700_000_000 * 10**9
REMOTE_S = 1234.5
SHORTEST_S = 2e-4


def feed(tracker, seconds, drift, seed, *, rate_hz=500, begin_s=0.0, stood_still_s=0.0):
    """Messages with exponential delays; returns last remote time and its true local time [ns]."""
    rng = np.random.default_rng(seed)
    t = begin_s + np.arange(round(seconds * rate_hz)) / rate_hz
    delay = SHORTEST_S + rng.exponential(3e-4, t.size)
    delay += (rng.random(t.size) < 0.01) * rng.exponential(0.03, t.size)
    true_ns = START_NS + (t * (1 + drift) + stood_still_s) * 1e9
    for remote, local in zip(REMOTE_S + t, true_ns + delay * 1e9, strict=True):
        tracker.add(float(remote), int(local))
    return float(REMOTE_S + t[-1]), int(true_ns[-1])


@pytest.mark.parametrize("seconds", [0.4, 1.0, 4.0, 20.0, 60.0])
@pytest.mark.parametrize("drift", [-2e-4, 0.0, 5e-5])
def test_the_error_is_within_the_stated_uncertainty(seconds, drift):
    ratios = []
    for seed in range(10):
        tracker = ClockTracker(SHORTEST_S)
        remote_s, true_ns = feed(tracker, seconds, drift, seed)
        ratios.append((tracker.to_local_ns(remote_s) - true_ns) * 1e-9 / tracker.uncertainty_s)
        assert tracker.uncertainty_s < (3e-4 if seconds < 3 else 3e-5)
    assert np.sqrt(np.mean(np.square(ratios))) < 1.2  # a standard deviation, not a hope


def test_the_drift_of_messages_that_come_evenly_is_that_of_the_lower_edge():
    # one in each block, an odd number of blocks: the middle one lies on their mean
    wrong = []
    for seed in range(40):
        delay = np.random.default_rng(seed).exponential(3e-4, 22)
        tracker, t = ClockTracker(), np.arange(22) * 0.25
        for remote_s, late_s in zip(t, delay, strict=True):
            tracker.add(remote_s, START_NS + round((remote_s + late_s) * 1e9))
        remote_s = float(t[-1])
        slope = (tracker.to_local_ns(remote_s + 1.0) - tracker.to_local_ns(remote_s)) * 1e-9 - 1.0
        # the edge touches complete blocks on both sides of their mean, and none lies below it
        above = delay[:-1] - slope * t[:-1]
        touched = np.flatnonzero(above < above.min() + 1e-8)
        wrong.append(not touched[0] <= 10 <= touched[-1] or touched.size < 2)
    assert not any(wrong)


def test_drift_is_found():
    tracker = ClockTracker(SHORTEST_S)
    remote_s, _ = feed(tracker, 40.0, 8e-5, 1)
    took_ns = tracker.to_local_ns(remote_s + 1.0) - tracker.to_local_ns(remote_s)
    assert took_ns * 1e-9 - 1.0 == pytest.approx(8e-5, abs=2e-6)


def test_an_unknown_shortest_delay_stays_in_the_uncertainty():
    tracker = ClockTracker(shortest_delay_s=0.0, delay_std_s=5e-4)
    remote_s, true_ns = feed(tracker, 10.0, 0.0, 2)
    error_s = (tracker.to_local_ns(remote_s) - true_ns) * 1e-9
    assert error_s == pytest.approx(SHORTEST_S, abs=2e-5)
    assert tracker.uncertainty_s >= 5e-4


def test_messages_held_up_for_seconds_do_not_move_it():
    tracker = ClockTracker(SHORTEST_S)
    feed(tracker, 10.0, 0.0, 3)
    before_ns = tracker.to_local_ns(REMOTE_S + 11)
    for i in range(100):
        tracker.add(REMOTE_S + 10.0 + i / 500, START_NS + round((10.0 + 2.0 + i / 1e5) * 1e9))
    assert abs(tracker.to_local_ns(REMOTE_S + 11) - before_ns) < 1e5


def test_a_remote_clock_set_anew_is_followed_at_once():
    tracker = ClockTracker(SHORTEST_S)
    feed(tracker, 5.0, 0.0, 4)
    for i in range(500):
        tracker.add(3.0 + i / 500, START_NS + round((8 + i / 500 + SHORTEST_S) * 1e9))
    assert tracker.to_local_ns(3.0) == pytest.approx(START_NS + 8 * 10**9, abs=1e4)


def test_a_sender_that_stood_still_is_followed_within_two_seconds():
    tracker = ClockTracker(SHORTEST_S)
    feed(tracker, 10.0, 0.0, 5)
    remote_s, true_ns = feed(tracker, 2.0, 0.0, 6, begin_s=10.0, stood_still_s=0.5)
    error_s = (tracker.to_local_ns(remote_s) - true_ns) * 1e-9
    assert abs(error_s) < 3 * tracker.uncertainty_s


def test_while_a_sender_is_late_the_uncertainty_says_so():
    tracker = ClockTracker(SHORTEST_S)
    feed(tracker, 10.0, 0.0, 7)
    feed(tracker, 0.6, 0.0, 8, begin_s=10.0, stood_still_s=0.02)
    assert tracker.uncertainty_s > 0.015


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="shortest_delay_s: got -1"):
        ClockTracker(-1.0)
    tracker = ClockTracker()
    with pytest.raises(ValueError, match="no message"):
        tracker.to_local_ns(1.0)
    assert math.isnan(tracker.uncertainty_s)
    with pytest.raises(ValueError, match="remote_s: nan"):
        tracker.add(float("nan"), 0)
