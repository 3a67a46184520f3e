# SPDX-License-Identifier: Apache-2.0
"""How a robot's tip follows its commands: acceleration limit, dead time, lag, vibration."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import float64, njit
from numba.types import UniTuple

from tactile_resonance.fields import check_above_zero, check_not_negative
from tactile_resonance.simulation.noise import NormalRows, Seed


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
        check_not_negative(self, "dead_time_s", "lag_s", "jitter_rms_m")
        check_above_zero(self, "jitter_corner_rad_s")


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
        if now is before and tuple(now) == self.value:  # at rest
            return self.value
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
        self._by = np.ascontiguousarray(np.hstack([transition, drive]))
        self.reseed(seed)

    def reseed(self, seed: Seed) -> None:
        """Let vibration follow from a seed, from the next step on, beginning in a state drawn anew."""
        random = np.random.default_rng(seed)
        self._state = self._rms[:, None] * random.standard_normal((2, 3))  # places and speeds
        self._rows = NormalRows(random, [1.0] * 6)

    def step(self) -> tuple[float, float, float]:
        """Advance one period; return the displacement [m]."""
        return _tremble(self._state, self._by, self._rows.take())


@njit(UniTuple(float64, 3)(float64[:, ::1], float64[:, ::1], float64[::1]), cache=True)
def _tremble(state, by, noise):
    """Advance place and speed of three axes; return the place."""
    for k in range(3):
        place, speed, first, second = state[0, k], state[1, k], noise[k], noise[3 + k]
        for n in range(2):
            a, b, c, d = by[n, 0], by[n, 1], by[n, 2], by[n, 3]
            state[n, k] = a * place + b * speed + c * first + d * second
    return state[0, 0], state[0, 1], state[0, 2]
