# SPDX-License-Identifier: Apache-2.0
"""Every command of the client's handshake, driven through the registers as the client does it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.simulation.robot.controller import RuntimeState
from tactile_resonance.simulation.robot.kinematics import forward
from tactile_resonance.simulation.robot.poses import matrix_from_pose, pose_from_matrix
from tactile_resonance.simulation.robot.safety import SafetyMode

TCP = [0.01, -0.02, 0.15, 0.2, 0.0, -0.3]
# Dead time and lag of the joints are over after this long, to nanometres.
SETTLED_S = 0.2


def apart(pose, other) -> np.ndarray:
    """Position (3,) and rotation vector (3,) between two poses."""
    turn = Rotation.from_rotvec(pose[3:]) * Rotation.from_rotvec(other[3:]).inv()
    return np.concatenate([pose[:3] - other[:3], turn.as_rotvec()])


def unpacked(word: int) -> tuple[int, int, bool]:
    """Operation, write count and running flag of the asynchronous progress word."""
    return word >> 24 & 127, word >> 16 & 127, bool(word >> 15 & 1)


@pytest.fixture(params=[0, 24], ids=["lower", "upper"])
def any_client(request, make_client):
    return make_client(offset=request.param)


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


def test_movej_to_a_pose_and_movel_to_joints(client):
    pose = client.output("target_TCP_pose")
    pose[:3] += [0.05, 0.02, -0.04]
    client.call(2, [*pose, 1.0, 1.4])
    np.testing.assert_allclose(apart(client.output("target_TCP_pose"), pose), 0, atol=1e-9)
    q = client.output("target_q") + [0.1, 0.05, -0.1, 0, 0, 0.2]
    client.call(4, [*q, 0.25, 1.2])
    reached = pose_from_matrix(forward(q))
    np.testing.assert_allclose(apart(client.output("target_TCP_pose"), reached), 0, atol=1e-9)


def test_asynchronous_move_reports_its_progress_and_can_be_stopped(any_client):
    client = any_client
    pose = client.output("target_TCP_pose")
    goal = pose + [0.1, 0, -0.1, 0, 0, 0]
    operation, writes, _ = unpacked(client.progress)
    client.call(3, [*goal, 0.1, 0.5], [1])
    client.run(0.3)
    assert unpacked(client.progress) == (operation + 1, writes + 1, True)
    assert np.linalg.norm(client.output("target_TCP_speed")[:3]) == pytest.approx(0.1, rel=1e-6)
    client.call(33, [0.5], [1])  # stopL, asynchronous
    client.run(0.4)
    assert unpacked(client.progress)[2] is False
    assert not client.output("target_qd").any()
    way = apart(client.output("target_TCP_pose"), pose)
    assert 0.02 < np.linalg.norm(way[:3]) < 0.1
    np.testing.assert_allclose(np.cross(way[:3], goal[:3] - pose[:3]), 0, atol=1e-9)
    client.call(3, [*goal, 0.1, 0.5], [1])
    client.run(3.0)
    assert unpacked(client.progress)[2] is False
    np.testing.assert_allclose(apart(client.output("target_TCP_pose"), goal), 0, atol=1e-9)


def test_a_new_move_replaces_an_asynchronous_one(client):
    start = client.output("target_q")
    client.call(1, [*(start + 1.0), 0.5, 1.0], [1])
    client.run(0.2)
    client.call(1, [*start, 0.5, 1.0], [0])
    np.testing.assert_allclose(client.output("target_q"), start, atol=1e-12)
    assert unpacked(client.progress)[2] is False


@pytest.mark.parametrize("command", [33, 34])
def test_synchronous_stops_end_an_asynchronous_move(client, command):
    start = client.output("target_q")
    client.call(1, [*(start + 1.0), 0.5, 1.0], [1])
    client.run(0.6)
    client.call(command, [2.0], [0])
    assert not client.output("target_qd").any()
    # joints in proportion: the client's program stops in the joints, whatever was asked
    moved = client.output("target_q") - start
    np.testing.assert_allclose(moved, moved[0], atol=1e-12)


def test_speedl_streams_until_stopped(any_client):
    client = any_client
    start = client.output("actual_TCP_pose")
    client.stream(10, [0.0, 0.0, -0.02, 0.0, 0.0, 0.0, 0.5, 0.0])
    client.run(1.0)
    assert client.status == 1  # a streaming command is ready for the next at once
    # 1 s less half the ramp of 40 ms, the dead time of 4 ms and the lag of 10 ms
    way = client.output("actual_TCP_pose")[2] - start[2]
    assert way == pytest.approx(-0.02 * (1 - 0.02 - 0.004 - 0.010), abs=0.02 * 0.002)
    np.testing.assert_allclose(client.output("actual_TCP_speed"), [0, 0, -0.02, 0, 0, 0], atol=5e-6)
    client.call(15, [1.0])
    client.run(SETTLED_S)
    assert not client.output("target_qd").any()
    np.testing.assert_allclose(client.output("actual_qd"), 0, atol=1e-9)


def test_command_to_motion_takes_the_dead_time(client):
    client.stream(10, [0.0, 0.0, -0.02, 0.0, 0.0, 0.0, 10.0, 0.0])
    start, cycles = client.output("actual_q"), 0
    while np.array_equal(client.output("actual_q"), start):
        client.controller.step()
        cycles += 1
    # taken up in the first cycle, moving one dead time of 4 ms later
    assert cycles == 3


def test_a_new_speed_waits_until_the_time_of_the_last_is_over(client):
    client.stream(10, [0.01, 0, 0, 0, 0, 0, 5.0, 0.5])
    client.run(0.1)
    client.stream(10, [0, 0.01, 0, 0, 0, 0, 5.0, 0.002])
    client.run(0.3)
    np.testing.assert_allclose(client.output("target_TCP_speed")[:2], [0.01, 0], atol=1e-9)
    client.run(0.15)
    np.testing.assert_allclose(client.output("target_TCP_speed")[:2], [0, 0.01], atol=1e-9)


def test_speed_goes_on_without_its_client(client):
    client.stream(10, [0.0, 0.0, 0.005, 0.0, 0.0, 0.0, 0.5, 0.02])
    client.run(5.0)
    assert client.output("target_TCP_speed")[2] == pytest.approx(0.005)


def test_speedj_and_its_stop(any_client):
    any_client.stream(9, [0.0, 0.1, 0.0, 0.0, 0.0, -0.2, 1.0, 0.0])
    any_client.run(0.5)
    np.testing.assert_allclose(any_client.output("target_qd"), [0, 0.1, 0, 0, 0, -0.2])
    any_client.call(15, [1.0])
    assert not any_client.output("target_qd").any()


def test_servoj_and_servol_follow(any_client):
    client = any_client
    q = client.output("actual_q")
    for step in range(200):
        client.stream(11, [*(q + 0.0002 * step), 0, 0, 0.002, 0.05, 300])
        client.run(0.002)
    # a ramp is followed with the speed of the ramp, one look-ahead time late
    np.testing.assert_allclose(client.output("target_qd"), 0.1, rtol=0.01)
    np.testing.assert_allclose(q + 0.0002 * 199 - client.output("target_q"), 0.1 * 0.05, rtol=0.05)
    pose = client.output("target_TCP_pose") + [0, 0, 0.002, 0, 0, 0]
    client.stream(24, [*pose, 0, 0, 0.002, 0.05, 300])
    client.run(1.0)
    np.testing.assert_allclose(apart(client.output("target_TCP_pose"), pose), 0, atol=1e-7)
    client.call(16, [10.0])
    assert not client.output("target_qd").any()


def test_moving_while_a_thread_moves_the_arm_ends_the_program(client):
    client.stream(10, [0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.5, 0.0])
    client.run(0.1)
    client.write(1, [*client.output("target_q"), 1.0, 1.0])
    client.run(0.1)
    assert not client.controller.program_running
    assert "another thread" in client.controller.log[-1]
    assert client.controller.outputs("runtime_state") == RuntimeState.STOPPED
    assert client.controller.safety_mode is SafetyMode.NORMAL


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
    assert not client.controller.program_running
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
    assert not client.controller.program_running


def test_watchdog_stops_a_program_whose_client_falls_silent(any_client):
    client, controller = any_client, any_client.controller
    client.call(35, [10.0])
    client.stream(10, [0.0, 0.0, 0.005, 0.0, 0.0, 0.0, 0.5, 0.0])
    client.controller.step()
    for _ in range(20):  # kicked: the register is refreshed, whatever its value
        client.write(0)
        client.run(0.08)
        assert controller.program_running
    assert client.output("target_TCP_speed")[2] == pytest.approx(0.005)
    client.run(0.1 - 0.08)
    assert controller.program_running
    client.run(0.004)
    assert not controller.program_running
    assert "watchdog" in controller.log[-1]
    client.run(0.1)
    assert not client.output("target_qd").any()
    assert controller.outputs("runtime_state") == RuntimeState.STOPPED


def test_watchdog_watches_the_command_register_alone(client):
    client.call(35, [10.0])
    for _ in range(10):
        client.controller.write_inputs({"input_int_register_18": 1})
        client.run(0.02)
    assert not client.controller.program_running


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
    assert not client.controller.program_running
    assert "command 18: not modelled" in client.controller.log[-1]


def test_jogging_in_the_tools_frame(client):
    axis = Rotation.from_rotvec(client.output("actual_TCP_pose")[3:]).as_matrix()[:, 2]
    client.call(41, [0, 0, 0.02, 0, 0, 0, 1, 0.5])
    client.run(0.5)
    np.testing.assert_allclose(client.output("target_TCP_speed")[:3], 0.02 * axis, atol=1e-9)
    client.call(42)
    assert not client.output("target_qd").any()


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
