# SPDX-License-Identifier: Apache-2.0
"""A folder that receives every excitation and record of a device, one file each; its measurements for analysis.

``FOLDER/<number>-<measurement id>/excitation-<realisation>.npz`` and
``.../record-<realisation>-<block>.npz``; the number counts the measurements of the folder from 1.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tactile_resonance.files import PART, sync
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Record
from tactile_resonance.recording.recording import Recording, make_recording
from tactile_resonance.recording.stored_file import read_stored, write_stored

_MEASUREMENT = re.compile(r"(\d+)-(\d+)")
_EXCITATION = re.compile(r"excitation-(\d+)\.npz")
_RECORD = re.compile(r"record-(\d+)-(\d+)\.npz")
_MOST_LISTED = 20
_SAMPLE_BYTES = 8  # at most: floating point; counts take less
_FILE_BYTES = 16384  # fields beside the samples, and what the file system rounds up to


class RecordStore:
    """Writes what a device plays and reads, before anybody else sees it.

    Parameters
    ----------
    folder : Path
        Made at the first measurement where it does not exist; several runs may share it, one after the other.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._measurements: dict[int, Path] = {}
        self._known: set[int] | None = None  # ids of all that was ever here; None: not looked yet
        self._number = 0  # of the newest

    def begin(self, excitations: Sequence[Excitation]) -> None:
        """Prepare for a measurement, before anything of it is played.

        Parameters
        ----------
        excitations : sequence of Excitation
            All that will be played, with one measurement id.

        Raises
        ------
        ValueError
            If the folder holds this measurement already, or what is planned does not fit on it.
        OSError
            If the folder cannot be made or written.
        """
        key = excitations[0].measurement_id
        existed = self.folder.is_dir()
        self.folder.mkdir(parents=True, exist_ok=True)
        if not existed:
            sync(self.folder.parent)
        if self._known is None:
            entries, _ = list_measurements(self.folder)
            self._known = {entry.measurement_id for entry in entries}
            self._number = int(entries[-1].path.name.split("-")[0]) if entries else 0
        if key in self._known:
            raise ValueError(
                f"measurement_id: {key} is in {self.folder} already, expected a new one"
            )
        planned = sum(_planned_bytes(excitation) for excitation in excitations)
        free = shutil.disk_usage(self.folder).free
        if planned > free:
            raise ValueError(
                f"record_folder: {self.folder} has {free / 1e6:.0f} MB free, the measurement may "
                f"take {planned / 1e6:.0f} MB"
            )
        path = self.folder / f"{self._number + 1:06d}-{key}"
        path.mkdir()
        sync(self.folder)
        self._number += 1
        self._known.add(key)
        self._measurements[key] = path

    def add_excitation(self, excitation: Excitation) -> None:
        """Write one realisation; OSError where that fails."""
        folder = self._folder_of(excitation.measurement_id)
        write_stored(folder / f"excitation-{excitation.realisation:05d}.npz", excitation)

    def add_record(self, record: Record, written: Callable[[], None] | None = None) -> None:
        """Write one block; OSError where that fails.

        `written` is called once a kill of this process cannot lose it any more, before the disk has it.
        """
        folder = self._folder_of(record.origin.measurement_id)
        name = f"record-{record.realisation:05d}-{record.block_index:07d}.npz"
        write_stored(folder / name, record, written)

    def remove(self, measurement_id: int) -> None:
        """Remove a measurement that this store received and that is safe elsewhere; others stay."""
        path = self._measurements.pop(measurement_id, None)
        if path is not None:
            shutil.rmtree(path, ignore_errors=True)

    def _folder_of(self, measurement_id: int) -> Path:
        if measurement_id not in self._measurements:
            raise ValueError(f"measurement_id: {measurement_id}, expected one that was begun")
        return self._measurements[measurement_id]


@dataclass(frozen=True)
class StoredMeasurement:
    """What is readable of one measurement.

    Attributes
    ----------
    measurement_id : int
    excitations : tuple of Excitation
        By realisation.
    records : tuple of Record
        By realisation and block.
    problems : tuple of str
        Damaged and foreign files, by name.
    """

    measurement_id: int
    excitations: tuple[Excitation, ...]
    records: tuple[Record, ...]
    problems: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        measurement_id: int,
        excitations: Iterable[Excitation],
        records: Iterable[Record],
        problems: Iterable[str],
    ) -> StoredMeasurement:
        """From excitations and records in any order; of those of one place the last counts."""
        played = {excitation.realisation: excitation for excitation in excitations}
        taken = {(record.realisation, record.block_index): record for record in records}
        in_order = (
            tuple(played[m] for m in sorted(played)),
            tuple(taken[at] for at in sorted(taken)),
        )
        return cls(measurement_id, *in_order, tuple(problems))

    @property
    def gaps(self) -> tuple[tuple[int, int], ...]:
        """(realisation, block) of what is missing before the last record; an early end is no gap."""
        if not self.records:
            return ()
        planned = {excitation.realisation: excitation for excitation in self.excitations}
        seen = {(record.realisation, record.block_index) for record in self.records}
        last = self.records[-1]
        expected = []
        for realisation in range(last.realisation + 1):
            blocks = 1 + max((b for m, b in seen if m == realisation), default=-1)
            if realisation < last.realisation and realisation in planned:
                n = planned[realisation].samples_per_period
                periods = max(1, last.actuator.samples.size // n)  # in each block
                blocks = max(blocks, -(-planned[realisation].periods // periods))
            expected += [(realisation, block) for block in range(blocks)]
        return tuple(place for place in expected if place not in seen)


@dataclass(frozen=True)
class StoredEntry:
    """One measurement of a store or a run: id, folder or file, what reads all readable of it, and its place.

    `read` raises ValueError where nothing is readable, OSError where it cannot be listed.
    """

    measurement_id: int
    path: Path
    read: Callable[[], StoredMeasurement]
    place: str = ""


def choose(entries: Sequence[StoredEntry], measurement_id: int | None, where: Path) -> StoredEntry:
    """The entry of an id, or the only one where none is named; ValueError that lists what is there."""
    by_id = {entry.measurement_id: entry for entry in entries}
    named = [f"{key} ({entry.place})" if entry.place else f"{key}" for key, entry in by_id.items()]
    ids = ", ".join(named[:_MOST_LISTED]) or "none"
    if len(by_id) > _MOST_LISTED:
        ids += f" and {len(by_id) - _MOST_LISTED} more"
    if measurement_id is None and len(entries) == 1:
        return entries[0]
    if measurement_id not in by_id:
        asked = "not given" if measurement_id is None else measurement_id
        raise ValueError(f"measurement_id: {asked}, {where} holds {ids}")
    return by_id[measurement_id]


def list_measurements(folder: Path) -> tuple[list[StoredEntry], list[str]]:
    """Measurements of a store in order, and what else lies there; OSError if unreadable."""
    found, problems = [], []
    for path in folder.iterdir():
        match = _MEASUREMENT.fullmatch(path.name)
        if match and path.is_dir():
            found.append((int(match[1]), int(match[2]), path))
        else:
            problems.append(f"{path.name}: not a measurement of a store")
    entries = [StoredEntry(key, path, partial(_read, path, key)) for _, key, path in sorted(found)]
    return entries, sorted(problems)


def _read(folder: Path, measurement_id: int) -> StoredMeasurement:
    excitations: list[Excitation] = []
    records: list[Record] = []
    problems: list[str] = []
    for path in sorted(folder.iterdir()):
        name = path.name.removesuffix(PART)
        try:
            if match := _EXCITATION.fullmatch(name):
                excitation = read_stored(path, Excitation)
                found: tuple[int, ...] = (excitation.measurement_id, excitation.realisation)
                _check_name(path, found, (measurement_id, int(match[1])))
                excitations.append(excitation)
            elif match := _RECORD.fullmatch(name):
                record = read_stored(path, Record)
                found = (record.origin.measurement_id, record.realisation, record.block_index)
                _check_name(path, found, (measurement_id, int(match[1]), int(match[2])))
                records.append(record)
            else:
                raise ValueError(f"{path.name}: neither excitation nor record")
        except ValueError as error:
            # else it was being written when its writer ended; nobody has seen it
            if name == path.name:
                problems.append(f"{folder.name}/{error}")
    return StoredMeasurement.of(measurement_id, excitations, records, problems)


def _planned_bytes(excitation: Excitation) -> int:
    block = 2 * _SAMPLE_BYTES * excitation.samples_per_period + _FILE_BYTES
    return excitation.periods * block + 3 * 8 * excitation.harmonics.size + _FILE_BYTES


def _check_name(path: Path, found: tuple[int, ...], named: tuple[int, ...]) -> None:
    if found != named:
        raise ValueError(f"{path.name}: holds what belongs to {found}, its name says {named}")


def read_store_recording(
    folder: Path, measurement_id: int | None = None, periods: int | None = None
) -> Recording:
    """One measurement of a store, ready for analysis.

    Parameters
    ----------
    folder : Path
    measurement_id : int, optional
        Which one; not needed where there is only one.
    periods : int, optional
        Use the first this many of each realisation; when absent all that were planned, or as many as the
        longest one has where the measurement ended before.

    Returns
    -------
    Recording
        Realisations of which every period is there; its notes name what was left out.

    Raises
    ------
    ValueError
        If the measurement is not named or not there, or no realisation has the periods wanted, or any.
    OSError
        If the folder cannot be listed.
    """
    entries, problems = list_measurements(folder)
    if not entries:
        found = f" ({'; '.join(problems[:3])})" if problems else ""
        raise ValueError(f"{folder}: no measurement in it, expected a folder of records{found}")
    return recording_of(choose(entries, measurement_id, folder).read(), periods)


def recording_of(measurement: StoredMeasurement, periods: int | None = None) -> Recording:
    """A measurement that was read, as `read_store_recording` gives it.

    Raises
    ------
    ValueError
        If no realisation has the periods asked for, or any.
    """
    key = measurement.measurement_id
    if not measurement.excitations:
        raise ValueError(f"measurement {key}: holds no readable excitation {measurement.problems}")
    first = measurement.excitations[0]
    notes = [*measurement.problems]
    played: list[tuple[Excitation, npt.NDArray, npt.NDArray]] = []
    for excitation in measurement.excitations:
        if excitation.sample_rate_hz != first.sample_rate_hz or not np.array_equal(
            [excitation.samples_per_period, *excitation.harmonics],
            [first.samples_per_period, *first.harmonics],
        ):
            raise ValueError(
                f"measurement {key}: realisation {excitation.realisation + 1} differs from realisation "
                f"{first.realisation + 1} in sample rate, period or lines, expected the same"
            )
        blocks = _leading_blocks(measurement, excitation.realisation)
        n = excitation.samples_per_period
        u, y = (
            np.concatenate([np.empty(0, np.float32), *(getattr(b, name).volts() for b in blocks)])
            for name in ("actuator", "sensor")
        )
        whole = min(u.size, y.size) // n
        u, y = (x[: whole * n].reshape(whole, n) for x in (u, y))
        played.append((excitation, u, y))
    wanted, longest = periods or first.periods, max(len(u) for _, u, _ in played)
    if periods is None and 0 < longest < wanted:
        notes.append(f"the measurement ended after {longest} of {wanted} periods")
        wanted = longest
    for excitation, u, _ in played:
        if len(u) < wanted:
            notes.append(
                f"realisation {excitation.realisation + 1} left out: {len(u)} of {wanted} consecutive "
                "periods are there"
            )
    channels = [(u[:wanted], y[:wanted]) for _, u, y in played if len(u) >= wanted]
    if len(measurement.excitations) < first.realisations:
        notes.append(
            f"{len(measurement.excitations)} of {first.realisations} realisations were played"
        )
    if not channels:
        raise ValueError(
            f"measurement {key}: no complete realisation ({'; '.join(notes)}), expected one, or "
            "fewer periods requested"
        )
    recording = make_recording(
        np.stack([u for u, _ in channels]),  # (M, P, N)
        np.stack([y for _, y in channels]),
        sample_rate_hz=first.sample_rate_hz,
        samples_per_period=first.samples_per_period,
        excited_harmonics=first.harmonics,
    )
    return replace(recording, notes=tuple(notes))


def _leading_blocks(measurement: StoredMeasurement, realisation: int) -> list[Record]:
    """Blocks of a realisation up to the first gap."""
    mine = [record for record in measurement.records if record.realisation == realisation]
    return [record for index, record in enumerate(mine) if record.block_index == index]
