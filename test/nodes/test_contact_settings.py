# SPDX-License-Identifier: Apache-2.0
"""Which arm and which force source contact_node makes of its parameters."""

import os
from dataclasses import replace
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.drivers.twist import TwistConfig
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import read_ur_config
from tactile_resonance.fields import read_file
from tactile_resonance.nodes import contact_settings
from tactile_resonance.nodes.managed_node import TIME_SERVER, ManagedNode
from tactile_resonance.nodes.running import initialised
from tactile_resonance.nodes.topic_wrench import TopicWrench
from tactile_resonance.nodes.twist_arm import TwistArm
from tactile_resonance.processes import free_domain_id

TWIST = "config/devices/twist.yaml"
HARDWARE = read_ur_config(share_path("config/devices/ur5e.yaml"))


class Node:
    """Its parameters, and the wall clock."""

    time_server = ""

    def __init__(self, **given):
        self._values = {p.name: p.default for p in contact_settings.PARAMETERS}
        self._values |= {"base_frame": "base"} | given

    def get_parameter(self, name):
        return SimpleNamespace(value=self._values[name])


def test_hardware_is_waited_for_as_its_files_say():
    config = contact_settings.make_arm(Node(robot_host="192.0.2.1"), 0).config
    assert config.max_state_age_s == HARDWARE.max_state_age_s == 0.02
    assert config.watchdog_hz == HARDWARE.watchdog_hz


def test_a_simulated_robot_that_stalls_is_waited_for_longer():
    node = Node(robot_host="127.0.1.1", force_host="127.0.1.1", simulated_stalls_s=0.05)
    arm = contact_settings.make_arm(node, 0)
    assert arm.config.max_state_age_s == pytest.approx(HARDWARE.max_state_age_s + 0.05)
    assert 1 / arm.config.watchdog_hz == pytest.approx(1 / HARDWARE.watchdog_hz + 0.05)
    cell = contact_settings.make_force_source(node, arm)
    assert cell._config.limits.silent_s == pytest.approx(0.01 + 0.05)


def test_no_robot_of_hardware_is_waited_for_longer():
    with pytest.raises(
        ValueError, match=r"simulated_stalls_s.*0\.05.*0 for the robot at 192.0.2.1"
    ):
        contact_settings.make_arm(Node(robot_host="192.0.2.1", simulated_stalls_s=0.05), 0)


def test_a_file_that_names_no_kind_is_of_a_universal_robot_and_another_kind_is_refused(tmp_path):
    given = share_path("config/devices/ur5e.yaml").read_text(encoding="utf-8")
    path = tmp_path / "mine.yaml"
    for kind in ("", "kind: ur\n"):
        path.write_text(kind + given, encoding="utf-8")
        assert isinstance(contact_settings.make_arm(Node(robot_config=str(path)), 0), UrArm)
    path.write_text("kind: kuka\n" + given, encoding="utf-8")
    with pytest.raises(ValueError, match=r"mine.yaml: kind: got 'kuka'; accepted is ur or twist"):
        contact_settings.make_arm(Node(robot_config=str(path)), 0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robot_host": "192.0.2.1"}, "robot_host: got '192.0.2.1'; accepted is empty for an arm"),
        ({"simulated_stalls_s": 0.05}, "simulated_stalls_s: got 0.05; accepted is 0 for an arm of"),
        ({"time_server": "127.0.0.1:30021"}, "time_server: got '127.0.0.1:30021'; accepted is emp"),
    ],
)
def test_what_is_only_of_a_universal_robot_is_refused_with_a_twist_controller(given, message):
    node = Node(robot_config=TWIST, **given)
    node.time_server = given.get("time_server", "")
    with pytest.raises(ValueError, match=message):
        contact_settings.make_arm(node, 0)


@pytest.fixture
def twist_arm():
    with initialised(domain_id=free_domain_id(os.environ)):
        node = ManagedNode("contact_settings_test", (*contact_settings.PARAMETERS, TIME_SERVER))
        arm = TwistArm(node, read_file(TwistConfig, share_path(TWIST)), "base")
        yield arm
        node.destroy_node()


def test_the_force_sensor_of_a_universal_robot_is_refused_with_a_twist_controller(twist_arm):
    node = Node(force_config="rtde_ur.yaml")
    with pytest.raises(ValueError, match=r"rtde_ur.yaml' is of kind rtde, accepted .* can, topic"):
        contact_settings.make_force_source(node, twist_arm)
    topic = contact_settings.make_force_source(Node(force_config="topic.yaml"), twist_arm)
    assert isinstance(topic, TopicWrench)


def test_a_loop_faster_than_the_poses_and_speeds_beyond_the_arm_are_refused(twist_arm):
    parameters, limits = read_contact()
    contact_settings.require_arm_allows(twist_arm.config, parameters, limits)
    slower = replace(twist_arm.config, rate_hz=125.0)
    with pytest.raises(ValueError, match=r"period_s: got 0.002; accepted is 1/rate_hz = 0.008"):
        contact_settings.require_arm_allows(slower, parameters, limits)
    contact_settings.require_arm_allows(slower, replace(parameters, period_s=0.008), limits)
    slower = replace(twist_arm.config, max_speed_m_s=0.05)
    with pytest.raises(ValueError, match="free_speed_m_s: got 0.1; .* max_speed_m_s = 0.05 of rob"):
        contact_settings.require_arm_allows(slower, parameters, limits)
