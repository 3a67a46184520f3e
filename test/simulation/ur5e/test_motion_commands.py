# SPDX-License-Identifier: Apache-2.0
"""Commands of the client's handshake that move the arm, driven through the registers as the client does it."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.simulation.ur5e.controller import RuntimeState, SafetyMode

sys.path.insert(0, str(Path(__file__).parent))
from commands import SETTLED_S, apart, unpacked
from matrices import forward, pose_from_matrix


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
    assert client.controller.program is None
    assert "another thread" in client.controller.log[-1]
    assert client.controller.outputs("runtime_state") == RuntimeState.STOPPED
    assert client.controller.safety_mode is SafetyMode.NORMAL


def test_jogging_in_the_tools_frame(client):
    axis = Rotation.from_rotvec(client.output("actual_TCP_pose")[3:]).as_matrix()[:, 2]
    client.call(41, [0, 0, 0.02, 0, 0, 0, 1, 0.5])
    client.run(0.5)
    np.testing.assert_allclose(client.output("target_TCP_speed")[:3], 0.02 * axis, atol=1e-9)
    client.call(42)
    assert not client.output("target_qd").any()


def test_jogging_again_takes_the_acceleration_that_comes_with_it(client):
    client.call(41, [0, 0, 0.02, 0, 0, 0, 0, 0.02])
    client.run(0.1)
    slow = client.output("actual_TCP_speed")[2]
    assert 0 < slow < 0.003
    client.call(41, [0, 0, 0.02, 0, 0, 0, 0, 1.0])
    client.run(0.1)
    assert client.output("actual_TCP_speed")[2] == pytest.approx(0.02, rel=1e-3)
    client.call(42)
