# SPDX-License-Identifier: Apache-2.0
"""Ages of an arm's states are told on the arm's own clock."""

import itertools
import re

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
    states_a_look = 1

    def __init__(self, config):
        self.clock = Clock()
        self.received = 0
        self._cycles = (n for n in itertools.count(10) if n % 4)

    def connect(self):
        pass

    def state(self):
        for _ in range(self.states_a_look):
            stamp_ns = next(self._cycles) * CYCLE_NS
            self.received += 1
        self.clock.time_ns = stamp_ns + AGE_NS
        zero = (0.0, 0.0, 0.0)
        return ArmSample(stamp_ns, stamp_ns * 1e-9, zero, zero, (0.0,) * 6)

    def close(self):
        pass


@pytest.mark.parametrize(("states_a_look", "longest_ms"), [(1, 4), (5, 6)])
def test_ages_and_gaps_are_those_of_the_states(monkeypatch, states_a_look, longest_ms):
    """Also where the machine looks seldom: what it finds then is not missed, two gaps may be one."""
    monkeypatch.setattr(Arm, "states_a_look", states_a_look)
    monkeypatch.setattr(ur_check, "UrArm", Arm)
    lines, fit = ur_check.watch(UrArmConfig("127.0.0.1", Pose(np.zeros(3), np.zeros(3))), 0.2)
    assert fit
    states, gap, age, clock = lines.split("\n")
    rate_hz, seconds, missed = map(float, re.findall(r"[\d.]+", states))
    assert rate_hz == pytest.approx(0.75 * 500, abs=0.02 * 500)
    # the time is stated to 0.05 s
    assert missed == pytest.approx(0.25 * 500 * seconds, abs=0.02 * 500 * seconds + 0.05 * 500)
    assert gap == f"longest gap: at most {longest_ms} ms"
    assert age == "age: median 5.0, 99 % 5.0, largest 5.0 ms; limit 20 ms, beyond it 0 times"
    assert clock == "clock of the robot: known to 0.10 ms (1 sigma)"
