# SPDX-License-Identifier: Apache-2.0
"""Times of wrenches from the stamps of a CAN adapter, as more and more is known of its clock."""

from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.drivers.force_config import read_force_config

can = pytest.importorskip("can", reason="python-can is not installed")

from tactile_resonance.drivers import can_wrench  # noqa: E402

PERIOD_NS = 1_000_000
START_NS = 1_700_000_000_000_000_000
HELD_UP_NS, QUICK_NS = 4_000_000, 200_000


def stamps(monkeypatch, delay_ns):
    """Time that the driver gives to each wrench [ns]; the n-th is taken at START_NS + n PERIOD_NS."""
    driver = can_wrench.CanWrench(read_force_config(Path("can_simulated.yaml"), force_n=0.01))
    told = []
    for n, delay in enumerate(delay_ns):
        arrival_ns = START_NS + n * PERIOD_NS + int(delay)
        monkeypatch.setattr(can_wrench.time, "time_ns", lambda now=arrival_ns: now)
        told.append(driver._stamp_ns(can.Message(timestamp=n * PERIOD_NS * 1e-9)))
    return np.array(told)


def test_times_ascend_while_the_clock_becomes_better_known(monkeypatch):
    """Messages that are held up at first make the first relation late; it is mended in one step."""
    delay_ns = np.where(np.arange(2000) < 600, HELD_UP_NS, QUICK_NS)
    told = stamps(monkeypatch, delay_ns)
    assert np.all(np.diff(told) > 0)
    taken = START_NS + PERIOD_NS * np.arange(2000)
    # as soon as the quick ones are known the times are theirs, but for the delay that nobody can know
    np.testing.assert_allclose(told[-500:] - taken[-500:], QUICK_NS, atol=2e5)
    assert told[300] - taken[300] > 3_000_000


def test_a_clock_that_was_set_back_is_not_hidden(monkeypatch):
    """By more than any relation is wrong: what comes after is told by the clock as it is now."""
    delay_ns = np.where(np.arange(2000) < 1000, QUICK_NS, QUICK_NS - 3_000_000_000)
    told = stamps(monkeypatch, delay_ns)
    assert np.sum(np.diff(told) < 0) == 1
    assert np.min(np.diff(told)) == pytest.approx(-3e9, abs=2e7)
