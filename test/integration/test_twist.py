# SPDX-License-Identifier: Apache-2.0
"""contact_node on somebody else's controller, in lockstep with a stub of it: 1 cN, and what ends a contact."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from benchmarks.contact_client import ContactClient
from benchmarks.twist_stub import TwistStub, stub_parameters
from tactile_resonance.nodes.client import HANGS_S
from tactile_resonance.processes import NodeProcesses

STILL_M = 5e-5


class Lab:
    """The stub, contact_node with its manager, and their client."""

    def __init__(self, stub, client):
        self.stub, self.client, self.places = stub, client, 0

    def start(self):
        """A contact at a new place."""
        self.places += 1
        return self.client.start(0.006 * (self.places % 5), 0.006 * (self.places // 5))

    def truth(self, since_s):
        """Time [s], true force [N] and height of the tip [m] of all that was after a time."""
        times = np.array(self.stub.controller.force_n)
        height = np.array(self.stub.controller.height_m[: len(times)])
        after = times[:, 0] > since_s
        return times[after, 0], times[after, 1], height[after]

    def commanded(self, since_s):
        """Largest speed that was commanded after a time [m/s]."""
        return max((max(map(abs, twist)) for at_s, twist in self.stub.commands if at_s > since_s))


@pytest.fixture(scope="module", params=[500.0, 125.0])
def lab(request, module_domain, tmp_path_factory):
    folder = tmp_path_factory.mktemp("twist")
    with TwistStub(request.param) as stub, NodeProcesses(folder / "log") as nodes:
        nodes.bring_up(["contact_node"], {"contact_node": stub_parameters(folder, request.param)})
        with ContactClient(nodes.check) as client:
            yield Lab(stub, client)


at_125_hz = pytest.mark.parametrize("lab", [125.0], indirect=True)


def test_one_centinewton_is_reached_and_held(lab):
    result = lab.client.result(lab.start())
    assert result.reached, result.message
    lab.client.until("hold")
    held_s = lab.client.states[-1][1]
    lab.client.let_pass(2.0)
    _, before, _ = lab.truth(0.0)
    assert before.max() < 0.0115
    time_s, force_n, _ = lab.truth(held_s)
    second = force_n[time_s < held_s + 1.0]
    assert np.mean(second) == pytest.approx(0.01, rel=0.04)
    assert np.sqrt(np.mean((second - 0.01) ** 2)) < 6e-4
    assert lab.client.ask("retract").success
    lab.client.until("idle")
    _, force_n, height_m = lab.truth(0.0)
    assert force_n[-1] == 0
    # nothing is commanded while nothing is under way
    idle_s = 1e-9 * lab.client.told_ns
    lab.client.let_pass(0.3)
    assert lab.commanded(idle_s) == 0
    assert np.ptp(lab.truth(idle_s)[2]) < STILL_M


@at_125_hz
def test_a_controller_that_was_switched_off_is_a_fault_and_nothing_moves_until_a_new_goal(lab):
    controller = lab.stub.controller
    handle = lab.start()
    lab.client.until("approach")
    controller.active = False
    result = lab.client.result(handle)
    assert not result.reached
    assert "is the controller active, and the only one" in result.message
    # contact_node is brought up anew meanwhile; the controller is switched back, and hears zero
    fault_s = controller.time_ns * 1e-9
    lab.client.until("idle")
    controller.active = True
    lab.client.let_pass(1.0)
    assert lab.commanded(fault_s) == 0
    assert np.ptp(lab.truth(fault_s)[2]) < STILL_M
    again = lab.client.result(lab.start())
    assert again.reached, again.message
    lab.client.ask("retract")
    lab.client.until("idle")


@at_125_hz
def test_poses_that_stop_coming_are_a_fault_and_zero_within_the_deadline(lab):
    controller = lab.stub.controller
    handle = lab.start()
    lab.client.until("approach")
    lab.stub.poses = False
    silent_s = controller.time_ns * 1e-9
    result = lab.client.result(handle)
    assert not result.reached
    assert "the newest pose on tool_pose is" in result.message
    lab.stub.poses = True
    lab.client.until("idle")
    # a step may have been on its way when they stopped; the limit is 20 ms
    moving = [at_s for at_s, twist in lab.stub.commands if at_s > silent_s and any(twist)]
    assert moving, "it was under way"
    assert moving[-1] < silent_s + 0.020 + 2 * 0.008
    again = lab.client.result(lab.start())
    assert again.reached, again.message
    lab.client.ask("retract")
    lab.client.until("idle")


@at_125_hz
def test_a_node_that_is_shut_down_in_contact_draws_the_tip_back_and_commands_nothing_more(lab):
    result = lab.client.result(lab.start())
    assert result.reached, result.message
    held_m = lab.stub.controller.height_m[-1]
    assert lab.client.ask("manager_node/shut_down").success
    lab.client.wait(lambda: lab.stub.controller.force_n[-1][1] == 0, HANGS_S, "the tip to leave")
    lab.client.wait(lambda: not any(lab.stub.commands[-1][1]), HANGS_S, "zero")
    assert lab.stub.controller.height_m[-1] > held_m + 2e-3
    lab.client.state = None
    assert lab.client.ask("manager_node/start").success
    lab.client.until(
        "idle"
    )  # a goal before that may be lost with the server that is being taken down
    again = lab.client.result(lab.start())
    assert again.reached, again.message
    lab.client.ask("retract")
    lab.client.until("idle")
