# SPDX-License-Identifier: Apache-2.0
"""The robot's own sensor, from arm states."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.interfaces import ArmError, ArmFault, ForceError, ForceFault
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.vectors import six
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.drivers.force_sources import force_source
from tactile_resonance.drivers.rtde_wrench import RtdeWrench

CONFIG = read_force_config(Path("rtde_ur.yaml"))
PLACE_M, TURNED_RAD, STILL = (0.4, 0.0, 0.3), (np.pi / 2, 0.0, 0.0), (0.0,) * 6


class HandClock:
    """A clock that goes on where the test says so."""

    simulated = True

    def __init__(self):
        self.ns = 5_000_000_000

    def now_ns(self):
        return self.ns


class States:
    """An arm that hands out a state; None: it raises."""

    clock_uncertainty_s = 0.0

    def __init__(self):
        self.clock = HandClock()
        self.now = self.at(1.0, [0.0] * 6)

    def at(self, time_s, wrench):
        time_ns, wrench = round(time_s * 1e9), None if wrench is None else six(wrench)
        return ArmSample(time_ns, time_s, PLACE_M, TURNED_RAD, STILL, tool_wrench=wrench)

    def recent(self):
        if self.now is None:
            raise ArmError(ArmFault.STALE, "state is 30 ms old")
        return self.now


def test_the_wrench_is_turned_into_the_frame_of_the_tip():
    # the tip is turned by 90 degrees about x: its y axis is the base's z, its z the base's -y
    states = States()
    source = RtdeWrench(CONFIG, states)
    source.start()
    assert source.read() == []
    states.now = states.at(1.002, [1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    (sample,) = source.read()
    np.testing.assert_allclose(sample.wrench, [1, 3, -2, 0.1, 0.3, -0.2], atol=1e-12)
    assert sample.time_ns == 1_002_000_000
    assert source.read() == []  # one state, one wrench


def test_it_can_be_made_before_the_arm_is_connected():
    connected = []

    class Arm(States):
        @property
        def clock_uncertainty_s(self):
            if not connected:
                raise ArmError(ArmFault.LINK_LOST, "not connected")
            return 2e-4

    source = force_source(CONFIG, Arm())
    assert np.isnan(source.info.clock_uncertainty_s)
    connected.append(True)
    assert source.info.clock_uncertainty_s == 2e-4


@pytest.mark.parametrize(
    ("state", "fault"),
    [
        (None, ForceFault.LINK_LOST),
        ([0, 0, 101, 0, 0, 0], ForceFault.OVERLOAD),
        ([0, 0, np.nan, 0, 0, 0], ForceFault.INVALID),
    ],
)
def test_faults_are_named_and_end(state, fault):
    states = States()
    source = RtdeWrench(CONFIG, states)
    source.start()

    def read_five():
        for i in range(1, 6):
            states.now = None if state is None else states.at(1 + 0.002 * i, state)
            source.read()

    with pytest.raises(ForceError) as caught:
        read_five()
    assert caught.value.fault is fault
    states.now = states.at(2.0, [0.0] * 6)
    source.start()
    states.now = states.at(2.002, [0.0] * 6)
    assert len(source.read()) == 1


def test_a_robot_clock_that_stands_still_is_silence():
    states = States()
    config = replace(CONFIG, limits=replace(CONFIG.limits, silent_s=0.004))
    source = RtdeWrench(config, states)
    source.start()
    states.clock.ns += 3_900_000
    assert source.read() == []
    states.clock.ns += 200_000
    with pytest.raises(ForceError, match="no new state") as caught:
        source.read()
    assert caught.value.fault is ForceFault.SILENT


def test_an_arm_without_a_sensor_is_refused():
    states = States()
    states.now = states.at(1.0, None)
    with pytest.raises(ForceError, match="no wrench"):
        RtdeWrench(CONFIG, states).start()


def test_1_cn_is_refused_with_the_figures():
    with pytest.raises(ValueError, match=r"UR e-series cannot control 10 mN: its noise is 100 mN"):
        read_force_config(Path("rtde_ur.yaml"), force_n=0.01)
