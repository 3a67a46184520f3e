# SPDX-License-Identifier: Apache-2.0
"""The force at the tip of a moving arm, and which sources are refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.admission import require_fit, unfit
from tactile_resonance.contact.interfaces import ForceInfo, Mount
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.samples import ArmSample, CellSample, Pose
from tactile_resonance.contact.tip_force import Mounting, TipForce
from tactile_resonance.contact.vectors import six, vector

FINE = ForceInfo("fine", 1000.0, 1e-3, 2e-4, 5.0, Mount.TOOL)


class Recorded:
    """A cell that plays back wrenches."""

    info = FINE

    def __init__(self):
        self.waiting = []

    def start(self):
        pass

    def read(self):
        waiting, self.waiting = self.waiting, []
        return waiting

    def close(self):
        pass


def test_weight_and_inertia_of_a_shaken_tool_leave_the_contact():
    """The tool swings at 2 Hz with 0.5 m/s2 and turns; 10 mN press on it all the while."""
    payload = Payload(0.03, (0.0, 0.0, 0.02))
    frame = Pose(np.array([-0.05, 0.0, 0.02]), np.array([0.0, 0.3, 0.0]))
    own = frame.rotation.as_matrix()
    w = 2 * np.pi * 2

    def state_at(t):
        tilt = Rotation.from_rotvec([0.3 * np.sin(w * t), 0, 0])
        velocity = np.array([0, 0, -0.5 / w * np.cos(w * t), 0.3 * w * np.cos(w * t), 0, 0])
        position = np.array([0.4, 0, 0.1 - 0.5 / w**2 * np.sin(w * t)])
        return ArmSample(
            round(t * 1e9), t, vector(position), vector(tilt.as_rotvec()), six(velocity)
        )

    def cell_at(t):
        state = state_at(t)
        turn = state.tip.rotation.as_matrix()
        # place of the centre of mass through time, twice differentiated
        arm = frame.position_m + own @ payload.centre_m
        h = 1e-4
        places = [
            s.tip.position_m + s.tip.rotation.as_matrix() @ arm
            for s in (state_at(t - h), state, state_at(t + h))
        ]
        acceleration = (places[0] - 2 * places[1] + places[2]) / h**2
        contact = np.array([0, 0, 0.01])
        load = 0.03 * (np.array([0, 0, -9.80665]) - acceleration)
        force = own.T @ (contact + turn.T @ load)
        torque = own.T @ np.cross(-frame.position_m, contact)
        torque = torque + np.cross(payload.centre_m, own.T @ turn.T @ load)
        return CellSample(state.time_ns, six([*force, *torque]))

    def worst_error_n(window_s):
        now = [0.0]
        cell = Recorded()
        mounting = Mounting(Mount.TOOL, frame, payload)
        source = TipForce(cell, mounting, lambda: state_at(now[0]), window_s)
        source.start()
        worst = 0.0
        for i in range(1, 260):
            now[0] = i * 0.002
            cell.waiting.append(cell_at(now[0]))
            (sample,) = source.read()
            if i > 10:
                worst = max(worst, float(np.abs(np.subtract(sample.force_n, [0, 0, 0.01])).max()))
        return worst

    uncompensated_n = worst_error_n(0.0)
    assert uncompensated_n > 0.012  # inertia of 30 g at 0.5 m/s2: 15 mN
    # half a window late: 5 ms of 2 Hz is 6 %
    assert worst_error_n(0.010) < 0.1 * uncompensated_n


def test_a_frame_for_another_mount_is_refused():
    with pytest.raises(ValueError, match="mount: tool for the cell, table"):
        TipForce(Recorded(), Mounting(Mount.TABLE, Pose(np.zeros(3), np.zeros(3))), lambda: None)


def test_the_required_cell_serves_1_cn_and_those_in_the_page_do_not():
    require_fit(ForceInfo("required", 500.0, 1e-3, 3e-4, 5.0, Mount.TABLE), 0.01)
    robotous = ForceInfo("RFT40", 1000.0, 0.17, 0.02, 100.0, Mount.TOOL)
    with pytest.raises(
        ValueError,
        match=r"RFT40 cannot control 10 mN: its noise is 120 mN rms \(at 500 Hz\), at most 1 mN serve; "
        "its smallest step is 20 mN, at most 0.3 mN serve",
    ):
        require_fit(robotous, 0.01)
    e_series = ForceInfo("UR e-series", 500.0, 4.0, 0.1, 100.0, Mount.TOOL)
    assert len(unfit(e_series, 0.01)) == 2
    assert not unfit(robotous, 2.0)


def test_noise_is_compared_by_its_density():
    fast = ForceInfo("fast", 2000.0, 2e-3, 1e-4, 1.0, Mount.TABLE)
    slow = ForceInfo("slow", 250.0, 0.8e-3, 1e-4, 1.0, Mount.TABLE)
    assert not unfit(fast, 0.01)
    assert "1.13 mN rms" in unfit(slow, 0.01)[0]


def test_rate_and_range_are_asked_for_too():
    poor = ForceInfo("poor", 100.0, 1e-5, 1e-5, 0.02, Mount.TABLE)
    assert unfit(poor, 0.01) == [
        "it gives 100 Hz, at least 200 Hz serve",
        "its range is 20 mN, at least 50 mN serve",
    ]
    with pytest.raises(ValueError, match="force_n: 0"):
        unfit(poor, 0)
