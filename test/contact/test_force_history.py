# SPDX-License-Identifier: Apache-2.0
"""The force of a block and its stated uncertainty against known noise."""

import threading
import time

import numpy as np
import pytest
from scipy.signal import lfilter

from tactile_resonance.contact.force_history import ForceHistory

STEP_NS = 2_000_000


def filled(forces):
    history = ForceHistory()
    for k, force in enumerate(forces):
        history.add(k * STEP_NS, force)
    return history


def test_only_the_time_of_the_block_counts():
    forces = np.concatenate([np.zeros(100), np.full(100, 0.01), np.full(100, 5.0)])
    assert filled(forces).mean(100 * STEP_NS, 199 * STEP_NS) == (pytest.approx(0.01), 0.0)


@pytest.mark.parametrize("pole", [0.0, 0.8])
def test_stated_uncertainty_is_that_of_the_mean_of_correlated_noise(pole):
    rng = np.random.default_rng(1)
    errors, stated = [], []
    for _ in range(400):
        noise = lfilter([1 - pole], [1, -pole], 1e-3 * rng.standard_normal(400))[200:]
        mean, std = filled(0.01 + noise).mean(0, 10**12)
        errors.append(mean - 0.01)
        stated.append(std)
    # the variance of a ratio of 400 runs is known to sqrt(2/400) = 7 %; three of them, both ways,
    # and the batches of strongly correlated noise are a little short
    assert np.mean(np.square(stated)) / np.var(errors) == pytest.approx(1.0, abs=0.25)


def test_what_was_not_heard_is_unknown():
    assert np.isnan(ForceHistory().mean(0, 10**9)).all()
    assert np.isnan(filled([0.01] * 5).mean(10**12, 2 * 10**12)).all()
    mean, std = filled([0.01] * 5).mean(0, 10**9)
    assert mean == pytest.approx(0.01)
    assert np.isnan(std)


def test_a_source_that_tells_changes_only_is_no_stream():
    history = ForceHistory()
    # each change ten times over within 0.2 s, one a second
    for change in range(30):
        for k in range(10):
            history.add(change * 10**9 + k * 20_000_000, 0.01)
            assert not history.streams
    for k in range(200):
        history.add(31 * 10**9 + k * 10_000_000, 0.01)
    assert history.streams


def late_stream(begin_ns: int) -> tuple[ForceHistory, threading.Thread]:
    """Forces of 10 mN, and a thread that brings a second of 12 mN more, late and at once."""
    history = filled([0.01] * 301)

    def bring():
        time.sleep(0.2)
        for k in range(101):
            history.add(begin_ns + k * 10_000_000, 0.012)

    return history, threading.Thread(target=bring)


def test_a_late_stream_is_waited_for_until_the_end_of_the_block():
    begin_ns = 3_500_000_000
    history, thread = late_stream(begin_ns)
    assert np.isnan(history.mean(begin_ns, begin_ns + 10**9)).all()
    thread.start()
    history.wait(begin_ns, begin_ns + 10**9, 30.0)
    mean, std = history.mean(begin_ns, begin_ns + 10**9)
    thread.join()
    assert mean == pytest.approx(0.012)
    assert std == pytest.approx(0, abs=1e-9)


def test_a_stream_that_stays_silent_is_not_waited_for_for_ever():
    silent = filled([0.01] * 301)
    silent.wait(10**10, 2 * 10**10, 0.05)
    assert np.isnan(silent.mean(10**10, 2 * 10**10)).all()


@pytest.mark.parametrize(
    ("heard", "begin_ns"),
    [(5, 10**10), (301, 500_000_000)],
    ids=["a source that tells changes only", "a block whose forces began to come"],
)
def test_nothing_is_waited_for_where_nothing_is_missing(heard, begin_ns):
    history = filled([0.01] * heard)
    waiting = threading.Thread(target=history.wait, args=(begin_ns, 2 * 10**10, 1e6), daemon=True)
    waiting.start()
    waiting.join(timeout=20.0)
    assert not waiting.is_alive()


def test_a_clock_set_back_forgets_what_was_before():
    history = filled([0.5] * 10)
    history.add(0, 0.01)
    assert history.newest() == (0, 0.01)
    assert history.mean(0, 10**12)[0] == pytest.approx(0.01)
