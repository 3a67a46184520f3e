# SPDX-License-Identifier: Apache-2.0
"""What lies in the folder of a run, read without changing anything."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zlib import crc32

from tactile_resonance.counted import counted
from tactile_resonance.fields import read_dataclass
from tactile_resonance.scan.mcap_checksums import is_checked
from tactile_resonance.scan.point_file import FileContent, read_content, read_messages
from tactile_resonance.scan.point_result import TOPIC, PointResult, from_message
from tactile_resonance.scan.run_index import Entry, damaged_lines, read_entries
from tactile_resonance.scan.scan_point import ScanPoint

FORMAT = "tactile_resonance run 1"
RECORDING, SCENE = "recording", "scene.yaml"
POINT_FILE = re.compile(r"point-(\d{5})-(\d{2,})\.mcap")
CHECKSUM = "crc32"
"""Field of ``run.json``."""
PLAN_DAMAGED = "run.json: differs from what was written (checksum)"


@dataclass(frozen=True)
class RunContent:
    """A run, as far as it has come.

    Attributes
    ----------
    path : Path
    scene : str
        Text of the scene file.
    facts : mapping
        Versions, seeds, what the plan skips.
    points : tuple of ScanPoint
        The plan; of an adaptive scan what it chose so far.
    files : tuple of FileContent
        Finished files of the recording.
    results : tuple of PointResult
        Of every attempt, by point and attempt.
    problems : tuple of str
        Damaged, missing and foreign files, by name.
    unchecked : int
        Files without a line in the index that hold no checksums either: an earlier version finished them.
    places : tuple of ScanPoint
        Among which an adaptive scan chooses its points; empty: all points are known beforehand.
    """

    path: Path
    scene: str
    facts: Mapping[str, Any]
    points: tuple[ScanPoint, ...]
    files: tuple[FileContent, ...] = ()
    results: tuple[PointResult, ...] = ()
    problems: tuple[str, ...] = ()
    unchecked: int = 0
    places: tuple[ScanPoint, ...] = ()

    @cached_property
    def latest(self) -> tuple[PointResult, ...]:
        """The latest attempt at each finished point, by index."""
        return tuple({result.index: result for result in self.results}.values())

    @property
    def next_point(self) -> ScanPoint | None:
        """First point known that is not finished; None where all are."""
        finished = {result.index for result in self.results}
        return next((point for point in self.points if point.index not in finished), None)

    @property
    def paths_in_order(self) -> list[Path]:
        """Finished files, in the order in which they were recorded."""
        return self.paths_with("")

    def paths_with(self, type_name: str) -> list[Path]:
        """Of `paths_in_order` those that hold messages of a type; an empty one: all."""
        files = sorted(self.files, key=lambda file: (file.start_ns, file.name))
        return [
            self.path / RECORDING / file.name
            for file in files
            if not type_name or any(topic.type_name == type_name for topic in file.topics)
        ]

    def messages_at(self, type_name: str) -> dict[int, int]:
        """How many messages of a type the latest attempt at a point holds, by index; none: left out."""
        counts = Counter[str]()
        for file in self.files:
            counts[file.name] += sum(t.count for t in file.topics if t.type_name == type_name)
        names = {result.index: file_of(self.path, result).name for result in self.latest}
        return {index: counts[name] for index, name in names.items() if counts[name]}


def not_checked(files: int) -> str:
    """A sentence on files without a checksum."""
    which = counted(files, "file is", "files are")
    return f"{which} not checked for damage: an earlier version recorded what has no checksum"


def file_of(run: Path, result: PointResult) -> Path:
    """File of one attempt at a point."""
    return Path(run) / RECORDING / f"point-{result.index:05d}-{result.attempt:02d}.mcap"


def read_run(path: Path) -> RunContent:
    """Everything readable of a run, of one that is being recorded too.

    Every byte is compared with the checksums of ``index.jsonl``, or, where a file has no line there, with those
    in the file itself; a damaged file counts as if it were not there, and its point as not finished.

    Raises
    ------
    ValueError
        If it is no run.
    """
    try:
        listed = sorted((Path(path) / RECORDING).iterdir())
    except OSError as error:
        raise ValueError(f"run: {path} cannot be read as a run ({error})") from error
    names = {
        f"{RECORDING}/{file.name}": file for file in listed if file.suffix not in (".yaml", ".part")
    }
    # after the names: each has its point in the plan and its line before
    run = read_plan(path)
    entries = read_entries(run.path)
    files, results, unchecked = [], [], 0
    problems = [*run.problems, *damaged_lines(run.path), *_missing(run.path, entries)]
    scene = entries.get(SCENE)
    if scene is not None and (damage := scene.damage(run.path / SCENE)):
        problems.append(f"{SCENE}: {damage}")
    with ThreadPoolExecutor() as pool:  # a checksum holds no lock of the interpreter
        read = pool.map(lambda name: _checked(names[name], entries.get(name), run), names)
        for content, result, problem, checked in read:
            if content is not None:
                files.append(content)
                unchecked += not checked
            if result is not None:
                results.append(result)
            if problem:
                problems.append(problem)
    return replace(
        run,
        files=tuple(files),
        results=in_order(results),
        problems=tuple(problems),
        unchecked=unchecked,
    )


def _missing(run: Path, entries: Mapping[str, Entry]) -> list[str]:
    """Files that were finished and are no longer there.

    The last one may never have been: its line is written before the file has its name.
    """
    return [
        f"{Path(name).name}: finished, but no longer there"
        for name in list(entries)[:-1]
        if not (run / name).exists()
    ]


def _checked(
    path: Path, entry: Entry | None, run: RunContent
) -> tuple[FileContent | None, PointResult | None, str, bool]:
    """What a file holds, its result, what is wrong with it, and whether it was compared with a checksum."""
    try:
        if entry is not None and (damage := entry.damage(path)):
            return None, None, f"{path.name}: {damage}", True
        result = None if entry is None else entry.result
        if entry is None or result is None:
            checked = entry is not None or _is_checked(path)
            return *_read_file(path, len(run.points)), "", checked
        match = POINT_FILE.fullmatch(path.name)
        named = None if match is None else _named(result, match, len(run.points))
        return entry.content, named, "", True
    except (OSError, ValueError) as error:
        return None, None, str(error), True


def _is_checked(path: Path) -> bool:
    """Whether a file that is not in the index agrees with the checksums that it holds itself."""
    try:
        return is_checked(path)
    except ValueError as error:
        raise ValueError(f"{path.name}: damaged or foreign file ({error})") from error


def in_order(results: Iterable[PointResult]) -> tuple[PointResult, ...]:
    """By point and attempt."""
    return tuple(sorted(results, key=lambda result: (result.index, result.attempt)))


def read_plan(path: Path) -> RunContent:
    """The scene and the plan of a run alone, as if nothing were finished.

    Raises
    ------
    ValueError
        If it is no run.
    """
    path = Path(path)
    try:
        content = json.loads((path / "run.json").read_text(encoding="utf-8"))
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT!r}")
        scene = (path / SCENE).read_text(encoding="utf-8")
        points, places = (
            tuple(
                read_dataclass(ScanPoint, point, f"{name}[{i}]") for i, point in enumerate(listed)
            )
            for name, listed in (
                ("points", content["points"]),
                ("places", content.get("places", ())),
            )
        )
        facts = content["facts"]
        written = content.pop(CHECKSUM, None)  # earlier versions wrote none
        problems = () if written in (None, checksum_of(content)) else (PLAN_DAMAGED,)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"run: {path} cannot be read as a run ({error})") from error
    return RunContent(path, scene, facts, points, problems=problems, places=places)


def checksum_of(content: Mapping[str, Any]) -> int:
    """CRC-32 of the content of a JSON file, however it is spaced."""
    return crc32(json.dumps(content).encode())


def _read_file(path: Path, points: int) -> tuple[FileContent, PointResult | None]:
    match = POINT_FILE.fullmatch(path.name)
    if match is None:
        if not re.fullmatch(r"reference-.*\.mcap", path.name):
            raise ValueError(f"{path.name}: neither of a point nor a reference")
        return read_content(path), None
    content = read_content(path)
    found = [from_message(message) for _, _, message in read_messages(path, f"/{TOPIC}")]
    if len(found) != 1:
        raise ValueError(f"{path.name}: {len(found)} results, expected one")
    return content, _named(found[0], match, points)


def _named(result: PointResult, match: re.Match[str], points: int) -> PointResult:
    """The result, which must be that of its file's name."""
    own = (result.index, result.attempt)
    if own != (int(match[1]), int(match[2])) or result.index >= points:
        raise ValueError(f"{match[0]}: holds point and attempt {own}")
    return result
