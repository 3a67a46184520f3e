# SPDX-License-Identifier: Apache-2.0
"""Nodes are brought up in order, brought back after a fault or a kill, and taken down on request."""

import signal

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from std_srvs.srv import Trigger

from tactile_resonance.nodes.client import HANGS_S, NodeClient
from tactile_resonance.processes import NodeProcesses

NODES = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node")


class Watcher(NodeClient):
    """Hears the diagnostics and asks for states and transitions."""

    def __init__(self):
        super().__init__("watcher", lambda: None)

    def join(self):
        self.heard = {}
        self._clients = {}
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self.on_array, 50)

    def why(self):
        return str(self.heard)

    def on_array(self, array):
        for status in array.status:
            self.heard[status.name] = {
                **{v.key: v.value for v in status.values},
            }

    def until(self, done, what="the diagnostics to tell it"):
        self.wait(done, HANGS_S, what)

    def call(self, kind, name, request):
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, name)
        return self.answer(self._clients[name], request)

    def change(self, node, transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call(ChangeState, f"{node}/change_state", request).success

    def state(self, node):
        return self.call(GetState, f"{node}/get_state", GetState.Request()).current_state.label

    def all_are(self, state):
        return all(self.state(node) == state for node in NODES)


@pytest.fixture(scope="module")
def running(module_domain, tmp_path_factory):
    """Nodes that every test leaves as it found them: active."""
    folder = tmp_path_factory.mktemp("running")
    with NodeProcesses(folder / "log") as nodes, Watcher() as watcher:
        nodes.bring_up(NODES, {"excitation_node": {"record_folder": folder / "records"}})
        watcher.until(lambda: watcher.heard.get("/manager_node", {}).get("state") == "active")
        yield nodes, watcher


def test_all_come_up_go_down_in_order_and_come_up_again(running):
    _, watcher = running
    assert watcher.all_are("active")
    assert watcher.call(Trigger, "manager_node/shut_down", Trigger.Request()).success
    watcher.until(lambda: watcher.all_are("unconfigured"))
    assert watcher.call(Trigger, "manager_node/start", Trigger.Request()).success
    watcher.until(lambda: watcher.all_are("active"))


def test_a_transition_that_the_state_does_not_have_is_refused(running):
    _, watcher = running
    assert not watcher.change("frf_node", Transition.TRANSITION_CONFIGURE)
    assert watcher.state("frf_node") == "active"


def test_a_node_that_was_deactivated_is_held_until_start(running):
    _, watcher = running
    told = watcher.heard
    assert watcher.change("frf_node", Transition.TRANSITION_DEACTIVATE)
    watcher.until(lambda: told["/manager_node"]["state"] == "held: frf_node")
    assert told["/manager_node"]["last error"] == "frf_node was deactivated, and is held"
    assert watcher.change("frf_node", Transition.TRANSITION_CLEANUP)
    watcher.until(lambda: told["/manager_node"]["frf_node"] == "unconfigured")
    assert watcher.state("frf_node") == "unconfigured"
    assert watcher.call(Trigger, "manager_node/start", Trigger.Request()).success
    watcher.until(lambda: watcher.all_are("active"))


def test_a_killed_node_that_is_started_again_is_brought_up(running):
    nodes, watcher = running
    process = nodes._processes.pop("poles_node")
    process.send_signal(signal.SIGKILL)
    process.wait()
    watcher.until(lambda: watcher.heard["/manager_node"]["poles_node"] != "active")
    nodes.start("poles_node")
    watcher.until(lambda: watcher.heard["/manager_node"]["poles_node"] == "active")
    assert watcher.state("poles_node") == "active"


def test_a_configuration_that_is_refused_is_reported_with_its_reason(domain, tmp_path):
    with NodeProcesses(tmp_path / "log") as nodes, Watcher() as watcher:
        nodes.bring_up(NODES, {"excitation_node": {"device": "replay"}})
        watcher.until(lambda: "last error" in watcher.heard.get("/excitation_node", {}))
        told = watcher.heard["/excitation_node"]
        assert told["last error"].startswith("device_config: empty, expected a path")
        assert told["state"] == "unconfigured"
        # what comes before it is up, what comes after it waits
        watcher.until(
            lambda: watcher.heard.get("/manager_node", {}).get("fake_hardware_node") == "active"
        )
        assert watcher.state("frf_node") == "unconfigured"
