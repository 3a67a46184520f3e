# SPDX-License-Identifier: Apache-2.0
"""A supervisor deactivates a node, or stops the tip, in the middle of a scan: the scan waits for it."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.qos import qos_profile_sensor_data
from robot_at_hand import own_time
from std_srvs.srv import SetBool, Trigger
from tactile_resonance.action import Scan
from tactile_resonance.msg import ContactState

from tactile_resonance.client import Ending
from tactile_resonance.nodes.client import HANGS_S, ScanClient
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE

NODES = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node", "scan_node")
SCENE = """
name: two points
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.025}}
positions:
  list: [[0.0, 0.0], [0.004, 0.0]]
blocks: {least: 24, most: 24}
"""
TIME = own_time(17)


class Supervisor(ScanClient):
    """Changes the life of nodes, watches the contact, and has one scan after the other made."""

    def __init__(self, nodes, folder):
        super().__init__(nodes.check)
        self.nodes, self.folder = nodes, folder

    def join(self):
        super().join()
        self.contact, self.heard = "", []
        self._clients = {}
        self._node.create_subscription(
            ContactState, "contact_state", self._on_contact, qos_profile_sensor_data
        )

    def _on_contact(self, message):
        self.contact, self.message = message.state, message

    def why(self):
        return f"{super().why()}; scan: {self.heard[-1:]}"

    def begin(self, **goal):
        """Ask for a scan, and wait until it measures."""
        self.heard.clear()
        self.outcome = self.tactile.scan(**goal, on_feedback=self.heard.append)
        measures = Scan.Feedback.PHASE_MEASURE
        self.wait(lambda: self.heard and self.heard[-1].phase == measures, HANGS_S, "a measurement")

    def see_it_wait(self, reason):
        """It tells the reason, and waits on with the tip free."""
        self.wait(lambda: self.heard[-1].waiting_for == reason, HANGS_S, "the scan to wait")
        self.wait(lambda: self.contact == "idle", HANGS_S, "the tip to leave")
        # for many periods of the manager nothing changes
        said = len(self.heard)
        self.wait(lambda: len(self.heard) > said + 10, HANGS_S, "the scan to wait on")
        assert {feedback.waiting_for for feedback in self.heard[said:]} == {reason}
        assert self.contact == "idle"

    def see_it_complete(self):
        """It goes on, and repeats the point."""
        self.wait(self.outcome.done, 5 * HANGS_S, "the scan")
        result = self.outcome.result()
        assert result.ending is Ending.COMPLETE, result.message
        assert (result.done, result.failed, result.repeats) == (2, 0, 1)

    def call(self, kind, name, request):
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, name)
        return self.answer(self._clients[name], request)

    def change(self, node, transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert self.call(ChangeState, f"{node}/change_state", request).success

    def state(self, node):
        return self.call(GetState, f"{node}/get_state", GetState.Request()).current_state.label


@pytest.fixture(scope="module")
def stack(module_domain, tmp_path_factory):
    """Nodes that run, and who supervises them."""
    folder = tmp_path_factory.mktemp("supervised")
    (folder / "two.yaml").write_text(SCENE)
    table = list(TABLE_IN_BASE)
    parameters = {
        "fake_hardware_node": {"scene": folder / "two.yaml", "serve_contact": True},
        "excitation_node": {"record_folder": folder / "records"},
        "scan_node": {"table_in_base": table, "goal_folders": [str(folder)]},
    }
    for given in parameters.values():
        given["time_server"] = TIME
    with NodeProcesses(folder / "log") as nodes, Supervisor(nodes, folder) as supervisor:
        nodes.bring_up(NODES, parameters)
        supervisor.wait_until_up(HANGS_S)
        supervisor.parameters = parameters
        yield supervisor


@pytest.fixture
def supervisor(stack, request):
    """A scan in its first measurement, and who supervises it."""
    stack.run = stack.folder / request.node.name
    stack.begin(scene=stack.folder / "two.yaml", run_directory=stack.run)
    yield stack
    if not stack.outcome.done():  # of a test that failed
        stack.tactile.cancel()
        stack.call(SetBool, "stop", SetBool.Request(data=False))
        stack.call(Trigger, "manager_node/start", Trigger.Request())
        stack.wait(stack.outcome.done, HANGS_S, "the scan to end")


def test_a_scan_waits_for_a_node_that_a_supervisor_holds(supervisor):
    def held():
        return supervisor.states.get("manager_node", "").startswith("held: poles_node")

    supervisor.change("poles_node", Transition.TRANSITION_DEACTIVATE)
    supervisor.see_it_wait("poles: /poles_node is inactive, not active")
    supervisor.wait(held, HANGS_S, "the manager to report it")
    assert supervisor.state("poles_node") == "inactive"
    supervisor.change("poles_node", Transition.TRANSITION_ACTIVATE)
    supervisor.see_it_complete()
    supervisor.wait(lambda: not held(), HANGS_S, "the manager to report it")
    assert [r.disturbances for r in read_run(supervisor.run).results] == ["node away 1", ""]


def test_a_scan_waits_while_the_tip_is_stopped_also_by_a_node_started_anew(supervisor):
    assert supervisor.call(SetBool, "stop", SetBool.Request(data=True)).success
    reason = "contact: the tip is stopped (service or topic stop)"
    supervisor.see_it_wait(reason)
    before = supervisor.message.instance
    process = supervisor.nodes._processes.pop("fake_hardware_node")
    process.kill()
    process.wait()
    supervisor.nodes.start("fake_hardware_node", supervisor.parameters["fake_hardware_node"])
    supervisor.wait(
        lambda: supervisor.message.instance != before and supervisor.message.stopped,
        HANGS_S,
        "the new node to be stopped",
    )
    supervisor.see_it_wait(reason)
    assert supervisor.call(SetBool, "stop", SetBool.Request(data=False)).success
    supervisor.see_it_complete()


def test_a_scan_whose_node_is_deactivated_draws_the_tip_back_and_ends(supervisor):
    supervisor.change("scan_node", Transition.TRANSITION_DEACTIVATE)
    supervisor.wait(supervisor.outcome.done, HANGS_S, "the scan to end")
    outcome = supervisor.outcome.result()
    assert (outcome.message, outcome.done) == ("cancelled", 0)
    supervisor.wait(lambda: supervisor.contact == "idle", HANGS_S, "the tip to leave")
