# SPDX-License-Identifier: Apache-2.0
"""The unmodified ur_rtde on one robot, its times those of the robot; poses compared."""

import time

import numpy as np
import rtde_control
import rtde_receive
from scipy.spatial.transform import Rotation


class Clients:
    def __init__(self, host, control=True):
        self.host = host
        self.receive = rtde_receive.RTDEReceiveInterface(host)
        self.control = rtde_control.RTDEControlInterface(host) if control else None

    def pose(self):
        return np.array(self.receive.getActualTCPPose())

    def wait(self, seconds):
        """Wait by the robot's clock."""
        end = self.receive.getTimestamp() + seconds
        limit = time.monotonic() + 10 * seconds + 5
        while self.receive.getTimestamp() < end:
            assert time.monotonic() < limit, "the robot's clock stands still"
            time.sleep(0.001)

    def track(self, seconds):
        """Robot times (n,) and poses (n, 6) that belong together."""
        times, poses = [], []
        end = self.receive.getTimestamp() + seconds
        while (stamp := self.receive.getTimestamp()) < end:
            pose = self.receive.getActualTCPPose()
            if self.receive.getTimestamp() == stamp and (not times or stamp > times[-1]):
                times.append(stamp)
                poses.append(pose)
            time.sleep(0.0005)
        return np.array(times), np.array(poses)

    def q(self):
        return np.array(self.receive.getActualQ())


def near(a, b, tolerance):
    difference = np.abs(np.asarray(a) - np.asarray(b)).max()
    assert difference <= tolerance, f"{a} and {b} differ by {difference}"


def same_pose(a, b, tolerance):
    """Rotation vectors of half a turn may point either way: the angle between the two counts."""
    near(a[:3], b[:3], tolerance)
    turn = Rotation.from_rotvec(a[3:]).inv() * Rotation.from_rotvec(b[3:])
    assert turn.magnitude() <= tolerance / 0.1


def slope(times, values):
    """Rate of change by least squares, columns apart."""
    return np.polyfit(times - times[0], values, 1)[0]
