# SPDX-License-Identifier: Apache-2.0
"""Calls of the unmodified ur_rtde on simulated robots, as a program: NAME HOST...

Poses and speeds are asserted on the robot's own time stamps.
"""

import os
import sys

import dashboard_client
import numpy as np
import rtde_control
import rtde_io
from clients import Clients, near, same_pose, slope

from tactile_resonance.simulation.plant.defaults import order

FLAGS = rtde_control.RTDEControlInterface
UPLOAD = FLAGS.FLAG_UPLOAD_SCRIPT
KEPT = []  # until the process ends
FREE_ROOM = np.array([0.0, 0.0, -0.05, 0, 0, 0])


def connect(host):
    clients = Clients(host)
    assert clients.control.isConnected()
    assert clients.control.isProgramRunning()
    assert clients.receive.isConnected()
    assert clients.receive.getRobotMode() == 7
    assert clients.receive.getSafetyMode() == 1
    near(np.linalg.norm(clients.receive.getActualToolAccelerometer()), 9.80665, 1e-9)
    with clients.passing():
        io = rtde_io.RTDEIOInterface(host)
    assert io.setStandardDigitalOut(3, True)
    assert io.setToolDigitalOut(1, True)
    assert io.setConfigurableDigitalOut(2, True)
    assert io.setAnalogOutputCurrent(0, 0.5)
    assert io.setInputIntRegister(18, 42)
    assert io.setInputDoubleRegister(19, 1.5)
    assert io.setAnalogOutputVoltage(1, 0.25)
    assert io.setSpeedSlider(0.5)
    clients.wait(0.05)
    bits = clients.receive.getActualDigitalOutputBits()
    assert bits == 1 << 3 | 1 << 10 | 1 << 17, hex(bits)
    near(clients.receive.getStandardAnalogOutput0(), 0.5, 1e-9)
    near(clients.receive.getStandardAnalogOutput1(), 0.25, 1e-9)
    near(clients.receive.getTargetSpeedFraction(), 0.5, 1e-9)
    assert io.setSpeedSlider(1.0)
    dashboard = dashboard_client.DashboardClient(host)
    dashboard.connect()
    assert dashboard.isConnected()
    assert dashboard.isInRemoteControl()
    assert dashboard.running()
    assert dashboard.robotmode() == "Robotmode: RUNNING"
    assert dashboard.safetystatus() == "Safetystatus: NORMAL"
    assert dashboard.getSerialNumber().isdigit()
    assert dashboard.polyscopeVersion().count(".") == 3
    dashboard.popup("a message")
    dashboard.closePopup()
    dashboard.stop()
    assert not dashboard.running()
    assert clients.control.reuploadScript()
    clients.wait(0.05)
    assert clients.control.isProgramRunning()


def leave_upper(host):
    """Leave a program behind that reads the upper registers."""
    flags = FLAGS.FLAG_UPPER_RANGE_REGISTERS | UPLOAD
    KEPT.append(rtde_control.RTDEControlInterface(host, -1.0, flags))


def flags(host):
    for flag in (FLAGS.FLAG_NO_EXT_FT, FLAGS.FLAG_UPPER_RANGE_REGISTERS):
        c = Clients(host, control=False)
        with c.passing():
            control = c.wrap(rtde_control.RTDEControlInterface(host, -1.0, flag | UPLOAD))
        above = c.pose() + [0, 0, 0.002, 0, 0, 0]
        assert control.moveL(above.tolist(), 0.1, 1.0)
        c.wait(0.1)
        same_pose(c.pose(), above, 1e-4)
        tip = [0.0, 0.01, 0.1, 0.0, 0.0, 0.0]  # its answer comes by the registers of that range too
        assert control.setTcp(tip)
        near(control.getTCPOffset(), tip, 1e-9)
        control.stopScript()
        control.disconnect()
        c.clock.close()


def refused(host):
    """What the model does not know is told in its log, and the arm stands still."""
    for call, number in (
        (lambda c: c.control.teachMode(), 18),
        (lambda c: c.control.moveL([[*c.pose(), 0.1, 0.5, 0.0]]), 45),
        (lambda c: c.control.directTorque([0.0] * 6), 66),
    ):
        c = Clients(host)
        before = c.pose()
        call(c)
        c.wait(0.1)
        assert not c.control.isProgramRunning()
        assert f"command {number}: not modelled" in order(host, "log")["log"][-1]
        same_pose(c.pose(), before, 1e-4)
        c.control.disconnect()
        c.receive.disconnect()
        c.clock.close()


def moves(host):
    c = Clients(host)
    control = c.control
    start_q, start = c.q(), c.pose()
    goal = start + FREE_ROOM
    assert control.moveL(goal.tolist(), 0.1, 0.5)
    c.wait(0.1)
    same_pose(c.pose(), goal, 5e-5)
    assert control.moveJ(start_q.tolist(), 0.5, 1.0)
    c.wait(0.1)
    near(c.q(), start_q, 5e-5)
    # asynchronous: a straight line, never faster than asked for
    before = c.receive.getTimestamp()
    assert control.moveL(goal.tolist(), 0.1, 0.5, True)
    times, poses = c.track(1.0)
    assert times[0] - before < 0.1
    near(poses[:, :2], start[:2], 5e-5)
    near(poses[-1, :3], goal[:3], 5e-5)
    fastest = -np.diff(poses[::10, 2]) / np.diff(times[::10])
    assert 0.09 < fastest.max() < 0.102, fastest.max()
    assert control.getAsyncOperationProgress() < 0
    # stopped on the way
    assert control.moveJ(start_q.tolist(), 0.2, 1.0, True)
    c.wait(0.2)
    control.stopJ(5.0)
    c.wait(0.3)
    rest = c.pose()
    assert goal[2] + 1e-4 < rest[2] < start[2] - 1e-3
    assert control.moveL(start.tolist(), 0.1, 0.5, True)
    c.wait(0.1)
    control.stopL(5.0, True)
    c.wait(0.3)
    assert rest[2] < c.pose()[2] < start[2] - 1e-3
    near(c.receive.getActualTCPSpeed(), np.zeros(6), 0.01)


def streams(host):
    c = Clients(host)
    control, start = c.control, c.pose()
    wanted = np.array([0.01, -0.005, -0.02, 0, 0, 0])
    assert control.speedL(wanted.tolist(), 0.5, 0.002)
    c.wait(0.2)
    times, poses = c.track(0.5)
    near(slope(times, poses)[:3], wanted[:3], 2e-5)
    assert control.speedStop(2.0)
    c.wait(0.2)
    still = c.pose()
    c.wait(0.2)
    near(c.pose()[:3], still[:3], 5e-5)
    qd = np.array([0.0, 0, 0, 0, 0, 0.2])
    q = c.q()
    began = c.receive.getTimestamp()
    assert control.speedJ(qd.tolist(), 2.0, 0.002)
    c.wait(0.3)
    assert control.speedStop(5.0)
    took = c.receive.getTimestamp() - began
    c.wait(0.2)
    assert 0.1 * 0.2 < c.q()[5] - q[5] < 0.2 * (took + 0.1)
    near(c.q()[:5], q[:5], 1e-4)
    # servo: to a pose and to joint angles nearby
    goal = c.pose() + [0, 0, 0.004, 0, 0, 0]
    for _ in range(60):
        assert control.servoL(goal.tolist(), 0, 0, 0.002, 0.05, 300)
        c.wait(0.01)
    same_pose(c.pose(), goal, 2e-4)
    assert control.servoStop(5.0)
    goal_q = c.q() + [0, 0, 0, 0, 0, 0.01]
    for _ in range(60):
        assert control.servoJ(goal_q.tolist(), 0, 0, 0.002, 0.05, 300)
        c.wait(0.01)
    near(c.q(), goal_q, 5e-4)
    assert control.servoStop(5.0)
    assert np.linalg.norm(c.pose()[:3] - start[:3]) < 0.1


def settings(host):
    c = Clients(host)
    control = c.control
    flange, q = c.pose(), c.q()
    tip = [0.01, 0.02, 0.12, 0.0, np.pi, 0.0]
    assert control.setTcp(tip)
    near(control.getTCPOffset(), tip, 1e-9)
    c.wait(0.05)
    same_pose(c.pose(), control.poseTrans(flange.tolist(), tip), 5e-5)
    same_pose(control.getForwardKinematics(q.tolist(), tip), c.pose(), 5e-5)
    solved = control.getInverseKinematics(c.receive.getTargetTCPPose(), q.tolist())
    near(solved, q, 1e-4)
    assert control.setPayload(0.6, [0.0, 0.0, 0.05])
    c.wait(0.05)
    near(c.receive.getPayload(), 0.6, 1e-12)
    near(c.receive.getPayloadCog(), [0, 0, 0.05], 1e-12)
    assert control.isPoseWithinSafetyLimits(c.pose().tolist())
    assert not control.isPoseWithinSafetyLimits([5.0, 0, 0, 0, 0, 0])
    assert control.isJointsWithinSafetyLimits(q.tolist())
    assert not control.isJointsWithinSafetyLimits([7.0, 0, 0, 0, 0, 0])
    c.wait(0.6)
    assert control.isSteady()
    control.getStepTime()
    c.wait(0.02)
    near(control.getStepTime(), 0.002, 1e-12)  # the first call returns what was there before


def force(host):
    """Needs a rigid tip over tissue at 0.2 m."""
    c = Clients(host)
    control = c.control
    assert control.setTcp([0.0, 0.0, 0.12, 0.0, np.pi, 0.0])
    c.wait(0.05)
    above = c.pose()
    above[2] = 0.21
    assert control.moveL(above.tolist(), 0.25, 1.0)
    assert control.setPayload(0.0, [0.0, 0.0, 0.0])
    assert control.zeroFtSensor()
    zeroed = []
    for _ in range(50):
        c.wait(0.004)
        zeroed.append(c.receive.getActualTCPForce()[:3])
    # what is left is the reading that was taken for zero, and a slow drift: precision 3.5 N is 2 sigma
    near(np.mean(zeroed, axis=0), np.zeros(3), 5.5)
    assert order(host, "truth")["in_contact"] is False
    assert control.moveUntilContact([0, 0, -0.05, 0, 0, 0])
    at_contact = c.pose()
    c.wait(0.1)
    # back where the tissue was first felt, well below the surface, far above where it would end
    assert 0.1 < at_contact[2] < 0.2025, at_contact
    assert control.moveL(above.tolist(), 0.25, 1.0)
    assert control.zeroFtSensor()
    base = [0.0] * 6
    for _ in range(250):
        assert control.forceMode(
            base, [0, 0, 1, 0, 0, 0], [0, 0, -10.0, 0, 0, 0], 2, [0.1, 0.1, 0.1, 0.2, 0.2, 0.2]
        )
        c.wait(0.01)
    pushed = order(host, "truth")["force_n"]
    assert 3 < pushed[2] < 17, pushed  # the sensor's accuracy is that coarse
    assert control.forceModeStop()


def watchdog(host):
    """Kicked every 40 ms, it lets the arm go on; at 10 Hz it waits for 0.1 s."""
    c = Clients(host)
    assert c.control.setWatchdog(10.0)
    assert c.control.speedL([0, 0, -0.01, 0, 0, 0], 0.5, 0.002)
    for _ in range(10):
        assert c.control.kickWatchdog()
        c.wait(0.04)
    assert c.receive.getRuntimeState() == 2
    alive = c.pose()
    c.wait(0.5)
    assert c.receive.getRuntimeState() == 1
    assert alive[2] - c.pose()[2] < 0.01 * (0.1 + 0.03)  # and stopped within a few cycles more
    assert not c.control.speedL([0, 0, -0.01, 0, 0, 0], 0.5, 0.002)


def stops(host):
    c = Clients(host)
    assert c.control.speedL([0, 0, -0.02, 0, 0, 0], 0.5, 0.002)
    c.wait(0.2)
    assert c.control.triggerProtectiveStop() in (
        True,
        False,
    )  # the stop may end it before its answer
    c.wait(0.3)
    assert c.receive.isProtectiveStopped()
    near(c.receive.getActualTCPSpeed()[:3], np.zeros(3), 5e-3)
    assert not c.control.moveL(c.pose().tolist(), 0.1, 0.5)
    dashboard = dashboard_client.DashboardClient(host)
    dashboard.connect()
    try:
        dashboard.unlockProtectiveStop()
        raise SystemExit("unlocked within 5 s of the stop")
    except ValueError:
        pass
    except RuntimeError:
        pass
    c.wait(5.0)
    dashboard.unlockProtectiveStop()
    assert c.control.reuploadScript()
    c.wait(0.1)
    assert c.control.moveL((c.pose() + [0, 0, 0.005, 0, 0, 0]).tolist(), 0.1, 0.5)
    order(host, "emergency_stop")
    c.wait(0.1)
    assert c.receive.isEmergencyStopped()
    assert not c.control.speedL([0, 0, 0.01, 0, 0, 0], 0.5, 0.002)
    order(host, "release_emergency_stop")
    dashboard.powerOn()
    c.wait(0.4)
    dashboard.brakeRelease()
    c.wait(0.4)
    assert c.control.reuploadScript()
    c.wait(0.1)
    assert c.control.isProgramRunning()
    assert c.receive.getRobotMode() == 7


def side_by_side(*hosts):
    """Each robot moves its own way, all at the same time."""
    robots = [Clients(host) for host in hosts]
    speeds = [0.005 * (k + 1) for k in range(len(robots))]
    for robot, speed in zip(robots, speeds, strict=True):
        assert robot.control.speedL([0, 0, -speed, 0, 0, 0], 0.5, 0.002)
    for robot in robots:
        robot.wait(0.2)
    marks = [robot.pose() for robot in robots]
    for _ in range(10):  # now one, now the other
        for robot in robots:
            robot.wait(0.1)
    for robot, host, speed, pose in zip(robots, hosts, speeds, marks, strict=True):
        near((robot.pose() - pose)[2], -speed, 2e-5)
        assert robot.control.speedStop(1.0)
        robot.wait(0.3)
        # each client sees its own robot
        same_pose(robot.pose(), np.array(order(host, "state")["tcp_pose"]), 1e-12)


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
    sys.stdout.flush()
    os._exit(0)  # each interface would wait half a second in its destructor
