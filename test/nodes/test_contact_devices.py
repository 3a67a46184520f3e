# SPDX-License-Identifier: Apache-2.0
"""Which arm and which force source contact_node makes of its parameters."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.ur_config import read_ur_config
from tactile_resonance.nodes import contact_devices

HARDWARE = read_ur_config(share_path("config/devices/ur5e.yaml"))


class Node:
    """Its parameters, and the wall clock."""

    time_server = ""

    def __init__(self, **given):
        self._values = {p.name: p.default for p in contact_devices.PARAMETERS} | given

    def get_parameter(self, name):
        return SimpleNamespace(value=self._values[name])


def test_hardware_is_waited_for_as_its_files_say():
    config = contact_devices.make_arm(Node(robot_host="192.0.2.1"), 0).config
    assert config.max_state_age_s == HARDWARE.max_state_age_s == 0.02
    assert config.watchdog_hz == HARDWARE.watchdog_hz


def test_a_simulated_robot_that_stalls_is_waited_for_longer():
    node = Node(robot_host="127.0.1.1", force_host="127.0.1.1", simulated_stalls_s=0.05)
    arm = contact_devices.make_arm(node, 0)
    assert arm.config.max_state_age_s == pytest.approx(HARDWARE.max_state_age_s + 0.05)
    assert 1 / arm.config.watchdog_hz == pytest.approx(1 / HARDWARE.watchdog_hz + 0.05)
    cell = contact_devices.make_force_source(node, arm).cell
    assert cell._config.limits.silent_s == pytest.approx(0.01 + 0.05)


def test_no_robot_of_hardware_is_waited_for_longer():
    with pytest.raises(
        ValueError, match=r"simulated_stalls_s.*0\.05.*0 for the robot at 192.0.2.1"
    ):
        contact_devices.make_arm(Node(robot_host="192.0.2.1", simulated_stalls_s=0.05), 0)
