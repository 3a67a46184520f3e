# SPDX-License-Identifier: Apache-2.0
"""A point of the simulated bench, block by block, with all that may disturb it at once."""

from __future__ import annotations

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Channel, Record
from tactile_resonance.simulation.sensor.bench import SimulatedBench, convert
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, VaryingStream
from tactile_resonance.simulation.sensor.nonlinear import NonlinearStream
from tactile_resonance.simulation.sensor.response import Lines, ResponseStream, sample_period
from tactile_resonance.simulation.tissue.library import Tissue


class SimulatedPoint:
    """The tip on one point, from rest.

    Distortion is that of the contact as it is at first, added to the response of the contact that creeps: the
    bench has no response of both at once, and one changes the other by far less than itself.

    Parameters
    ----------
    bench : SimulatedBench
    tissue : Tissue
    force_n : float
        Of the contact.
    age_s : float
        Of the contact when the first block begins.
    seed : int
        Of the noise.
    distortion, creep : bool
        The sensor's nonlinearity; a contact that grows while it is measured.

    Attributes
    ----------
    time_s : float
        That was measured so far.
    """

    def __init__(
        self,
        bench: SimulatedBench,
        tissue: Tissue,
        force_n: float,
        age_s: float,
        *,
        seed: int,
        distortion: bool = False,
        creep: bool = False,
    ) -> None:
        self._bench, self._tissue, self._force_n, self._age_s = bench, tissue, force_n, age_s
        self._creep = creep
        self._first = self.at(0.0)
        self._stream = VaryingStream(self.at)
        self._nonlinear = None
        if distortion:
            model, nonlinear = self._first.modal, bench.sensor.nonlinear
            self._nonlinear = NonlinearStream(model, nonlinear), ResponseStream(model)
        self._rng = np.random.default_rng([seed, 7])
        self.time_s, self._blocks = 0.0, 0

    def at(self, time_s: float) -> CoupledBimorph:
        """The linear sensor, after so long."""
        if time_s and not self._creep:
            return self._first
        held_s = self._age_s + time_s
        return self._bench.coupled(self._tissue, force_n=self._force_n, hold_time_s=held_s)

    def block(self, excitation: Excitation) -> Record:
        """The next period."""
        lines, acquisition = Lines.of(excitation), self._bench.sensor.acquisition
        sensed = self._stream.play(lines)
        if self._nonlinear is not None:
            distorted, linear = self._nonlinear
            sensed = sensed + distorted.play(lines) - linear.play(lines)
        rms_v = acquisition.noise_rms_v(lines.sample_rate_hz)
        sensed = sensed + rms_v * self._rng.standard_normal(sensed.size)
        self.time_s += lines.period_s
        self._blocks += 1
        return Record(
            actuator=self._converted(sample_period(lines), acquisition.actuator_scale_v),
            sensor=self._converted(sensed, acquisition.sensor_scale_v),
            sample_rate_hz=lines.sample_rate_hz,
            samples_per_period=lines.samples_per_period,
            realisation=0,
            block_index=self._blocks - 1,
        )

    def truth(self) -> FloatArray:
        """(2,) f0 [Hz] and damping ratio in the middle of what was measured."""
        return pole_of(self.at(self.time_s / 2))

    def _converted(self, volts: FloatArray, scale_v: float) -> Channel:
        return convert(volts, scale_v, self._bench.sensor.acquisition.adc_bits)


def pole_of(coupled: CoupledBimorph, near_hz: float = 250.0) -> FloatArray:
    """(2,) f0 [Hz] and damping ratio of the mode near a frequency."""
    mode = coupled.mode_near(near_hz)
    return np.array([mode.f0_hz, mode.damping_ratio])
