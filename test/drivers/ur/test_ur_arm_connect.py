# SPDX-License-Identifier: Apache-2.0
"""What keeps UrArm from connecting, each by its name, and that it connects afterwards."""

import contextlib
import socket

import pytest

from tactile_resonance.contact.interfaces import ArmError, ArmFault

MUTE = "127.253.254.1"


@pytest.mark.parametrize(
    ("name", "good", "fault"),
    [
        ("remote_control", True, ArmFault.NOT_REMOTE),
        ("registers_in_use", False, ArmFault.REGISTERS_IN_USE),
        ("script_starts", True, ArmFault.PROGRAM_NOT_STARTED),
    ],
)
def test_what_the_robot_is_set_to_is_told_and_set_right_it_connects(
    robot, module_arm, name, good, fault
):
    arm = module_arm
    arm.close()
    robot.order(name, value=not good)
    with pytest.raises(ArmError) as error:
        arm.connect()
    assert error.value.fault is fault
    robot.order(name, value=good)
    arm.connect()


def test_a_program_of_other_registers_is_named(robot, module_arm, start_arm, run_calls):
    """The library waits for ever for its end; whoever stops it at the robot can connect."""
    module_arm.close()
    run_calls("leave_upper", robot.host)
    arm = start_arm(robot.host, connect_timeout_s=2.5)
    with pytest.raises(ArmError, match="another program runs there") as error:
        arm.connect()
    assert error.value.fault is ArmFault.PROGRAM_NOT_STARTED
    robot.dashboard("stop")
    robot.until(runtime_state="STOPPED")
    arm.connect()
    assert arm.state().moving_allowed
    arm.close()


def test_host_that_takes_connections_and_says_nothing(start_arm):
    with contextlib.ExitStack() as stack:
        for port in (29999, 30003, 30004):
            stack.enter_context(socket.create_server((MUTE, port)))
        with pytest.raises(ArmError, match="port 30004: timed out") as error:
            start_arm(MUTE, simulated=False).connect()
        assert error.value.fault is ArmFault.LINK_LOST


@pytest.mark.parametrize("host", ["..", "no such host"])
def test_what_no_address_can_be_is_a_lost_link(start_arm, host):
    with pytest.raises(ArmError, match="no robot answers") as error:
        start_arm(host, simulated=False).connect()
    assert error.value.fault is ArmFault.LINK_LOST


def test_nobody_there_and_not_connected(start_arm):
    arm = start_arm("127.254.254.1", simulated=False)
    with pytest.raises(ArmError) as error:
        arm.connect()
    assert error.value.fault is ArmFault.LINK_LOST
    with pytest.raises(ArmError) as error:
        arm.state()
    assert error.value.fault is ArmFault.LINK_LOST
    arm.close()
    arm.close()
