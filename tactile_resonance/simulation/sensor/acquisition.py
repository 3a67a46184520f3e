# SPDX-License-Identifier: Apache-2.0
"""What the simulated acquisition adds to clean signals, and the blocks it hands out."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.fields import require
from tactile_resonance.simulation.sensor.linear import FloatArray


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
class ChannelSamples:
    """Samples of one channel: counts with a scale, or volts.

    Attributes
    ----------
    counts : (samples,) int32 array or None
        None where the channel is not quantised.
    scale_v : float
        Volts per count; 0 without counts.
    volts : (samples,) float array
        The samples in volts, whichever way they were taken.
    saturated : bool
        A sample stands at the end of the converter's range.
    """

    counts: NDArray[np.int32] | None
    scale_v: float
    volts: FloatArray
    saturated: bool


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


@dataclass(frozen=True, eq=False)
class Block:
    """Simulated samples of both channels over whole periods.

    Attributes
    ----------
    realisation : int
        Counts the excitations of the run, from 0.
    index : int
        Index of the first period within the realisation, from 0.
    start_time_s : float
        Time of the first sample since the start of the run.
    sample_rate_hz : float
    samples_per_period : int
    actuator, sensor : ChannelSamples
    parts : SignalParts or None
        Where the run keeps them.
    """

    realisation: int
    index: int
    start_time_s: float
    sample_rate_hz: float
    samples_per_period: int
    actuator: ChannelSamples
    sensor: ChannelSamples
    parts: SignalParts | None

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.sensor.volts.size


def convert(volts: FloatArray, scale_v: float, bits: int) -> ChannelSamples:
    """Quantise volts to signed counts, clipped to the range of the converter.

    Within range the error is at most half a count.
    """
    lowest, highest = -(2 ** (bits - 1)), 2 ** (bits - 1) - 1
    counts = np.clip(np.rint(volts * (1 / scale_v)), lowest, highest).astype(np.int32)
    saturated = bool(counts.size) and bool(counts.min() == lowest or counts.max() == highest)
    return ChannelSamples(counts, scale_v, counts.astype(float) * scale_v, saturated)


def join(blocks: list[Block]) -> Block:
    """Join consecutive blocks of one realisation into one."""
    require(len(blocks) > 0, "blocks", len(blocks), "one block or more")
    first = blocks[0]
    if len(blocks) == 1:
        return first
    parts = [block.parts for block in blocks if block.parts is not None]
    joined_parts = None
    if parts:
        joined_parts = SignalParts(
            *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(SignalParts))
        )
    return Block(
        first.realisation,
        first.index,
        first.start_time_s,
        first.sample_rate_hz,
        first.samples_per_period,
        _join_channel([block.actuator for block in blocks]),
        _join_channel([block.sensor for block in blocks]),
        joined_parts,
    )


def _join_channel(channels: list[ChannelSamples]) -> ChannelSamples:
    counts = [channel.counts for channel in channels if channel.counts is not None]
    return ChannelSamples(
        np.concatenate(counts) if counts else None,
        channels[0].scale_v,
        np.concatenate([channel.volts for channel in channels]),
        any(channel.saturated for channel in channels),
    )
