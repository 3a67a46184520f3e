# SPDX-License-Identifier: Apache-2.0
"""How living tissue moves under the tip: breath and heartbeat, in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tactile_resonance.fields import check_not_negative, check_within


@dataclass(frozen=True)
class SurfaceMotion:
    """Displacement of a surface along its outward normal, as a function of time.

    Breath is ``b cos^{2n}(pi f t + phase)`` (Lujan, Larsen, Balter & Ten Haken, Med. Phys. 26 (1999) 715):
    0 and quiet at end-expiration, b at end-inspiration. The heartbeat is a sinusoid about it.

    Attributes
    ----------
    breath_m : float
        Peak to peak, b [m].
    breath_hz : float
        f [Hz].
    breath_power : int
        n, 1 to 3: the larger, the longer it is quiet at end-expiration.
    heart_m : float
        Peak to peak [m].
    heart_hz : float
    phase_seed : int
        Of both phases at time 0, uniform.
    """

    breath_m: float = 0.0
    breath_hz: float = 0.25
    breath_power: int = 3
    heart_m: float = 0.0
    heart_hz: float = 1.2
    phase_seed: int = 1

    def __post_init__(self) -> None:
        check_within(self, breath_m=(0, 0.02), heart_m=(0, 0.005))  # peak to peak
        check_within(self, breath_hz=(0.05, 2.0), heart_hz=(0.3, 10.0), breath_power=(1, 3))
        check_not_negative(self, "phase_seed")

    @cached_property
    def phases_rad(self) -> tuple[float, float]:
        """Of breath and heart at time 0; a breath is over after pi of the first."""
        breath, heart = np.random.default_rng(self.phase_seed).uniform(0, 1, 2).tolist()
        return math.pi * breath, 2 * math.pi * heart

    def displacement_m(self, time_s: float) -> float:
        """Of the surface at a time [m]; 0 is end-expiration between two heartbeats."""
        breath, heart = self._turns(time_s)
        rise = self.breath_m * math.cos(breath) ** (2 * self.breath_power)
        return rise + self.heart_m / 2 * math.sin(heart)

    def velocity_m_s(self, time_s: float) -> float:
        """Time derivative of the displacement [m/s]."""
        breath, heart = self._turns(time_s)
        n = self.breath_power
        steepness = -2 * n * math.cos(breath) ** (2 * n - 1) * math.sin(breath)
        rise = self.breath_m * steepness * math.pi * self.breath_hz
        return rise + self.heart_m * math.pi * self.heart_hz * math.cos(heart)

    def _turns(self, time_s: float) -> tuple[float, float]:
        breath, heart = self.phases_rad
        return (
            breath + math.pi * self.breath_hz * time_s,
            heart + 2 * math.pi * self.heart_hz * time_s,
        )
