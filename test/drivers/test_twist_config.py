# SPDX-License-Identifier: Apache-2.0
"""Which twist controller is used: every wrong field is named with its value and what is accepted."""

import re

import numpy as np
import pytest
import yaml

from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.twist import TwistConfig
from tactile_resonance.fields import read_file

RANGES = {
    "rate_hz": (25.0, 1000.0),
    "max_state_age_s": (0.002, 0.2),
    "max_command_gap_s": (0.004, 0.5),
    "follow_s": (0.005, 0.5),
    "follow_m": (1e-4, 0.01),
    "max_speed_m_s": (1e-4, 1.5),
    "max_turn_rad_s": (1e-4, np.pi),
    "max_acceleration_m_s2": (1e-3, 20.0),
}
GIVEN = yaml.safe_load(share_path("config/devices/twist.yaml").read_text(encoding="utf-8"))


@pytest.fixture
def read(tmp_path):
    def read(**changed):
        path = tmp_path / "mine.yaml"
        fields = {name: value for name, value in (GIVEN | changed).items() if value != "left out"}
        path.write_text(yaml.safe_dump(fields), encoding="utf-8")
        return read_file(TwistConfig, path)

    return read


def test_the_file_of_the_package_states_the_defaults(read):
    config = read_file(TwistConfig, share_path("config/devices/twist.yaml"))
    needed = {"kind", "command_topic", "pose_topic", "tip_in_tool"}
    least = read(**dict.fromkeys(set(GIVEN) - needed, "left out"))
    assert {**vars(config), "tip_in_tool": 0} == {**vars(least), "tip_in_tool": 0}
    assert not config.tip_in_tool.vector.any()
    assert (config.rate_hz, config.lockstep) == (500.0, False)


def test_the_place_of_the_tip_in_the_tool_is_read(read):
    offset = [0.0, 0.01, 0.12, 0.0, np.pi, 0.0]
    assert read(tip_in_tool=offset).tip_in_tool.vector.tolist() == offset


@pytest.mark.parametrize(("name", "limits"), RANGES.items())
def test_numbers_out_of_range_are_named(read, name, limits):
    low, high = limits
    for value in (0.99 * low, 1.01 * high):
        with pytest.raises(ValueError, match=rf"mine.yaml: {name}: got .*; accepted is .* to "):
            read(**{name: value})
    for value in ("fast", True, float("nan"), None):
        with pytest.raises(ValueError, match=rf"{name}: got .*accepted is a finite number"):
            read(**{name: value})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"kind": "ur"}, "mine.yaml: kind: got 'ur'; accepted is twist"),
        ({"kind": "left out"}, "mine.yaml: kind: got None"),
        ({"command_topic": "left out"}, "command_topic: got None; accepted is text (it is miss"),
        ({"command_topic": ""}, "command_topic: got ''; accepted is the name of a topic"),
        ({"pose_topic": 3}, "pose_topic: got 3; accepted is text"),
        ({"pose_topic": ""}, "pose_topic: got ''"),
        ({"pose_topic": "a//b"}, "pose_topic: got 'a//b'; accepted is the name of a topic"),
        ({"command_topic": "a b"}, "command_topic: got 'a b'; accepted is the name of a topic"),
        ({"command_topic": "1a"}, "command_topic: got '1a'"),
        ({"pose_topic": GIVEN["command_topic"]}, "accepted is another topic than command_topic"),
        ({"tip_in_tool": "left out"}, "tip_in_tool: got None; accepted is a"),
        ({"lockstep": 1}, "lockstep: got 1; accepted is true or false"),
        ({"tip_in_tool": [0.0] * 5}, "tip_in_tool: got [0.0, 0.0, 0.0, 0.0, 0.0]; accepted is a"),
        ({"tip_in_tool": [0.0] * 5 + [11.0]}, "tip_in_tool: got [0.0, 0.0, 0.0, 0.0, 0.0, 11.0]"),
        ({"host": "127.0.1.1"}, "mine.yaml: host: got '127.0.1.1'; accepted is one of"),
        # a deadline shorter than the period would always be missed
        ({"rate_hz": 40.0}, "max_state_age_s: got 0.02; accepted is above 1/rate_hz = 0.025"),
        (
            {"rate_hz": 25.0, "max_state_age_s": 0.1},
            "max_command_gap_s: got 0.04; accepted is above 1/rate_hz = 0.04",
        ),
        ({"follow_s": 0.0019999, "rate_hz": 500.0}, "follow_s: got 0.0019999; accepted is 0.005"),
    ],
)
def test_what_is_wrong_is_named(read, changed, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        read(**changed)
