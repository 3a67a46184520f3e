# SPDX-License-Identifier: Apache-2.0
"""Commands of the client's handshake that set, ask and end, and the handshake itself, through the registers."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.simulation.ur5e.controller import RuntimeState, SafetyMode

sys.path.insert(0, str(Path(__file__).parent))
from commands import SETTLED_S, apart, unpacked
from matrices import forward, matrix_from_pose, pose_from_matrix

TCP = [0.01, -0.02, 0.15, 0.2, 0.0, -0.3]


def test_program_starts_ready_and_says_so(any_client):
    assert any_client.status == 1
    assert any_client.controller.outputs("runtime_state") == RuntimeState.PLAYING
    assert any_client.controller.outputs("robot_status_bits") & 3 == 3
    assert not unpacked(any_client.progress)[2]


def test_blocking_command_is_done_once_and_waits_to_be_cleared(any_client):
    client, start = any_client, any_client.output("actual_q")
    goal = start + 0.1
    client.write(1, [*goal, 1.0, 1.5])
    client.until(2, 10.0)
    np.testing.assert_allclose(client.output("target_q"), goal, atol=1e-15)
    client.run(0.1)  # the command still stands: nothing happens, the answer stays
    assert client.status == 2
    client.write(0)
    client.controller.step()
    assert client.status == 1
    client.run(SETTLED_S)
    np.testing.assert_allclose(client.output("actual_q"), goal, atol=1e-9)


def test_registers_of_the_other_range_are_not_read(make_client):
    client = make_client(offset=24)
    before = client.output("target_q")
    client.controller.write_inputs({"input_int_register_0": 9, "input_double_register_0": 1.0})
    client.run(0.1)
    assert np.array_equal(client.output("target_q"), before)


def test_tcp_is_set_and_moves_are_of_the_tcp(any_client):
    client = any_client
    client.call(29, TCP)
    client.call(40)
    np.testing.assert_allclose(client.answers, TCP, atol=1e-12)
    np.testing.assert_allclose(client.output("tcp_offset"), TCP, atol=1e-12)
    flange = forward(client.output("actual_q"))
    expected = pose_from_matrix(flange @ matrix_from_pose(TCP))
    np.testing.assert_allclose(apart(client.output("actual_TCP_pose"), expected), 0, atol=1e-12)
    client.call(43)
    np.testing.assert_allclose(apart(client.answers, expected), 0, atol=1e-12)
    client.stream(10, [0, 0, 0, 0, 0, 0.2, 1.0, 0.0])  # turning leaves the TCP in its place
    client.run(1.0)
    np.testing.assert_allclose(client.output("target_TCP_pose")[:3], expected[:3], atol=1e-9)


def test_payload_is_set_and_its_centre_kept_where_none_is_given(any_client):
    client = any_client
    client.call(17, [0.4, 0.01, 0.02, 0.05])
    assert client.controller.outputs("payload") == 0.4
    assert client.controller.outputs("payload_cog") == [0.01, 0.02, 0.05]
    client.call(17, [0.6, 0, 0, 0])
    assert client.controller.outputs("payload") == 0.6
    assert client.controller.outputs("payload_cog") == [0.01, 0.02, 0.05]
    client.call(65, [0.7, 0, 0, 0.1, 1e-3, 2e-3, 3e-3, 0, 0, 0])
    assert client.controller.outputs("payload_inertia") == [1e-3, 2e-3, 3e-3, 0, 0, 0]


def test_step_time_is_streamed(any_client):
    any_client.stream(26)
    any_client.run(0.01)
    assert any_client.status == 1
    assert any_client.answers[0] == 0.002


def test_inverse_kinematics_near_the_arm_and_near_given_angles(any_client):
    client = any_client
    client.call(29, TCP)
    q = client.output("actual_q") + [0.1, -0.1, 0.2, 0.0, 0.1, 0.3]
    tool = forward(q) @ matrix_from_pose(TCP)
    client.call(46, pose_from_matrix(tool))
    np.testing.assert_allclose(client.answers, q, atol=1e-9)
    other = q + [0, 0, 0, 0, 0, -2 * np.pi]
    client.call(30, [*pose_from_matrix(tool), *other, 1e-10, 1e-10])
    np.testing.assert_allclose(client.answers, other, atol=1e-9)
    client.call(44, [*other, *TCP])
    np.testing.assert_allclose(apart(client.answers, pose_from_matrix(tool)), 0, atol=1e-9)


def test_safety_limit_queries(any_client):
    client = any_client
    pose = client.output("actual_TCP_pose")
    client.call(36, pose)
    assert client.answer == 1
    client.call(60, pose)
    assert client.answer == 1
    far = pose + [2.0, 0, 0, 0, 0, 0]
    client.call(36, far)
    assert client.answer == 0
    client.call(60, far)
    assert client.answer == 0
    client.call(37, [0, 0, 0, 0, 0, 6.2])
    assert client.answer == 1
    client.call(37, [0, 0, 0, 0, 0, 6.4])
    assert client.answer == 0


def test_inverse_kinematics_out_of_reach_ends_the_program(client):
    client.write(46, [2.0, 0, 0, 0, 0, 0])
    client.run(0.01)
    assert client.controller.program is None
    assert "no joint angles reach" in client.controller.popup


def test_is_steady_after_half_a_second_of_rest(any_client):
    client = any_client
    client.stream(9, [0.1, 0, 0, 0, 0, 0, 1.0, 0.0])
    client.run(0.3)
    client.call(15, [1.0])
    client.run(0.4)
    client.call(47)
    assert client.answer == 0
    client.run(0.2)
    client.call(47)
    assert client.answer == 1


def test_past_joint_positions(client):
    client.stream(9, [0.1, 0, 0, 0, 0, 0, 50.0, 0.0])
    client.run(0.5)
    now = client.output("actual_q")
    client.stream(27, (), [50])
    client.controller.step()
    # the answer was taken before the arm moved in that cycle
    np.testing.assert_allclose(now - client.answers, [0.1 * 50 * 0.002, 0, 0, 0, 0, 0], atol=1e-9)


def test_triggered_protective_stop_ends_the_program(client):
    client.write(31)
    client.run(0.1)
    assert client.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    assert client.controller.outputs("safety_status_bits") >> 2 & 1
    assert client.controller.program is None


def test_watchdog_stops_a_program_whose_client_falls_silent(any_client):
    client, controller = any_client, any_client.controller
    client.call(35, [10.0])
    client.stream(10, [0.0, 0.0, 0.005, 0.0, 0.0, 0.0, 0.5, 0.0])
    client.controller.step()
    for _ in range(20):  # kicked: the register is refreshed, whatever its value
        client.write(0)
        client.run(0.08)
        assert controller.program is not None
    assert client.output("target_TCP_speed")[2] == pytest.approx(0.005)
    client.run(0.1 - 0.08)
    assert controller.program is not None
    client.run(0.004)
    assert controller.program is None
    assert "watchdog" in controller.log[-1]
    client.run(0.1)
    assert not client.output("target_qd").any()
    assert controller.outputs("runtime_state") == RuntimeState.STOPPED


def test_watchdog_watches_the_command_register_alone(client):
    client.call(35, [10.0])
    for _ in range(10):
        client.controller.write_inputs({"input_int_register_18": 1})
        client.run(0.02)
    assert client.controller.program is None


def test_stop_script_ends_the_program_and_brakes(any_client):
    client = any_client
    client.stream(9, [0.2, 0, 0, 0, 0, 0, 1.0, 0.0])
    client.run(0.5)
    client.write(255)
    client.controller.step()
    assert client.controller.outputs("runtime_state") != RuntimeState.PLAYING
    client.run(0.1)
    assert client.controller.outputs("runtime_state") == RuntimeState.STOPPED
    assert not client.output("target_qd").any()


def test_unknown_commands_end_the_program_with_their_number(client):
    client.write(18)
    client.run(0.01)
    assert client.controller.program is None
    assert "command 18: not modelled" in client.controller.log[-1]


def test_pose_trans_and_flange_pose(client):
    first, second = [0.1, 0.2, 0.3, 0.1, 0.2, 0.3], [0.01, 0, -0.1, 0, 0.5, 0]
    client.call(39, [*first, *second])
    a, b = Rotation.from_rotvec(first[3:]), Rotation.from_rotvec(second[3:])
    expected = [*(np.array(first[:3]) + a.apply(second[:3])), *(a * b).as_rotvec()]
    np.testing.assert_allclose(client.answers, expected, atol=1e-12)
    client.call(29, TCP)
    client.stream(58)
    client.run(0.004)
    flange = pose_from_matrix(forward(client.output("actual_q")))
    np.testing.assert_allclose(apart(client.answers, flange), 0, atol=1e-12)
