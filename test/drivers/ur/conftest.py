# SPDX-License-Identifier: Apache-2.0
"""Simulated robots as processes of their own, each on an address of its own."""

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.simulation.plant_process import TIP_IN_FLANGE
from tactile_resonance.simulation.robot.control_port import order

# Of the three numbers after 127 two say which test run, the last which robot of it.
RUN = f"127.{1 + os.getpid() % 250}.{1 + os.getpid() // 250 % 250}"


def may_take_priority():
    """Whether this process may run under SCHED_FIFO: then the simulation keeps its pace on busy cores."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except (AttributeError, OSError):
        return False
    return True


PRIORITY = 2 if may_take_priority() else 0


def need_ur_rtde():
    pytest.importorskip("rtde_control", reason="ur_rtde is not here (no wheel for Python 3.13)")


class Robot:
    """A simulated robot's process and its control port."""

    def __init__(self, host, *options):
        self.host = host
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "tactile_resonance.cli", "simulate-ur", "--host", host),
                *("--priority", str(PRIORITY), *options),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def wait(self):
        ready, _, _ = select.select([self.process.stdout], [], [], 30)
        assert ready, "the simulated robot says nothing for 30 s"
        line = self.process.stdout.readline()
        assert "ready at" in line, line

    def order(self, command, **fields):
        return order(self.host, command, **fields)

    def end(self):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        output, _ = self.process.communicate(timeout=10)
        return output


@pytest.fixture
def start_robots():
    """Start robots with the same options; all are ended after the test."""
    robots = []

    def start(*options, count=1):
        new = [Robot(f"{RUN}.{len(robots) + k + 1}", *options) for k in range(count)]
        robots.extend(new)
        for robot in new:
            robot.wait()
        return new

    yield start
    for robot in robots:
        robot.end()


@pytest.fixture(scope="module")
def robot():
    """One robot for the tests of a module."""
    robot = Robot(f"{RUN}.200", "--tissue", "gel12")
    try:
        robot.wait()
        yield robot
    finally:
        robot.end()


@pytest.fixture
def start_arm():
    """Make an arm; all are closed after the test."""
    need_ur_rtde()
    arms = []

    def start(host, **fields):
        given = {"max_state_age_s": 0.1, "realtime_priority": max(0, PRIORITY - 1), **fields}
        arms.append(UrArm(UrArmConfig(host, TIP_IN_FLANGE, **given)))
        return arms[-1]

    yield start
    for arm in arms:
        arm.close()


@pytest.fixture
def run_calls():
    """Run a function of client_calls.py in a process of its own: the library may abort it."""
    need_ur_rtde()
    script = Path(__file__).with_name("client_calls.py")

    def run(name, *hosts):
        done = subprocess.run(
            [sys.executable, script, name, *hosts],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, f"status {done.returncode}\n{done.stdout}\n{done.stderr}"

    return run
