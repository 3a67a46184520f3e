# SPDX-License-Identifier: Apache-2.0
"""Bring-up from the launch file: nodes come up, measure on the bench, and end in order."""

import os
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
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from launch.actions import IncludeLaunchDescription, SetEnvironmentVariable
from launch.launch_description_sources import PythonLaunchDescriptionSource
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from tactile_resonance.action import Measure

from launch import LaunchDescription
from tactile_resonance import msg
from tactile_resonance.nodes.running import RESULTS
from tactile_resonance.processes import free_domain_id

MOCK = Path(__file__).resolve().parents[2] / "launch" / "mock.launch.py"
DOMAIN_ID = free_domain_id({})
NAMESPACE = "left"
HOST = f"127.{1 + os.getpid() % 250}.{1 + os.getpid() // 250 % 250}.7"


@pytest.mark.launch_test
def generate_test_description():
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN_ID)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    mock = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(MOCK)),
        launch_arguments={"namespace": NAMESPACE, "robot_ip": HOST}.items(),
    )
    return LaunchDescription(
        [
            SetEnvironmentVariable("ROS_DOMAIN_ID", str(DOMAIN_ID)),
            SetEnvironmentVariable("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            SetEnvironmentVariable("ROS_HOME", tempfile.mkdtemp()),  # records go there
            mock,
            launch_testing.actions.ReadyToTest(),
        ]
    )


class TestStream(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.context = rclpy.Context()
        rclpy.init(context=cls.context, domain_id=DOMAIN_ID)
        cls.node = rclpy.create_node("listener", namespace=NAMESPACE, context=cls.context)
        cls.executor = SingleThreadedExecutor(context=cls.context)
        cls.executor.add_node(cls.node)
        cls.states, cls.poles = {}, []
        cls.node.create_subscription(DiagnosticArray, "/diagnostics", cls.on_diagnostics, 50)
        cls.node.create_subscription(msg.Poles, "poles", cls.poles.append, RESULTS)

    @classmethod
    def tearDownClass(cls):
        cls.executor.shutdown()
        cls.node.destroy_node()
        rclpy.shutdown(context=cls.context)

    @classmethod
    def on_diagnostics(cls, array):
        for status in array.status:
            cls.states[status.name] = {v.key: v.value for v in status.values}.get("state")

    def wait(self, done, timeout_s=120.0):
        deadline = time.monotonic() + timeout_s
        while not done():
            assert time.monotonic() < deadline, self.states
            self.executor.spin_once(timeout_sec=0.05)

    def test_a_measurement_gives_poles(self):
        self.wait(lambda: self.states.get(f"/{NAMESPACE}/manager_node") == "active")
        client = ActionClient(self.node, Measure, "measure")
        self.wait(client.server_is_ready)
        for attempt in range(10):  # until every reader has been matched
            goal = client.send_goal_async(Measure.Goal(periods=3, label="launch test"))
            self.wait(goal.done)
            assert goal.result().accepted
            result = goal.result().get_result_async()
            self.wait(result.done)
            assert result.result().result.outcome == Measure.Result.DONE
            deadline = time.monotonic() + 2.0 * (1 + attempt)
            while time.monotonic() < deadline and not any(m.final for m in self.poles):
                self.executor.spin_once(timeout_sec=0.05)
            if any(m.final for m in self.poles):
                return
        raise AssertionError("no poles came")


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    def test_every_process_ended_in_order(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info, allowable_exit_codes=[0])
