# SPDX-License-Identifier: Apache-2.0
"""The built tree is one that `ros2 run` and `ros2 launch` find things in."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

packages = pytest.importorskip(
    "ament_index_python.packages", reason="ROS 2 is not here, so nothing is built for it"
)
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

NAME = "tactile_resonance"
NODES = ("excitation_node", "frf_node", "poles_node", "fake_hardware_node")


@pytest.fixture
def prefix():
    return Path(packages.get_package_prefix(NAME))


def test_index_executables_config_and_launch(prefix):
    assert (prefix / "share/ament_index/resource_index/packages" / NAME).is_file()
    share = Path(packages.get_package_share_directory(NAME))
    for name in (
        "package.xml",
        "config/nodes.yaml",
        "config/tissues.yaml",
        "config/security/policy.xml",
        "config/security/node.xml",
        "launch/bringup.launch.py",
        "launch/mock.launch.py",
        "launch/ur.launch.py",
    ):
        assert (share / name).is_file(), name
    for kind in ("msg/FRF.msg", "msg/Poles.msg", "srv/Play.srv", "action/Measure.action"):
        assert (share / kind).is_file(), kind
    for name in (*NODES, NAME):
        executable = prefix / "lib" / NAME / name
        assert os.access(executable, os.X_OK), name


def wait_for_node(name, timeout_s=120):
    import rclpy

    context = rclpy.Context()
    rclpy.init(context=context)
    watcher = rclpy.create_node("watcher", context=context)
    try:
        deadline = time.monotonic() + timeout_s
        while name not in watcher.get_node_names() and time.monotonic() < deadline:
            time.sleep(0.1)
    finally:
        watcher.destroy_node()
        rclpy.shutdown(context=context)


def test_an_executable_runs_and_ends_on_interrupt(prefix, tmp_path, monkeypatch):
    from tactile_resonance.processes import free_domain_id

    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain_id({})))
    parameters = Path(packages.get_package_share_directory(NAME)) / "config" / "nodes.yaml"
    node = subprocess.Popen(
        [prefix / "lib" / NAME / "poles_node", "--ros-args", "--params-file", parameters],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=tmp_path,
    )
    wait_for_node("poles_node")
    assert node.poll() is None, node.communicate()[0]
    node.send_signal(signal.SIGINT)
    output, _ = node.communicate(timeout=60)
    assert node.returncode == 0, output
    assert "Traceback" not in output
