# SPDX-License-Identifier: Apache-2.0
"""A recording as an acquisition device."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactile_resonance.clock import WallClock
from tactile_resonance.drivers.acquisition import DeviceError, DeviceInfo
from tactile_resonance.frf.excited import find_excited_harmonics
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Channel, Origin, Record
from tactile_resonance.recording.recording import Recording, read_recording
from tactile_resonance.recording.store import StoredEntry, StoredMeasurement, list_measurements


class ReplayDevice:
    """Plays back what was recorded, whatever it is asked for; keeps `AcquisitionDevice`.

    Parameters
    ----------
    path : Path
        Folder of a `RecordStore`: times, contact, counts and everything else come back as recorded.
        Or a ``.npz``, ``.mat`` or ``.csv`` file for `read_recording`, one measurement: its channels
        are taken as measured and band-limited and its phases as given, for it does not say; contact
        and delay stay unknown, and its blocks carry the time of the replay.
    speed : float
        Signal time over real time; 0: as fast as possible.
    entries : sequence of StoredEntry, optional
        The measurements where `path` is neither: the run of a scan, for example.

    Raises
    ------
    ValueError
        If the path holds no recording, or `speed` is negative.
    OSError
        If it cannot be opened.
    """

    def __init__(
        self, path: Path, speed: float = 1.0, entries: Sequence[StoredEntry] | None = None
    ) -> None:
        if not speed >= 0:
            raise ValueError(f"speed: {speed}, expected 0 (as fast as possible) or above")
        self._path = path
        self._speed = speed
        self._next = 0
        self._next_after = 0
        self._measurement: StoredMeasurement | None = None
        self._blocks: dict[int, Record] = {}
        self._playing: Excitation | None = None
        self._clock, self._start_ns = WallClock(), 0
        self._index = 0
        self._stopped = threading.Event()
        self._closed = False
        if entries is None and not path.is_dir():
            file = _measurement_of_file(read_recording(path), path.name)
            entries = [StoredEntry(0, path, lambda: file)]
        problems: list[str] = []
        if entries is None:
            entries, problems = list_measurements(path)
        if not entries:
            accepted = "a folder of records, or a run with one"
            raise ValueError(f"{path}: no measurement in it, expected {accepted} {problems[:3]}")
        self._entries = entries

    def plan(self, excitations: Sequence[Excitation]) -> list[Excitation]:
        """The realisations recorded, each with as many periods; see `AcquisitionDevice.plan`.

        Bands are those asked for where the recording, a file or a run of an earlier version, names none. A
        measurement that was cut off ends where it was. What was begun without a single record is passed over.
        """
        asked = excitations[0]
        self._measurement = self._find(asked)
        last = self._measurement.records[-1]
        recorded = {e.realisation: e for e in self._measurement.excitations}
        realisations = range(last.realisation + 1)
        for realisation in realisations:
            if realisation not in recorded:
                raise DeviceError(
                    f"replay: measurement {self._measurement.measurement_id}: the excitation of "
                    f"realisation {realisation + 1} is not readable {list(self._measurement.problems)}"
                )
        recorded[last.realisation] = replace(
            recorded[last.realisation], periods=last.block_index + 1
        )
        told: dict[str, Any] = {"realisations": len(realisations)}
        if not self._measurement.measurement_id:  # a file says neither
            told |= {"measurement_id": asked.measurement_id, "label": asked.label or self._path.name}
        return [
            replace(e, bands=e.bands or asked.bands, **told)
            for e in (recorded[realisation] for realisation in realisations)
        ]

    def configure(self, sample_rate_hz: float) -> DeviceInfo:
        """Check the rate."""
        if self._measurement is None:
            raise DeviceError("replay: nothing planned to play")
        record = self._measurement.records[0]
        if record.sample_rate_hz != sample_rate_hz:
            raise DeviceError(
                f"replay: sample_rate_hz: {sample_rate_hz:g}, recorded was "
                f"{record.sample_rate_hz:g}"
            )
        return DeviceInfo(f"replay of {self._path.name}", float("inf"), recorded=True)

    def play(self, excitation: Excitation) -> None:
        """Start the clock for one realisation. Only now is the measurement used up."""
        if self._measurement is None or self._closed:
            raise DeviceError("replay: nothing planned to play")
        self._playing = excitation
        self._blocks = {
            record.block_index: record
            for record in self._measurement.records
            if record.realisation == excitation.realisation
        }
        self._next = self._next_after
        self._index = 0
        self._clock = WallClock()
        self._start_ns = self._clock.now_ns()
        self._stopped.clear()

    def interrupt(self) -> None:
        """End the wait for a block."""
        self._stopped.set()

    def read_block(self, timeout_s: float) -> Record:
        """The next block, when its last sample would have been taken; a gap is an error."""
        excitation = self._playing
        if excitation is None:
            raise DeviceError("replay: nothing plays")
        index = self._index
        if self._speed > 0:
            passed_s = (self._clock.now_ns() - self._start_ns) * 1e-9
            wait_s = (index + 1) * excitation.period_s / self._speed - passed_s
            if self._stopped.wait(max(0.0, min(wait_s, timeout_s))):
                raise DeviceError("replay: stopped")
            if wait_s > timeout_s:
                raise DeviceError(f"replay: no block within {timeout_s:g} s")
        record = self._blocks.get(index)
        where = f"block {index + 1} of realisation {excitation.realisation + 1}"
        if record is None:
            raise DeviceError(f"replay: {where} is missing in {self._path}")
        n = excitation.samples_per_period
        if not record.actuator.samples.size == record.sensor.samples.size == n:
            raise DeviceError(
                f"replay: {where} has {record.actuator.samples.size} and "
                f"{record.sensor.samples.size} samples, expected one period of {n}"
            )
        self._index += 1
        begun_ns = self._start_ns + round(index * excitation.period_s * 1e9)
        time_ns = record.origin.time_ns or self._clock.ros_ns(begun_ns)
        return replace(record, origin=replace(record.origin, time_ns=time_ns))

    def stop(self) -> None:
        """End what plays."""
        self._playing = None
        self._stopped.set()

    def close(self) -> None:
        """Stop for good."""
        self._closed = True
        self.stop()

    def _find(self, asked: Excitation) -> StoredMeasurement:
        """The one named, or the next that holds a record and was driven, or silent, as is asked for."""
        measurement_id, silent = asked.measurement_id, asked.level_v == 0
        if measurement_id and self._entries[0].measurement_id:  # a file has none, and is all there is
            named = [entry for entry in self._entries if entry.measurement_id == measurement_id]
            if not named:
                raise DeviceError(f"replay: no measurement {measurement_id} in {self._path}")
            # out of turn: the turn of the others stays what it is
            self._next_after = self._next
            measurement = named[0].read()
            if not measurement.records:
                raise DeviceError(
                    f"replay: measurement {measurement_id} holds no readable record "
                    f"{list(measurement.problems)}"
                )
            if _is_silent(measurement) != silent:
                raise DeviceError(
                    f"replay: measurement {measurement_id} is silent, or the goal is: one of them"
                )
            return measurement
        for position in range(self._next, len(self._entries)):
            measurement = self._entries[position].read()
            if measurement.records and _is_silent(measurement) == silent:
                self._next_after = position + 1
                return measurement
        raise DeviceError(
            f"replay: the recording is over: all {len(self._entries)} measurements of {self._path} "
            f"were played, or are {'driven' if silent else 'silent'}"
        )


def _is_silent(measurement: StoredMeasurement) -> bool:
    played = measurement.excitations
    return bool(played) and all(excitation.level_v == 0 for excitation in played)


def _measurement_of_file(recording: Recording, label: str) -> StoredMeasurement:
    """The recording of a file as if a device had taken it; ids are 0, times unknown."""
    recording.require_repeated()  # without its period a file would be one long one
    harmonics = recording.excited_harmonics
    if harmonics is None:
        harmonics = find_excited_harmonics(Spectrum.of(recording.u, recording.y))
    realisations, periods, n = recording.u.shape
    excitations, records = [], []
    for realisation in range(realisations):
        line = np.fft.rfft(recording.u[realisation].mean(axis=0))[harmonics] / n  # (F,)
        excitations.append(
            Excitation(
                harmonics=harmonics,
                amplitude_v=2 * np.abs(line),
                phase_rad=np.angle(line),
                sample_rate_hz=recording.sample_rate_hz,
                samples_per_period=n,
                periods=periods,
                realisation=realisation,
                realisations=realisations,
                random_phases=False,
                label=label,
            )
        )
        records += [
            Record(
                actuator=Channel(recording.u[realisation, period]),
                sensor=Channel(recording.y[realisation, period]),
                sample_rate_hz=recording.sample_rate_hz,
                samples_per_period=n,
                realisation=realisation,
                block_index=period,
                origin=Origin(frame_id="", label=label),
            )
            for period in range(periods)
        ]
    return StoredMeasurement(0, tuple(excitations), tuple(records))
