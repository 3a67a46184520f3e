# SPDX-License-Identifier: Apache-2.0
"""Arguments that make no sense: refused in the log, and the controller stands."""

import numpy as np
import pytest

from tactile_resonance.simulation.ur5e.controller import SafetyMode

ODD = (1e300, -1e20, 2e6, 5e-324, np.nan, np.inf)
COMMANDS = range(1, 70)
SPEED_AT, ACCELERATION_AT = 6, 7


@pytest.mark.parametrize("odd", ODD)
def test_whatever_the_figures_the_controller_stands(make_client, odd):
    """Every command, with all its figures odd and with its acceleration alone."""
    for command in COMMANDS:
        for alone in (False, True):
            client = make_client()
            figures = np.full(18, odd)
            if alone:
                figures = np.concatenate([client.output("target_q") + 0.05, np.full(12, 0.1)])
                figures[ACCELERATION_AT] = odd
            client.write(command, figures, [1] * 7)
            client.run(0.01)
            for name in ("target_q", "actual_q", "target_TCP_pose", "tcp_offset", "ft_raw_wrench"):
                assert np.isfinite(client.output(name)).all(), (command, name)


@pytest.mark.parametrize(
    ("place", "odd"), [(0, 1e300), (SPEED_AT, 5e-324), (ACCELERATION_AT, np.nan)]
)
def test_what_is_refused_is_told_on_the_pendant_and_in_the_log(client, place, odd):
    figures = np.concatenate([client.output("target_q") + 0.05, [0.5, 0.5]])
    figures[place] = odd
    client.write(1, figures)
    client.run(0.01)
    assert client.controller.program is None
    assert client.controller.popup.startswith("Runtime error")
    assert f"{odd:g}" in client.controller.log[-1]
    assert "accepted" in client.controller.log[-1]


@pytest.mark.parametrize("odd", [np.nan, np.inf])
def test_an_external_sensor_that_sends_no_number_stops_the_robot(client, odd):
    client.call(56, [0.0] * 7, [1])
    assert client.controller.safety_mode is SafetyMode.NORMAL
    client.controller.write_inputs({"external_force_torque": [0.0, 0.0, odd, 0.0, 0.0, 0.0]})
    client.run(0.01)
    assert client.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    assert np.isfinite(client.output("target_q")).all()
