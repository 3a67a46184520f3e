# SPDX-License-Identifier: Apache-2.0
"""Power, brakes and stops of the robot, with the modes that RTDE and dashboard report.

Numbers of modes and bits: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

from enum import IntEnum


class RobotMode(IntEnum):
    """RTDE output ``robot_mode``."""

    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """RTDE output ``safety_mode``."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


# Bits of RTDE output ``safety_status_bits``.
_STATUS_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}

# After a protective stop the robot refuses to be unlocked for this long [s] (dashboard server manual).
UNLOCK_DELAY_S = 5.0
# Time that powering on and releasing the brakes take each [s]; seconds on a real robot.
SWITCHING_S = 0.2


class RefusedError(Exception):
    """The controller refuses what was asked of it, as its dashboard would answer."""


class Safety:
    """Modes of the robot.

    Attributes
    ----------
    robot_mode : RobotMode
    safety_mode : SafetyMode
    """

    def __init__(self) -> None:
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self._time_s = 0.0
        self._next_mode: RobotMode | None = None
        self._due_s = 0.0
        self._stopped_s = 0.0

    @property
    def may_move(self) -> bool:
        """Brakes released, no stop in force."""
        return self.robot_mode is RobotMode.RUNNING and self.safety_mode is SafetyMode.NORMAL

    @property
    def powered(self) -> bool:
        """Whether motors, not brakes, hold the joints."""
        return self.robot_mode is RobotMode.RUNNING

    @property
    def status_bits(self) -> int:
        """RTDE output ``safety_status_bits``."""
        return _STATUS_BITS[self.safety_mode]

    def step(self, time_s: float, at_rest: bool) -> None:
        """Advance to a time; at rest, a stop that removes power does so."""
        self._time_s = time_s
        if self._next_mode is not None and time_s >= self._due_s:
            self.robot_mode, self._next_mode = self._next_mode, None
        if self.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP and at_rest:
            self.power_off()

    def power_on(self) -> None:
        """Power the arm; its brakes stay closed."""
        self._require_normal("power on")
        if self.robot_mode is RobotMode.POWER_OFF:
            self.robot_mode = RobotMode.POWER_ON
            self._switch(RobotMode.IDLE)

    def brake_release(self) -> None:
        """Release the brakes, powering the arm first where it is off."""
        self._require_normal("release brakes")
        if self.robot_mode is RobotMode.POWER_OFF:
            self.robot_mode = RobotMode.POWER_ON
        if self.robot_mode is not RobotMode.RUNNING:
            self._switch(RobotMode.RUNNING)

    def power_off(self) -> None:
        """Close the brakes and remove power."""
        self.robot_mode, self._next_mode = RobotMode.POWER_OFF, None

    def protective_stop(self) -> None:
        """Stop, power kept, until unlocked."""
        if self.safety_mode is SafetyMode.NORMAL:
            self.safety_mode = SafetyMode.PROTECTIVE_STOP
            self._stopped_s = self._time_s

    def unlock_protective_stop(self) -> None:
        """End a protective stop.

        Raises
        ------
        RefusedError
            Within 5 s of the stop.
        """
        if self.safety_mode is not SafetyMode.PROTECTIVE_STOP:
            return
        if self._time_s - self._stopped_s < UNLOCK_DELAY_S:
            raise RefusedError(
                "Cannot unlock protective stop until 5s after occurrence. "
                "Always inspect cause of protective stop before unlocking"
            )
        self.safety_mode = SafetyMode.NORMAL

    def emergency_stop(self) -> None:
        """Press the emergency stop: brake, then remove power."""
        self.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP

    def release_emergency_stop(self) -> None:
        """Release the button; the arm stays without power."""
        if self.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP:
            self.safety_mode = SafetyMode.NORMAL

    def _require_normal(self, action: str) -> None:
        if self.safety_mode is not SafetyMode.NORMAL:
            raise RefusedError(f"cannot {action} in safety mode {self.safety_mode.name}")

    def _switch(self, mode: RobotMode) -> None:
        self._next_mode, self._due_s = mode, self._time_s + SWITCHING_S
