# SPDX-License-Identifier: Apache-2.0
"""States of the robot from ur_rtde's receive interface, dated and handed out to the owner."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import replace
from typing import Any

from tactile_resonance.contact.clocks import ClockTracker
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_exchange import ClientState, Exchange
from tactile_resonance.drivers.ur_safety import PROGRAM_PLAYING, PROGRAM_STOPPED

VARIABLES = [
    "timestamp",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "safety_status_bits",
    "runtime_state",
    "robot_mode",
    "safety_mode",
]
CYCLE_S = 0.002
# No command is given where the newest state is older.
HEALTHY_S = 0.1


class StateReader:
    """Polls the newest state, relates its time stamp to the local clock, writes it to the page.

    Parameters
    ----------
    receive : rtde_receive.RTDEReceiveInterface
    exchange : Exchange
    round_trip_s : float
        Of the network.

    Attributes
    ----------
    polls : int
        How often it was polled.
    """

    def __init__(self, receive: Any, exchange: Exchange, round_trip_s: float) -> None:
        self.polls = 0
        self._receive = receive
        self._control: Any = None
        self._exchange = exchange
        # what all messages share cannot be seen by listening: half of the round trip, and how long a
        # state waits in the robot before it is sent, at most a cycle
        self._clock = ClockTracker(round_trip_s / 2, math.hypot(round_trip_s, CYCLE_S) / 12**0.5)
        self._lock = threading.Lock()
        self._newest: ClientState | None = None
        self._newest_s = time.monotonic()
        self._arrivals: deque[float] = deque()
        self._moving = False
        self._done = self._refused = 0
        self._runtime = 0
        self._guarded = self._ended = False

    @property
    def silence_s(self) -> float:
        """Time since the last new state [s]."""
        return time.monotonic() - self._newest_s

    @property
    def connected(self) -> bool:
        """Both connections of the library say so."""
        control = self._control is None or self._control.isConnected()
        return control and self._receive.isConnected()

    @property
    def healthy(self) -> bool:
        """Connected and the newest state fresh enough to command on."""
        return self.silence_s < HEALTHY_S and self.connected

    def watch(self, control: Any) -> None:
        """Judge the connection of the control interface too."""
        self._control = control

    def wait_for_first(self) -> None:
        """Wait for a state. Raises `ArmError` where none comes."""
        deadline = time.monotonic() + 2.0
        while self._newest is None:
            if time.monotonic() > deadline or not self.connected:
                raise ArmError(ArmFault.LINK_LOST, "connected, but no state of the robot comes")
            self.poll()
            time.sleep(0.001)

    @property
    def revived(self) -> bool:
        """A program runs, but not the one that was guarded: that one has ended, or was paused.

        Whoever started it (the library after a lost connection, someone at the pendant) has not set its
        watchdog, and it may follow an old velocity. So it is told to the owner as stopped.
        """
        return self._ended and self._runtime == PROGRAM_PLAYING

    def guard(self) -> bool:
        """Watch the program that was started; False where none runs within a second."""
        deadline = time.monotonic() + 1.0
        while self.state().runtime_state != PROGRAM_PLAYING:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.001)
        self._guarded = True
        return True

    def unguard(self) -> None:
        """Forget the program that was watched."""
        self._guarded = self._ended = False

    def state(self) -> ClientState:
        """Return the newest state."""
        assert self._newest is not None
        return self._newest

    def poll(self) -> None:
        """Take a new state where there is one."""
        self.polls += 1
        receive = self._receive
        robot_s = receive.getTimestamp()
        now_ns = time.monotonic_ns()
        if self._newest is not None and robot_s == self._newest.robot_time_s:
            return
        pose, speed = receive.getActualTCPPose(), receive.getActualTCPSpeed()
        force = receive.getActualTCPForce()
        safety_bits = receive.getSafetyStatusBits()
        self._runtime, mode = receive.getRuntimeState(), receive.getRobotMode()
        safety_mode = receive.getSafetyMode()
        if receive.getTimestamp() != robot_s:
            return  # the next state came meanwhile: these values are of two
        self._ended |= self._guarded and self._runtime != PROGRAM_PLAYING
        self._newest_s = now_ns * 1e-9
        self._clock.add(robot_s, now_ns)
        relation = self._clock.relation()
        self._arrivals.append(self._newest_s)
        while self._arrivals[0] < self._newest_s - 1.0:
            self._arrivals.popleft()
        self._hand_out(
            ClientState(
                received_ns=now_ns,
                robot_time_s=robot_s,
                state_ns=relation.to_local_ns(robot_s),
                tip_pose=tuple(pose),
                tip_speed=tuple(speed),
                tip_force=tuple(force),
                safety_bits=safety_bits,
                runtime_state=PROGRAM_STOPPED if self.revived else self._runtime,
                robot_mode=mode,
                safety_mode=safety_mode,
                connected=self.connected,
                moving=self._moving,
                done=self._done,
                refused=self._refused,
                clock_std_s=relation.uncertainty_s,
                rate_hz=float(len(self._arrivals)),
            )
        )

    def note_moving(self, moving: bool) -> None:
        """Say with the next state whether a move is under way."""
        self._moving = moving

    def report(self, number: int, done: bool) -> None:
        """Say with the next state what became of a command."""
        with self._lock:
            self._done = max(self._done, number)
            if not done:
                self._refused = number

    def lose(self) -> None:
        """Hand out that the link is lost."""
        if self._newest is not None:
            now_ns = time.monotonic_ns()
            self._hand_out(replace(self._newest, connected=False, received_ns=now_ns))

    def _hand_out(self, state: ClientState) -> None:
        with self._lock:
            self._newest = state
            self._exchange.write(state)
