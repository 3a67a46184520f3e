# SPDX-License-Identifier: Apache-2.0
"""A whole scan from the launch file, a node killed in the middle of it and brought back, and the end."""

import os
import signal
import tempfile
import time
import unittest
from pathlib import Path

import pytest

pytest.importorskip(
    "launch_testing", reason="launch_testing is not here: it comes with a full ROS 2"
)

import launch_testing
import launch_testing.actions
import launch_testing.asserts
from launch.actions import IncludeLaunchDescription, SetEnvironmentVariable
from launch.launch_description_sources import PythonLaunchDescriptionSource
from tactile_resonance.action import Scan

from launch import LaunchDescription
from tactile_resonance.client import Ending
from tactile_resonance.nodes.scan_client import ScanClient
from tactile_resonance.processes import free_domain_id
from tactile_resonance.scan.run_content import read_run

MOCK = Path(__file__).resolve().parents[2] / "launch" / "mock.launch.py"
DOMAIN_ID = free_domain_id({})
HOST = f"127.{1 + os.getpid() % 250}.{1 + os.getpid() // 250 % 250}.6"
FOLDER = Path(tempfile.mkdtemp())
SCENE = """
name: two points
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.025}}
positions:
  list: [[0.0, 0.0], [0.004, 0.0]]
blocks: {least: 3, most: 3}
time_limits: {point_s: 120.0}
"""


@pytest.mark.launch_test
def generate_test_description():
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN_ID)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    (FOLDER / "scene.yaml").write_text(SCENE)
    arguments = {"scene": str(FOLDER / "scene.yaml"), "robot_ip": HOST}
    mock = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(MOCK)), launch_arguments=arguments.items()
    )
    return LaunchDescription(
        [
            SetEnvironmentVariable("ROS_DOMAIN_ID", str(DOMAIN_ID)),
            SetEnvironmentVariable("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            SetEnvironmentVariable("ROS_HOME", str(FOLDER)),  # records go there
            mock,
            launch_testing.actions.ReadyToTest(),
        ]
    )


def kill(node):
    """As a crash would: SIGKILL."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = (
                (entry / name).read_bytes().split(b"\0") for name in ("cmdline", "environ")
            )
        except OSError:
            continue
        ours = f"ROS_DOMAIN_ID={DOMAIN_ID}".encode() in environment
        if ours and any(part.endswith(node.encode()) for part in command[:3]):
            os.kill(int(entry.name), signal.SIGKILL)
            return
    raise AssertionError(f"no process of {node}")


class TestScan(unittest.TestCase):
    def test_a_scan_outlives_a_node_that_is_killed(self):
        heard, killed = [], []

        def hear(feedback):
            heard.append(feedback)
            if feedback.phase == Scan.Feedback.PHASE_MEASURE and feedback.point == 1 and not killed:
                killed.append(time.monotonic())
                kill("frf_node")

        with ScanClient(lambda: None) as client:
            client.wait_until_up(120.0)
            result = client.scan(
                300.0,
                scene=FOLDER / "scene.yaml",
                run_directory=FOLDER / "run",
                on_feedback=hear,
            )
        assert killed
        assert result.ending is Ending.COMPLETE, result.message
        assert (result.done, result.failed) == (2, 0), result.message
        run = read_run(FOLDER / "run")
        assert [(r.index, r.attempt) for r in run.results] == [(0, 0), (1, 0)]
        # the point that lost its node was repeated
        assert run.results[1].repeats >= 1


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    def test_every_process_ended_in_order(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info, allowable_exit_codes=[0, -signal.SIGKILL])
