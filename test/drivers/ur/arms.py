# SPDX-License-Identifier: Apache-2.0
"""What the owner of an arm does: ask for states, wait for faults, connect again."""

import time

import numpy as np

from tactile_resonance.contact.interfaces import ArmError

DOWN = np.array([0.0, 0.0, -0.005, 0.0, 0.0, 0.0])
ACCELERATION_M_S2 = 0.5
LAG_S = 0.1  # the arm follows its target with dead time and lag


def keep(arm, condition, limit_s=10.0):
    """States while a condition holds, as the owner of a moving arm asks for them."""
    samples = []
    end = time.monotonic() + limit_s
    while condition():
        assert time.monotonic() < end, "it goes on for too long"
        samples.append(arm.state())
        time.sleep(0.004)
    return samples


def keep_for(arm, seconds):
    """States for a time of the robot's clock."""
    start = arm.state().robot_time_s
    return keep(arm, lambda: arm.state().robot_time_s < start + seconds)


def wait_for_fault(arm, limit_s=2.0):
    """Drive the arm until it raises."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        try:
            arm.speed(DOWN, ACCELERATION_M_S2)
        except ArmError as error:
            return error
        time.sleep(0.004)
    raise AssertionError(f"no fault within {limit_s} s")


def connect_again(arm, limit_s=12.0):
    """Connect as soon as the fault has ended."""
    end = time.monotonic() + limit_s
    while True:
        try:
            arm.connect()
            return
        except ArmError:
            assert time.monotonic() < end
            time.sleep(0.1)


def standing(robot):
    """Whether the robot stands after it had the time that a stop takes; its own word."""
    time.sleep(0.3)
    return np.linalg.norm(robot.order("state")["tcp_speed"]) < 1e-3
