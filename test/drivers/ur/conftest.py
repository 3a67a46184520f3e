# SPDX-License-Identifier: Apache-2.0
"""Simulated robots as processes of their own, each on an address of its own, and arms that a test leads."""

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from robot_at_hand import RobotAtHand

from tactile_resonance.clock import PORT
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.processes import end_with_parent
from tactile_resonance.simulation.plant.tabletop import TIP_IN_FLANGE

sys.path.insert(0, str(Path(__file__).parent))
from arms import ACCELERATION_M_S2, LAG_S, UP, connect_again, follow, keep, keep_for

# Of the three numbers after 127 two say which test run, the last which robot of it.
RUN = f"127.{1 + os.getpid() % 250}.{1 + os.getpid() // 250 % 250}"
SIMULATED = ("--simulated-time", "--tissue", "gel12")


def need_ur_rtde():
    pytest.importorskip("rtde_control", reason="ur_rtde is not here (no wheel for Python 3.13)")


class Robot(RobotAtHand):
    """A simulated robot's process and its control port."""

    def __init__(self, host, *options):
        super().__init__(host)
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "tactile_resonance.cli", "simulate-ur", "--host", host),
                *options,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )

    def wait(self):
        ready, _, _ = select.select([self.process.stdout], [], [], 60)
        assert ready, "the simulated robot says nothing for 60 s"
        line = self.process.stdout.readline()
        assert "ready at" in line, line

    def end(self):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        output, _ = self.process.communicate(timeout=60)
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


@pytest.fixture
def robot(module_robot):
    """A robot in simulated time without faults, shared by the tests of a module."""
    module_robot.recover()
    return module_robot


@pytest.fixture(scope="module")
def module_robot():
    """One robot for the tests of a module."""
    robot = Robot(f"{RUN}.200", *SIMULATED)
    try:
        robot.wait()
        yield robot
    finally:
        robot.end()


def config(host, **fields):
    return UrArmConfig(host, TIP_IN_FLANGE, **fields)


@pytest.fixture(scope="module")
def module_arm(module_robot):
    """One arm for the tests of a module, not yet connected."""
    need_ur_rtde()
    arm = UrArm(config(module_robot.host), f"{module_robot.host}:{PORT}")
    yield arm
    arm.close()


@pytest.fixture
def arm(robot, module_arm):
    """A connected arm that the test leads; connecting one that is healthy does nothing."""
    connect_again(module_arm)
    yield module_arm
    follow(module_arm)


@pytest.fixture
def high(arm):
    """The arm well above the tissue, wherever an earlier test left it."""
    if arm.state().position_m[2] < 0.3:
        arm.speed(40 * UP, ACCELERATION_M_S2)
        keep(arm, lambda: arm.state().position_m[2] < 0.35)
    arm.stop(ACCELERATION_M_S2)
    keep_for(arm, 0.4 + LAG_S)
    return arm


@pytest.fixture
def start_arm():
    """Make an arm, in simulated time where that is not denied; all are closed after the test."""
    need_ur_rtde()
    arms = []

    def start(host, simulated=True, **fields):
        arms.append(UrArm(config(host, **fields), f"{host}:{PORT}" if simulated else ""))
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
            timeout=240,
            check=False,
        )
        assert done.returncode == 0, f"status {done.returncode}\n{done.stdout}\n{done.stderr}"

    return run
