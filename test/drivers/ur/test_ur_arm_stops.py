# SPDX-License-Identifier: Apache-2.0
"""No stop is lost or late, and nothing moves that nobody wants to move."""

import socket

import numpy as np
import pytest
from arms import (
    ACCELERATION_M_S2,
    LAG_S,
    UP,
    connect_again,
    keep_for,
    left_alone,
    pass_time,
    wait_for_fault,
)

from tactile_resonance.contact.interfaces import ArmError, ArmFault


def height_m(arm):
    return arm.state().position_m[2]


def test_connecting_after_the_program_was_stopped_moves_nothing(robot, high):
    high.speed(UP, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.dashboard("stop")
    assert wait_for_fault(high)[0].fault is ArmFault.PROGRAM_STOPPED
    keep_for(high, LAG_S)
    place = height_m(high)
    connect_again(high)
    keep_for(high, 0.3)
    assert height_m(high) == pytest.approx(place, abs=5e-5)


def test_stop_is_taken_while_states_are_stale(robot, module_arm, start_arm):
    """The network holds packets back, for less than the watchdog's time, which does not stop the arm here."""
    module_arm.close()  # its registers are its own
    arm = start_arm(robot.host, watchdog_hz=5.0)
    connect_again(arm)
    for sign in (1, -1, 1, -1, 1):
        arm.speed(sign * UP, ACCELERATION_M_S2)
        pass_time(arm, 0.1)
        robot.order("freeze", seconds=0.06)
        pass_time(arm, 0.04)
        with pytest.raises(ArmError) as error:
            arm.state()
        assert error.value.fault is ArmFault.STALE
        arm.stop(ACCELERATION_M_S2)
        assert np.linalg.norm(robot.order("state")["tcp_speed"][:3]) > 0.004
        pass_time(arm, 0.02 + LAG_S)
        assert np.linalg.norm(robot.order("state")["tcp_speed"][:3]) < 5e-4
        assert arm.state().moving_allowed


def test_a_velocity_that_is_overtaken_by_a_stop_never_moves_the_arm(robot, high):
    place = robot.order("state")["tcp_pose"]
    high.speed(40 * UP, 2.0)
    high.stop(2.0)
    keep_for(high, 0.2)
    assert robot.order("state")["tcp_pose"] == pytest.approx(place, abs=5e-5)


def test_program_that_another_starts_is_not_ours(robot, high):
    """It has no watchdog, and finds the velocity in its register."""
    high.speed(UP, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.dashboard("stop")
    keep_for(high, 0.05)  # a robot takes longer than that to begin a program
    assert robot.order("state")["runtime_state"] == "STOPPED"
    with socket.create_connection((robot.host, 30003), 5) as channel:
        channel.sendall(b"def rtde_control():\n  reg_offset_int = 0\nend\n")
        with left_alone(high, robot):
            robot.until(runtime_state="PLAYING")
        assert wait_for_fault(high)[0].fault is ArmFault.PROGRAM_STOPPED
        keep_for(high, 0.1 + LAG_S)
        assert robot.order("state")["runtime_state"] == "PLAYING"
        assert np.linalg.norm(robot.order("state")["tcp_speed"][:3]) < 5e-4
        assert "program" in high.state().message
    connect_again(high)
    keep_for(high, 0.1)
    assert high.state().moving_allowed
