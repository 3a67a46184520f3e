# SPDX-License-Identifier: Apache-2.0
"""The folder of a run: whatever happens, every finished point is in it and the next one is known.

::

    RUN/scene.yaml surface.*            the scene as it was given, and the file of its surface, if it names one
    RUN/run.json                        plan, versions, seeds, what was skipped; written again where a scan
                                        that chooses its points appends one
    RUN/recording/point-00003-00.mcap   one file per attempt at a point (here point 3, first attempt)
    RUN/recording/reference-00-air.mcap references of the session
    RUN/recording/metadata.yaml         makes all of them one rosbag2 recording
    RUN/index.jsonl                     checksum, content and result of each finished file: `scan.run_content`
    RUN/results.csv                     one row per finished point, its latest attempt

A point is finished when its file is there. Files get their names when they are complete, on disk and in
``index.jsonl``; ``metadata.yaml`` and ``results.csv`` follow from the files and are rebuilt when a run is
opened. While it is recorded ``metadata.yaml`` may lag behind by a twentieth of the files: written after each,
it would cost more than the files of a long run.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tactile_resonance.fields import counted
from tactile_resonance.files import sync, write_whole
from tactile_resonance.scan.measurement import MeasurementDesign
from tactile_resonance.scan.messages import definition_and_hash, message_types
from tactile_resonance.scan.point_file import (
    FileContent,
    PointFileWriter,
    offered_qos,
    write_bag_metadata,
)
from tactile_resonance.scan.point_result import (
    POLES_TYPE,
    RESULTS_DEPTH,
    TOPIC,
    TYPE,
    PointResult,
    ResultsFile,
    is_poles,
    serialised,
)
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.run_content import (
    CHECKSUM,
    FORMAT,
    INDEX,
    PLAN_DAMAGED,
    POINT_FILE,
    RECORDING,
    SCENE,
    RunContent,
    append_entry,
    checksum_of,
    entry_of,
    in_order,
    read_index,
    read_run,
    write_entries,
)

HIDDEN = ".unfinished"


class RunDirectory:
    """A run that is being recorded; the only one who writes to its folder.

    Made by `create` or `open`; a context that gives the folder free again.

    What a point costs here does not depend on how many are finished.

    Attributes
    ----------
    path : Path
    repeats : int
        Of all attempts that are kept.
    """

    def __init__(self, path: Path, lock: int, content: RunContent) -> None:
        self.path = path
        self._lock = lock
        self._opened = content
        self._points, self._files = list(content.points), list(content.files)
        self._results = list(content.results)
        self._latest = {result.index: result for result in content.latest}
        self.repeats = sum(result.repeats for result in content.results)
        self._next = 0  # all points before this one are finished
        # damaged files keep their names: their attempt is not given twice
        self._attempts = Counter[int]()
        for name in os.listdir(path / RECORDING):
            if match := POINT_FILE.fullmatch(name):
                index, attempt = map(int, match.groups())
                self._attempts[index] = max(self._attempts[index], attempt + 1)
        self._results_file = ResultsFile(path, content.latest)
        self._write_metadata()

    @classmethod
    def create(
        cls,
        path: Path,
        scene: str,
        points: Sequence[ScanPoint],
        facts: Mapping[str, Any],
        needed_bytes: int = 0,
        places: Sequence[ScanPoint] = (),
        beside: Path | None = None,
    ) -> RunDirectory:
        """Begin a run.

        Parameters
        ----------
        path : Path
            A folder that is empty or does not exist.
        scene : str
            Text of the scene file.
        points : sequence of ScanPoint
            The plan, in order, numbered from 0.
        facts : mapping
            What JSON can hold: versions, seeds, what the plan skips.
        needed_bytes : int
            What the run may take on disk; `expected_bytes` estimates it.
        places : sequence of ScanPoint
            Among which further points will be chosen.
        beside : Path, optional
            File of the surface, which the scene names as it will be beside it: ``surface``, its ending kept.

        Raises
        ------
        ValueError
            If the folder holds something, or space is short; nothing is left behind.
        OSError
            If it cannot be written.
        """
        path = Path(path)
        cls.check_new(path, needed_bytes)
        text = _plan_text(RunContent(path, scene, facts, tuple(points), places=tuple(places)))
        (path / RECORDING).mkdir(parents=True)
        with _locked(path) as lock:
            if beside is not None:
                write_whole(path / beside.with_stem("surface").name, beside.read_bytes())
            write_whole(path / SCENE, scene.encode())
            write_entries(path, [entry_of(path / SCENE, SCENE)])
            write_whole(path / "run.json", text)  # last: with it the run exists
            sync(path)
            sync(path.parent)
            return cls(path, lock, read_run(path))

    @staticmethod
    def check_new(path: Path, needed_bytes: int) -> None:
        """Raise ``ValueError`` where a new run cannot begin in a folder, for it or its disk is not empty."""
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ValueError(f"run: {path} holds something; accepted is a new or empty folder")
        parent = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
        if not parent.is_dir():
            raise ValueError(f"run: {path} is below the file {parent}; accepted is a folder")
        free = shutil.disk_usage(parent).free
        if needed_bytes > free:
            raise ValueError(
                f"run: {parent} has {free / 1e6:.0f} MB free, the run may take "
                f"{needed_bytes / 1e6:.0f} MB"
            )

    @classmethod
    def open(cls, path: Path) -> RunDirectory:
        """Go on with a run, after whatever ended it.

        Removes what was not finished and makes ``metadata.yaml`` and ``results.csv`` anew from the
        finished files; damaged files are left as they are and named in ``content.problems``.

        Raises
        ------
        ValueError
            If it is no run, its plan or scene was changed, another process is recording it, or its messages
            are of another version: no reader takes two definitions of one type in one bag.
        """
        path = Path(path)
        with _locked(path) as lock:
            content = read_run(path)
            if PLAN_DAMAGED in content.problems:
                raise ValueError(f"run: {path}: {PLAN_DAMAGED}: nobody knows where its points lie")
            # points measured from now on would be of another force or band than those before
            if changed := [of for of in content.problems if of.startswith(f"{SCENE}: ")]:
                raise ValueError(
                    f"run: {path}: {changed[0]}; accepted is the scene with which the run began"
                )
            told = {(each.type_name, each.type_hash) for file in content.files for each in file.topics}
            if other := sorted(name for name, own in told if definition_and_hash(name)[1] != own):
                raise ValueError(
                    f"run: {path} was recorded by a version with other definitions of {', '.join(other)}; "
                    "accepted is that version (report and analyze take the run as it is)"
                )
            shutil.rmtree(path / HIDDEN, ignore_errors=True)
            for part in [*path.glob("*.part"), *(path / RECORDING).glob("*.part")]:
                part.unlink()
            _mend_index(path)
            return cls(path, lock, content)

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Complete the summaries, where the disk takes them, and give the folder free."""
        if self._lock >= 0:
            if self._listed < len(self._files):
                with contextlib.suppress(OSError):  # `open` makes them anew
                    self._write_metadata()
            os.close(self._lock)
            self._lock = -1

    @property
    def content(self) -> RunContent:
        """The run as far as it has come; put together at each call."""
        return replace(
            self._opened,
            points=tuple(self._points),
            files=tuple(self._files),
            results=in_order(self._results),
        )

    @property
    def finished(self) -> int:
        """Number of points that are."""
        return len(self._latest)

    @property
    def next_point(self) -> ScanPoint | None:
        """As `RunContent.next_point`."""
        while self._next < len(self._points):
            point = self._points[self._next]
            if point.index not in self._latest:
                return point
            self._next += 1
        return None

    def append(self, point: ScanPoint) -> ScanPoint:
        """Add the next point of a scan that chooses them, durably; returns it."""
        content = replace(self._opened, points=(*self._points, point))
        write_whole(self.path / "run.json", _plan_text(content))
        sync(self.path)
        self._points.append(point)
        return point

    def begin_point(self, index: int) -> PointRecording:
        """Begin the next attempt at a point of the plan."""
        attempt = self._attempts[index]
        return PointRecording(self, f"point-{index:05d}-{attempt:02d}", index, attempt)

    def begin_reference(self, name: str) -> PointRecording:
        """Begin a recording that belongs to no point, such as ``air-before``."""
        number = len(list((self.path / RECORDING).glob("reference-*.mcap")))
        return PointRecording(self, f"reference-{number:02d}-{name}")

    def _add(self, file: FileContent, result: PointResult | None) -> None:
        self._files.append(file)
        if result is not None:
            self._results.append(result)
            self._latest[result.index] = result
            self.repeats += result.repeats
            self._attempts[result.index] = result.attempt + 1
            self._results_file.add(result, lambda: self.content.latest)
        if len(self._files) > 1.05 * self._listed:
            self._write_metadata()

    def _write_metadata(self) -> None:
        write_bag_metadata(self.path / RECORDING, self._files)
        self._listed = len(self._files)


class PointRecording(PointFileWriter):
    """Receives the messages of one attempt at a point, or of a reference.

    Attributes
    ----------
    index : int or None
        Of the point; None: a reference.
    attempt : int
    measurement_id : int
        Of the measurement that is recorded; 0: none was begun.
    """

    def __init__(
        self, run: RunDirectory, stem: str, index: int | None = None, attempt: int = 0
    ) -> None:
        super().__init__(run.path / HIDDEN, run.path / RECORDING / f"{stem}.mcap")
        self._run, self.index, self.attempt = run, index, attempt
        self.measurement_id = 0

    def message_of(self, result: PointResult) -> bytes:
        """The result as it is published (CDR), with the last poles recorded."""
        last = (cdr for topic, cdr in self.newest.items() if is_poles(topic))
        poles = [message_types().deserialize_cdr(cdr, POLES_TYPE) for cdr in last]
        return serialised(result, poles[0] if poles else None)

    def finish(self, result: PointResult) -> bytes:
        """Keep all with the result of this point and attempt, durably: no interruption loses it from now on.

        Returns
        -------
        bytes
            `message_of` the result.
        """
        cdr, qos = self.message_of(result), offered_qos(RESULTS_DEPTH, latched=True)
        self.write(f"/{TOPIC}", TYPE, result.time_ns, cdr, qos)
        of_point, run = None if self.index is None else result, self._run

        def enter(path: Path, content: FileContent) -> None:
            entry = entry_of(path, f"{RECORDING}/{content.name}", content, cdr)
            append_entry(run.path, entry)

        run._add(self.complete(enter), of_point)
        return cdr


def expected_bytes(points: int, design: MeasurementDesign) -> int:
    """What a run of so many points may take on disk, generously [bytes].

    Two channels of floating point samples per block, an FRF of all lines after each of them, and
    a megabyte a point for poses and wrenches.
    """
    block = 2 * 8 * design.samples + 10 * 8 * design.lines + 10_000
    return points * (design.periods * block + 1_000_000)


def ended_by_storage(path: Path, error: OSError, safe: int) -> str:
    """Why a run ends that cannot be written, and how many of its points are safe."""
    points = counted(safe, "point is", "points are")
    return f"{path}: {error.strerror or error}; {points} safe in it, resume goes on"


def _plan_text(content: RunContent) -> bytes:
    """``run.json``; places only where there are some."""
    plan: dict[str, Any] = {
        "format": FORMAT,
        "facts": dict(content.facts),
        "points": [asdict(point) for point in content.points],
    }
    if content.places:
        plan["places"] = [asdict(point) for point in content.places]
    plan[CHECKSUM] = checksum_of(plan)
    return (json.dumps(plan, indent=1, allow_nan=False) + "\n").encode()


def _mend_index(path: Path) -> None:
    """Remove what an interruption left at the end: part of a line, or one whose file never got its name."""
    (entries, _), index = read_index(path), path / INDEX
    last = next(reversed(entries), None)
    if last is not None and not (path / last).exists():
        del entries[last]
    elif not index.exists() or index.read_bytes().endswith(b"\n"):
        return
    write_entries(path, entries.values())


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[int]:
    """Descriptor that holds the folder until it or its process ends; closed where its context fails."""
    try:
        descriptor = os.open(path / RECORDING, os.O_RDONLY)
    except OSError as error:
        raise ValueError(f"run: {path} cannot be read as a run ({error})") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"run: {path} is being recorded by another process") from None
        yield descriptor
    except BaseException:
        os.close(descriptor)
        raise
