# SPDX-License-Identifier: Apache-2.0
"""What the simulated acquisition adds to clean signals."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require
from tactile_resonance.record import Channel


@dataclass(frozen=True)
class BenchEffects:
    """What spoils the signals, each with a switch (or a size, 0 = off) of its own.

    Attributes
    ----------
    noise : bool
        White noise on the sensor channel, of the sensor's parameters.
    quantisation : bool
        Converters that count, and saturate; otherwise samples are floating point volts.
    nonlinearity : bool
        The static nonlinearity of the sensor's parameters.
    actuator_noise_v : float
        Rms of white noise on the recorded actuator channel [V], in its full band.
    channel_skew_s : float
        Delay of the sensor channel behind the actuator channel [s]; negative: it leads.
    hum_v, hum_frequency_hz : float
        Rms [V] and frequency of mains hum on the sensor channel; its phase follows the seed.
    offset_v, drift_v_per_s : float
        Added to the sensor channel: ``offset + drift t``, t from the start of the run.
    """

    noise: bool = True
    quantisation: bool = True
    nonlinearity: bool = False
    actuator_noise_v: float = 0.0
    channel_skew_s: float = 0.0
    hum_v: float = 0.0
    hum_frequency_hz: float = 50.0
    offset_v: float = 0.0
    drift_v_per_s: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type == "float":
                require(bool(np.isfinite(value)), field.name, value, "a finite number")
        for name in ("actuator_noise_v", "hum_v", "hum_frequency_hz"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or above")

    @classmethod
    def none(cls) -> BenchEffects:
        """Return the ideal bench: clean linear signals in floating point volts."""
        return cls(noise=False, quantisation=False)


@dataclass(frozen=True, eq=False)
class SignalParts:
    """What a block is made of, (samples,) arrays in volts.

    ``actuator = actuator_v + actuator_noise_v`` and
    ``sensor = linear_v + distortion_v + disturbance_v + noise_v``, then quantised. `disturbance_v`
    is hum, offset and drift.
    """

    actuator_v: FloatArray
    actuator_noise_v: FloatArray
    linear_v: FloatArray
    distortion_v: FloatArray
    disturbance_v: FloatArray
    noise_v: FloatArray


def convert(volts: FloatArray, scale_v: float, bits: int) -> Channel:
    """Quantise volts to signed counts, clipped to the range of the converter.

    Within range the error is at most half a count.
    """
    lowest, highest = -(2 ** (bits - 1)), 2 ** (bits - 1) - 1
    counts = np.clip(np.rint(volts * (1 / scale_v)), lowest, highest).astype(np.int32)
    saturated = bool(counts.size) and bool(counts.min() == lowest or counts.max() == highest)
    return Channel(counts, scale_v, saturated=saturated)
