# SPDX-License-Identifier: Apache-2.0
"""Nodes are brought up in order, brought back after a fault or a kill, and taken down on request."""

import signal
import time

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from tactile_resonance.processes import NodeProcesses

NODES = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node")


class Watcher:
    """Hears the diagnostics and asks for states and transitions."""

    def __enter__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("watcher", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.heard = {}
        self.order = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.on_array, 50)
        return self

    def __exit__(self, *_):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def on_array(self, array):
        for status in array.status:
            self.heard[status.name] = {
                "message": status.message,
                **{v.key: v.value for v in status.values},
            }

    def wait(self, done, timeout_s=30.0):
        deadline = time.monotonic() + timeout_s
        while not done():
            assert time.monotonic() < deadline, self.heard
            self.executor.spin_once(timeout_sec=0.05)

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready)
        future = client.call_async(request)
        self.wait(future.done)
        self.node.destroy_client(client)
        return future.result()

    def state(self, node):
        """Asked until it answers: one that was killed takes questions for its successor for a while."""
        client = self.node.create_client(GetState, f"{node}/get_state")
        deadline, future = time.monotonic() + 60.0, None
        while future is None or not future.done():
            assert time.monotonic() < deadline, f"{node} does not answer: {self.heard}"
            self.wait(client.service_is_ready)
            future = client.call_async(GetState.Request())
            self.executor.spin_until_future_complete(future, 3.0)
        self.node.destroy_client(client)
        return future.result().current_state.label

    def all_are(self, state):
        return all(self.state(node) == state for node in NODES)


@pytest.fixture(scope="module")
def running(module_domain, tmp_path_factory):
    """Nodes that every test leaves as it found them: active."""
    folder = tmp_path_factory.mktemp("running")
    with NodeProcesses(folder / "log") as nodes, Watcher() as watcher:
        nodes.bring_up(NODES, {"excitation_node": {"record_folder": folder / "records"}})
        watcher.wait(lambda: watcher.heard.get("/manager_node", {}).get("state") == "active")
        yield nodes, watcher


def test_all_come_up_go_down_in_order_and_come_up_again(running):
    _, watcher = running
    assert watcher.all_are("active")
    assert watcher.call(Trigger, "manager_node/shut_down", Trigger.Request()).success
    watcher.wait(lambda: watcher.all_are("unconfigured"))
    assert watcher.call(Trigger, "manager_node/start", Trigger.Request()).success
    watcher.wait(lambda: watcher.all_are("active"))


def test_a_transition_that_the_state_does_not_have_is_refused(running):
    _, watcher = running
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    assert not watcher.call(ChangeState, "frf_node/change_state", request).success
    assert watcher.state("frf_node") == "active"


def test_a_node_that_was_deactivated_is_held_until_start(running):
    _, watcher = running
    told = watcher.heard
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    assert watcher.call(ChangeState, "frf_node/change_state", request).success
    watcher.wait(lambda: told["/manager_node"]["message"] == "held: frf_node")
    assert told["/manager_node"]["last error"] == "frf_node was deactivated, and is held"
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CLEANUP))
    assert watcher.call(ChangeState, "frf_node/change_state", request).success
    watcher.wait(lambda: told["/manager_node"]["frf_node"] == "unconfigured")
    assert watcher.state("frf_node") == "unconfigured"
    assert watcher.call(Trigger, "manager_node/start", Trigger.Request()).success
    watcher.wait(lambda: watcher.all_are("active"))


def test_a_killed_node_that_is_started_again_is_brought_up(running):
    nodes, watcher = running
    process = nodes._processes.pop("poles_node")
    process.send_signal(signal.SIGKILL)
    process.wait()
    watcher.wait(lambda: watcher.heard["/manager_node"]["poles_node"] != "active")
    nodes.start("poles_node")
    watcher.wait(lambda: watcher.heard["/manager_node"]["poles_node"] == "active")
    assert watcher.state("poles_node") == "active"


def test_a_configuration_that_is_refused_is_reported_with_its_reason(domain, tmp_path):
    with NodeProcesses(tmp_path / "log") as nodes, Watcher() as watcher:
        nodes.bring_up(NODES, {"excitation_node": {"device": "replay"}})
        watcher.wait(lambda: "last error" in watcher.heard.get("/excitation_node", {}))
        told = watcher.heard["/excitation_node"]
        assert told["last error"].startswith("device_config: empty, expected a path")
        assert told["state"] == "unconfigured"
        # what comes before it is up, what comes after it waits
        watcher.wait(
            lambda: watcher.heard.get("/manager_node", {}).get("fake_hardware_node") == "active"
        )
        assert watcher.state("frf_node") == "unconfigured"
