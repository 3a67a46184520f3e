# SPDX-License-Identifier: Apache-2.0
"""Excitations and records out of a run's recording, bit by bit what the nodes sent."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Record
from tactile_resonance.recording.messages import excitation_from_message, record_from_message
from tactile_resonance.recording.recording import Recording
from tactile_resonance.recording.store import StoredEntry, StoredMeasurement, choose, recording_of
from tactile_resonance.scan.point_file import read_messages
from tactile_resonance.scan.point_result import (
    POLES_TYPE,
    TYPE,
    PointResult,
    from_message,
    is_poles,
    serialised,
)
from tactile_resonance.scan.run_content import (
    POINT_FILE,
    RECORDING,
    RunContent,
    file_of,
    read_index,
    read_run,
)

EXCITATION = "tactile_resonance/msg/Excitation"
RECORD = "tactile_resonance/msg/Record"


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
    content = read_run(run)
    entries = run_entries(content)
    points = [entry for entry in entries if entry.path.name.startswith("point-")]
    among = points if measurement_id is None and len(points) == 1 else entries
    try:
        return choose(among, measurement_id, run).read()
    except ValueError as error:
        if not content.problems:
            raise
        raise ValueError(f"{error}; left out: {'; '.join(content.problems)}") from error


def run_entries(run: RunContent) -> list[StoredEntry]:
    """The measurements of a run, in the order in which they were taken."""
    return [
        StoredEntry(key, path, partial(_read, path, key), _place_of(path))
        for path in run.paths()
        for key in dict.fromkeys(int(m.measurement_id) for _, _, m in read_messages(path, EXCITATION))
    ]


def _place_of(path: Path) -> str:
    """Where a file was recorded, for people, who count points from 1."""
    match = POINT_FILE.fullmatch(path.name)
    return path.stem if match is None else f"point {int(match[1]) + 1}"


def measurement_at(run: Path, point: int) -> int:
    """Id of the newest measurement at a point, counted from 1.

    Raises
    ------
    ValueError
        If it is no run, or the point is not of it or has no measurement, or its file is damaged.
    """
    content = read_run(run)
    measured = {r.index + 1: r.measurement_id for r in content.latest if r.measurement_id}
    if point not in measured:
        damaged = [text for text in content.problems if text.startswith(f"point-{point - 1:05d}-")]
        if damaged:
            raise ValueError(f"point: {point}, {'; '.join(damaged)}")
        known = ", ".join(map(str, sorted(measured))) or "none"
        raise ValueError(f"point: {point}, measured points of {run} are {known}")
    return measured[point]


def _read(path: Path, measurement_id: int) -> StoredMeasurement:
    for measurement in measurements_of_file(path):
        if measurement.measurement_id == measurement_id:
            return measurement
    raise ValueError(f"no record of measurement {measurement_id} in {path.name}")


def recording_of_point(run: Path, result: PointResult) -> Recording:
    """Record of one attempt at a point of a run.

    Raises
    ------
    ValueError
        If nothing was measured, or its record is not there or damaged.
    """
    if not result.measurement_id:
        raise ValueError(f"{result.outcome.name.lower()}, nothing was measured")
    return recording_of(_read(file_of(run, result), result.measurement_id))


def recorded_results(run: RunContent) -> Iterator[bytes]:
    """``msg/PointResult`` (CDR) of every attempt that is kept, references included, as it was published.

    In runs of earlier versions references have none, and poles are the last ones in the file of the point.
    """
    entries, _ = read_index(run.path)
    # as they were finished, whatever the clock showed: of two attempts at a point the later message counts
    order = {Path(name).name: number for number, name in enumerate(entries)}
    for path in sorted(run.paths(), key=lambda path: order.get(path.name, -1)):
        entry = entries.get(f"{RECORDING}/{path.name}")
        if entry is not None and entry.result is not None:
            yield entry.message
            continue
        for _, _, message in read_messages(path, TYPE):
            yield serialised(from_message(message), last_poles(path))


def last_poles(path: Path) -> Any:
    """The last message of estimated poles in a file, truths of a simulation left out; None where there is none.

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    messages = (each for _, topic, each in read_messages(path, POLES_TYPE) if is_poles(topic))
    return next(iter(deque(messages, maxlen=1)), None)


def measurements_of_file(path: Path) -> Iterator[StoredMeasurement]:
    """Every measurement of one file of a recording, in the order of its first message.

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    excitations: defaultdict[int, list[Excitation]] = defaultdict(list)
    records: defaultdict[int, list[Record]] = defaultdict(list)
    problems: defaultdict[int, list[str]] = defaultdict(list)
    for _, _, message in read_messages(path, EXCITATION):
        excitation = excitation_from_message(message)
        excitations[excitation.measurement_id].append(excitation)
    for _, _, message in read_messages(path, RECORD):
        try:
            records[message.measurement_id].append(record_from_message(message))
        except ValueError as error:
            problems[message.measurement_id].append(f"{path.name}: {error}")
    for key in dict.fromkeys([*excitations, *records, *problems]):
        yield StoredMeasurement.of(key, excitations[key], records[key], problems[key])
