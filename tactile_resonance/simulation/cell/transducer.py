# SPDX-License-Identifier: Apache-2.0
"""A load cell on CAN that speaks as those of Robotous do.

`Transducer` is what it makes of the wrench on it: bias, drift, noise, filter, counts, overload; and its faults.

Source of the frames: Robotous, Force/Torque Sensor RFT Series, CAN manual, revision 1.7. Identifiers have 11
bits. A command is one frame; a response 16 bytes in two frames, called D1 to D16 as in the manual, whose first
byte repeats the command. A wrench is such a response.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, from_dtype, int64, njit, uint8, void
from numba.types import UniTuple
from numpy.typing import NDArray

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.vectors import Numbers
from tactile_resonance.fields import AboveZero, Checked, NotNegative, read_file, require
from tactile_resonance.simulation.noise import NormalRows, Seed

Counts = tuple[int, ...]
"""Of the six axes, and overload bits."""

SAMPLE_PERIOD_S = 0.001
"""The cell converts at 1 kHz, the fastest rate that it can send."""
LARGEST_COUNT = 32767
START = 0x0B
"""Command of the stream, which its responses repeat."""
RESPONSE_BYTES, WRENCH = 16, struct.Struct(">B6hB")
"""Of a response, and what it has of a wrench: command, six counts, overload bits."""
NO_NUMBER = -32768
"""The count of a converter that has no result."""


@dataclass(frozen=True)
class CellParameters(Checked):
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
    force_divisor: AboveZero
    torque_divisor: AboveZero
    force_noise_rms_n: NotNegative
    torque_noise_rms_nm: NotNegative
    force_range_n: AboveZero
    torque_range_nm: AboveZero
    force_bias_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque_bias_nm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    force_drift_n_per_s: float = 0.0

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


AXES = np.dtype(
    [
        *[(name, float) for name in ("range", "divisor", "drift", "offset")],
        # what the bias command takes off; of the newest reading, filtered
        *[(name, float) for name in ("zero", "signal", "noise")],
        *[(name, np.int64) for name in ("count", "overloaded", "overloads")],
    ]
)
"""What there is for each axis; of a load beyond the range: whether it is now, and how often it began."""


@njit(
    void(
        *(from_dtype(AXES)[::1], uint8[:, ::1], float64[:, ::1], *[UniTuple(float64, 6)] * 2),
        *(*[float64] * 3, *[boolean] * 3, float64, boolean, int64),
    ),
    cache=True,
)
def _convert(
    axes, responses, noise, load, before,
    start_s, span_s, keep, has_signal, has_noise, flipped, bias_step_n, stuck, z_count,
):  # fmt: skip
    """See `Transducer.convert`; behind the low-pass noise begins anywhere in its stationary state."""
    time_s = start_s
    for row in range(len(responses)):
        time_s += SAMPLE_PERIOD_S
        part, bits = (time_s - start_s) / span_s, 0
        signal_keep = keep if has_signal else 0.0
        for k in range(6):
            axis, now = axes[k], before[k] + part * (load[k] - before[k])
            axis.offset += axis.drift
            signal = now + axis.offset
            if flipped:  # the bias turns with the sign too
                signal = -signal
            if k == 2:
                signal += bias_step_n
            if has_noise:
                axis.noise = keep * axis.noise + (1 - keep) * noise[row, k]
            else:
                axis.noise = math.sqrt((1 - keep) / (1 + keep)) * noise[row, k]
            axis.signal = signal_keep * axis.signal + (1 - signal_keep) * signal
            if not stuck:
                count = (axis.signal + axis.noise - axis.zero) * axis.divisor
                axis.count = int(np.rint(max(-LARGEST_COUNT, min(LARGEST_COUNT, count))))
            told = z_count if z_count != 0 and k == 2 else axis.count
            responses[row, 1 + 2 * k], responses[row, 2 + 2 * k] = told >> 8 & 255, told & 255
            over = abs(now) > axis.range
            axis.overloads += over and not axis.overloaded
            axis.overloaded = over
            bits = bits << 1 | over
        responses[row, 0], responses[row, 13] = START, bits
        has_signal = has_noise = True


class Transducer:
    """Wrenches in, counts out, at a fixed period.

    Parameters
    ----------
    parameters : CellParameters
    seed : int
        Of the noise.
    period_s : float
        From one conversion to the next [s].

    Attributes
    ----------
    faults : CellFaults
        Its fields may be set at any time.
    """

    def __init__(
        self, parameters: CellParameters, seed: Seed = 1, *, period_s: float = SAMPLE_PERIOD_S
    ) -> None:
        self.parameters = parameters
        self.faults = CellFaults()
        p = parameters
        self._noise_rms = [p.force_noise_rms_n] * 3 + [p.torque_noise_rms_nm] * 3
        self._axes = np.zeros(6, AXES)
        self._axes["range"] = [p.force_range_n] * 3 + [p.torque_range_nm] * 3
        self._axes["divisor"] = [p.force_divisor] * 3 + [p.torque_divisor] * 3
        self._axes["drift"] = [p.force_drift_n_per_s * period_s] * 3 + [0.0] * 3
        self._axes["offset"] = [*p.force_bias_n, *p.torque_bias_nm]
        self._read = self._noisy = False  # whether there is a reading, and noise in the filter
        self._period_s, self._keep = period_s, 0.0  # of the low-pass, off
        self.reseed(seed)

    def set_low_pass(self, corner_hz: float) -> None:
        """Set the corner of the first-order low-pass [Hz]; 0: off."""
        self._keep = math.exp(-2 * math.pi * corner_hz * self._period_s) if corner_hz > 0 else 0.0

    def reseed(self, seed: Seed) -> None:
        """Take all noise from the next conversion on from a seed, that in the filter's memory too."""
        self._rows = NormalRows(seed, self._noise_rms)
        self._noisy = False

    def set_zero(self, on: bool) -> None:
        """Take the present reading as zero, or end that."""
        self._axes["zero"] = self._axes["signal"] + self._axes["noise"] if on else 0.0

    def convert(
        self, load: Numbers, before: Numbers, start_s: float, span_s: float, count: int
    ) -> NDArray[np.uint8]:
        """Convert some times, once a period.

        Parameters
        ----------
        load, before : 6 floats
            Wrench on the cell at the end and at the beginning of some time [N, N m].
        start_s, span_s : float
            When that time begins, with the conversion before, and how long it is.
        count : int

        Returns
        -------
        (count, 16) array
            Responses of the stream: counts of the six axes from the second byte on, big-endian, then overload
            bits, of which bit 5 belongs to Fx, bit 0 to Tz.
        """
        faults, z_count = self.faults, 0
        if faults.saturated or faults.invalid:
            z_count = NO_NUMBER if faults.invalid else LARGEST_COUNT
        responses = np.zeros((count, RESPONSE_BYTES), np.uint8)
        _convert(
            *(self._axes, responses, self._rows.take(count), load, before, start_s, span_s),
            *(self._keep, self._read, self._noisy, faults.flipped, faults.bias_step_n, faults.stuck),
            z_count,
        )
        self._read = self._noisy = True
        return responses

    def convert_once(self, load: Numbers) -> Counts:
        """Convert once: from the wrench on the cell, 6 [N, N m], to six counts and, last, overload bits."""
        response = self.convert(load, load, 0.0, SAMPLE_PERIOD_S, 1)
        return WRENCH.unpack_from(response.tobytes())[1:]


READ_MODEL, READ_SERIAL, READ_FIRMWARE = 0x01, 0x02, 0x03
SET_IDS, READ_IDS = 0x04, 0x05
SET_FILTER, READ_FILTER = 0x08, 0x09
READ_ONCE, STOP = 0x0A, 0x0C
SET_RATE, READ_RATE = 0x0F, 0x10
SET_BIAS, READ_OVERLOADS = 0x11, 0x12

RATES_HZ = (200, 10, 20, 50, 100, 200, 333, 500, 1000)
DECIMATIONS = tuple(round(1 / (rate_hz * SAMPLE_PERIOD_S)) for rate_hz in RATES_HZ)
"""Conversions from one wrench that is sent to the next."""
FILTERS_HZ = (0, 500, 300, 200, 150, 100, 50, 40, 30, 20, 10, 5, 3, 2, 1)
UNSUPPORTED, OUT_OF_RANGE = 1, 2
WHILE_STREAMING = (STOP, SET_BIAS)


class CanFrame(NamedTuple):
    """One frame on the bus: when it was sent (plant's clock) [s], identifier, up to 8 bytes."""

    time_s: float
    can_id: int
    data: bytes


COMMAND_ID, RESPONSE_IDS = 0x64, (0x001, 0x002)
"""Identifiers of the frames that it takes, and of those that it sends."""


class LoadCell(Transducer):
    """The cell on its bus, moved by whoever steps it.

    Attributes
    ----------
    streaming : bool
    """

    def __init__(self, parameters: CellParameters, seed: Seed = 1) -> None:
        super().__init__(parameters, seed)
        self._next_ids = (COMMAND_ID, *RESPONSE_IDS)
        self.streaming = False
        self._rate_code = self._filter_code = 0
        self._time_s: float | None = None
        self._ticks = self._sent = 0
        self._wrench: tuple[float, ...] = (0.0,) * 6
        self._response = bytes(RESPONSE_BYTES)  # its command is that of the stream

    def step(self, wrench: Iterable[float], time_s: float) -> list[CanFrame]:
        """Advance to a time of the plant, at which `wrench`, 6 [N, N m], acts on the cell.

        Between two calls the wrench runs linearly.

        Returns
        -------
        list of CanFrame
            Sent meanwhile, oldest first.
        """
        load = tuple(map(float, wrench))
        if self._time_s is None:
            self._time_s, self._wrench = time_s, load
        before, start_s, span_s = self._wrench, self._time_s, time_s - self._time_s
        frames: list[CanFrame] = []
        times_s = []
        while self._time_s + SAMPLE_PERIOD_S <= time_s + 1e-9:
            self._time_s += SAMPLE_PERIOD_S
            times_s.append(self._time_s)
        if times_s:
            told = self.convert(load, before, start_s, span_s, len(times_s)).tobytes()
            self._response = told[-RESPONSE_BYTES:]
        for number, told_s in enumerate(times_s):
            self._ticks += 1
            if self.streaming and self._ticks % DECIMATIONS[self._rate_code] == 0:
                first = number * RESPONSE_BYTES
                frames += self._wrench_frames(told[first : first + RESPONSE_BYTES], told_s)
        if load != before:
            # what is left of the span counts for the next call
            left = (time_s - self._time_s) / span_s if span_s > 0 else 0.0
            pairs = zip(load, before, strict=True)
            self._wrench = tuple([new - left * (new - old) for new, old in pairs])
        return frames

    def receive(self, can_id: int, data: bytes) -> list[CanFrame]:
        """Take one frame from the bus; return the answer, empty where the cell gives none."""
        if can_id != COMMAND_ID or not data or self.faults.silent:
            return []
        command = data[0]
        if self.streaming and command not in WHILE_STREAMING:
            return []
        parameters = [*data[1:], *[0] * 7]
        if command == START:
            self.streaming, self._ticks = True, 0
            return []
        if command == STOP:
            self.streaming = False
            return []
        if command == SET_BIAS:
            self.set_zero(bool(parameters[0]))
            return []
        if command == READ_ONCE:
            return self._wrench_frames(bytes([READ_ONCE]) + self._response[1:], self._time_s or 0.0)
        answer = bytes([command, *self._answer(command, parameters)])
        return self._frames(answer.ljust(RESPONSE_BYTES, b"\0"), self._time_s or 0.0)

    def _answer(self, command: int, parameters: list[int]) -> bytes:
        """D2 onwards."""
        if command in (READ_MODEL, READ_SERIAL, READ_FIRMWARE):
            texts = {READ_MODEL: self.parameters.name, READ_SERIAL: "SIMULATED", READ_FIRMWARE: "1.7"}
            return texts[command].encode("ascii", "replace")[:15]
        if command == SET_IDS:
            good = all(0 < i < 0x100 for i in parameters[:3]) and len(set(parameters[:3])) == 3
            if good:  # valid from the next power-up
                self._next_ids = (parameters[0], parameters[1], parameters[2])
            return _result(good)
        if command == READ_IDS:
            return bytes([COMMAND_ID, *RESPONSE_IDS, *self._next_ids])
        if command == SET_FILTER:
            kind, code = parameters[:2]
            good = kind in (0, 1) and code < len(FILTERS_HZ)
            if good:
                self._filter_code = code if kind else 0
                self.set_low_pass(FILTERS_HZ[self._filter_code])
            return _result(good)
        if command == READ_FILTER:
            return bytes([1 if self._filter_code else 0, self._filter_code])
        if command == SET_RATE:
            good = parameters[0] < len(RATES_HZ)
            if good:
                self._rate_code = parameters[0]
            return _result(good)
        if command == READ_RATE:
            return bytes([self._rate_code])
        if command == READ_OVERLOADS:
            return bytes(min(255, count) for count in self._axes["overloads"].tolist())
        return bytes([0, UNSUPPORTED])

    def _wrench_frames(self, response: bytes, time_s: float) -> list[CanFrame]:
        if self.faults.silent:
            return []
        self._sent += 1
        frames = self._frames(response, time_s)
        every = self.faults.lose_second_every
        return frames[:1] if every and self._sent % every == 0 else frames

    def _frames(self, response: bytes, time_s: float) -> list[CanFrame]:
        first, second = RESPONSE_IDS
        return [CanFrame(time_s, first, response[:8]), CanFrame(time_s, second, response[8:])]


def _result(good: bool) -> bytes:
    return bytes([1, 0]) if good else bytes([0, OUT_OF_RANGE])
