# SPDX-License-Identifier: Apache-2.0
"""Motions of the arm as calls of ur_rtde, in the order that its control program understands.

No call here waits longer than the robot's watchdog allows without feeding it: the library's own
``speedStop`` and synchronous ``stopL`` do, so a speed is taken back to zero before its thread is ended.

A velocity is not acknowledged: it stands in the command register until the robot's program looks, once a
cycle. The library's ``kickWatchdog`` writes zero into that register, and where both arrive within one cycle
(the robot's own, or a network that held packets back) the velocity is lost, be it the zero of a stop. So
while a velocity holds the watchdog is fed by saying the velocity again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

# speedL hands the newest velocity to the arm once a cycle of an e-series; it is no dead-man's switch.
CYCLE_S = 0.002
# Beyond the time that deceleration takes: dead time and lag of the arm.
SETTLE_S = 0.06
FEED_S = 0.01
LONGEST_STOP_S = 3.0


class Motion:
    """Speeds, straight moves and stops; each call says whether the robot took it.

    Parameters
    ----------
    control : rtde_control.RTDEControlInterface
    """

    def __init__(self, control: Any) -> None:
        self._control = control
        self._twist = [0.0] * 6  # newest velocity, and the acceleration towards it
        self._acceleration_m_s2 = 0.0
        self._speeding = False  # whether a velocity, zero included, is what the program follows
        self._rest_s = 0.0  # monotonic time from which a speed that was taken back is zero
        self._operation: int | None = None  # id of the asynchronous operation before our move
        self._do: dict[str, Callable[..., bool]] = {
            "speed": self._speed,
            "move": self._move,
            "stop": self._stop,
        }

    @property
    def commanded(self) -> bool:
        """Whether the arm moves, or would without end, by a command of ours."""
        return any(self._twist) or self.moving

    @property
    def moving(self) -> bool:
        """Whether a move, or its stop, is still under way."""
        if self._operation is None:
            return False
        progress = self._control.getAsyncOperationProgressEx()
        if progress.isAsyncOperationRunning() or progress.operationId() == self._operation:
            return True
        self._operation = None
        return False

    def execute(self, name: str, values: list) -> bool:
        """Do a command; False where the robot refused it."""
        return self._do[name](*values)

    def feed(self) -> bool:
        """Keep the robot's watchdog quiet without changing what the arm does."""
        if self._speeding:
            return self._control.speedL(self._twist, self._acceleration_m_s2, CYCLE_S)
        return self._control.kickWatchdog()

    def _speed(self, twist: list[float], acceleration: float) -> bool:
        if self.moving and not self._end_move(acceleration):
            return False
        return self._follow(twist, acceleration)

    def _follow(self, twist: list[float], acceleration: float) -> bool:
        self._twist, self._acceleration_m_s2, self._speeding = twist, acceleration, True
        return self._control.speedL(twist, acceleration, CYCLE_S)

    def _move(self, pose: list[float], speed: float, acceleration: float) -> bool:
        # neither the program's thread that keeps a speed nor an earlier move may fight with this one
        if self._speeding and not self._end_speed(acceleration):
            return False
        if self.moving and not self._end_move(acceleration):
            return False
        operation = self._control.getAsyncOperationProgressEx().operationId()
        if not self._control.moveL(pose, speed, acceleration, True):
            return False
        self._operation = operation
        return True

    def _stop(self, deceleration: float) -> bool:
        done = self._brake(deceleration) if self._speeding else True
        if self.moving:
            # asynchronous: the synchronous one may stop the joints instead of the tool. It tells
            # nothing; that the operation ends does
            self._control.stopL(deceleration, True)
        return done

    def _brake(self, deceleration: float) -> bool:
        speed_m_s = float(np.linalg.norm(self._twist))
        self._rest_s = time.monotonic() + speed_m_s / deceleration + SETTLE_S
        return self._follow([0.0] * 6, deceleration)

    def _end_speed(self, deceleration: float) -> bool:
        if any(self._twist) and not self._brake(deceleration):
            return False
        if not self._feed_while(lambda: time.monotonic() < self._rest_s):
            return False
        self._speeding = not self._control.speedStop(deceleration)
        return not self._speeding

    def _end_move(self, deceleration: float) -> bool:
        self._control.stopL(deceleration, True)
        return self._feed_while(lambda: self.moving)

    def _feed_while(self, condition: Callable[[], bool]) -> bool:
        """Feed the watchdog while a condition holds; False where that takes too long."""
        end_s = time.monotonic() + LONGEST_STOP_S
        while condition():
            if time.monotonic() > end_s or not self.feed():
                return False
            time.sleep(FEED_S)
        return True
