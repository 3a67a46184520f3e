# SPDX-License-Identifier: Apache-2.0
"""A load cell on CAN that speaks as those of Robotous do.

Source: Robotous, Force/Torque Sensor RFT Series, CAN manual, revision 1.7. Identifiers have 11 bits. A
command is one frame; a response 16 bytes in two frames, called D1 to D16 as in the manual, whose first
byte repeats the command. A wrench is such a response.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import NamedTuple

from tactile_resonance.simulation.cell.transducer import (
    SAMPLE_PERIOD_S,
    CellParameters,
    Transducer,
)
from tactile_resonance.simulation.noise import Seed

READ_MODEL, READ_SERIAL, READ_FIRMWARE = 0x01, 0x02, 0x03
SET_IDS, READ_IDS = 0x04, 0x05
SET_FILTER, READ_FILTER = 0x08, 0x09
READ_ONCE, START, STOP = 0x0A, 0x0B, 0x0C
SET_RATE, READ_RATE = 0x0F, 0x10
SET_BIAS, READ_OVERLOADS = 0x11, 0x12

RATES_HZ = (200, 10, 20, 50, 100, 200, 333, 500, 1000)
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


class LoadCell:
    """The cell, moved by whoever steps it.

    Parameters
    ----------
    parameters : CellParameters
    seed : int
        Of its noise.

    Attributes
    ----------
    faults : CellFaults
        Its fields may be set at any time.
    streaming : bool
    """

    def __init__(self, parameters: CellParameters, seed: Seed = 1) -> None:
        self._transducer = Transducer(parameters, seed)
        self.faults = self._transducer.faults
        self._model = parameters.name
        self._next_ids = (COMMAND_ID, *RESPONSE_IDS)
        self.streaming = False
        self._rate_code = self._filter_code = 0
        self._decimation = _decimation(0)
        self._time_s: float | None = None
        self._ticks = self._sent = 0
        self._wrench: tuple[float, ...] = (0.0,) * 6
        self._counts: tuple[int, ...] = (0,) * 6
        self._bits = 0

    def reseed(self, seed: Seed) -> None:
        """Take all noise from the next conversion on from a seed, whatever was drawn before."""
        self._transducer.reseed(seed)

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
        while self._time_s + SAMPLE_PERIOD_S <= time_s + 1e-9:
            self._time_s += SAMPLE_PERIOD_S
            part = (self._time_s - start_s) / span_s
            self._counts, self._bits = self._transducer.convert(load, before, part)
            self._ticks += 1
            if self.streaming and self._ticks % self._decimation == 0:
                frames += self._wrench_frames(START)
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
            self._transducer.set_zero(bool(parameters[0]))
            return []
        if command == READ_ONCE:
            return self._wrench_frames(READ_ONCE)
        return self._frames(bytes([command, *self._answer(command, parameters)]))

    def _answer(self, command: int, parameters: list[int]) -> bytes:
        """D2 onwards."""
        if command in (READ_MODEL, READ_SERIAL, READ_FIRMWARE):
            texts = {READ_MODEL: self._model, READ_SERIAL: "SIMULATED", READ_FIRMWARE: "1.7"}
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
                self._transducer.set_low_pass(FILTERS_HZ[self._filter_code])
            return _result(good)
        if command == READ_FILTER:
            return bytes([1 if self._filter_code else 0, self._filter_code])
        if command == SET_RATE:
            good = parameters[0] < len(RATES_HZ)
            if good:
                self._rate_code = parameters[0]
                self._decimation = _decimation(self._rate_code)
            return _result(good)
        if command == READ_RATE:
            return bytes([self._rate_code])
        if command == READ_OVERLOADS:
            return bytes(min(255, count) for count in self._transducer.overload_counts)
        return bytes([0, UNSUPPORTED])

    def _wrench_frames(self, command: int) -> list[CanFrame]:
        if self.faults.silent:
            return []
        self._sent += 1
        frames = self._frames(struct.pack(">B6hB", command, *self._counts, self._bits))
        every = self.faults.lose_second_every
        return frames[:1] if every and self._sent % every == 0 else frames

    def _frames(self, response: bytes) -> list[CanFrame]:
        whole = response.ljust(16, b"\0")
        parts = zip(RESPONSE_IDS, (whole[:8], whole[8:]), strict=True)
        return [CanFrame(self._time_s or 0.0, can_id, part) for can_id, part in parts]


def _decimation(rate_code: int) -> int:
    """Conversions from one wrench that is sent to the next."""
    return round(1 / (RATES_HZ[rate_code] * SAMPLE_PERIOD_S))


def _result(good: bool) -> bytes:
    return bytes([1, 0]) if good else bytes([0, OUT_OF_RANGE])
