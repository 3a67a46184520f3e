# SPDX-License-Identifier: Apache-2.0
"""``index.jsonl`` of a run: what each file was when it was finished.

One line is appended per finished file, before the file gets its name: the checksum of the line, then JSON with
size and checksum of the file, what it holds and its ``PointResult`` message. A run is read from these lines,
and a file that no longer agrees with its line is damaged. Checksums are CRC-32 (`zlib.crc32`): they detect
damage, not forgery. Runs of earlier versions have no index; their files are read and cannot be checked.
"""

from __future__ import annotations

import base64
import json
import os
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
from rosbags.serde import SerdeError

from tactile_resonance.files import write_whole
from tactile_resonance.scan.messages import definition_and_hash, message_types
from tactile_resonance.scan.point_file import FileContent, TopicContent, topic_content
from tactile_resonance.scan.point_result import TYPE, PointResult, from_message

INDEX = "index.jsonl"
_PART_BYTES = 1 << 20
_NAME = re.compile(r"(?:recording/)?([\w-]{1,200}\.(?:mcap|yaml))")


@dataclass(frozen=True)
class Entry:
    """One finished file.

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
        return "" if crc32_of(path) == self.crc32 else "differs from what was finished (checksum)"


def entry_of(
    path: Path,
    name: str,
    content: FileContent | None = None,
    message: bytes = b"",
) -> Entry:
    """Entry of a file that is complete; arguments as the fields of `Entry`."""
    return Entry(name, path.stat().st_size, crc32_of(path), content, message)


def crc32_of(path: Path) -> int:
    """CRC-32 of a file's bytes."""
    found = 0
    with path.open("rb") as file:
        while part := file.read(_PART_BYTES):
            found = zlib.crc32(part, found)
    return found


def append_entry(run: Path, entry: Entry) -> None:
    """Add a line, durably."""
    with (run / INDEX).open("ab") as file:
        file.write(_line(entry))
        file.flush()
        os.fsync(file.fileno())


def write_entries(run: Path, entries: Iterable[Entry]) -> None:
    """Replace all lines."""
    write_whole(run / INDEX, b"".join(map(_line, entries)))


def read_entries(run: Path) -> dict[str, Entry]:
    """The last valid line of each file, by its name and in the order of the lines.

    A line that is damaged or of another format is left out: its file is then read, and checked only by what
    it holds itself; see `damaged_lines`.
    """
    entries: dict[str, Entry] = {}
    for _, text in _lines(run):
        if text is None:
            continue
        try:
            entry = _entry(json.loads(text))
        except (ValueError, TypeError, KeyError, AttributeError):  # of another version, or anyone's
            continue
        entries.pop(entry.name, None)
        entries[entry.name] = entry
    return entries


def damaged_lines(run: Path) -> list[str]:
    """Lines that do not agree with their checksum, as texts.

    The last one may be cut short: it is, where a run was interrupted while it was written.
    """
    return [
        f"{INDEX}: line {number} is damaged; the file that it was of is compared with its own checksums alone"
        for number, text in _lines(run)
        if text is None
    ]


def _lines(run: Path) -> Iterator[tuple[int, bytes | None]]:
    """Number and JSON of each line; None where it is damaged. The rest after the last line is left out."""
    try:
        whole = (run / INDEX).read_bytes()
    except FileNotFoundError:
        return
    for number, line in enumerate(whole.split(b"\n")[:-1], start=1):
        checksum, _, text = line.partition(b" ")
        yield number, text if checksum == b"%08x" % zlib.crc32(text) else None


def _line(entry: Entry) -> bytes:
    fields: dict[str, Any] = {"name": entry.name, "size": entry.size, "crc32": entry.crc32}
    if (content := entry.content) is not None:
        topics = [
            [t.name, t.type_name, t.type_hash, _qos_text(t.qos), t.count] for t in content.topics
        ]
        fields["content"] = [content.name, content.start_ns, content.end_ns, topics]
    if entry.message:
        fields["point_result"] = base64.b64encode(entry.message).decode()
    text = json.dumps(fields, separators=(",", ":")).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _entry(fields: Mapping[str, Any]) -> Entry:
    match = _NAME.fullmatch(fields["name"])
    if match is None:
        raise ValueError(f"name: {fields['name']!r}")
    content = None
    if "content" in fields:
        _, start_ns, end_ns, topics = fields["content"]
        times_ns = _whole(start_ns), _whole(end_ns)
        content = FileContent(match[1], *times_ns, tuple(_topic(*topic) for topic in topics))
    message = base64.b64decode(fields.get("point_result", ""))
    return Entry(fields["name"], _whole(fields["size"]), _whole(fields["crc32"]), content, message)


def _whole(value: object) -> int:
    if type(value) is not int or not 0 <= value < 1 << 64:
        raise ValueError(f"no whole number: {value!r}")
    return value


def _qos_text(qos: Qos | None) -> str:
    return json.dumps([] if qos is None else dump_qos_v9([qos]), separators=(",", ":"))


@cache
def _topic(name: str, type_name: str, type_hash: str, qos: str, count: int) -> TopicContent:
    if not all(isinstance(text, str) for text in (name, type_name, type_hash)):
        raise TypeError("topic: no texts")
    offered = next(iter(parse_qos(json.loads(qos))), None)
    return topic_content(name, type_name, type_hash, offered, _whole(count))
