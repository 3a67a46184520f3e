# SPDX-License-Identifier: Apache-2.0
"""How freely a surface moves, learnt from the innovations of the filter that follows it.

White acceleration drives the surface. Innovations of a filter that is right are white (Mehra, IEEE Trans.
Automatic Control 17, 1972), so the intensity of the acceleration rises while their running mean is further
from 0 than white ones leave it, and falls elsewhere. Until a motion is detected it stays so low that still
tissue is followed as if it could not move. A motion that goes to and fro is pulled back towards its middle:
then speed is foreseen where white acceleration would only follow it.
"""

from __future__ import annotations

import math

LEAST, MOST = math.log(1e-11), math.log(2e-4)
"""ln of the intensity [m2/s3]: tissue that is still; a heart's motion of 1 mm at 2 Hz."""

FIRST, LEAST_MOVING = math.log(2e-5), math.log(4e-6)
"""The same when a motion is detected, and at least after it."""

MEAN_OF, SLOW_OF, SQUARES_OF = 12.0, 48.0, 100.0
"""Innovations are averaged over so many forces, and over so many; squares of the first mean over so many."""

LARGEST = 5.0
"""A larger innovation, in deviations, counts as this: one bad force is no motion."""

OF_MEAN, OF_SLOW = math.sqrt(2 * MEAN_OF - 1), math.sqrt(2 * SLOW_OF - 1)
"""Deviation of one white innovation over those of both means."""

DETECTED, SLOWLY, EXCEEDED, MOST_SQUARE = 36.0, 14.0, 4.0, 25.0
"""Square of the running mean, in its deviations: a motion; one where the slow mean is as large; one that is
followed too slowly; counted at most."""

STILL_S = 5.0
"""So long without need of more than the least intensity the surface counts as still again [s]."""

RISE_PER_S, FALL_PER_S, QUIET_FALL_PER_S = 10.0, 3.0, 20.0
"""Of ln of the intensity: for what the square exceeds; always; more where squares are less than white ones'."""

SPEED_STD_M_S = 1e-3
"""Of the speed when a motion is detected."""

LEARN_S, LEAST_LEARN_S, MIDDLE_S = 2.0, 0.8, 0.6
"""Sizes of a motion and of its speed are means over so long, of use after the second; its middle is one over
the third, short enough to leave creep out."""

SLOWEST_RAD_S, FASTEST_RAD_S = 5.0, 20.0
"""To and fro at these rates is foreseen; slower motion is followed well without."""


class MovingSurface:
    """What is known of a surface's motion beside its place and speed.

    Attributes
    ----------
    moving : bool
        Whether a motion has been detected.
    acceleration_m_s2 : float
        Of a motion to and fro, towards its middle; 0 where none is known.
    """

    def __init__(self) -> None:
        self.moving = False
        self.acceleration_m_s2 = 0.0
        self._ln_intensity, self._mean, self._slow, self._square = LEAST, 0.0, 0.0, 1.0
        self._quiet_s = 0.0
        self._learnt_s = self._middle_m = self._middle_n = self._way_m2 = self._speed_m2_s2 = 0.0

    @property
    def surprise(self) -> float:
        """Running mean of the innovations, in the deviations of white ones."""
        return self._mean * OF_MEAN

    @property
    def intensity_m2_s3(self) -> float:
        """Spectral density of the acceleration [m2/s3]."""
        return math.exp(self._ln_intensity)

    def judge(self, innovation: float, dt_s: float) -> bool:
        """Take an innovation, in deviations; return whether it is the one that shows a motion."""
        within = min(LARGEST, max(-LARGEST, innovation))
        self._mean += (within - self._mean) / MEAN_OF
        self._slow += (within - self._slow) / SLOW_OF
        square = (self._mean * OF_MEAN) ** 2
        if not self.moving:
            both = min(square, (self._slow * OF_SLOW) ** 2)
            self.moving = square > DETECTED or both > SLOWLY
            if self.moving:
                self._ln_intensity, self._quiet_s = FIRST, 0.0
            return self.moving
        self._square += (square - self._square) / SQUARES_OF
        rate = RISE_PER_S * max(0.0, min(square, MOST_SQUARE) - EXCEEDED) - FALL_PER_S
        rate -= QUIET_FALL_PER_S * max(0.0, 1.0 - self._square)
        self._ln_intensity = min(MOST, max(LEAST_MOVING, self._ln_intensity + rate * dt_s))
        self._quiet_s = self._quiet_s + dt_s if self._ln_intensity == LEAST_MOVING else 0.0
        if self._quiet_s > STILL_S:
            self.moving, self._ln_intensity = False, LEAST
            self.acceleration_m_s2 = self._learnt_s = 0.0
        return False

    def learn(
        self, height_m: float, force_n: float, slope_n_per_m: float, speed_m_s: float, dt_s: float
    ) -> None:
        """Take where the tip is, what it presses and how fast the surface moves.

        What the surface does is what the tip does, but for the force that is more or less than its mean: so
        it does not depend on how deep the tip is thought to be. Of a sine, its size and that of its speed
        tell the rate.
        """
        self._learnt_s += dt_s
        share = dt_s / min(self._learnt_s, LEARN_S)
        near = dt_s / min(self._learnt_s, MIDDLE_S)
        self._middle_n += near * (force_n - self._middle_n)
        place_m = height_m
        if slope_n_per_m > 0:
            place_m += (force_n - self._middle_n) / slope_n_per_m
        self._middle_m += near * (place_m - self._middle_m)
        off_m = place_m - self._middle_m
        self._way_m2 += share * (off_m * off_m - self._way_m2)
        self._speed_m2_s2 += share * (speed_m_s * speed_m_s - self._speed_m2_s2)
        self.acceleration_m_s2 = 0.0
        if self._learnt_s > LEAST_LEARN_S and self._way_m2 > 0:
            pull_per_s2 = self._speed_m2_s2 / self._way_m2
            if SLOWEST_RAD_S**2 < pull_per_s2 < FASTEST_RAD_S**2:
                self.acceleration_m_s2 = -pull_per_s2 * off_m
