# SPDX-License-Identifier: Apache-2.0
"""How a robot's tip follows its commands: acceleration limit, dead time, lag, vibration."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.samples import Pose
from tactile_resonance.fields import require
from tactile_resonance.simulation.noise import NormalRows, Seed

FloatArray = NDArray[np.float64]

ROTATION_LEVER_M = 0.1
"""Lever that turns the acceleration limit [m/s2] into one of rotation [rad/s2]."""


@dataclass(frozen=True)
class TrackingParameters:
    """How an arm follows; the defaults are chosen to resemble a UR e-series, not measured on one.

    Attributes
    ----------
    dead_time_s : float
        From a command to the first motion [s].
    lag_s : float
        Time constant of the motion behind its set point [s].
    jitter_rms_m : float
        Vibration of the tip on each axis [m], unseen by the joint encoders.
    jitter_corner_rad_s : float
        Its spectrum falls as of white noise through two poles at this rate [rad/s].
    """

    dead_time_s: float = 0.004
    lag_s: float = 0.010
    jitter_rms_m: float = 3e-6
    jitter_corner_rad_s: float = 50.0

    def __post_init__(self) -> None:
        for name in ("dead_time_s", "lag_s", "jitter_rms_m"):
            value = getattr(self, name)
            require(0 <= value < math.inf, name, value, "a number, 0 or above")
        corner = self.jitter_corner_rad_s
        require(0 < corner < math.inf, "jitter_corner_rad_s", corner, "a number above 0")


class Lag:
    """Any number of axes behind their set points: dead time, then a first-order lag.

    Exact for set points that run linearly over each period; a dead time that is no multiple of the
    period is interpolated.

    Attributes
    ----------
    value : tuple of float
        Where the axes are.
    """

    def __init__(
        self, parameters: TrackingParameters, start: Sequence[float], period_s: float
    ) -> None:
        self.value = tuple(start)
        periods = parameters.dead_time_s / period_s
        whole = int(periods + 1e-9)
        self._fraction = max(0.0, periods - whole)
        self._line: deque[Sequence[float]] = deque([self.value] * (whole + 2), maxlen=whole + 2)
        self._delayed: Sequence[float] = self.value
        lag = parameters.lag_s
        self._decay = math.exp(-period_s / lag) if lag > 0 else 0.0
        self._slope = lag / period_s * (1 - self._decay)

    def step(self, target: Sequence[float]) -> tuple[float, ...]:
        """Advance one period, at whose end the set points are `target`; return `value`."""
        line, before, decay, slope = self._line, self._delayed, self._decay, self._slope
        line.append(target)
        now = line[1]
        if self._fraction:
            now = [b + self._fraction * (a - b) for a, b in zip(line[0], now, strict=True)]
        self._delayed = now
        axes = zip(self.value, before, now, strict=True)
        self.value = tuple([n + decay * (value - b) - slope * (n - b) for value, b, n in axes])
        return self.value


class Jitter:
    """Stationary vibration of three axes: white noise through two equal real poles, seeded.

    Its autocorrelation is ``s^2 (1 + w |t|) exp(-w |t|)``; the step is exact for any period.
    """

    def __init__(self, parameters: TrackingParameters, period_s: float, seed: Seed) -> None:
        rms, w, t = parameters.jitter_rms_m, parameters.jitter_corner_rad_s, period_s
        fall = math.exp(-w * t)
        transition = fall * np.array([[1 + w * t, t], [-(w**2) * t, 1 - w * t]])
        stationary = rms**2 * np.diag([1.0, w**2])
        driven = stationary - transition @ stationary @ transition.T
        # tiny negative eigenvalues are rounding
        values, vectors = np.linalg.eigh(driven)
        drive = vectors * np.sqrt(np.maximum(values, 0))
        self._rms = np.array([rms, rms * w])  # of place and speed
        self._place_by, self._speed_by = np.hstack([transition, drive]).tolist()
        self.reseed(seed)

    def reseed(self, seed: Seed) -> None:
        """Let vibration follow from a seed, from the next step on, beginning in a state drawn anew."""
        random = np.random.default_rng(seed)
        self._place, self._speed = (self._rms[:, None] * random.standard_normal((2, 3))).tolist()
        self._rows = NormalRows(random, [1.0] * 6)

    def step(self) -> tuple[float, float, float]:
        """Advance one period; return the displacement [m]."""
        (x, y, z), (vx, vy, vz) = self._place, self._speed
        x1, y1, z1, x2, y2, z2 = self._rows.take()
        a, b, c, d = self._place_by
        self._place = (
            a * x + b * vx + c * x1 + d * x2,
            a * y + b * vy + c * y1 + d * y2,
            a * z + b * vz + c * z1 + d * z2,
        )
        a, b, c, d = self._speed_by
        self._speed = (
            a * x + b * vx + c * x1 + d * x2,
            a * y + b * vy + c * y1 + d * y2,
            a * z + b * vz + c * z1 + d * z2,
        )
        return self._place


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
        self._jitter = Jitter(parameters, period_s, seed) if parameters.jitter_rms_m > 0 else None

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
        self.pose = self.reported
        if self._jitter is not None:
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
