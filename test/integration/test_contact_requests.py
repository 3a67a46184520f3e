# SPDX-License-Identifier: Apache-2.0
"""What is asked of contact_node while a contact is under way, through the real drivers; judged by the truth."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from benchmarks.contact_client import goal_message
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.nodes.client import HANGS_S

sys.path.insert(0, str(Path(__file__).parent))
from contact_rig import height_m, last_way_down_s
from lifecycle_msgs.msg import Transition

PARAMETERS, LIMITS = read_contact()
STANDOFF_M = PARAMETERS.standoff_m
SLOW = {
    "contact__tare_s": 1.0,
    "contact__zero_std_n": 0.0,
    "contact__time_constant_s": 0.3,
    "contact__settle_s": 1.0,
}
"""Each state lasts long enough to be met, that of the tare too."""


def drawn_back(bench, client):
    client.idle()
    assert height_m(bench) > STANDOFF_M - 2e-4
    assert bench.order("truth")["normal_force_n"] == 0


def test_a_held_contact_takes_no_goal_and_no_parameters_and_is_drawn_back_when_told_to(
    bench, client
):
    first = client.start()
    client.wait(lambda: client.state.state not in ("idle", "fault"), HANGS_S, "it to begin")
    assert not client.send(goal_message()).accepted, "one at a time"
    refused = client.set(contact__approach_speed_m_s=1e-3)
    assert "accepted in idle" in refused
    result = client.result(first)
    assert result.reached, result.message
    bench.let_pass(0.5)  # the force creeps into place
    at_s = bench.order("truth")["time_s"]
    # the goal has ended, the contact goes on: another one is taken as a goal and refused as a contact
    answer = client.result(client.start())
    assert (answer.reached, answer.cause) == (False, "busy")
    assert "hold" in answer.message
    for name, value in (
        ("contact__approach_speed_m_s", 1e-3),
        ("limits__depth_m", 1e-4),
        ("limits__abort_force_n", 2e-3),
    ):
        assert "accepted in idle" in client.set(**{name: value})
    assert "at most the limit" in client.set(
        contact__approach_speed_m_s=5e-3, limits__near_speed_m_s=2e-3
    )
    bench.let_pass(0.3)
    _, tip_m, force_n = bench.history(at_s)
    # nothing of that has moved the tip, but for the vibration of the robot and the creep of the tissue
    assert np.ptp(tip_m[:, 2]) < 1e-4
    assert np.mean(force_n) == pytest.approx(0.01, rel=0.1)
    told = client.retract()
    assert told.success, told.message
    drawn_back(bench, client)
    assert client.state.cause == "cancelled"
    # at rest they are taken, but none that the arm's driver would not pass on
    assert "max_acceleration_m_s2" in client.set(limits__stop_deceleration_m_s2=5.0)
    assert "at most 0.03, as launched" in client.set(limits__abort_force_n=0.04)
    assert client.set(contact__approach_speed_m_s=3e-3) == ""
    assert client.set(contact__approach_speed_m_s=PARAMETERS.approach_speed_m_s) == ""


@pytest.mark.parametrize("by_topic", [False, True])
def test_a_stop_draws_the_tip_back_and_keeps_it_out_until_it_is_released(bench, client, by_topic):
    ask = client.publish_stop if by_topic else client.stop
    result = client.result(client.start())
    assert result.reached, result.message
    at_s = bench.order("truth")["time_s"]
    ask(True)
    client.wait(lambda: client.state.stopped and client.state.state == "idle", HANGS_S, "idle")
    time_s, _, force_n = bench.history(at_s)
    assert time_s[np.flatnonzero(force_n)[-1]] - at_s < 2.0
    drawn_back(bench, client)
    assert not client.send(goal_message()).accepted
    # a retraction, and any time that passes, change nothing
    assert client.retract().success
    bench.let_pass(1.0)
    client.idle()
    assert client.state.stopped
    at_s = bench.order("truth")["time_s"]
    ask(False)
    client.wait(lambda: not client.state.stopped, HANGS_S, "the release")
    bench.let_pass(0.5)
    _, tip_m, _ = bench.history(at_s)
    assert np.ptp(tip_m[:, 2]) < 1e-4  # nothing moves by that
    assert client.result(client.start()).reached
    assert client.retract().success
    drawn_back(bench, client)


@pytest.mark.slow
@pytest.mark.parametrize("state", ["travel", "tare", "approach", "contact", "settle"])
def test_a_goal_that_is_cancelled_in_any_state_is_drawn_back(bench, client, state):
    assert client.set(**SLOW) == ""
    try:
        # travel is met from the other end of the table
        handle = client.start(0.04 if state == "travel" else 0.0)
        bench.until_state(client, state)
        at_s = bench.order("truth")["time_s"]
        client.cancel(handle)
        bench.time.free()
        result = client.result(handle)
        assert (result.reached, result.cause) == (False, "cancelled"), result.message
        drawn_back(bench, client)
        time_s, tip_m, force_n = bench.history(at_s)
        assert max(force_n) < LIMITS.abort_force_n
        if state != "travel":  # which comes down from where it was
            assert last_way_down_s(time_s, tip_m) - at_s < 0.2
    finally:
        client.back()
        client.set(**{name: getattr(PARAMETERS, name.split("__")[1]) for name in SLOW})


@pytest.mark.slow
@pytest.mark.parametrize(
    "state", ["travel", "tare", "approach", "contact", "settle", "hold", "retract"]
)
@pytest.mark.parametrize("stop", ["protective_stop", "emergency_stop"])
def test_stop_of_the_robot_in_any_state_is_named_and_moves_nothing_later(
    bench, client, state, stop
):
    assert client.set(**SLOW) == ""
    try:
        handle = client.start(0.04 if state == "travel" else 0.0)
        if state == "retract":
            bench.until_state(client, "hold")
            assert client.retract().success
        bench.until_state(client, state)
        at_s = bench.order("truth")["time_s"]
        bench.order(stop)
        bench.time.free()
        if state not in ("hold", "retract"):  # whose goals were reached
            result = client.result(handle)
            assert not result.reached
            assert result.cause in {"arm_stopped", "arm_link"}, result.message
        bench.until_state(client, "fault")
        bench.time.free()
        told = client.state
        assert told.message
        if state == "hold":
            assert told.cause in {"arm_stopped", "arm_link"}
        assert not client.retract().success, "not before it is released"
        bench.let_pass(0.3)
        time_s, tip_m, force_n = bench.history(at_s)
        assert max(force_n) < LIMITS.hard_force_n
        assert last_way_down_s(time_s, tip_m) - at_s < 0.2
        place = bench.order("truth")["tip_m"]
        bench.unlock() if stop == "protective_stop" else bench.power_up()
        bench.let_pass(1.0)
        assert np.linalg.norm(np.subtract(bench.order("truth")["tip_m"], place)) < 5e-5
        client.wait(lambda: client.retract().success, HANGS_S, "a retraction to be taken")
        client.idle()
        assert height_m(bench) > STANDOFF_M - 2e-4
    finally:
        client.back()
        client.set(**{name: getattr(PARAMETERS, name.split("__")[1]) for name in SLOW})


@pytest.mark.slow
def test_node_that_is_asked_to_end_in_a_contact_answers_its_goal(bench, client):
    assert client.set(**SLOW) == ""
    handle = client.start()
    bench.until_state(client, "contact")
    future = handle.get_result_async()
    client.change_state(Transition.TRANSITION_DEACTIVATE)
    bench.time.free()
    client.wait(future.done, HANGS_S, "the result")
    assert future.result().result.cause == "cancelled"
    assert height_m(bench) > STANDOFF_M - 2e-4
    client.change_state(Transition.TRANSITION_ACTIVATE)
    client.idle()
    client.set(**{name: getattr(PARAMETERS, name.split("__")[1]) for name in SLOW})
