# SPDX-License-Identifier: Apache-2.0
"""Hum and other tones by name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special
from scipy.ndimage import median_filter

from tactile_resonance._typing import BoolArray, FloatArray

MAINS_HZ = (50.0, 60.0)
MAINS_TOLERANCE_HZ = 0.2
"""Of a mains frequency; of its harmonics as many times as much."""
MOST_HARMONICS = 25
"""Beyond them the tolerances of all fill the axis."""
FEWEST_AROUND = 8
"""Fewer powers give no level."""
ROUNDING = 1e-14
"""Of the power of a signal: what is smaller is no tone."""


@dataclass(frozen=True)
class Tone:
    """A sinusoid that the excitation did not make.

    Attributes
    ----------
    frequency_hz : float
    rms_v : float
        In the channel that it was seen in; over several records the quadratic mean [V]. NaN where it is
        not known.
    channel : str
        ``actuator`` or ``sensor``.
    resolution_hz : float
        Of the record: one over its length.
    """

    frequency_hz: float
    rms_v: float
    channel: str
    resolution_hz: float

    @property
    def mains_hz(self) -> tuple[float, ...]:
        """Mains frequencies of which it may be a harmonic."""
        fitting = []
        for mains in MAINS_HZ:
            k = round(self.frequency_hz / mains)
            away = abs(self.frequency_hz - k * mains)
            if 1 <= k <= MOST_HARMONICS and away <= k * MAINS_TOLERANCE_HZ + self.resolution_hz / 2:
                fitting.append(mains)
        return tuple(fitting)

    def text(self, what: str = "") -> str:
        """Such as ``tone at 250.0 Hz left out: fits hum of 50 Hz, 7e-05 V rms in the sensor``."""
        volts = f"{self.rms_v:.2g} V rms in the {self.channel}" if self.rms_v > 0 else ""
        mains = " or ".join(f"{hz:g}" for hz in self.mains_hz)
        hum = f"fits hum of {mains} Hz" if mains else ""
        start = f"tone at {self.frequency_hz:.1f} Hz{what and ' ' + what}"
        return ": ".join(filter(None, [start, ", ".join(filter(None, [hum, volts]))]))


def level_around(
    power: FloatArray, kind: BoolArray, records: int, window: int
) -> tuple[FloatArray, int]:
    """(K,) mean power of noise at each bin by the median of those of a kind around.

    And how many these are; level and number are zero where there are too few.

    Parameters
    ----------
    power : (K,) float
        Means over records.
    kind : (K,) bool
    records : int
    window : int
        How many bins of the kind count as around.
    """
    at = np.flatnonzero(kind)
    around = min(window, at.size)
    if around < FEWEST_AROUND:
        return np.zeros(power.size), 0
    if around < window or window % 2 == 0:
        medians = np.median(np.lib.stride_tricks.sliding_window_view(power[at], around), axis=-1)
    else:
        half = around // 2
        medians = median_filter(power[at], around)[half : at.size - half]
    nearest = np.searchsorted(at, np.arange(power.size))
    first = np.clip(nearest - around // 2, 0, medians.size - 1)
    return medians[first] * (records / special.gammaincinv(records, 0.5)), around
