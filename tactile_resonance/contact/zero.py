# SPDX-License-Identifier: Apache-2.0
"""The zero of a force source from one contact to the next: a random walk that is seen while the tip is in air.

Between two looks its variance grows with time; each look, a mean of forces in air, lowers it (the scalar Kalman
filter of a local level, one for each axis). What a look shows beyond both deviations is no walk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.tare import Tare

STEPPED = 4.0
"""Deviations beyond which the zero has not walked, but stepped."""


@dataclass(frozen=True)
class Zero:
    """What was known of the zero.

    Attributes
    ----------
    force_n : (3,) array
        In the frame `tip`.
    std_n : (3,) array
    time_ns : int
        When, on the clock of the samples.
    """

    force_n: FloatArray
    std_n: FloatArray
    time_ns: int

    def with_look(self, look: Tare, time_ns: int, walk_n_per_sqrt_s: float) -> Zero | None:
        """The zero after one more look at it; None where it has stepped.

        Parameters
        ----------
        look : Tare
            Forces in air.
        time_ns : int
        walk_n_per_sqrt_s : float
            Of the random walk [N/sqrt(s)].
        """
        passed_s = max(0.0, (time_ns - self.time_ns) * 1e-9)
        variance = self.std_n**2 + walk_n_per_sqrt_s**2 * passed_s
        seen = look.force_std_n**2
        off = look.force_n - self.force_n
        if np.any(off**2 > STEPPED**2 * (variance + seen)):
            return None
        gain = variance / (variance + seen)
        return Zero(self.force_n + gain * off, np.sqrt(gain * seen), time_ns)
