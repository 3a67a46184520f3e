# SPDX-License-Identifier: Apache-2.0
"""Trapezoidal speed over a distance: rest to rest under a speed and an acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Trapezoid:
    """Accelerate, cruise, brake; a triangle where the distance is too short to reach the speed.

    Attributes
    ----------
    length, speed, acceleration : float
        All above or equal to 0, speed and acceleration above 0, in units that go together.
    """

    length: float
    speed: float
    acceleration: float

    @property
    def peak(self) -> float:
        """Highest speed reached."""
        return min(self.speed, math.sqrt(self.length * self.acceleration))

    @property
    def duration(self) -> float:
        """Time from rest to rest."""
        return (
            0.0 if self.length == 0.0 else self.length / self.peak + self.peak / self.acceleration
        )

    def at(self, time: float) -> tuple[float, float]:
        """Return distance and speed at a time; at rest before the start and after the end."""
        if time <= 0.0 or self.length == 0.0:
            return 0.0, 0.0
        left = self.duration - time
        if left <= 0.0:
            return self.length, 0.0
        ramp = self.peak / self.acceleration
        if time < ramp:
            return self.acceleration * time**2 / 2, self.acceleration * time
        if left < ramp:
            return self.length - self.acceleration * left**2 / 2, self.acceleration * left
        return self.peak * (time - ramp / 2), self.peak
