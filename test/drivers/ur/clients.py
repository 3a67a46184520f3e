# SPDX-License-Identifier: Apache-2.0
"""The unmodified ur_rtde on one robot in simulated time, which goes on where these wait; poses compared."""

import contextlib
import time

import numpy as np
import rtde_control
import rtde_receive
from scipy.spatial.transform import Rotation

from tactile_resonance.clock import PORT, Demand, SimulatedClock
from tactile_resonance.simulation.plant.defaults import order

PATIENCE_S = 60.0
CYCLE_S = 0.002
# Calls that say something and wait for no answer: time stands meanwhile.
STREAMED = {"speedL", "speedJ", "servoL", "servoJ", "forceMode", "kickWatchdog"}
# Of the robot's time, for a handshake; less than the watchdog of these tests.
HANDSHAKE_S, SETTLE_S = 0.05, 0.01


class Control:
    """Calls of a control interface; those that wait for the robot let time go on, at the pace of real time."""

    def __init__(self, control, clients):
        self._control, self._clients = control, clients

    def __getattr__(self, name):
        call = getattr(self._control, name)
        if name in STREAMED:
            return call

        def passing(*arguments):
            # what only has to be taken has as much time as that needs: an asynchronous move begins when it
            # is told, however late this process hears of it
            brief = name == "setWatchdog" or (arguments and arguments[-1] is True)
            with self._clients.passing(HANDSHAKE_S if brief else None):
                return call(*arguments)

        return passing


class Clients:
    """Receive and control interface; time stands between their calls."""

    def __init__(self, host, control=True):
        self.host = host
        self.clock = SimulatedClock(f"{host}:{PORT}", "test")
        with self.passing():
            self.receive = rtde_receive.RTDEReceiveInterface(host)
            self.control = self.wrap(rtde_control.RTDEControlInterface(host)) if control else None

    def wrap(self, control):
        return Control(control, self)

    @contextlib.contextmanager
    def passing(self, seconds=None):
        """Time goes on meanwhile, at the pace of real time, without or up to an end; it stands afterwards."""
        if seconds is None:
            self.clock.free(Demand.REAL)
        else:
            self.clock.hold(0, Demand.REAL, 0)
            limit_ns = self.clock.ask_ns() + round(seconds * 1e9)
            self.clock.hold(limit_ns, Demand.REAL, 1)  # from when the robot has the call
        try:
            yield
        finally:
            # the robot is to hear the end of a handshake, and the library that it is ready for the next
            now_ns = self.clock.ask_ns()
            self.clock.wait_until(now_ns + round(SETTLE_S * 1e9), Demand.REAL)

    def pose(self):
        return np.array(self.receive.getActualTCPPose())

    def wait(self, seconds):
        """Let time go on, and wait until the state at its end has been received."""
        self.clock.wait_until(self.clock.ask_ns() + round(seconds * 1e9), Demand.FAST)
        now_s, limit = order(self.host, "state")["time_s"], time.monotonic() + PATIENCE_S
        while self.receive.getTimestamp() < now_s - 1e-6:
            assert time.monotonic() < limit, "the newest state is not received"
            time.sleep(0.0005)

    def track(self, seconds):
        """Robot times (n,) and poses (n, 6) that belong together."""
        times, poses = [], []
        for _ in range(round(seconds / CYCLE_S)):
            self.wait(CYCLE_S)
            times.append(self.receive.getTimestamp())
            poses.append(self.receive.getActualTCPPose())
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
