# SPDX-License-Identifier: Apache-2.0
"""Faults in contact, through contact_node and the real drivers; judged by the plant's truth.

Each fault comes at the first touch, while the tip still presses. The times are those that docs/safety.md
states; they are simulated, so that a slow machine has no part in them.
"""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.nodes.client import HANGS_S

sys.path.insert(0, str(Path(__file__).parent))
from contact_rig import height_m, last_way_down_s

PARAMETERS, LIMITS = read_contact()
STANDOFF_M = PARAMETERS.standoff_m
REST_S = 0.2
"""Until the tip goes down no more: the fault is seen (10 to 40 ms), told, and the arm brakes."""


def cell(name, value=1):
    return (
        lambda bench: bench.order("cell_fault", fault=name, value=value),
        lambda bench: bench.order("cell_fault", fault=name, value=0),
    )


FORCE_FAULTS = {
    # name: injection and its end, accepted causes
    "silent": (*cell("silent"), {"force_stale", "force_source"}),
    "stuck": (*cell("stuck"), {"force_stuck", "force_source"}),
    "no number": (*cell("invalid"), {"force_invalid", "force_source"}),
    "saturated": (*cell("saturated"), {"force_overload", "force_source", "force_pull"}),
    "sign flipped": (*cell("flipped"), {"force_pull", "force_source", "force_rate"}),
    "server gone": (
        lambda bench: bench.order("cell_fault", fault="server_gone", value=1),
        lambda bench: None,
        {"force_stale", "force_source"},
    ),
}


def client_pid(bench):
    """Process of the arm's client library, a child of contact_node."""
    node = bench.nodes._processes["contact_node"].pid
    for path in Path("/proc").glob("[0-9]*/stat"):
        fields = path.read_text().rpartition(")")[2].split()
        command = path.with_name("cmdline").read_bytes()
        if int(fields[1]) == node and b"ur_client" in command:
            return int(path.parent.name)
    raise AssertionError("contact_node has no client of the arm")


ARM_FAULTS = {
    "network frozen for 1 s": lambda bench: bench.order("freeze", seconds=1.0),
    "connections dropped": lambda bench: bench.order("drop"),
    "client killed": lambda bench: os.kill(client_pid(bench), signal.SIGKILL),
}
"""The last one leaves nothing that could stop the robot but its own watchdog."""


def pressed_then(bench, client, inject):
    """Inject at the first touch; the action's result and what truly happened from then on."""
    handle, _, at_s = bench.start_contact(client)
    assert at_s is not None, client.result(handle).message
    inject(bench)
    bench.time.free()
    result = client.result(handle)
    bench.let_pass(0.3)
    time_s, tip_m, force_n = bench.history(at_s)
    assert max(force_n) < LIMITS.hard_force_n
    assert last_way_down_s(time_s, tip_m) - at_s < REST_S
    return result, tip_m


@pytest.mark.parametrize("name", FORCE_FAULTS)
def test_fault_of_the_cell_stops_the_tip_and_draws_it_back(bench, client, name):
    inject, end, causes = FORCE_FAULTS[name]
    try:
        result, _ = pressed_then(bench, client, inject)
    finally:
        end(bench)
    assert not result.reached
    assert result.cause in causes, result.message
    assert result.message
    client.wait(lambda: height_m(bench) > STANDOFF_M - 2e-4, HANGS_S, "the tip to be drawn back")
    bench.let_pass(1.5)  # the end of a fault may be a step, by which the source is started again
    client.back()
    # the loop goes on
    cycles, result = client.state.cycles, client.result(client.start())
    assert result.reached, result.message
    client.retract()
    client.idle()
    assert client.state.cycles > cycles


@pytest.mark.parametrize("name", ARM_FAULTS)
def test_lost_arm_is_stopped_by_its_watchdog_where_it_is(bench, client, name):
    result, tip_m = pressed_then(bench, client, ARM_FAULTS[name])
    assert not result.reached
    assert result.cause in {"arm_link", "arm_stale"}, result.message
    assert result.message
    # stopped, and not drawn back by itself
    assert np.ptp(tip_m[-50:, 2]) < 5e-5
    assert height_m(bench) < 0
    bench.let_pass(1.5)  # a link that is dead for a second is made anew
    client.back()


ROBOT_STOPS = {
    "protective_stop": lambda bench: bench.unlock(),
    "emergency_stop": lambda bench: bench.power_up(),
}


@pytest.mark.parametrize("stop", ROBOT_STOPS)
def test_stop_of_the_robot_is_named_and_the_tip_stays(bench, client, stop):
    result, tip_m = pressed_then(bench, client, lambda b: b.order(stop))
    assert not result.reached
    assert result.cause in {"arm_stopped", "arm_link"}, result.message
    assert np.ptp(tip_m[-50:, 2]) < 5e-5
    ROBOT_STOPS[stop](bench)
    bench.let_pass(0.5)
    assert height_m(bench) < 0, "released, it moves only when it is told to"
    # told to, once the newest state no longer shows the stop
    client.wait(lambda: client.retract().success, HANGS_S, "a retraction to be taken")
    client.wait(lambda: height_m(bench) > STANDOFF_M - 2e-4, HANGS_S, "the tip to be drawn back")
    client.idle()


def test_a_cancelled_goal_draws_back(bench, client):
    handle, _, at_s = bench.start_contact(client)
    assert at_s is not None
    client.cancel(handle)
    bench.time.free()
    result = client.result(handle)
    assert result.cause == "cancelled"
    assert height_m(bench) > STANDOFF_M - 2e-4
    client.idle()


def test_killed_nodes_leave_a_tip_that_stands_and_the_next_one_lifts_it_first(bench, client):
    handle = client.start()
    assert client.result(handle).reached
    at_s = bench.order("truth")["time_s"]
    arm = client_pid(bench)
    process = bench.nodes._processes.pop("contact_node")
    os.kill(arm, signal.SIGKILL)
    process.send_signal(signal.SIGKILL)
    process.wait()
    bench.let_pass(0.5)
    time_s, tip_m, force_n = bench.history(at_s)
    assert max(force_n) < LIMITS.hard_force_n
    assert last_way_down_s(time_s, tip_m) - at_s < REST_S
    assert np.ptp(tip_m[-100:, 2]) < 5e-5
    assert force_n[-1] > 0
    bench.nodes.start("contact_node", bench.parameters)
    client.idle()
    at_s = bench.order("truth")["time_s"]
    result = client.result(client.start(0.004, 0.0))
    assert result.reached, result.message
    _, tip_m, force_n = bench.history(at_s)
    away = np.linalg.norm(tip_m[:, :2] - tip_m[0, :2], axis=1)
    lifted = np.argmax(force_n == 0)  # out of the first contact
    assert away[:lifted].max() < 1e-4
    # asked to end in contact, it draws the tip back first
    process = bench.nodes._processes.pop("contact_node")
    process.send_signal(signal.SIGTERM)
    assert process.wait(HANGS_S) == 0
    assert height_m(bench) > STANDOFF_M - 2e-4
