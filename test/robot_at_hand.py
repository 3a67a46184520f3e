# SPDX-License-Identifier: Apache-2.0
"""What whoever stands beside a simulated robot can do: its pendant, its emergency stop, its settings."""

import os
import socket
import time

from tactile_resonance.clock import PORT as TIME_PORT
from tactile_resonance.simulation.plant.defaults import order

PATIENCE_S = 60.0


def own_host(last):
    """Address that no other run of the tests uses; `last` tells the robots of one run apart."""
    return f"127.{1 + os.getpid() % 250}.{1 + os.getpid() // 250 % 250}.{last}"


def own_time(last):
    """Address of the simulated time of such a robot, or of a bench without one."""
    return f"{own_host(last)}:{TIME_PORT}"


class RobotAtHand:
    """A simulated robot, by its address."""

    def __init__(self, host):
        self.host = host

    def order(self, command, **fields):
        return order(self.host, command, timeout_s=PATIENCE_S, **fields)

    def dashboard(self, line):
        with socket.create_connection((self.host, 29999), PATIENCE_S) as channel:
            lines = channel.makefile()
            lines.readline()
            channel.sendall(line.encode() + b"\n")
            return lines.readline().strip()

    def until(self, **wanted):
        """Wait until the control port's state is as wanted."""
        end = time.monotonic() + PATIENCE_S
        while any(self.order("state")[name] != value for name, value in wanted.items()):
            assert time.monotonic() < end, f"{self.order('state')} is never {wanted}"
            time.sleep(0.02)

    def unlock(self):
        """Release a protective stop, as soon as the robot takes it."""
        end = time.monotonic() + PATIENCE_S
        while self.dashboard("unlock protective stop") != "Protective stop releasing":
            assert time.monotonic() < end
            time.sleep(0.1)

    def power_up(self):
        """Release the emergency stop and bring the robot up again."""
        self.order("release_emergency_stop")
        self.dashboard("power on")
        self.until(robot_mode="IDLE")
        self.dashboard("brake release")
        self.until(robot_mode="RUNNING")

    def recover(self):
        """End every fault that a test which failed may have left."""
        self.order("release_emergency_stop")
        for name, value in (("remote_control", True), ("script_starts", True)):
            self.order(name, value=value)
        self.order("registers_in_use", value=False)
        if self.order("state")["safety_mode"] == "PROTECTIVE_STOP":
            self.unlock()
        if self.order("state")["robot_mode"] != "RUNNING":
            self.power_up()
