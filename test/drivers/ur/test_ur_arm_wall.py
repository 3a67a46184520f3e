# SPDX-License-Identifier: Apache-2.0
"""UrArm on the wall clock: limits that are in this machine's time, of ur_rtde and of the arm's client.

In simulated time these cannot be met: what is silent, or hangs, stops the time.
"""

import contextlib
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from arms import DOWN, PATIENCE_S

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.processes import may_take_priority, take_priority

ACCELERATION_M_S2 = 0.5


@pytest.fixture
def moving(start_robots, start_arm):
    """A robot on the wall clock and an arm that moves down on it, as patient as a configuration can be."""
    (robot,) = start_robots()
    arm = start_arm(
        robot.host,
        simulated=False,
        max_state_age_s=1.0,
        owner_timeout_s=1.0,
        watchdog_hz=5.0,
        connect_timeout_s=60.0,
    )
    arm.connect()
    arm.speed(DOWN, ACCELERATION_M_S2)
    drive(arm, lambda: arm.state().velocity[2] < 0.9 * DOWN[2])
    return robot, arm


def drive(arm, condition):
    """Look at the arm as its owner does, until a condition holds."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.004)


def fault_of(arm):
    """Drive the arm until it raises another fault than that states are old."""
    found = []

    def raises():
        try:
            arm.speed(DOWN, ACCELERATION_M_S2)
        except ArmError as error:
            found.append(error.fault)
        return found and found[-1] is not ArmFault.STALE

    drive(arm, raises)
    return found[-1]


def stands(robot):
    return np.linalg.norm(robot.order("state")["tcp_speed"]) < 1e-3


def connect_again(robot, arm):
    """As soon as the fault has ended, and look at the arm for a while."""

    def connected():
        try:
            arm.connect()
        except ArmError:
            return False
        return True

    drive(arm, connected)
    start_s = robot.order("state")["time_s"]
    drive(arm, lambda: arm.state().robot_time_s > start_s + 0.2)
    assert arm.state().moving_allowed


def test_states_are_dated_on_this_machines_monotonic_clock(moving):
    _, arm = moving
    for _ in range(20):
        before_ns = time.monotonic_ns()
        stamp_ns = arm.state().time_ns
        assert before_ns - arm.config.max_state_age_s * 1e9 <= stamp_ns
        assert stamp_ns <= time.monotonic_ns() + 5e9 * arm.clock_uncertainty_s
        time.sleep(0.01)
    assert 0 < arm.clock_uncertainty_s < 0.1


def test_network_is_frozen_for_longer_than_the_library_bears(moving):
    """ur_rtde gives up after 2.5 s without data and may end its process: the robot has stopped before."""
    robot, arm = moving
    robot.order("freeze", seconds=4.0)
    assert fault_of(arm) is ArmFault.LINK_LOST
    drive(arm, lambda: stands(robot))
    connect_again(robot, arm)
    assert robot.process.poll() is None


def test_owner_that_falls_silent_is_left_to_the_watchdog(moving):
    """The client feeds the watchdog for `owner_timeout_s` of this machine's time."""
    robot, arm = moving
    client = arm.client.pid
    drive(arm, lambda: stands(robot))  # looks at the robot, not at the arm
    assert any("watchdog" in line for line in robot.order("log")["log"][-3:])
    with pytest.raises(ArmError) as error:
        arm.speed(DOWN, ACCELERATION_M_S2)
    assert error.value.fault is ArmFault.PROGRAM_STOPPED
    arm.connect()
    assert arm.client.pid == client
    # at rest nothing is asked of the owner
    time.sleep(arm.config.owner_timeout_s + 3 / arm.config.watchdog_hz)
    drive(arm, lambda: arm.state().moving_allowed)


def test_client_that_hangs_is_left_to_the_watchdog(moving):
    robot, arm = moving
    client = arm.client.pid
    os.kill(client, signal.SIGSTOP)
    assert fault_of(arm) in (ArmFault.PROGRAM_STOPPED, ArmFault.COMMAND_REFUSED)
    drive(arm, lambda: stands(robot))
    assert any("watchdog" in line for line in robot.order("log")["log"][-3:])
    arm.client._connect_timeout_s = 1.0  # it does not answer, however long that is
    with pytest.raises(ArmError):
        arm.connect()
    connect_again(robot, arm)
    assert arm.client.pid != client


@pytest.mark.skipif(not may_take_priority(20), reason="real-time priority is not permitted")
def test_of_a_client_with_priority_the_thread_of_the_library_alone_has_none(moving, start_arm):
    robot, arm = moving
    arm.close()
    arm = start_arm(robot.host, simulated=False, realtime_priority=20, max_state_age_s=1.0)
    try:
        take_priority(20)  # as a node that starts a client has it
        connect_again(robot, arm)
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    first, *others = sorted(map(int, os.listdir(f"/proc/{arm.client.pid}/task")))
    assert first == arm.client.pid
    assert os.sched_getscheduler(first) == os.SCHED_FIFO
    assert [os.sched_getscheduler(thread) for thread in others] == [os.SCHED_OTHER]
    from tactile_resonance.drivers.ur_session import SLACK_NS  # ur_rtde is here

    with contextlib.suppress(PermissionError):
        (slack_ns,) = [int(Path(f"/proc/{one}/timerslack_ns").read_text()) for one in others]
        assert slack_ns == SLACK_NS
