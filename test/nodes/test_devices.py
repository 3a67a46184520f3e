# SPDX-License-Identifier: Apache-2.0
"""Which device a node gets, and where its records go."""

import os
import re
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from rclpy.parameter import Parameter as RosParameter

from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.acquisition import DeviceError
from tactile_resonance.nodes import devices
from tactile_resonance.nodes.excitation_node import ExcitationNode
from tactile_resonance.nodes.parameters import declare
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id


@pytest.fixture
def make():
    """Device of a node with these parameters."""

    def make_with(**parameters):
        given = [RosParameter(name, value=value) for name, value in parameters.items()]
        node = rclpy.create_node("owner", parameter_overrides=given)
        declare(node, devices.PARAMETERS)
        try:
            return devices.make_device(node)[0]
        finally:
            node.destroy_node()

    with initialised(domain_id=free_domain_id(os.environ)):
        yield make_with


def test_a_device_that_is_not_there_is_named(make, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="device_config: empty, expected a path .* replay"):
        make(device="replay")
    with pytest.raises(ValueError, match="no measurement in it"):
        make(device="replay", device_config=str(tmp_path))
    with pytest.raises(ValueError, match="nowhere.yaml: cannot be read"):
        make(device="nidaqmx", device_config=str(tmp_path / "nowhere.yaml"))
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with pytest.raises(DeviceError, match="install the package"):
        make(device="nidaqmx", device_config=str(share_path("config/devices/nidaqmx.yaml")))


def test_a_node_that_ends_closes_its_device(monkeypatch):
    closed = []

    class Device:
        def close(self):
            closed.append(True)

    monkeypatch.setattr(devices, "make_device", lambda _: (Device(), ()))
    with initialised(domain_id=free_domain_id(os.environ)):
        node = ExcitationNode()
        node.trigger_configure()
        node.destroy_node()
    assert closed == [True]


def test_records_go_where_the_parameter_says(tmp_path):
    store = devices.open_store(str(tmp_path / "mine"), "bench")
    assert store.folder == tmp_path / "mine"
    assert not store.folder.exists()  # made by the first measurement


def test_records_go_to_ros_home_by_default(tmp_path, monkeypatch):
    parent = tmp_path / "ros" / "tactile_resonance" / "records"
    # two nodes in the same second do not share a folder
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "ros"))
    folders = [devices.open_store("", device).folder for device in ("bench", "nidaqmx")]
    assert sorted(parent.iterdir()) == sorted(folders)
    assert len(set(folders)) == 2
    assert re.fullmatch(r"\d{8}T\d{6}Z(-\d+)?", folders[0].name)
    monkeypatch.delenv("ROS_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    store = devices.open_store("", "bench")
    assert store.folder.parent == tmp_path / ".ros" / "tactile_resonance" / "records"


def test_a_replay_is_on_disk_already(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    assert devices.open_store("", "replay") is None
    assert devices.open_store(str(tmp_path / "copy"), "replay").folder == tmp_path / "copy"
    assert list(tmp_path.iterdir()) == []


def test_a_node_that_is_configured_anew_hears_each_block_of_the_bench_once():
    """Those of a device that nobody reads any more would be kept for ever."""
    with initialised(domain_id=free_domain_id(os.environ)):
        node = ExcitationNode()

        def heard():
            return [s.topic_name for s in node.subscriptions if s.topic_name == "/bench/block"]

        for _ in range(2):
            node.trigger_configure()
            assert len(heard()) == 1
            node.trigger_cleanup()
            assert heard() == []
        node.destroy_node()
