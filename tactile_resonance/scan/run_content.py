# SPDX-License-Identifier: Apache-2.0
"""What lies in the folder of a run, and what each of its files was when it was finished.

``index.jsonl`` has one line per finished file, appended before the file gets its name: the checksum of the
line, then JSON with size and checksum of the file, what it holds and its ``PointResult`` message. A run is read
from these lines; a file that no longer agrees with its line is damaged. Checksums are CRC-32 (`zlib.crc32`):
they detect damage, not forgery. Runs of earlier versions have no index; their files cannot be checked.
"""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from itertools import repeat
from pathlib import Path
from typing import Any
from zlib import crc32

from rosbags.serde import SerdeError

from tactile_resonance.fields import counted, read, whole
from tactile_resonance.files import write_whole
from tactile_resonance.scan.messages import definition_and_hash, message_types
from tactile_resonance.scan.point_file import (
    FileContent,
    TopicContent,
    is_checked,
    read_content,
    read_messages,
    topic_content,
)
from tactile_resonance.scan.point_result import TYPE, PointResult, from_message
from tactile_resonance.scan.points import ScanPoint

FORMAT = "tactile_resonance run 1"
INDEX, RECORDING, SCENE = "index.jsonl", "recording", "scene.yaml"
POINT_FILE = re.compile(r"point-(\d{5})-(\d{2,})\.mcap")
CHECKSUM = "crc32"
"""Field of ``run.json``."""
PLAN_DAMAGED = "run.json: differs from what was written (checksum)"
_NAME = re.compile(r"(?:recording/)?([\w-]{1,200}\.(?:mcap|yaml))")


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
        Finished files of the recording, in the order of the index; by the clock where one has no line there.
    results : tuple of PointResult
        Of every attempt but those before a damaged one, by point and attempt.
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

    def paths(self, type_name: str = "", reference: str = "") -> list[Path]:
        """Finished files, in the order in which they were recorded.

        Parameters
        ----------
        type_name : str
            Those that hold messages of this type; empty: all.
        reference : str
            Those of a reference of this name; empty: all.
        """
        ending = f"-{reference}.mcap" if reference else ""
        return [
            self.path / RECORDING / file.name
            for file in self.files
            if file.name.endswith(ending) and (not type_name or file.messages(type_name))
        ]

    def messages_at(self, type_name: str) -> dict[int, int]:
        """How many messages of a type the latest attempt at a point holds, by index; none: left out."""
        counts = {file.name: file.messages(type_name) for file in self.files}
        names = {result.index: file_of(self.path, result).name for result in self.latest}
        return {index: counts[name] for index, name in names.items() if counts.get(name)}


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
    in the file itself; a damaged file counts as if it were not there, and its point as not finished: attempts
    before it, which it replaced, have no result.

    Raises
    ------
    ValueError
        If it is no run.
    """
    try:
        listed = sorted((Path(path) / RECORDING).iterdir())
    except OSError as error:
        raise ValueError(f"run: {path} cannot be read as a run ({error})") from error
    paths = [file for file in listed if file.suffix not in (".yaml", ".part")]
    # after the names: each has its point in the plan and its line before
    run = read_plan(path)
    entries, damaged = read_index(run.path)
    # the last one may never have been: its line is written before the file has its name
    missing = [name for name in list(entries)[:-1] if not (run.path / name).exists()]
    problems = [*run.problems, *damaged]
    problems += [f"{Path(name).name}: finished, but no longer there" for name in missing]
    scene = entries.get(SCENE)
    if scene is not None and (damage := scene.damage(run.path / SCENE)):
        problems.append(f"{SCENE}: {damage}")
    files, results, unchecked, lost = [], [], 0, [Path(name).name for name in missing]
    with ThreadPoolExecutor() as pool:  # a checksum holds no lock of the interpreter
        of_files = [entries.get(f"{RECORDING}/{file.name}") for file in paths]
        found = pool.map(_finished, paths, of_files, repeat(len(run.points)))
        for path, each in zip(paths, found, strict=True):
            if isinstance(each, str):
                problems.append(each)
                lost.append(path.name)
                continue
            content, result, checked = each
            files.append(content)
            unchecked += not checked
            if result is not None:
                results.append(result)
    place = {Path(name).name: line for line, name in enumerate(entries)}
    if not all(file.name in place for file in files):
        place = {file.name: file.start_ns for file in files}
    files.sort(key=lambda file: place[file.name])
    attempts = (POINT_FILE.fullmatch(name) for name in lost)
    newest_lost = dict(sorted((int(match[1]), int(match[2])) for match in attempts if match))
    return replace(
        run,
        files=tuple(files),
        results=in_order(each for each in results if each.attempt > newest_lost.get(each.index, -1)),
        problems=tuple(problems),
        unchecked=unchecked,
    )


def _finished(
    path: Path, entry: Entry | None, points: int
) -> tuple[FileContent, PointResult | None, bool] | str:
    """What a file holds, the result of its point, and whether it was checked; what is wrong with it as text."""
    try:
        if entry is not None and (damage := entry.damage(path)):
            raise ValueError(f"{path.name}: {damage}")
        checked = entry is not None or is_checked(path)
        content, result = (None, None) if entry is None else (entry.content, entry.result)
        match = POINT_FILE.fullmatch(path.name)
        if match is None and not re.fullmatch(r"reference-.*\.mcap", path.name):
            raise ValueError(f"{path.name}: neither of a point nor a reference")
        if content is None or result is None:
            content = read_content(path)
        if match is None:
            return content, None, checked
        if result is None:
            found = [from_message(message) for _, _, message in read_messages(path, TYPE)]
            if len(found) != 1:
                raise ValueError(f"{path.name}: {len(found)} results, expected one")
            result = found[0]
        own = (result.index, result.attempt)
        if own != (int(match[1]), int(match[2])) or result.index >= points:
            raise ValueError(f"{path.name}: holds point and attempt {own}")
        return content, result, checked
    except (OSError, ValueError) as error:
        return str(error)


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
        points = read(tuple[ScanPoint, ...], content["points"], "points")
        places = read(tuple[ScanPoint, ...], content.get("places", ()), "places")
        facts = content["facts"]
        written = content.pop(CHECKSUM, None)  # earlier versions wrote none
        problems = () if written in (None, checksum_of(content)) else (PLAN_DAMAGED,)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"run: {path} cannot be read as a run ({error})") from error
    return RunContent(path, scene, facts, points, problems=problems, places=places)


def checksum_of(content: Mapping[str, Any]) -> int:
    """CRC-32 of the content of a JSON file, however it is spaced."""
    return crc32(json.dumps(content).encode())


@dataclass(frozen=True)
class Entry:
    """One finished file, as its line of the index states it.

    Attributes
    ----------
    name : str
        Relative to the run's folder.
    size : int
        [bytes]
    crc32 : int
        Of all its bytes.
    content : FileContent or None
        None: it is no recording.
    message : bytes
        Its ``msg/PointResult`` (CDR); empty: it has none.
    """

    name: str
    size: int
    crc32: int
    content: FileContent | None = None
    message: bytes = b""

    @property
    def result(self) -> PointResult | None:
        """Of the message; None where there is none that can be read by the definition of today."""
        topics = self.content.topics if self.content else ()
        today = definition_and_hash(TYPE)[1]
        if not any((topic.type_name, topic.type_hash) == (TYPE, today) for topic in topics):
            return None
        try:
            return from_message(message_types().deserialize_cdr(self.message, TYPE))
        except (SerdeError, ValueError):
            return None

    def damage(self, path: Path) -> str:
        """What of a file is not as it was when it was finished; empty: nothing."""
        size = path.stat().st_size
        if size != self.size:
            return f"has {size} bytes, {self.size} when it was finished"
        return "" if crc32(path.read_bytes()) == self.crc32 else "differs from what was finished (checksum)"


def entry_of(
    path: Path, name: str, content: FileContent | None = None, message: bytes = b""
) -> Entry:
    """Entry of a file that is complete; arguments as the fields of `Entry`."""
    return Entry(name, path.stat().st_size, crc32(path.read_bytes()), content, message)


def append_entry(run: Path, entry: Entry) -> None:
    """Add a line, durably."""
    with (run / INDEX).open("ab") as file:
        file.write(_line(entry))
        file.flush()
        os.fsync(file.fileno())


def write_entries(run: Path, entries: Iterable[Entry]) -> None:
    """Replace all lines."""
    write_whole(run / INDEX, b"".join(map(_line, entries)))


def read_index(run: Path) -> tuple[dict[str, Entry], list[str]]:
    """The last valid line of each file, by its name and in the order of the lines, and what lines are damaged.

    A line that is damaged or of another format is left out: its file is then read, and checked only by what
    it holds itself. What follows the last end of a line is left out too: an interruption cut it short.
    """
    entries, damaged = dict[str, Entry](), list[str]()
    try:
        lines = (run / INDEX).read_bytes().split(b"\n")[:-1]
    except FileNotFoundError:
        lines = []
    for number, line in enumerate(lines, start=1):
        checksum, _, text = line.partition(b" ")
        if checksum != b"%08x" % crc32(text):
            what = "is damaged; the file that it was of is compared with its own checksums alone"
            damaged.append(f"{INDEX}: line {number} {what}")
            continue
        try:
            entry = _entry(json.loads(text))
        except (ValueError, TypeError, KeyError, AttributeError):  # of another version, or anyone's
            continue
        entries.pop(entry.name, None)
        entries[entry.name] = entry
    return entries, damaged


def _line(entry: Entry) -> bytes:
    fields: dict[str, Any] = {"name": entry.name, "size": entry.size, "crc32": entry.crc32}
    if (content := entry.content) is not None:
        fields["content"] = astuple(content)
    if entry.message:
        fields["point_result"] = base64.b64encode(entry.message).decode()
    text = json.dumps(fields, separators=(",", ":")).encode()
    return b"%08x %s\n" % (crc32(text), text)


def _entry(fields: Mapping[str, Any]) -> Entry:
    match = _NAME.fullmatch(fields["name"])
    if match is None:
        raise ValueError(f"name: {fields['name']!r}")
    content = None
    if "content" in fields:
        _, start_ns, end_ns, topics = fields["content"]
        times_ns = whole(start_ns, "start_ns"), whole(end_ns, "end_ns")
        content = FileContent(match[1], *times_ns, tuple(_topic(*topic) for topic in topics))
    message = base64.b64decode(fields.get("point_result", ""))
    size, crc = (whole(fields[name], name) for name in ("size", "crc32"))
    return Entry(fields["name"], size, crc, content, message)


def _topic(name: str, type_name: str, type_hash: str, qos: str, count: int) -> TopicContent:
    if not all(isinstance(text, str) for text in (name, type_name, type_hash, qos)):
        raise TypeError("topic: no texts")
    return topic_content(name, type_name, type_hash, qos, whole(count, "count"))
