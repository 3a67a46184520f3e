# SPDX-License-Identifier: Apache-2.0
"""What a load cell makes of the wrench on it: bias, drift, noise, filter, counts, overload; and its faults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from operator import add
from pathlib import Path

from tactile_resonance.configuration import share_path
from tactile_resonance.fields import check_above_zero, check_not_negative, read_file, require
from tactile_resonance.simulation.noise import NormalRows, Seed

SAMPLE_PERIOD_S = 0.001
"""The cell converts at 1 kHz, the fastest rate that it can send."""
LARGEST_COUNT = 32767
NO_NUMBER = -32768
"""The count of a converter that has no result."""


@dataclass(frozen=True)
class CellParameters:
    """A cell's scale and errors; see ``config/load_cells``.

    Attributes
    ----------
    name : str
    force_divisor, torque_divisor : float
        Counts per N and per N m.
    force_noise_rms_n, torque_noise_rms_nm : float
        Of one conversion, white, before the filter.
    force_range_n, torque_range_nm : float
        Largest of each axis without overload.
    force_bias_n, torque_bias_nm : tuple of 3 float
        What the unloaded cell reads at the start.
    force_drift_n_per_s : float
        Of the bias, on each axis of force.
    """

    name: str
    force_divisor: float
    torque_divisor: float
    force_noise_rms_n: float
    torque_noise_rms_nm: float
    force_range_n: float
    torque_range_nm: float
    force_bias_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque_bias_nm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    force_drift_n_per_s: float = 0.0

    def __post_init__(self) -> None:
        check_above_zero(
            self, "force_divisor", "torque_divisor", "force_range_n", "torque_range_nm"
        )
        check_not_negative(self, "force_noise_rms_n", "torque_noise_rms_nm")

    @classmethod
    def from_yaml(cls, path: Path | None = None) -> CellParameters:
        """Read a file; without a path ``config/load_cells/fine.yaml``. Raises ``ValueError``."""
        path = share_path("config/load_cells/fine.yaml") if path is None else path
        return read_file(cls, path)


@dataclass
class CellFaults:
    """What is wrong with the cell at present; each can be set while it runs.

    Attributes
    ----------
    silent : bool
        Neither sends nor answers.
    stuck : bool
        Repeats its last counts.
    lose_second_every : int
        The second frame of every n-th wrench is lost; 0: none.
    invalid : bool
        The z axis has the count that means an invalid value.
    saturated : bool
        The z axis is at full scale, without an overload bit.
    flipped : bool
        Every axis has the wrong sign.
    bias_step_n : float
        Added to the z force.
    """

    silent: bool = False
    stuck: bool = False
    lose_second_every: int = 0
    invalid: bool = False
    saturated: bool = False
    flipped: bool = False
    bias_step_n: float = 0.0

    def inject(self, name: str, value: float) -> None:
        """Set a fault by its name; 0 ends it. Raises ``ValueError`` for an unknown name."""
        kinds = {f.name: type(getattr(self, f.name)) for f in fields(self)}
        require(name in kinds, "fault", name, ", ".join(kinds))
        require(math.isfinite(value), name, value, "a finite number")
        if kinds[name] is not float:
            require(value >= 0 and value == int(value), name, value, "a whole number, 0 or above")
        setattr(self, name, kinds[name](value))


class Transducer:
    """Wrenches in, counts out, at a fixed period.

    Parameters
    ----------
    parameters : CellParameters
    seed : int
        Of the noise.

    Attributes
    ----------
    faults : CellFaults
    overload_counts : list of 6 int
        How often each axis went beyond its range.
    """

    def __init__(self, parameters: CellParameters, seed: Seed = 1) -> None:
        self.parameters = parameters
        self.faults = CellFaults()
        self.overload_counts = [0] * 6
        p = parameters
        self._noise_rms = [p.force_noise_rms_n] * 3 + [p.torque_noise_rms_nm] * 3
        self._range = [p.force_range_n] * 3 + [p.torque_range_nm] * 3
        self._least_range = min(self._range)
        self._divisor = [p.force_divisor] * 3 + [p.torque_divisor] * 3
        self._drift = [p.force_drift_n_per_s * SAMPLE_PERIOD_S] * 3 + [0.0] * 3
        self._drifts = any(self._drift)
        self._offset = [*p.force_bias_n, *p.torque_bias_nm]
        self._zero = [0.0] * 6  # what the bias command subtracts
        # of the newest reading, filtered
        self._signal: list[float] | None = None
        self._noise = [0.0] * 6
        self._overloaded = 0
        self._counts = [0] * 6
        self._keep = 0.0
        self.cutoff_hz = 0.0
        self.reseed(seed)

    @property
    def cutoff_hz(self) -> float:
        """Corner of the first-order low-pass [Hz]; 0: off."""
        return self._cutoff_hz

    @cutoff_hz.setter
    def cutoff_hz(self, value: float) -> None:
        self._cutoff_hz = value
        self._keep = math.exp(-2 * math.pi * value * SAMPLE_PERIOD_S) if value > 0 else 0.0

    def reseed(self, seed: Seed) -> None:
        """Take all noise from the next conversion on from a seed, that in the filter's memory too."""
        self._rows = NormalRows(seed, self._noise_rms)
        self._noise_begins = True

    def set_zero(self, on: bool) -> None:
        """Take the present reading as zero, or end that."""
        self._zero = [0.0] * 6
        if on and self._signal is not None:
            self._zero = list(map(add, self._signal, self._noise))

    def convert(self, wrench: Sequence[float]) -> tuple[list[int], int]:
        """Convert once: from the wrench on the cell, 6 [N, N m], to six counts and overload bits.

        Bit 5 belongs to Fx, bit 0 to Tz.
        """
        faults = self.faults
        if self._drifts:
            self._offset = list(map(add, self._offset, self._drift))
        signal = list(map(add, wrench, self._offset))
        if faults.flipped:  # the bias turns with the sign too
            signal = [-value for value in signal]
        signal[2] += faults.bias_step_n
        noise = self._rows.take()
        if self._keep:
            signal, noise = self._through_filter(signal, noise)
        self._signal, self._noise, self._noise_begins = signal, noise, False
        if not faults.stuck:
            parts = zip(signal, noise, self._zero, self._divisor, strict=True)
            counts = [(value + n - zero) * divisor for value, n, zero, divisor in parts]
            if max(counts) > LARGEST_COUNT or min(counts) < -LARGEST_COUNT:
                counts = [max(-LARGEST_COUNT, min(LARGEST_COUNT, count)) for count in counts]
            self._counts = list(map(round, counts))
        result = list(self._counts)
        if faults.saturated:
            result[2] = LARGEST_COUNT
        if faults.invalid:
            result[2] = NO_NUMBER
        return result, self._overload_bits(wrench)

    def _through_filter(
        self, signal: list[float], noise: list[float]
    ) -> tuple[list[float], list[float]]:
        """Return signal and noise behind the low-pass; noise begins anywhere in its stationary state."""
        keep, take = self._keep, 1 - self._keep
        if self._noise_begins:
            noise = [math.sqrt((1 - keep) / (1 + keep)) * n for n in noise]
        else:
            noise = [keep * old + take * n for old, n in zip(self._noise, noise, strict=True)]
        if self._signal is not None:
            pairs = zip(self._signal, signal, strict=True)
            signal = [keep * old + take * value for old, value in pairs]
        return signal, noise

    def _overload_bits(self, wrench: Sequence[float]) -> int:
        bits, least = 0, self._least_range
        if max(wrench) <= least and -min(wrench) <= least:
            self._overloaded = 0
            return 0
        for load, most in zip(wrench, self._range, strict=True):
            bits = bits << 1 | (abs(load) > most)
        begun = bits & ~self._overloaded
        if begun:
            for axis in range(6):
                self.overload_counts[axis] += begun >> (5 - axis) & 1
        self._overloaded = bits
        return bits
