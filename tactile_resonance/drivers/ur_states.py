# SPDX-License-Identifier: Apache-2.0
"""Which state the robot is in: its newest one dated, and whether the program that runs is ours."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from tactile_resonance.contact.clocks import ClockTracker
from tactile_resonance.contact.interfaces import ArmFault
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.drivers.rtde_stream import RobotState, RtdeStream
from tactile_resonance.drivers.ur_safety import PROGRAM_PLAYING, PROGRAM_STOPPED, motion_fault

CYCLE_S = 0.002


class StateReader:
    """Newest state of a robot.

    Parameters
    ----------
    stream : RtdeStream
    now_ns : callable
        Returns the time of the clock on which states are dated [ns].
    round_trip_s : float
        Of the network [s].

    Attributes
    ----------
    newest : RobotState or None
    sample : ArmSample or None
        The same state, as the contract of an arm has it.
    fault : tuple of ArmFault and str, or None
        Why no command would be followed in it.
    """

    def __init__(self, stream: RtdeStream, now_ns: Callable[[], int], round_trip_s: float) -> None:
        self.newest: RobotState | None = None
        self.sample: ArmSample | None = None
        self.fault: tuple[ArmFault, str] | None = None
        self._stream, self._now_ns, self._trip_s = stream, now_ns, round_trip_s
        self._tracker = self._new_tracker()
        self._stamps: deque[float] = deque()
        self._guarded = self._ended = False

    @property
    def clock_std_s(self) -> float:
        """Standard deviation of the states' times [s]."""
        return self._tracker.relation().uncertainty_s

    @property
    def rate_hz(self) -> float:
        """States received of the last second of the robot's time."""
        return float(len(self._stamps))

    @property
    def revived(self) -> bool:
        """A program runs, but not the one that was guarded: that one has ended, or was paused.

        Whoever started it (the library after a lost connection, someone at the pendant) has not set its
        watchdog, and it may follow an old velocity. So it is reported as stopped.
        """
        runs = self.newest is not None and self.newest.runtime_state == PROGRAM_PLAYING
        return self._ended and runs

    def guard(self, on: bool) -> None:
        """From now on no program but the one that runs counts as ours; or forget that."""
        self._guarded, self._ended = on, False

    def read(self, now_known: bool = True) -> bool:
        """Take the states that have come, without waiting; whether any have. Raises `ConnectionError`.

        Where the present time is not known, states are dated by the relation of the clocks found before.
        """
        states = self._stream.read()
        last_s = -math.inf if self.newest is None else self.newest.robot_time_s
        # a robot whose simulated time stands repeats its state
        newest, stamps = None, self._stamps
        for state in states:
            if state.robot_time_s == last_s:
                continue
            newest = state
            if self._guarded and state.runtime_state != PROGRAM_PLAYING:
                self._ended = True
            stamps.append(state.robot_time_s)
        if newest is None:
            return bool(states)
        self.newest, now_s = newest, newest.robot_time_s
        while not now_s - 1.0 <= stamps[0] <= now_s:
            stamps.popleft()
        self._date(newest, now_known)
        return True

    def date_anew(self) -> None:
        """Forget how the robot's clock was related to this one, and date the newest state now."""
        self._tracker = self._new_tracker()
        if self.newest is not None:
            self._date(self.newest, True)

    def _new_tracker(self) -> ClockTracker:
        # what all messages share cannot be seen by listening: half of the round trip, and how long a
        # state waits in the robot before it is sent, at most a cycle
        return ClockTracker(self._trip_s / 2, math.hypot(self._trip_s, CYCLE_S) / 12**0.5)

    def _date(self, newest: RobotState, now_known: bool) -> None:
        if now_known or self.sample is None:
            self._tracker.add(newest.robot_time_s, self._now_ns())
        runtime = PROGRAM_STOPPED if self.revived else newest.runtime_state
        self.fault = fault = motion_fault(newest.safety_bits, newest.robot_mode, runtime)
        self.sample = ArmSample(
            self._tracker.to_local_ns(newest.robot_time_s),
            newest.robot_time_s,
            newest.pose[:3],
            newest.pose[3:],
            newest.speed,
            fault is None,
            "" if fault is None else fault[1],
            newest.force,
        )
