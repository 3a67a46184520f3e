# SPDX-License-Identifier: Apache-2.0
"""UrArm on the simulated robot: motion, time stamps, and every fault by its name."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from arms import (
    ACCELERATION_M_S2,
    DOWN,
    LAG_S,
    connect_again,
    keep,
    keep_for,
    standing,
    wait_for_fault,
)

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.samples import Pose


def test_moves_in_a_straight_line_to_the_pose(high):
    start = high.state().tip
    goal = Pose(start.position_m + [0.01, 0.02, -0.02], start.rotation_rad)
    high.move(goal, 0.05, ACCELERATION_M_S2)
    assert high.moving()
    samples = keep(high, high.moving)
    keep_for(high, LAG_S)
    np.testing.assert_allclose(high.state().tip.position_m, goal.position_m, atol=5e-5)
    way = goal.position_m - start.position_m
    length = np.linalg.norm(way)
    for sample in samples:
        done = sample.tip.position_m - start.position_m
        aside = done - way * (done @ way) / length**2
        assert np.linalg.norm(aside) < 2e-5
        assert np.linalg.norm(sample.velocity[:3]) < 0.052
    took = samples[-1].robot_time_s - samples[0].robot_time_s
    # trapezoid: length / speed + speed / acceleration
    assert took == pytest.approx(length / 0.05 + 0.05 / ACCELERATION_M_S2, abs=0.15)


def test_speed_changes_and_stop(high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.2)
    samples = keep_for(high, 0.4)
    t = np.array([s.robot_time_s for s in samples])
    z = np.array([s.tip.position_m[2] for s in samples])
    assert np.polyfit(t - t[0], z, 1)[0] == pytest.approx(DOWN[2], rel=5e-3)
    high.speed(-DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    assert high.state().velocity[2] == pytest.approx(-DOWN[2], rel=0.02)
    high.stop(ACCELERATION_M_S2)
    keep_for(high, 0.1)
    assert np.linalg.norm(high.state().velocity) < 1e-4
    # a move overtaken by a speed, and a speed by a move
    goal = Pose(high.state().tip.position_m - [0, 0, 0.05], high.state().tip.rotation_rad)
    high.move(goal, 0.05, 1.0)
    keep_for(high, 0.2)
    high.speed(-DOWN, 1.0)
    keep_for(high, 0.5)
    assert high.state().velocity[2] == pytest.approx(-DOWN[2], rel=0.02)
    assert not high.moving()
    high.move(goal, 0.1, 1.0)
    keep(high, high.moving)
    keep_for(high, LAG_S)
    np.testing.assert_allclose(high.state().tip.position_m, goal.position_m, atol=5e-5)


def test_stop_of_a_move(high):
    start = high.state().tip
    high.move(Pose(start.position_m - [0, 0, 0.1], start.rotation_rad), 0.1, 1.0)
    keep_for(high, 0.3)
    high.stop(2.0)
    keep(high, high.moving)
    keep_for(high, LAG_S)
    assert np.linalg.norm(high.state().velocity[:3]) < 1e-3
    assert start.position_m[2] - 0.09 < high.state().tip.position_m[2] < start.position_m[2] - 0.005
    assert high.state().moving_allowed


def test_time_stamps_are_on_the_local_clock(arm):
    samples = keep_for(arm, 1.5)
    robot = np.array([s.robot_time_s for s in samples])
    local = np.array([s.time_ns for s in samples]) * 1e-9
    assert np.all(np.diff(robot) >= 0)
    offset = local - robot
    # both clocks are of one machine: what the offset varies by is the error of the relation
    assert np.std(offset) < 5 * arm.clock_uncertainty_s + 1e-3
    assert 0 < arm.clock_uncertainty_s < 0.01
    assert -0.005 < time.time() - local[-1] < 0.2


def test_tip_is_the_frame_of_the_configuration(robot, arm):
    told = robot.order("state")["tcp_pose"]
    np.testing.assert_allclose(arm.state().tip.position_m, told[:3], atol=5e-5)
    normal = arm.state().tip.rotation.as_matrix()[:, 2]
    np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-3)  # up, away from the table
    # the robot's own sensor: bias, noise and drift within some sigma of the data sheet
    assert np.linalg.norm(arm.state().tool_wrench[:3]) < 30


def test_wrong_figures_are_refused_and_nothing_is_sent(robot, high):
    before = high.state().tip.position_m
    tip = high.state().tip
    for call in (
        lambda: high.speed(DOWN * 100, ACCELERATION_M_S2),
        lambda: high.speed(DOWN * np.nan, ACCELERATION_M_S2),
        lambda: high.speed(DOWN[:3], ACCELERATION_M_S2),
        lambda: high.speed(DOWN, 0.0),
        lambda: high.move(tip, 5.0, ACCELERATION_M_S2),
        lambda: high.stop(-1.0),
    ):
        with pytest.raises(ValueError, match="expected|allows"):
            call()
    keep_for(high, 0.2)
    np.testing.assert_allclose(high.state().tip.position_m, before, atol=5e-5)


@pytest.mark.parametrize("seconds", [1.0, 4.0])
def test_network_freezes(robot, high, seconds):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    before = robot.order("state")
    robot.order("freeze", seconds=seconds)
    error = wait_for_fault(high)
    assert error.fault is ArmFault.STALE
    time.sleep(0.3)
    after = robot.order("state")
    assert np.linalg.norm(after["tcp_speed"]) < 1e-3, "its watchdog stops a robot without commands"
    # at most: until its watchdog of 1 / 25 s expires, and a stop; before, some states and the order
    way = before["tcp_pose"][2] - after["tcp_pose"][2]
    assert way < 0.005 * 0.2
    connect_again(high)
    assert high.state().moving_allowed
    assert robot.process.poll() is None


def test_short_freeze_is_survived(robot, module_arm, start_arm):
    module_arm.close()  # its registers are its own
    arm = start_arm(robot.host, max_state_age_s=0.5)
    arm.connect()
    robot.order("freeze", seconds=0.02)
    assert all(s.moving_allowed for s in keep_for(arm, 0.3))
    arm.speed(DOWN, ACCELERATION_M_S2)
    assert keep_for(arm, 0.1)[-1].velocity[2] < 0


def test_no_velocity_is_lost_where_packets_come_together(robot, high):
    """Held back and let through at once, a velocity and what feeds the watchdog meet in one cycle."""
    for _ in range(3):
        robot.order("freeze", seconds=0.025)
        high.speed(DOWN, ACCELERATION_M_S2)
        keep_for(high, 0.025 + LAG_S)
        assert high.state().velocity[2] == pytest.approx(DOWN[2], rel=0.1)
        robot.order("freeze", seconds=0.025)
        high.stop(ACCELERATION_M_S2)
        keep_for(high, 0.025 + LAG_S)
        assert np.abs(high.state().velocity).max() < 5e-4


def test_connection_is_dropped(robot, high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    assert robot.order("drop")["dropped"] == 2
    assert wait_for_fault(high).fault is ArmFault.LINK_LOST
    assert standing(robot)
    connect_again(high)
    keep_for(high, 0.1)


def test_protective_stop(robot, high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.order("protective_stop")
    assert wait_for_fault(high).fault is ArmFault.PROTECTIVE_STOP
    sample = high.state()
    assert not sample.moving_allowed
    assert "protective stop" in sample.message
    high.stop(1.0)  # nothing to stop, no fault
    assert standing(robot)
    with pytest.raises(ArmError) as error:
        high.connect()
    assert error.value.fault is ArmFault.PROTECTIVE_STOP
    robot.unlock()
    connect_again(high)
    high.speed(-DOWN, ACCELERATION_M_S2)
    assert keep_for(high, 0.2)[-1].velocity[2] > 0


def test_emergency_stop(robot, high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.order("emergency_stop")
    assert wait_for_fault(high).fault is ArmFault.EMERGENCY_STOP
    assert standing(robot)
    robot.order("release_emergency_stop")
    keep(high, lambda: "emergency" in high.state().message)
    with pytest.raises(ArmError, match="not running") as error:
        high.connect()
    assert error.value.fault is ArmFault.PROGRAM_STOPPED
    robot.power_up()
    connect_again(high)
    keep_for(high, 0.1)


def test_owner_that_falls_silent_is_left_to_the_watchdog(robot, high):
    high.speed(DOWN, ACCELERATION_M_S2)
    time.sleep(0.5)
    error = wait_for_fault(high)
    assert error.fault is ArmFault.PROGRAM_STOPPED
    assert standing(robot)
    assert any("watchdog" in line for line in robot.order("log")["log"][-3:])
    high.connect()
    # at rest nothing is asked of the owner
    time.sleep(0.5)
    assert high.state().moving_allowed


@pytest.mark.parametrize(
    ("number", "fault"),
    [(signal.SIGKILL, ArmFault.CLIENT_DIED), (signal.SIGABRT, ArmFault.CLIENT_DIED),
     (signal.SIGSTOP, ArmFault.STALE)],
)  # fmt: skip
def test_client_dies_or_hangs_in_the_middle_of_a_motion(robot, high, number, fault):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    client = high.client_pid
    os.kill(client, number)
    assert wait_for_fault(high).fault is fault
    assert standing(robot)
    connect_again(high)
    keep_for(high, 0.1)
    assert not alive(client)


OWNER = """
import sys, time
import numpy as np
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig
arm = UrArm(UrArmConfig(sys.argv[1], max_state_age_s=0.5))
arm.connect()
print(arm.client_pid, flush=True)
while True:
    arm.speed(np.array([0, 0, 0.002, 0, 0, 0]), 0.5)
    time.sleep(0.01)
"""


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_no_client_outlives_a_killed_owner(robot, module_arm):
    module_arm.close()
    with subprocess.Popen(
        [sys.executable, "-c", OWNER, robot.host], stdout=subprocess.PIPE, text=True
    ) as owner:
        client = int(owner.stdout.readline())
        time.sleep(0.3)
        owner.kill()
    end = time.monotonic() + 5
    while alive(client):
        assert time.monotonic() < end, "the client process goes on without its owner"
        time.sleep(0.05)
    assert standing(robot)


def test_python_of_the_page(robot, module_arm, tmp_path, capsys):
    module_arm.close()
    page = Path(__file__).resolve().parents[3] / "docs" / "robot.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    own = tmp_path / "mine.yaml"
    text = share_path("config/devices/ur5e.yaml").read_text(encoding="utf-8")
    text = text.replace("host: 127.0.1.1", f"host: {robot.host}")
    # a client without priority, on processors that others need too
    text = text.replace("watchdog_hz: 25.0", "watchdog_hz: 5.0")
    own.write_text(text.replace("max_state_age_s: 0.020", "max_state_age_s: 0.2"))
    shipped = 'share_path("config/devices/ur5e.yaml")'
    assert shipped in code
    names = {"own": own}
    try:
        exec(compile(code.replace(shipped, "own"), page.name, "exec"), names)
    finally:
        if "arm" in names:
            names[
                "arm"
            ].close()  # a client left behind would hold the registers of every later robot
    moved_mm = float(re.search(r"moved ([\d.]+) mm", capsys.readouterr().out)[1])
    assert 2 < moved_mm < 10  # 0.5 s and a little more at 5 mm/s, more where this machine is busy
