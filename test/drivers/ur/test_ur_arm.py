# SPDX-License-Identifier: Apache-2.0
"""UrArm on the simulated robot, in simulated time: motion, and every fault by its name and at its time."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from arms import (
    ACCELERATION_M_S2,
    DOWN,
    LAG_S,
    PATIENCE_S,
    connect_again,
    keep,
    keep_for,
    left_alone,
    pass_time,
    standing,
    tick,
    wait_for_fault,
)

from tactile_resonance.clock import PORT, SimulatedClock
from tactile_resonance.configuration import share_path
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers import ur_arm

WATCHDOG_S = 1 / 25


def test_speed_changes_and_stop(high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.2)
    samples = keep_for(high, 0.4)
    t = np.array([s.robot_time_s for s in samples])
    z = np.array([s.position_m[2] for s in samples])
    assert np.polyfit(t - t[0], z, 1)[0] == pytest.approx(DOWN[2], rel=5e-3)
    high.speed(-DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    assert high.state().velocity[2] == pytest.approx(-DOWN[2], rel=0.02)
    high.stop(ACCELERATION_M_S2)
    keep_for(high, 0.1)
    assert np.linalg.norm(high.state().velocity) < 1e-4
    assert high.state().moving_allowed


def test_tip_is_the_frame_of_the_configuration(robot, arm):
    tick(arm)
    sample, told = arm.state(), robot.order("state")["tcp_pose"]
    assert (*sample.position_m, *sample.rotation_rad) == tuple(told)
    normal = sample.tip.rotation.as_matrix()[:, 2]
    np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-3)  # up, away from the table
    # the robot's own sensor: bias, noise and drift within some sigma of the data sheet
    assert np.linalg.norm(sample.tool_wrench[:3]) < 30


def test_wrong_figures_are_refused_and_nothing_is_sent(high):
    before = high.state().position_m
    for call in (
        lambda: high.speed(DOWN * 100, ACCELERATION_M_S2),
        lambda: high.speed(DOWN * np.nan, ACCELERATION_M_S2),
        lambda: high.speed(DOWN[:3], ACCELERATION_M_S2),
        lambda: high.speed(DOWN, 0.0),
        lambda: high.stop(-1.0),
    ):
        with pytest.raises(ValueError, match="expected|allows"):
            call()
    keep_for(high, 0.2)
    np.testing.assert_allclose(high.state().position_m, before, atol=5e-5)


@pytest.mark.parametrize("seconds", [1.0, 4.0])
def test_network_freezes(robot, high, seconds):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    before = robot.order("state")
    robot.order("freeze", seconds=seconds)
    error, after_s = wait_for_fault(high)
    assert error.fault is ArmFault.STALE
    assert after_s == pytest.approx(high.config.max_state_age_s, abs=0.005)
    assert standing(high, robot), "its watchdog stops a robot without commands"
    # until its watchdog expires, and a stop
    way = before["tcp_pose"][2] - robot.order("state")["tcp_pose"][2]
    assert 0.0 < way < 0.005 * (WATCHDOG_S + LAG_S / 2)
    pass_time(high, seconds)
    connect_again(high)
    assert high.state().moving_allowed
    assert robot.process.poll() is None


def test_link_is_given_up_where_the_network_stays_frozen(robot, high):
    robot.order("freeze", seconds=2.0)
    begun_ns = high.clock.now_ns()
    fault = ArmFault.STALE
    while fault is ArmFault.STALE:
        tick(high)
        try:
            high.state()
        except ArmError as error:
            fault = error.fault
        after_s = (high.clock.now_ns() - begun_ns) * 1e-9
    assert fault is ArmFault.LINK_LOST
    assert after_s == pytest.approx(ur_arm.GIVE_UP_S, abs=0.01)
    assert high.client is None


def test_short_freeze_is_survived(robot, high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.order("freeze", seconds=0.014)
    samples = keep_for(high, 0.1)
    assert all(sample.moving_allowed for sample in samples)
    # states of the freeze are missing, later ones are not
    ages_s = np.diff([sample.robot_time_s for sample in samples])
    assert ages_s.max() == pytest.approx(0.014, abs=0.003)
    assert samples[-1].velocity[2] == pytest.approx(DOWN[2], rel=0.02)


def test_no_velocity_is_lost_where_packets_come_together(robot, arm, start_arm):
    """Held back and let through at once, a velocity and what feeds the watchdog meet in one cycle."""
    arm.close()  # its registers are its own
    arm = start_arm(robot.host, max_state_age_s=0.1)
    connect_again(arm)
    for sign in (1, -1, 1):
        robot.order("freeze", seconds=0.025)
        arm.speed(-sign * DOWN, ACCELERATION_M_S2)
        keep_for(arm, 0.025 + LAG_S)
        assert arm.state().velocity[2] == pytest.approx(-sign * DOWN[2], rel=0.1)
        robot.order("freeze", seconds=0.025)
        arm.stop(ACCELERATION_M_S2)
        keep_for(arm, 0.025 + LAG_S)
        assert np.abs(arm.state().velocity).max() < 5e-4


def test_connection_is_dropped(robot, high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    assert robot.order("drop")["dropped"] == 2
    error, after_s = wait_for_fault(high)
    assert error.fault is ArmFault.LINK_LOST
    assert after_s <= 0.004
    assert standing(high, robot)
    connect_again(high)
    keep_for(high, 0.1)


def test_protective_stop(robot, high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.order("protective_stop")
    error, after_s = wait_for_fault(high)
    assert error.fault is ArmFault.PROTECTIVE_STOP
    assert after_s <= 0.004
    sample = high.state()
    assert not sample.moving_allowed
    assert "protective stop" in sample.message
    high.stop(1.0)  # nothing to stop, no fault
    assert standing(high, robot)
    with pytest.raises(ArmError) as error:
        high.connect()
    assert error.value.fault is ArmFault.PROTECTIVE_STOP
    with left_alone(high, robot):
        robot.unlock()
    connect_again(high)
    high.speed(-DOWN, ACCELERATION_M_S2)
    assert keep_for(high, 0.2)[-1].velocity[2] > 0


def test_emergency_stop(robot, high):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    robot.order("emergency_stop")
    error, after_s = wait_for_fault(high)
    assert error.fault is ArmFault.EMERGENCY_STOP
    assert after_s <= 0.004
    assert standing(high, robot)
    robot.order("release_emergency_stop")
    keep(high, lambda: "emergency" in high.state().message)
    with pytest.raises(ArmError, match="not running") as error:
        high.connect()
    assert error.value.fault is ArmFault.PROGRAM_STOPPED
    with left_alone(high, robot):
        robot.power_up()
    connect_again(high)
    keep_for(high, 0.1)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGABRT])
def test_client_dies_in_the_middle_of_a_motion(robot, high, number):
    high.speed(DOWN, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    client = high.client.pid
    os.kill(client, number)
    error, _ = wait_for_fault(high)
    assert error.fault is ArmFault.CLIENT_DIED
    assert standing(high, robot)
    assert any("watchdog" in line for line in robot.order("log")["log"][-3:])
    connect_again(high)
    keep_for(high, 0.1)
    assert not alive(client)


OWNER = """
import sys, time
import numpy as np
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig
arm = UrArm(UrArmConfig(sys.argv[1], max_state_age_s=1.0), sys.argv[1] + ":30021")
arm.connect()
print(arm.client.pid, flush=True)
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
        until(lambda: abs(robot.order("state")["tcp_speed"][2]) > 1e-3, "the arm does not move")
        owner.kill()
    until(lambda: not alive(client), "the client process goes on without its owner")
    until(lambda: np.linalg.norm(robot.order("state")["tcp_speed"]) < 1e-3, "the arm moves on")


def until(condition, otherwise="never"):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, otherwise
        time.sleep(0.01)


def test_python_of_the_page(robot, module_arm, tmp_path, capsys, monkeypatch):
    """It moves as far as the page says; its sleeps and its arm are in simulated time."""
    module_arm.close()
    # its program ends in the robot's time, which is this test's from here on
    until(lambda: robot.order("state")["runtime_state"] == "STOPPED", "the program goes on")
    page = Path(__file__).resolve().parents[3] / "docs" / "robot.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    own = tmp_path / "mine.yaml"
    text = share_path("config/devices/ur5e.yaml").read_text(encoding="utf-8")
    own.write_text(text.replace("host: 127.0.1.1", f"host: {robot.host}"))
    shipped = 'share_path("config/devices/ur5e.yaml")'
    assert shipped in code
    clock = SimulatedClock(f"{robot.host}:{PORT}", "page")

    slept_ns = [0]

    def sleep(seconds):
        slept_ns[0] += round(seconds * 1e9)
        clock.wait_until(slept_ns[0])
        time_s = robot.order("state")["time_s"]
        until(lambda: names["arm"].receive() or names["arm"]._states.newest.robot_time_s == time_s)

    here = SimpleNamespace(sleep=sleep)
    names, whole = {"own": own}, ur_arm.UrArm
    monkeypatch.setattr(ur_arm, "UrArm", lambda config: whole(config, f"{robot.host}:{PORT}"))
    before, after = code.replace(shipped, "own").split("arm.connect()\n")
    try:
        exec(compile(before + "arm.connect()\n", page.name, "exec"), names)
        slept_ns[0] = clock.ask_ns()
        sleep(0.1)  # from here on time stands but for the page's sleeps
        names["time"] = here
        exec(compile(after, page.name, "exec"), names)
    finally:
        clock.close()
        if "arm" in names:
            names["arm"].close()  # it would hold the registers of every later robot
    moved_mm = float(re.search(r"moved ([\d.]+) mm", capsys.readouterr().out)[1])
    # 0.5 s at 5 mm/s; what the arm starts late by it stops late by
    assert moved_mm == pytest.approx(2.5, abs=0.1)
