# SPDX-License-Identifier: Apache-2.0
"""A folder that receives every excitation and record of a device, one file each; its measurements for analysis.

Each is there whole or not at all, and bit-exact:
``FOLDER/<number>-<measurement id>/excitation-<realisation>.npz`` and
``.../record-<realisation>-<block>.npz``; the number counts the measurements of the folder from 1.
"""

from __future__ import annotations

import io
import re
import shutil
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from enum import Enum
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np
import numpy.typing as npt

from tactile_resonance.fields import one_line
from tactile_resonance.files import PART, sync, write_whole
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import SIMULATED, Origin, Record
from tactile_resonance.recording.recording import Recording, make_recording

T = TypeVar("T", Excitation, Record)
Fields = dict[str, npt.NDArray[Any]]

_FORMAT = "tactile_resonance {} 1"
_ORIGIN = "origin."
_DTYPE = ":dtype"  # suffix of the field that names the integer type an array had
_DAMAGE = (ValueError, TypeError, KeyError, EOFError, OSError, NotImplementedError, RuntimeError,
           SyntaxError, MemoryError, tokenize.TokenError, zipfile.BadZipFile, zlib.error)  # fmt: skip
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

    def add_record(
        self,
        record: Record,
        written: Callable[[], None] | None = None,
        origin: Callable[[], Origin] | None = None,
    ) -> None:
        """Write one block; OSError where that fails.

        `written` is called once a kill of this process cannot lose it any more, before the disk has it. An
        `origin` that is known later than the samples is asked for once all else is packed.
        """
        folder = self._folder_of(record.origin.measurement_id)
        name = f"record-{record.realisation:05d}-{record.block_index:07d}.npz"
        write_stored(folder / name, record, written, origin)

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
        """From excitations and records in any order; of those of one place the last counts.

        A record whose channels differ in length is none: what follows it would be shifted in one of them.
        """
        played = {excitation.realisation: excitation for excitation in excitations}
        taken, found = dict[tuple[int, int], Record](), [*problems]
        for record in records:
            place = record.realisation, record.block_index
            u, y = record.actuator.samples.size, record.sensor.samples.size
            if u == y:
                taken[place] = record
            else:
                which = f"block {place[1] + 1} of realisation {place[0] + 1}"
                found.append(f"{which}: {u} samples of the actuator, {y} of the sensor, expected as many")
        in_order = (
            tuple(played[m] for m in sorted(played)),
            tuple(taken[at] for at in sorted(taken)),
        )
        return cls(measurement_id, *in_order, tuple(found))

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


def read_measurement(folder: Path, measurement_id: int | None = None) -> StoredMeasurement:
    """One measurement of a store, ready for `recording_of`.

    Parameters
    ----------
    folder : Path
    measurement_id : int, optional
        Which one; not needed where there is only one.

    Raises
    ------
    ValueError
        If the measurement is not named or not there.
    OSError
        If the folder cannot be listed.
    """
    entries, problems = list_measurements(folder)
    if not entries:
        found = f" ({'; '.join(problems[:3])})" if problems else ""
        raise ValueError(f"{folder}: no measurement in it, expected a folder of records{found}")
    return choose(entries, measurement_id, folder).read()


def recording_of(measurement: StoredMeasurement, periods: int | None = None) -> Recording:
    """A measurement that was read, ready for analysis; realisations of which every period is there.

    Its notes name what was left out.

    Parameters
    ----------
    measurement : StoredMeasurement
    periods : int, optional
        Use the first this many of each realisation; when absent all that were planned, or as many as the
        longest one has where the measurement ended before.

    Raises
    ------
    ValueError
        If no realisation has the periods wanted, or any.
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
        mine = [each for each in measurement.records if each.realisation == excitation.realisation]
        blocks = [each for index, each in enumerate(mine) if each.block_index == index]  # to the first gap
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
        ended = f"the measurement ended after {longest} of {wanted} periods"
        if gaps := measurement.gaps:
            realisation, block = gaps[0]
            ended = (
                f"{longest} of {wanted} consecutive periods are used: block {block + 1} of realisation "
                f"{realisation + 1} is missing"
            )
        notes.append(ended)
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
    notes += _stated(measurement.records)
    recording = make_recording(
        np.stack([u for u, _ in channels]),  # (M, P, N)
        np.stack([y for _, y in channels]),
        sample_rate_hz=first.sample_rate_hz,
        samples_per_period=first.samples_per_period,
        excited_harmonics=first.harmonics,
    )
    return replace(recording, notes=tuple(notes))


def _stated(records: Sequence[Record]) -> Iterator[str]:
    """What records say of themselves that a recording has no field for."""
    if any(each.origin.simulated for each in records):
        yield SIMULATED
    for name in ("actuator", "sensor"):
        if any(getattr(each, name).saturated for each in records):
            yield f"{name} saturated"
    delays_s = {each.channel_delay_s for each in records}
    for delay_s in sorted(delay_s for delay_s in delays_s if np.isfinite(delay_s) and delay_s != 0):
        yield (
            f"the sensor channel is {delay_s:.6g} s behind the actuator channel, as the records state: it is "
            "taken out only where channel_delay_s (--channel-delay) gives it"
        )


def write_stored(
    path: Path,
    value: Excitation | Record,
    written: Callable[[], None] | None = None,
    origin: Callable[[], Origin] | None = None,
) -> None:
    """Write one object durably: a reader, or a power cut, finds the whole file or none.

    Parameters
    ----------
    path : Path
        In a folder that exists; a file of this name is replaced.
    value : Excitation or Record
        Each field becomes one array named after it (``origin.contact.force_n``). Integer arrays are
        held in the smallest signed type that holds them exactly.
    written : callable, optional
        See `write_whole`.
    origin : callable, optional
        Gives the origin of a record, in place of its own; called once all else is packed.

    Raises
    ------
    ValueError
        If an array is neither of signed integers nor floating point.
    OSError
        If it cannot be written; nothing is left behind, unless `written` was called.
    """
    content: Fields = {"format": np.array(_FORMAT.format(type(value).__name__))}
    last: Fields = {}
    _flatten("", value, content)
    if origin is not None:
        content = {name: content[name] for name in content if not name.startswith(_ORIGIN)}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:  # as numpy.savez, in a third of the time less
        _pack(archive, content)
        if origin is not None:
            _flatten(_ORIGIN, origin(), last)
        # a damaged zip directory can lose a field without an error
        last["fields"] = np.array(sorted([*content, *last]))
        _pack(archive, last)
    write_whole(path, buffer.getvalue(), written)
    sync(path.parent)


def _pack(archive: zipfile.ZipFile, content: Fields) -> None:
    for name, array in content.items():
        archive.writestr(f"{name}.npy", _header(array.dtype.str, array.shape) + array.tobytes())


def read_stored(path: Path, kind: type[T]) -> T:
    """What `write_stored` wrote.

    Raises
    ------
    ValueError
        If the file is damaged or something else; one line that names it.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = {name: archive[name] for name in archive.files}
        if str(content.get("format")) != _FORMAT.format(kind.__name__):
            raise ValueError(f"no {kind.__name__} of format 1")
        if sorted(content.keys() - {"fields"}) != content["fields"].tolist():
            raise ValueError("a field is lost")
        return _unflatten("", kind, content)
    except _DAMAGE as error:
        reason = one_line(error)[:120]
        raise ValueError(f"{path.name}: damaged or foreign file ({reason})") from error


@lru_cache(maxsize=256)
def _header(dtype: str, shape: tuple[int, ...]) -> bytes:
    """What stands before the values of an array of C order in an .npy file."""
    header = io.BytesIO()
    described = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, described)
    return header.getvalue()


def _flatten(prefix: str, value: Any, content: Fields) -> None:
    for field in fields(value):
        name, item = prefix + field.name, getattr(value, field.name)
        if is_dataclass(item):
            _flatten(f"{name}.", item, content)
        elif isinstance(item, tuple) and item and is_dataclass(item[0]):
            for part in fields(item[0]):
                content[f"{name}.{part.name}"] = np.array(
                    [getattr(each, part.name) for each in item]
                )
        elif isinstance(item, np.ndarray):
            content[name] = item
            if item.dtype.kind == "i":
                content[name + _DTYPE] = np.array(item.dtype.str)
                # -1 - n needs as many bits as n
                low, high = int(item.min(initial=0)), int(item.max(initial=0))
                content[name] = item.astype(np.min_scalar_type(min(low, -1 - high)))
            elif item.dtype.kind != "f":
                raise ValueError(f"{name}: values of type {item.dtype}, expected int or float")
        elif isinstance(item, Enum):
            content[name] = np.array(item.value)
        elif item is not None and item != ():  # no field of what is not there
            content[name] = np.array(item)


def _unflatten(prefix: str, kind: type, content: Mapping[str, npt.NDArray[Any]]) -> Any:
    hints = get_type_hints(kind)
    values: dict[str, Any] = {}
    for field in fields(kind):
        name, hint = prefix + field.name, hints[field.name]
        if is_dataclass(hint):
            values[field.name] = _unflatten(f"{name}.", hint, content)  # type: ignore[arg-type]
            continue
        if get_args(hint) and is_dataclass(part := get_args(hint)[0]):  # a tuple of them
            columns = [
                content.get(f"{name}.{each.name}", np.empty(0)).tolist() for each in fields(part)
            ]
            values[field.name] = tuple(part(*row) for row in zip(*columns, strict=True))  # type: ignore[operator]
            continue
        array = content.get(name)
        if array is None:
            # a file may be older than the field
            if field.default is MISSING:
                raise ValueError(f"{name} is missing")
        elif name + _DTYPE in content:
            values[field.name] = array.astype(np.dtype(str(content[name + _DTYPE])), casting="safe")
        elif array.ndim == 0:
            is_enum = isinstance(hint, type) and issubclass(hint, Enum)
            values[field.name] = hint(array.item()) if is_enum else array.item()
        else:
            is_tuple = str(field.type).startswith("tuple")
            values[field.name] = tuple(array.tolist()) if is_tuple else array
    return kind(**values)
