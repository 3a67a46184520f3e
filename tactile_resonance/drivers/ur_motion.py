# SPDX-License-Identifier: Apache-2.0
"""Velocities of the arm as calls of ur_rtde, in the order that its control program understands.

A velocity is not acknowledged: it stands in the command register until the robot's program looks, once a
cycle. The library's ``kickWatchdog`` writes zero into that register, and where both arrive within one cycle
(the robot's own, or a network that held packets back) the velocity is lost, be it the zero of a stop. So
once a velocity was sent the watchdog is fed by sending the newest velocity again. A stop is a velocity of
zero: the library's own ``speedStop`` waits for longer than the watchdog allows.
"""

from __future__ import annotations

from typing import Any

# speedL hands the newest velocity to the arm once a cycle of an e-series; it is no dead-man's switch.
CYCLE_S = 0.002
REST = (0.0,) * 6


class UrMotion:
    """Speeds and stops; each call returns whether the robot took it.

    Parameters
    ----------
    control : rtde_control.RTDEControlInterface

    Attributes
    ----------
    packets : int
        Sent to the robot by these calls.
    """

    def __init__(self, control: Any) -> None:
        self._control = control
        self._twist: tuple[float, ...] = REST
        self._acceleration_m_s2: float | None = None  # None: no velocity was sent yet
        self.packets = 0

    @property
    def commanded(self) -> bool:
        """Whether the arm moves, or would without end, by a command of ours."""
        return any(self._twist)

    def speed(self, twist: tuple[float, ...], acceleration: float) -> bool:
        """Follow a twist until the next call."""
        self._twist, self._acceleration_m_s2 = twist, acceleration
        return self.feed()

    def rest(self, deceleration: float) -> None:
        """Want no velocity any more: from now on the watchdog is fed with zero."""
        self._twist, self._acceleration_m_s2 = REST, deceleration

    def stop(self, deceleration: float) -> bool:
        """Brake and stand."""
        return self.speed(REST, deceleration)

    def feed(self) -> bool:
        """Keep the robot's watchdog quiet without changing what the arm does."""
        self.packets += 1
        if self._acceleration_m_s2 is None:
            return self._control.kickWatchdog()
        return self._control.speedL(self._twist, self._acceleration_m_s2, CYCLE_S)
