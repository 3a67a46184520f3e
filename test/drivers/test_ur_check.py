# SPDX-License-Identifier: Apache-2.0
"""Ages of an arm's states are told on the arm's own clock."""

import itertools

import numpy as np
import pytest

from tactile_resonance.contact.samples import ArmSample, Pose
from tactile_resonance.drivers import ur_check
from tactile_resonance.drivers.ur_config import UrArmConfig

CYCLE_NS, AGE_NS = 2_000_000, 5_000_000


class Clock:
    """Begins at 0, as monotonic clocks do, and is nowhere near UNIX time."""

    time_ns = 0

    def now_ns(self):
        return self.time_ns


class Arm:
    """Whenever it is asked, a cycle later and with a state of the same age; every fourth is lost."""

    clock_uncertainty_s = 1e-4

    def __init__(self, config):
        self.clock = Clock()
        self._cycles = (n for n in itertools.count(10) if n % 4)

    def connect(self):
        pass

    def state(self):
        stamp_ns = next(self._cycles) * CYCLE_NS
        self.clock.time_ns = stamp_ns + AGE_NS
        zero = (0.0, 0.0, 0.0)
        return ArmSample(stamp_ns, stamp_ns * 1e-9, zero, zero, (0.0,) * 6)

    def close(self):
        pass


def test_ages_and_gaps_are_those_of_the_states(monkeypatch):
    monkeypatch.setattr(ur_check, "UrArm", Arm)
    report = ur_check.watch(UrArmConfig("127.0.0.1", Pose(np.zeros(3), np.zeros(3))), 0.2)
    for age_s in (report.age_median_s, report.age_p99_s, report.age_max_s):
        assert age_s == pytest.approx(5e-3)
    assert report.longest_gap_s == pytest.approx(4e-3)
    assert report.missed / (report.duration_s * 500) == pytest.approx(0.25, abs=0.02)
    assert report.stale == 0
