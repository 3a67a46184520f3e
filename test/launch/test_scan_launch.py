# SPDX-License-Identifier: Apache-2.0
"""Scans from the launch file: nodes killed in the middle, one that is mute, a cancelled one; and the end."""

import os
import signal
import tempfile
import threading
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
from rclpy.qos import qos_profile_sensor_data
from tactile_resonance.action import Scan
from tactile_resonance.msg import ContactState

from launch import LaunchDescription
from tactile_resonance.client import Ending
from tactile_resonance.nodes.client import ScanClient
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


def signal_to(node, number):
    """Signal the process of a node of this launch."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = (
                (entry / name).read_bytes().split(b"\0") for name in ("cmdline", "environ")
            )
        except OSError:
            continue
        ours = f"ROS_DOMAIN_ID={DOMAIN_ID}".encode() in environment
        if ours and any(part.endswith(node.encode()) for part in command[:3]):
            os.kill(int(entry.name), number)
            return
    raise AssertionError(f"no process of {node}")


class Disturbed(ScanClient):
    """A scan in whose second point something happens, once it is measured."""

    def __init__(self, name, happens):
        super().__init__(lambda: None)
        self._run, self._happens, self._happened = FOLDER / name, happens, False
        self.waited_for = set()

    def outcome(self):
        self.wait_until_up(120.0)
        return self.scan(
            300.0,
            scene=FOLDER / "scene.yaml",
            run_directory=self._run,
            on_feedback=self._hear,
        )

    def results(self):
        """Of a scan whose two points were measured, the second once more."""
        outcome = self.outcome()
        assert self._happened
        assert outcome.ending is Ending.COMPLETE, outcome.message
        results = read_run(self._run).results
        told = outcome.message, [result.reason for result in results]
        assert (outcome.done, outcome.failed) == (2, 0), told
        assert [(r.index, r.attempt) for r in results] == [(0, 0), (1, 0)], told
        return results

    def _hear(self, feedback):
        if feedback.waiting_for:
            self.waited_for.add(feedback.waiting_for)
        measured = feedback.phase == Scan.Feedback.PHASE_MEASURE and feedback.point == 1
        if measured and not self._happened:
            self._happened = True
            self._happens(self)


class TestScan(unittest.TestCase):
    def test_a_scan_outlives_a_node_that_is_killed(self):
        for node in ("frf_node", "contact_node"):
            with Disturbed(f"without {node}", lambda _: signal_to(node, signal.SIGKILL)) as client:  # noqa: B023
                # the point that lost its node was repeated
                assert client.results()[1].repeats >= 1

    def test_a_node_that_is_mute_for_a_while_is_named_and_waited_for(self):
        def mute(_):
            signal_to("poles_node", signal.SIGSTOP)
            threading.Timer(8.0, lambda: signal_to("poles_node", signal.SIGCONT)).start()

        with Disturbed("mute", mute) as client:
            client.results()
            assert any("poles_node" in reason for reason in client.waited_for), client.waited_for

    def test_a_cancelled_scan_leaves_the_tip_free(self):
        states = []
        with Disturbed("cancelled", lambda client: client.tactile.cancel()) as client:
            client._node.create_subscription(
                ContactState, "contact_state", states.append, qos_profile_sensor_data
            )
            outcome = client.outcome()
            assert outcome.ending is Ending.CANCELLED, outcome.message
            assert outcome.done == 1, outcome.message
            del states[:]
            client.wait(lambda: states, 120.0, "the state of the contact")
            assert states[-1].state == ContactState.STATE_IDLE


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    def test_every_process_ended_in_order(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info, allowable_exit_codes=[0, -signal.SIGKILL])
