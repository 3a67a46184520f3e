# SPDX-License-Identifier: Apache-2.0
"""Times of wrenches from the stamps of a CAN adapter, as more and more is known of its clock."""

from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.drivers.force_config import read_force_config

pytest.importorskip("can", reason="python-can is not installed")

from tactile_resonance.drivers.can_wrench import CanWrench

PERIOD_NS = 1_000_000
START_NS = 1_700_000_000_000_000_000
HELD_UP_NS, QUICK_NS = 4_000_000, 200_000


def stamps(delay_ns, ahead_s=0.0):
    """Time that the driver gives to each wrench [ns]; the n-th is taken at START_NS + n PERIOD_NS.

    The adapter's clock is ahead by some time [s], of each wrench or of all.
    """
    driver = CanWrench(read_force_config(Path("can_simulated.yaml"), force_n=0.01))
    told = []
    for n, (delay, ahead) in enumerate(zip(*np.broadcast_arrays(delay_ns, ahead_s), strict=True)):
        stamp_s = n * PERIOD_NS * 1e-9 + float(ahead)
        told.append(driver._stamp_ns(stamp_s, START_NS + n * PERIOD_NS + int(delay)))
    return np.array(told)


def test_times_ascend_while_the_clock_becomes_better_known():
    """Messages that are held up at first make the first relation late; it is mended in one step."""
    told = stamps(np.where(np.arange(2000) < 600, HELD_UP_NS, QUICK_NS))
    assert np.all(np.diff(told) > 0)
    taken = START_NS + PERIOD_NS * np.arange(2000)
    # as soon as the quick ones are known the times are theirs, but for the delay that nobody can know
    np.testing.assert_allclose(told[-500:] - taken[-500:], QUICK_NS, atol=2e5)
    assert told[300] - taken[300] > 3_000_000


@pytest.mark.parametrize("ahead_s", [3.0, -3.0])
def test_an_adapter_whose_clock_is_set_anew_shows_in_no_time(ahead_s):
    told = stamps(np.full(2000, QUICK_NS), np.where(np.arange(2000) < 1000, 0.0, ahead_s))
    assert np.all(np.diff(told) > 0)
    taken = START_NS + PERIOD_NS * np.arange(2000)
    np.testing.assert_allclose(told - taken, QUICK_NS, atol=2e5)
