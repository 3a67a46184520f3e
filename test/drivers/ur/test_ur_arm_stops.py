# SPDX-License-Identifier: Apache-2.0
"""No stop is lost or late, and nothing moves that nobody wants to move."""

import contextlib
import socket
import time

import numpy as np
import pytest
from arms import ACCELERATION_M_S2, DOWN, LAG_S, connect_again, keep, keep_for, wait_for_fault

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.samples import Pose

UP = -DOWN


def below(arm, by_m=0.1):
    tip = arm.state().tip
    return Pose(tip.position_m - [0, 0, by_m], tip.rotation_rad)


def speed_m_s(arm):
    return float(np.linalg.norm(arm.state().velocity[:3]))


def followed(arm, seconds):
    """As an owner does who looks for the state, stale or not: his sign of life goes on."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(ArmError):
            arm.state()
        time.sleep(0.002)


def height_m(arm):
    return float(arm.state().tip.position_m[2])


def test_connecting_after_the_watchdog_moves_nothing(robot, high):
    high.speed(UP, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.dashboard("stop")
    assert wait_for_fault(high).fault is ArmFault.PROGRAM_STOPPED
    keep_for(high, LAG_S)
    place = height_m(high)
    high.connect()
    keep_for(high, 0.3)
    assert height_m(high) == pytest.approx(place, abs=5e-5)


def test_stop_is_taken_while_states_are_stale(robot, module_arm, start_arm):
    """A network that holds packets back for less than the watchdog's time; five times."""
    module_arm.close()
    arm = start_arm(robot.host, max_state_age_s=0.02)
    for sign in (1, -1, 1, -1, 1):
        connect_again(arm)
        arm.speed(sign * UP, ACCELERATION_M_S2)
        followed(arm, 0.1)
        robot.order("freeze", seconds=0.034)
        followed(arm, 0.026)
        arm.stop(ACCELERATION_M_S2)
        followed(arm, 0.05 + LAG_S)
        assert np.linalg.norm(robot.order("state")["tcp_speed"][:3]) < 5e-4


def test_stop_overtakes_a_command_that_waits_for_the_arm_to_brake(high):
    high.move(below(high), 0.1, 1.0)
    keep_for(high, 0.3)
    high.speed(UP, 0.15)  # first brakes by 0.15 m/s2, for 0.67 s
    keep_for(high, 0.05)
    high.stop(2.0)
    keep_for(high, 0.1 / 2.0 + 2 * LAG_S)
    assert speed_m_s(high) < 5e-4
    high.speed(20 * UP, 1.0)
    keep_for(high, 0.2)
    high.move(below(high), 0.1, 0.15)
    keep_for(high, 0.05)
    high.stop(2.0)
    keep_for(high, 0.1 / 2.0 + 2 * LAG_S)
    place = height_m(high)
    keep_for(high, 0.7)  # nor does the move begin later
    assert height_m(high) == pytest.approx(place, abs=5e-5)
    assert not high.moving()


def test_refused_move_is_not_begun_later(high):
    high.speed(20 * UP, 1.0)
    keep_for(high, 0.2)
    high.move(below(high), 0.1, 0.1)
    with pytest.raises(ArmError, match="brakes for 1.* s first") as error:
        keep_for(high, 1.0)
    assert error.value.fault is ArmFault.COMMAND_REFUSED
    heights = [sample.tip.position_m[2] for sample in keep_for(high, 1.5)]
    assert heights[-1] == pytest.approx(max(heights), abs=5e-5)
    assert speed_m_s(high) < 5e-4


def test_move_after_a_stop_that_was_told_twice(high):
    high.speed(20 * UP, 1.0)
    keep_for(high, 0.2)
    for _ in range(2):
        high.stop(0.3)
        keep_for(high, 0.03)
    goal = below(high, 0.03)
    high.move(goal, 0.1, 1.0)
    keep(high, high.moving)
    keep_for(high, LAG_S)
    assert height_m(high) == pytest.approx(goal.position_m[2], abs=5e-5)


def test_move_ends_with_its_program(robot, high):
    high.move(below(high), 0.05, 1.0)
    keep_for(high, 0.2)
    robot.dashboard("stop")
    keep(high, high.moving, 1.0)
    assert wait_for_fault(high).fault is ArmFault.PROGRAM_STOPPED


def test_program_that_another_starts_is_not_ours(robot, high):
    """It has no watchdog, and finds the velocity in its register."""
    high.speed(UP, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.dashboard("stop")
    robot.until(runtime_state="STOPPED")
    keep_for(high, 0.05)  # a robot takes longer than that to begin a program
    with socket.create_connection((robot.host, 30003), 5) as channel:
        channel.sendall(b"def rtde_control():\n  reg_offset_int = 0\nend\n")
        robot.until(runtime_state="PLAYING")
        assert wait_for_fault(high).fault is ArmFault.PROGRAM_STOPPED
        keep_for(high, 0.1 + LAG_S)
        assert robot.order("state")["runtime_state"] == "PLAYING"
        assert np.linalg.norm(robot.order("state")["tcp_speed"][:3]) < 5e-4
        assert "program" in high.state().message
    high.connect()
    keep_for(high, 0.1)
    assert high.state().moving_allowed
