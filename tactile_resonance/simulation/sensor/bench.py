# SPDX-License-Identifier: Apache-2.0
"""The simulated bench: an excitation in, blocks of sampled actuator and sensor voltage out.

`SimulatedBench.start` brings the sensor to one point, where a `BenchRun` plays one excitation after another.
What the tip touches there is one contact (`BenchTip`), or part by part what a plant reports (`ContactSoFar`).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import Checked, NotNegative, require
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Channel, Origin, Record
from tactile_resonance.sensor import SensorParameters, read_sensor
from tactile_resonance.simulation.sensor.bimorph import (
    CoupledBimorph,
    VaryingStream,
    parts_of,
    sensor_model,
)
from tactile_resonance.simulation.sensor.response import Lines, PoleResidueModel, ResponseStream
from tactile_resonance.simulation.tissue.library import (
    HertzParameters,
    Tissue,
    contact_of_radius,
    hertz_contact,
    read_tissues,
)

if TYPE_CHECKING:
    from tactile_resonance.simulation.sensor.nonlinear import NonlinearStream

NEGLIGIBLE_COUNTS = 1e-3  # of the converter
_SENSOR, _ACTUATOR, _HUM = range(3)  # independent random streams of a run


@dataclass(frozen=True)
class BenchEffects(Checked):
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
    actuator_noise_v: NotNegative = 0.0
    channel_skew_s: float = 0.0
    hum_v: NotNegative = 0.0
    hum_frequency_hz: NotNegative = 50.0
    offset_v: float = 0.0
    drift_v_per_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("channel_skew_s", "offset_v", "drift_v_per_s"):
            value = getattr(self, name)
            require(bool(np.isfinite(value)), name, value, "a finite number")

    @classmethod
    def none(cls) -> BenchEffects:
        """Return the ideal bench: clean linear signals in floating point volts."""
        return cls(noise=False, quantisation=False)


DEFAULT_EFFECTS = BenchEffects()


def convert(volts: FloatArray, scale_v: float, bits: int) -> Channel:
    """Quantise volts to signed counts, clipped to the range of the converter.

    Within range the error is at most half a count.
    """
    lowest, highest = -(2 ** (bits - 1)), 2 ** (bits - 1) - 1
    counts = np.clip(np.rint(volts * (1 / scale_v)), lowest, highest).astype(np.int32)
    saturated = bool(counts.size) and bool(counts.min() == lowest or counts.max() == highest)
    return Channel(counts, scale_v, saturated=saturated)


class BenchRun:
    """One stay of the tip at one point: excitations are played one after another, from rest.

    The state of the sensor carries over from block to block and from excitation to excitation.
    Playing the same excitation again continues its periods; another one starts a new realisation.

    Parameters
    ----------
    sensor : SensorParameters
    coupled : CoupledBimorph or callable
        The linear sensor; of a contact that changes that at each time [s] since the start, asked for no time
        beyond the block that is made. The nonlinearity is not modelled on such a contact.
    seed, effects
        As in `SimulatedBench.start`.

    Attributes
    ----------
    coupled : CoupledBimorph
        The exact linear sensor, at the start. At drives of 1 V rms and below estimates are to be compared with
        it; above, the best linear approximation of the nonlinear sensor differs.
    """

    def __init__(
        self,
        sensor: SensorParameters,
        coupled: CoupledBimorph | Callable[[float], CoupledBimorph],
        seed: int = 0,
        effects: BenchEffects = DEFAULT_EFFECTS,
    ) -> None:
        good = isinstance(seed, (int, np.integer)) and seed >= 0
        require(good, "seed", seed, "an integer, 0 or above")
        self.coupled = coupled(0.0) if callable(coupled) else coupled
        self.seed = seed
        self.effects = effects
        self._acquisition = sensor.acquisition
        skew, negligible_v = effects.channel_skew_s, self.negligible_v
        direct = PoleResidueModel(np.zeros(0, complex), np.zeros(0, complex), 1.0)
        self._drive = ResponseStream(direct, delay_s=max(0.0, -skew))
        late_s, modal = max(0.0, skew), self.coupled.modal
        self._sensor: ResponseStream | NonlinearStream | VaryingStream
        if callable(coupled):
            off = not effects.nonlinearity
            require(off, "nonlinearity", True, "off while the contact changes")
            self._sensor = VaryingStream(coupled, delay_s=late_s, negligible_v=negligible_v)
        elif effects.nonlinearity:
            # only here: it loads numba
            from tactile_resonance.simulation.sensor.nonlinear import NonlinearStream

            self._sensor = NonlinearStream(modal, sensor.nonlinear, delay_s=late_s)
        else:
            self._sensor = ResponseStream(modal, delay_s=late_s, negligible_v=negligible_v)
        self._lines: Lines | None = None
        self._realisation = -1
        self._index = 0
        self._samples = 0
        hum = np.random.SeedSequence(seed, spawn_key=(_HUM,))
        self.hum_phase_rad = float(np.random.default_rng(hum).uniform(0, 2 * np.pi))

    @property
    def negligible_v(self) -> float:
        """What a converter would not resolve [V]: no free decay is computed below it; 0: all are."""
        return NEGLIGIBLE_COUNTS * self._acquisition.sensor_scale_v * self.effects.quantisation

    def block(self, excitation: Excitation | Lines, periods: int = 1) -> Record:
        """Return the next periods of an excitation as one block; its origin's time counts from the start."""
        require(periods >= 1, "periods", periods, "1 or above")
        lines = Lines.of(excitation)
        if self._lines is None or not lines.same_signal(self._lines):
            self._lines = lines
            self._realisation += 1
            self._index = 0
        index, start_s = self._index, self._samples / lines.sample_rate_hz
        made = [self._make_period(self._lines) for _ in range(periods)]
        drive, sensed = (np.concatenate(channel) for channel in zip(*made, strict=True))
        return Record(
            actuator=self._channel(drive, self._acquisition.actuator_scale_v),
            sensor=self._channel(sensed, self._acquisition.sensor_scale_v),
            sample_rate_hz=lines.sample_rate_hz,
            samples_per_period=lines.samples_per_period,
            realisation=self._realisation,
            block_index=index,
            origin=Origin(time_ns=round(1e9 * start_s), simulated=True),
        )

    def play(self, excitation: Excitation | Lines, periods: int) -> Iterator[Record]:
        """Yield the next periods of an excitation, a block each, which is made when asked for."""
        for _ in range(periods):
            yield self.block(excitation)

    def _make_period(self, lines: Lines) -> tuple[FloatArray, FloatArray]:
        """Drive and sensor voltage over one period."""
        samples = lines.samples_per_period
        drive, clean = self._drive.play(lines), self._sensor.play(lines)
        drive_noise = self._noise(_ACTUATOR, self.effects.actuator_noise_v, samples)
        sensor_rms = self._acquisition.noise_rms_v(lines.sample_rate_hz)
        noise = self._noise(_SENSOR, sensor_rms if self.effects.noise else 0.0, samples)
        disturbance = self._disturbance(lines.sample_rate_hz, samples)
        self._index += 1
        self._samples += samples
        return drive + drive_noise, clean + disturbance + noise

    def _channel(self, volts: FloatArray, scale_v: float) -> Channel:
        if self.effects.quantisation:
            return convert(volts, scale_v, self._acquisition.adc_bits)
        return Channel(volts)

    def _noise(self, channel: int, rms_v: float, samples: int) -> FloatArray | float:
        """Return noise that depends on seed, realisation, period and channel only."""
        if rms_v == 0.0:
            return 0.0
        key = (channel, self._realisation, self._index)
        sequence = np.random.SeedSequence(self.seed, spawn_key=key)
        return rms_v * np.random.Generator(np.random.SFC64(sequence)).standard_normal(samples)

    def _disturbance(self, sample_rate_hz: float, samples: int) -> FloatArray | float:
        effects = self.effects
        if effects.hum_v == effects.offset_v == effects.drift_v_per_s == 0.0:
            return 0.0
        time_s = (self._samples + np.arange(samples)) / sample_rate_hz
        phase = 2 * np.pi * effects.hum_frequency_hz * time_s + self.hum_phase_rad
        hum = np.sqrt(2) * effects.hum_v * np.cos(phase)
        return np.asarray(hum + effects.offset_v + effects.drift_v_per_s * time_s)


@dataclass(frozen=True)
class SimulatedBench:
    """A sensor on a bench; `start` brings it into contact and returns a run.

    Examples
    --------
    >>> bench = SimulatedBench.from_configuration()
    >>> run = bench.start(read_tissues()["gel10"], seed=1)  # doctest: +SKIP
    >>> for block in run.play(excitation, periods=8):       # doctest: +SKIP
    ...     block.actuator.volts(), block.sensor.volts()
    """

    sensor: SensorParameters
    contact: HertzParameters

    @classmethod
    def from_configuration(cls) -> SimulatedBench:
        """Return the bench of ``config/sensors/bimorph.yaml`` and ``config/tissues.yaml``."""
        return cls(read_sensor(), read_tissues().contact)

    def coupled(
        self, tissue: Tissue | None, *, force_n: float | None = None, hold_time_s: float = 1.0
    ) -> CoupledBimorph:
        """Return the linear sensor in air (`tissue` None) or on tissue."""
        if tissue is None:
            return CoupledBimorph(sensor_model(self.sensor), None)
        contact = hertz_contact(
            tissue,
            self.sensor.tip.radius_m,
            self.contact,
            force_n=force_n,
            hold_time_s=hold_time_s,
        )
        return CoupledBimorph(sensor_model(self.sensor), contact)

    def start(
        self,
        tissue: Tissue | None,
        *,
        force_n: float | None = None,
        hold_time_s: float = 1.0,
        seed: int = 0,
        effects: BenchEffects = DEFAULT_EFFECTS,
    ) -> BenchRun:
        """Return a run of the sensor at rest.

        Parameters
        ----------
        tissue : Tissue or None
            None: in air.
        force_n : float, optional
            Preload [N]; that of the contact parameters by default. Not used in air.
        hold_time_s : float
            How long the preload has been held [s]; the contact creeps with it.
        seed : int
            Of everything random. The same seed gives the same samples however they are divided
            into blocks.
        effects : BenchEffects
        """
        coupled = self.coupled(tissue, force_n=force_n, hold_time_s=hold_time_s)
        return BenchRun(self.sensor, coupled, seed, effects)


@dataclass(frozen=True)
class BenchTip:
    """What the tip is in contact with.

    Attributes
    ----------
    tissue : Tissue or None
        None: air.
    force_n : float
    since_s : float
        How long the force has been held [s].
    contact_radius_m, depth_m : float
        As a plant has them [m]; NaN: those of Hertz under the force after `since_s`.
    """

    tissue: Tissue | None
    force_n: float
    since_s: float
    contact_radius_m: float = math.nan
    depth_m: float = math.nan

    def coupled(self, bench: SimulatedBench) -> CoupledBimorph:
        """The linear sensor on it."""
        if self.tissue is None or math.isnan(self.contact_radius_m):
            return bench.coupled(
                self.tissue, force_n=self.force_n or None, hold_time_s=self.since_s
            )
        contact = contact_of_radius(
            self.tissue,
            self.contact_radius_m,
            bench.contact,
            force_n=self.force_n,
            indentation_m=self.depth_m,
        )
        return CoupledBimorph(sensor_model(bench.sensor), contact)


LEAST_RADIUS_M = 1e-6
"""A contact that is lost stays one of this radius: its stiffness is below a hundredth of that at 1 cN."""

ContactState = tuple[float, float, float]
"""Mean force [N], contact radius and depth [m] along the normal over a part of time; 0 out of contact."""


class ContactSoFar:
    """Contact over time, constant in each part; beyond the last part it stays.

    A small vibration sees the contact radius alone, whatever force and motion brought it about.

    Parameters
    ----------
    bench : SimulatedBench
    start : BenchTip
        On tissue, at time 0.

    Attributes
    ----------
    parts : list of CoupledBimorph
        The linear sensor on each part so far.
    """

    def __init__(self, bench: SimulatedBench, start: BenchTip) -> None:
        self._bench, self._tip = bench, start
        self._start = start.coupled(bench)
        self._ends_s: list[float] = []
        self.parts: list[CoupledBimorph] = []

    def extend(self, length_s: float, states: Iterable[ContactState | None]) -> None:
        """Take in what followed: equal parts over `length_s`; None: the plant stood still."""
        states = list(states)
        require(length_s > 0, "length_s", length_s, "a number above 0")
        begin = self._ends_s[-1] if self._ends_s else 0.0
        for number, state in enumerate(states, 1):
            last = self.parts[-1] if self.parts else self._start
            self.parts.append(last if state is None else self._coupled(state))
            self._ends_s.append(begin + length_s * number / len(states))

    def held(self, length_s: float) -> list[ContactState]:
        """Return what follows for so long if the force of the start is held: creep as in `hertz_contact`."""
        tip, parts = self._tip, parts_of(length_s)
        begin_s, states = tip.since_s + (self._ends_s[-1] if self._ends_s else 0.0), []
        for since_s in (begin_s + (np.arange(parts) + 0.5) * length_s / parts).tolist():
            contact = replace(tip, since_s=since_s).coupled(self._bench).contact
            assert contact is not None
            states.append((contact.force_n, contact.contact_radius_m, contact.indentation_m))
        return states

    def coupled_at(self, time_s: float) -> CoupledBimorph:
        """Return the linear sensor on the contact of one time [s]."""
        if not self.parts:
            return self._start
        return self.parts[min(bisect_right(self._ends_s, time_s), len(self.parts) - 1)]

    def _coupled(self, state: ContactState) -> CoupledBimorph:
        force_n, radius_m, depth_m = state
        radius_m = max(radius_m, LEAST_RADIUS_M)
        tip = replace(self._tip, force_n=force_n, contact_radius_m=radius_m, depth_m=depth_m)
        return tip.coupled(self._bench)
