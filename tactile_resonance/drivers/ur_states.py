# SPDX-License-Identifier: Apache-2.0
"""Which state the robot is in: the newest one, dated; what it forbids; whether the program that runs is ours.

Numbers of modes and status bits: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

from tactile_resonance.contact.clocks import ClockTracker
from tactile_resonance.contact.interfaces import ArmFault
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.drivers.rtde_stream import RobotState, RtdeStream

CYCLE_S = 0.002
ROBOT_RUNNING = 7
PROGRAM_STOPPED, PROGRAM_PLAYING = 1, 2
_ROBOT_MODES = {
    -1: "no controller", 0: "disconnected", 1: "confirm safety", 2: "booting", 3: "power off",
    4: "power on", 5: "idle, brakes closed", 6: "backdrive", 7: "running", 8: "updating firmware",
}  # fmt: skip
_STOPS = (
    (5, ArmFault.EMERGENCY_STOP, "system emergency stop"),
    (6, ArmFault.EMERGENCY_STOP, "robot emergency stop"),
    (7, ArmFault.EMERGENCY_STOP, "emergency stop"),
    (8, ArmFault.PROTECTIVE_STOP, "a safety limit was violated"),
    (9, ArmFault.PROTECTIVE_STOP, "the safety system has a fault"),
    (4, ArmFault.PROTECTIVE_STOP, "safeguard stop"),
    (2, ArmFault.PROTECTIVE_STOP, "protective stop"),
    (3, ArmFault.PROTECTIVE_STOP, "recovery mode"),
    (10, ArmFault.PROTECTIVE_STOP, "stopped by the safety system"),
)


def stop_fault(safety_bits: int, robot_mode: int) -> tuple[ArmFault, str] | None:
    """Return why the arm cannot move whatever program runs; None where it can."""
    for bit, fault, text in _STOPS:
        if safety_bits >> bit & 1:
            return fault, f"{text} (safety_status_bits {safety_bits:#x})"
    if robot_mode != ROBOT_RUNNING:
        name = _ROBOT_MODES.get(robot_mode, "unknown")
        return (
            ArmFault.PROGRAM_STOPPED,
            f"the robot is not running: robot_mode {robot_mode} ({name})",
        )
    return None


@lru_cache(maxsize=16)  # each state is judged, and seldom differs from the one before
def motion_fault(
    safety_bits: int, robot_mode: int, runtime_state: int
) -> tuple[ArmFault, str] | None:
    """Return why no command would be followed; None where it would."""
    fault = stop_fault(safety_bits, robot_mode)
    if fault is None and runtime_state != PROGRAM_PLAYING:
        return (
            ArmFault.PROGRAM_STOPPED,
            f"the control program does not run (runtime_state {runtime_state}): its watchdog expired, or "
            "it was stopped at the robot",
        )
    return fault


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
    stream : RtdeStream
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
        self.stream, self._now_ns, self._trip_s = stream, now_ns, round_trip_s
        self._tracker = self._new_tracker()
        self._guarded = self._ended = False

    @property
    def clock_std_s(self) -> float:
        """Standard deviation of the states' times [s]."""
        return self._tracker.uncertainty_s

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
        states = self.stream.read()
        if not states:
            return False
        if self._guarded:
            for state in states:
                if state.runtime_state != PROGRAM_PLAYING:
                    self._ended = True
        before, self.newest = self.newest, states[-1]
        # a robot whose simulated time stands repeats its state
        if before is None or self.newest.robot_time_s != before.robot_time_s:
            self._date(self.newest, now_known)
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
