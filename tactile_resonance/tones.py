# SPDX-License-Identifier: Apache-2.0
"""Hum and other tones by name."""

from __future__ import annotations

from dataclasses import dataclass

MAINS_HZ = (50.0, 60.0)
MAINS_TOLERANCE_HZ = 0.2
"""Of a mains frequency; of its harmonics as many times as much."""
MOST_HARMONICS = 25
"""Beyond them the tolerances of all fill the axis."""


@dataclass(frozen=True)
class Tone:
    """A sinusoid that the excitation did not make.

    Attributes
    ----------
    frequency_hz : float
    rms_v : float
        In the channel that it was seen in; over several records the quadratic mean [V].
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
        mains = " or ".join(f"{hz:g}" for hz in self.mains_hz)
        hum = f"fits hum of {mains} Hz, " if mains else ""
        start = f"tone at {self.frequency_hz:.1f} Hz{what and ' ' + what}"
        return f"{start}: {hum}{self.rms_v:.2g} V rms in the {self.channel}"
