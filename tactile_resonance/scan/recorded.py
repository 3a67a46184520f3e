# SPDX-License-Identifier: Apache-2.0
"""Excitations and records out of a run's recording, bit by bit what the nodes sent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Record
from tactile_resonance.recording.messages import excitation_from_message, record_from_message
from tactile_resonance.recording.store import StoredMeasurement, gaps_of
from tactile_resonance.scan.point_file import read_messages_of_type
from tactile_resonance.scan.point_result import (
    POLES_TYPE,
    TYPE,
    PointResult,
    from_message,
    serialised,
)
from tactile_resonance.scan.run_content import RECORDING, RunContent, read_run

EXCITATION = "tactile_resonance/msg/Excitation"
RECORD = "tactile_resonance/msg/Record"
_MOST_LISTED = 20


def read_recorded(run: Path, measurement_id: int | None = None) -> StoredMeasurement:
    """One measurement of a run, ready for `recording_of` or to be played again.

    Parameters
    ----------
    run : Path
        Folder of a run.
    measurement_id : int, optional
        Column of ``results.csv``; not needed where only one point has one.

    Raises
    ------
    ValueError
        If it is not a run, or the measurement is not named or not there.
    """
    source = RunSource(run)
    by_id = {entry.measurement_id: entry for entry in source.entries}
    ids = ", ".join(str(key) for key in list(by_id)[:_MOST_LISTED])
    if len(by_id) > _MOST_LISTED:
        ids += f" and {len(by_id) - _MOST_LISTED} more"
    points = [entry.measurement_id for entry in source.entries if not entry.reference]
    if measurement_id is None and len(points) == 1:
        (measurement_id,) = points
    if measurement_id is None:
        raise ValueError(f"measurement_id: not given, {run} holds {ids or 'none'}")
    if measurement_id not in by_id:
        raise ValueError(f"measurement_id: {measurement_id}, {run} holds {ids or 'none'}")
    return source.read(by_id[measurement_id])


@dataclass(frozen=True)
class RecordedEntry:
    """One measurement of a run: its id and file, and whether it is a reference, in free air."""

    measurement_id: int
    path: Path
    reference: bool = False


class RunSource:
    """The measurements of a run, in the order in which they were taken, for a device that plays them again.

    Parameters
    ----------
    run : Path

    Raises
    ------
    ValueError
        If it is no run.
    """

    def __init__(self, run: Path) -> None:
        content = read_run(run)
        points = {file_of(run, result) for result in content.results}
        self.entries: list[RecordedEntry] = []
        for path in files_in_order(content):
            reference = path not in points
            self.entries += [RecordedEntry(key, path, reference) for key in _ids_of(path)]

    def read(self, entry: RecordedEntry) -> StoredMeasurement:
        """One of `entries`.

        Raises
        ------
        ValueError
            If its file is damaged or holds no record of it.
        """
        for measurement in measurements_of_file(entry.path):
            if measurement.measurement_id == entry.measurement_id:
                return measurement
        raise ValueError(
            f"measurement_id: {entry.measurement_id}, {entry.path.name} has no record of it"
        )


def recorded_results(run: RunContent) -> Iterator[bytes]:
    """``msg/PointResult`` (CDR) of every attempt that is kept, references included, as it was published.

    In runs of earlier versions references have none, and poles are the last ones in the file of the point.
    """
    for path in files_in_order(run):
        for _, _, message in read_messages_of_type(path, TYPE):
            poles = None
            for _, topic, poles_message in read_messages_of_type(path, POLES_TYPE):
                if topic.rsplit("/", 1)[-1] == "poles":
                    poles = poles_message
            yield serialised(from_message(message), poles)


def measurements_of_file(path: Path) -> Iterator[StoredMeasurement]:
    """Every measurement of one file of a recording, in the order of its first message.

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    excitations: dict[int, dict[int, Excitation]] = {}
    records: dict[int, dict[tuple[int, int], Record]] = {}
    problems: dict[int, list[str]] = {}
    for _, _, message in read_messages_of_type(path, EXCITATION):
        excitation = excitation_from_message(message)
        excitations.setdefault(excitation.measurement_id, {})[excitation.realisation] = excitation
    for _, _, message in read_messages_of_type(path, RECORD):
        key = int(message.measurement_id)
        try:
            record = record_from_message(message)
        except ValueError as error:
            problems.setdefault(key, []).append(f"{path.name}: {error}")
            continue
        place = (record.realisation, record.block_index)
        records.setdefault(key, {})[place] = record
    for key in dict.fromkeys([*excitations, *records, *problems]):
        played = [excitations[key][m] for m in sorted(excitations.get(key, {}))]
        taken = [records[key][place] for place in sorted(records.get(key, {}))]
        yield StoredMeasurement(
            key,
            tuple(played),
            tuple(taken),
            tuple(gaps_of(played, taken)),
            tuple(problems.get(key, [])),
        )


def files_in_order(run: RunContent) -> list[Path]:
    """Files of a run, in the order in which they were recorded."""
    files = sorted(run.files, key=lambda file: (file.start_ns, file.name))
    return [run.path / RECORDING / file.name for file in files]


def _ids_of(path: Path) -> list[int]:
    """Measurements of a file, by its excitations."""
    messages = read_messages_of_type(path, EXCITATION)
    return list(dict.fromkeys(int(excitation.measurement_id) for _, _, excitation in messages))


def file_of(run: Path, result: PointResult) -> Path:
    """File of one attempt at a point."""
    return Path(run) / RECORDING / f"point-{result.index:05d}-{result.attempt:02d}.mcap"
