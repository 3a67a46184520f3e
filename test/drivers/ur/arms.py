# SPDX-License-Identifier: Apache-2.0
"""What the owner of an arm does in simulated time: lead it, ask for states, wait for faults, connect again."""

import contextlib
import time

import numpy as np

from tactile_resonance.clock import PORT, Demand, SimulatedClock
from tactile_resonance.contact.interfaces import ArmError
from tactile_resonance.simulation.ur5e.target import CYCLE_S

DOWN = np.array([0.0, 0.0, -0.005, 0.0, 0.0, 0.0])
UP = -DOWN
ACCELERATION_M_S2 = 0.5
LAG_S = 0.1  # the arm follows its target with dead time and lag
CYCLE_NS = round(CYCLE_S * 1e9)
PATIENCE_S = 60.0


def tick(arm, cycles=1):
    """Let time go on by cycles of the robot, and wait for the state at its end."""
    arm.led.wait_until(arm.clock.now_ns() + cycles * CYCLE_NS, Demand.FAST)


def keep(arm, condition, limit_s=10.0):
    """States while a condition holds, as the owner of a moving arm asks for them."""
    samples = []
    end_ns = arm.clock.now_ns() + round(limit_s * 1e9)
    while condition():
        assert arm.clock.now_ns() < end_ns, "it goes on for too long"
        tick(arm)
        samples.append(arm.state())
    return samples


def keep_for(arm, seconds):
    """States of so much time."""
    end_ns = arm.clock.now_ns() + round(seconds * 1e9)
    return keep(arm, lambda: arm.clock.now_ns() < end_ns, seconds + 1.0)


def wait_for_fault(arm, limit_s=2.0):
    """Drive the arm until it raises; the error, and after how much time that was led [s].

    Time that passes once the link is lost is not led by anybody: it goes on at the pace of the machine.
    """
    for cycle in range(round(limit_s / CYCLE_S)):
        try:
            arm.speed(DOWN, ACCELERATION_M_S2)
        except ArmError as error:
            return error, cycle * CYCLE_S
        tick(arm)
    raise AssertionError(f"no fault within {limit_s} s")


def pass_time(arm, seconds):
    """Let time go on whatever becomes of the arm; its owner gives signs of life."""
    end_ns = arm.clock.now_ns() + round(seconds * 1e9)
    while arm.clock.now_ns() < end_ns:
        with contextlib.suppress(ArmError):
            arm.state()
        tick(arm)


def nothing():
    """While time stands."""


def lead(arm):
    """Let time go on only as this arm's owner says."""
    arm.led_clock(None, nothing)


def follow(arm):
    """Let it go on without."""
    if arm.led is not None:
        arm.led.close()


def connect_again(arm, attempts=3):
    """Connect as soon as the fault has ended, and lead."""
    for left in range(attempts, 0, -1):
        try:
            arm.connect()
            break
        except ArmError:
            if left == 1:
                raise
            if arm.led is not None:
                pass_time(arm, 0.1)  # while time stands the newest state shows what was before
            else:
                time.sleep(0.5)
    if arm.led is None:
        lead(arm)
    tick(arm)  # it is later than when time was told last


@contextlib.contextmanager
def left_alone(arm, robot):
    """Meanwhile time goes on by itself, and fast: for what is done at the robot."""
    follow(arm)
    with contextlib.closing(SimulatedClock(f"{robot.host}:{PORT}", "test")) as clock:
        clock.free(Demand.FAST)
        yield
    if arm.client is not None:
        lead(arm)


def standing(arm, robot):
    """Whether the robot stands after it had the time that a stop takes; its own word."""
    pass_time(arm, 0.3)
    return np.linalg.norm(robot.order("state")["tcp_speed"]) < 1e-3


class LateSocket:
    """A socket whose data can be read only some time after they have come."""

    def __init__(self, channel, late_s):
        self._channel, self._late_s = channel, late_s
        self._come = []

    def __getattr__(self, name):
        return getattr(self._channel, name)

    def recv(self, size):
        with contextlib.suppress(BlockingIOError):
            self._come.append((time.monotonic() + self._late_s, self._channel.recv(1 << 16)))
        if not self._come or self._come[0][0] > time.monotonic():
            raise BlockingIOError
        due_s, data = self._come.pop(0)
        if len(data) > size:
            self._come.insert(0, (due_s, data[size:]))
        return data[:size]
