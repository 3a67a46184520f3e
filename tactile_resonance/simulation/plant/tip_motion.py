# SPDX-License-Identifier: Apache-2.0
"""A tip in virtual time that obeys twists as a robot's does."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.samples import Pose
from tactile_resonance.simulation.ur5e.tracking import Jitter, Lag, TrackingParameters

ROTATION_LEVER_M = 0.1
"""Lever that turns the acceleration limit [m/s2] into one of rotation [rad/s2]."""


class TipMotion:
    """Six axes of a tip that obeys twists, one period at a time.

    Attributes
    ----------
    pose : Pose
        Where the tip is, vibration included.
    reported : Pose
        What the arm's encoders say: without vibration.
    twist : (6,) array
        Velocity [m/s] and angular velocity [rad/s] of `reported`.
    """

    def __init__(
        self, parameters: TrackingParameters, start: Pose, *, period_s: float = 0.002, seed: int = 0
    ) -> None:
        self.period_s = period_s
        self.pose = self.reported = start
        self.twist = np.zeros(6)
        self._set_twist = np.zeros(6)  # after the acceleration limit
        self._wanted: FloatArray = np.zeros(6)
        self._acceleration_m_s2 = 1.0
        self._lag = Lag(parameters, [0.0] * 6, period_s)
        self._jitter = Jitter(parameters, period_s, seed)

    def speed(self, twist: Sequence[float] | FloatArray, acceleration_m_s2: float) -> None:
        """Go over to a twist (6,) in the base, under an acceleration limit, and keep it."""
        self._wanted, self._acceleration_m_s2 = np.array(twist, dtype=float), acceleration_m_s2

    def step(self) -> None:
        """Advance one period."""
        dt = self.period_s
        self._set_twist = self._limited(self._wanted)
        last = self.twist
        self.twist = np.array(self._lag.step(self._set_twist.tolist()))
        self.reported = moved(self.reported, (last + self.twist) / 2 * dt)
        place = self.reported.position_m + self._jitter.step()
        self.pose = Pose(place, self.reported.rotation_rad)

    def _limited(self, wanted: FloatArray) -> FloatArray:
        change = wanted - self._set_twist
        linear = math.sqrt(change[0] ** 2 + change[1] ** 2 + change[2] ** 2)
        angular = math.sqrt(change[3] ** 2 + change[4] ** 2 + change[5] ** 2)
        step = self._acceleration_m_s2 * self.period_s
        largest = max(linear, angular * ROTATION_LEVER_M)
        if largest <= step:
            return wanted
        return self._set_twist + change * (step / largest)


def moved(pose: Pose, step: FloatArray) -> Pose:
    """Return a pose after a small motion (6,) [m, rad] in the base.

    The rotation vector stays the same object where nothing turns, so that what is computed from it
    can be kept.
    """
    rotation = pose.rotation_rad
    if step[3] or step[4] or step[5]:
        rotation = (Rotation.from_rotvec(step[3:]) * pose.rotation).as_rotvec()
    return Pose(pose.position_m + step[:3], rotation)
