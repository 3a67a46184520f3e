# SPDX-License-Identifier: Apache-2.0
"""One MCAP file, written out of sight and then there whole; what it holds, its checksums, and many as one bag.

A finished file holds three kinds of CRC-32, which say without any other file whether it is damaged: of the
content of each chunk, of all bytes of its data section, and of its summary; 0: none. rosbags compares the first
when it reads messages, and writes none.

References
----------
MCAP format specification, records Chunk (op 0x06), Data End (0x0F) and Footer (0x02),
https://mcap.dev/spec.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from zlib import crc32

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionMode, Reader, storage_mcap
from rosbags.rosbag2.metadata import dump_qos_v9

from tactile_resonance.files import sync, write_whole
from tactile_resonance.scan.messages import (
    OtherVersionError,
    definition_and_hash,
    hash_of,
    reader_of,
)

if TYPE_CHECKING:
    from typing_extensions import Self

BAG_VERSION: Literal[9] = 9
# rosbags parses the QoS of every topic of every file anew, 2 ms each: few texts differ
storage_mcap.parse_qos = cache(storage_mcap.parse_qos)  # type: ignore[assignment]
# Of a chunk's record: op, length, first and last time and size come before its checksum.
_CHUNK_CRC = 33
_DATA_END = b"\x0f" + struct.pack("<Q", 4)  # its checksum follows, then the summary
_FOOTER = b"\x02" + struct.pack("<Q", 20)  # starts of the summary and of its offsets follow, then the checksum
_END = b"\x89MCAP0\r\n"
_CRC = struct.Struct("<I")
_NEXT = ",\n  "  # between the entries of a list
_FOREVER = QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE


def offered_qos(depth: int, *, reliable: bool = True, latched: bool = False) -> Qos:
    """What a node offers on a topic: ``ros2 bag play`` offers the same, else it offers volatile."""
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )


@dataclass(frozen=True, slots=True)
class TopicContent:
    """One topic of a file; `type_hash` (REP-2011) is that of the definition in the file.

    `qos` is what its publisher offered, as JSON: a list of at most one, as rosbag2 has it.
    """

    name: str
    type_name: str
    type_hash: str
    qos: str
    count: int


# one object for the same topic of all files: they differ little from file to file
topic_content = cache(TopicContent)


@dataclass(frozen=True, slots=True)
class FileContent:
    """What one finished file holds.

    Attributes
    ----------
    name : str
    start_ns, end_ns : int
        Times of the first and the last message (UNIX time) [ns].
    topics : tuple of TopicContent
    """

    name: str
    start_ns: int
    end_ns: int
    topics: tuple[TopicContent, ...]

    def messages(self, type_name: str = "") -> int:
        """How many of a type it holds; of an empty one: of all."""
        return sum(topic.count for topic in self.topics if type_name in ("", topic.type_name))


class _Storage(storage_mcap.McapWriter):
    """Fills in the checksum of each chunk."""

    def close_chunk(self) -> None:
        place, crc = self.bio.tell() + _CHUNK_CRC, crc32(self.chunk.bio.getvalue())
        super().close_chunk()
        self.bio.seek(place)
        self.bio.write(_CRC.pack(crc))
        self.bio.seek(0, os.SEEK_END)


class PointFileWriter:
    """Writes one file; nobody sees it before `complete`, and then nobody loses it.

    A context that abandons what was not completed.

    Parameters
    ----------
    hidden : Path
        Folder for what is not finished, on the file system of `target`; a leftover of the same name is
        replaced.
    target : Path
        The finished file, ending in ``.mcap``; must not exist.

    Attributes
    ----------
    newest : dict of str to bytes
        Last message of each topic, serialised.
    """

    def __init__(self, hidden: Path, target: Path) -> None:
        if target.exists():
            raise ValueError(
                f"target: {target.name} exists already, finished files are not replaced"
            )
        self._target = target
        self._folder = hidden / target.stem
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True)
        # rosbags' Writer around it makes metadata of YAML, ten times the rest of a file
        self._storage = _Storage(self._folder, CompressionMode.NONE)
        self._connections: dict[str, Connection] = {}
        self.newest: dict[str, bytes | memoryview] = {}
        self._open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.abandon()

    def write(
        self,
        topic: str,
        type_name: str,
        time_ns: int,
        cdr: bytes | memoryview,
        qos: Qos | None = None,
    ) -> None:
        """Append one message.

        Parameters
        ----------
        topic : str
            Fully qualified.
        type_name : str
            Such as ``tactile_resonance/msg/Poles``; one per topic.
        time_ns : int
            When it was received (UNIX time) [ns].
        cdr : bytes
            Serialised, with the encapsulation header, as ``rclpy.serialization`` and rosbags make it.
        qos : Qos, optional
            Offered by its publisher, see `offered_qos`; that of the topic's first message is kept.

        Raises
        ------
        ValueError
            If the type is not known or not that of the topic, or the file is finished.
        """
        if not self._open:
            raise ValueError(f"{self._target.name}: finished or abandoned, expected an open file")
        connection = self._connections.get(topic) or self._add(topic, type_name, qos)
        if connection.msgtype != type_name:
            raise ValueError(f"type_name: got {type_name!r}; {topic} has {connection.msgtype}")
        self._storage.write(connection, time_ns, cdr)
        self.newest[topic] = cdr

    def _add(self, topic: str, type_name: str, qos: Qos | None) -> Connection:
        definition, type_hash = definition_and_hash(type_name)
        connection = Connection(
            len(self._connections) + 1,
            topic,
            type_name,
            MessageDefinition(MessageDefinitionFormat.MSG, definition),
            type_hash,
            0,
            ConnectionExtRosbag2("cdr", [] if qos is None else [qos]),
            self,
        )
        if type_name not in {known.msgtype for known in self._connections.values()}:
            self._storage.add_msgtype(connection)
        self._storage.add_connection(connection, _offered(connection))
        self._connections[topic] = connection
        return connection

    def complete(self, enter: Callable[[Path, FileContent], None] | None = None) -> FileContent:
        """Complete the file and give it its name, durably.

        Parameters
        ----------
        enter : callable, optional
            Called with the file, when all of it is on disk, and what it holds, before it gets its name.

        Raises
        ------
        ValueError
            If it holds no message, or is completed already.
        OSError
            If it cannot be written.
        """
        if not self._open or not self._connections:
            raise ValueError(f"{self._target.name}: nothing written, expected one message or more")
        self._open = False
        counts = self._storage.channel_stats
        content = FileContent(
            self._target.name,
            self._storage.message_start_time,
            self._storage.message_end_time,
            tuple(_topic_of(c, c.digest, counts[c.id]) for c in self._connections.values()),
        )
        self._storage.close(BAG_VERSION, _bag_metadata([content]))
        written = self._folder / self._target.name
        write_checksums(written)
        sync(written)
        if enter is not None:
            enter(written, content)
        written.rename(self._target)
        sync(self._target.parent)
        shutil.rmtree(self._folder, ignore_errors=True)
        return content

    def abandon(self) -> None:
        """Leave nothing behind; does nothing after `complete`."""
        if self._open:
            self._open = False
            self._storage.abort()
            shutil.rmtree(self._folder, ignore_errors=True)


def read_content(path: Path) -> FileContent:
    """What a finished file holds, from its index.

    Raises
    ------
    ValueError
        If it is damaged or no MCAP file of ROS 2.
    """
    try:
        with Reader(path) as reader:
            topics = tuple(
                _topic_of(c, hash_of(c.msgtype, c.msgdef), c.msgcount) for c in reader.connections
            )
            return FileContent(path.name, reader.start_time, reader.end_time - 1, topics)
    except Exception as error:  # whatever rosbags meets in a cut or overwritten file
        raise _damaged(path, error) from error


def _topic_of(connection: Connection, type_hash: str, count: int) -> TopicContent:
    offered = _offered(connection)
    return topic_content(connection.topic, connection.msgtype, type_hash, offered, count)


def _offered(connection: Connection) -> str:
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    offered = dump_qos_v9(list(connection.ext.offered_qos_profiles)[:1])
    return json.dumps(offered, separators=(",", ":"))


def read_messages(path: Path, *type_names: str) -> Iterator[tuple[int, str, Any]]:
    """(time [ns], topic, message) of each message of a type or of several of one file, in order.

    Messages are read with the definitions in the file, see `scan.messages.reader_of`; under whatever namespace.

    Raises
    ------
    ValueError
        If the file is damaged, or of a version whose messages cannot be read any more.
    """
    try:
        with Reader(path) as reader:
            connections = [c for c in reader.connections if c.msgtype in type_names]
            read = {c.id: reader_of(c.msgtype, c.msgdef) for c in connections}
            if connections:
                for connection, time_ns, cdr in reader.messages(connections=connections):
                    yield time_ns, connection.topic, read[connection.id](cdr)
    except OtherVersionError as error:
        raise ValueError(f"{path.name}: {error}") from error
    except Exception as error:  # whatever rosbags meets in a cut or overwritten file
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> ValueError:
    reason = " ".join(str(error).split())[:120] or type(error).__name__
    return ValueError(f"{path.name}: damaged or foreign file ({reason})")


def write_bag_metadata(folder: Path, files: Sequence[FileContent]) -> None:
    """Make all these files of a folder one bag.

    Parameters
    ----------
    folder : Path
    files : sequence of FileContent
        In any order; listed by the time of their first message. A topic must have one type, of one
        definition, in all of them.
    """
    lines = "".join(f"  {line}\n" for line in _bag_metadata(files).splitlines())
    write_whole(folder / "metadata.yaml", f"rosbag2_bagfile_information:\n{lines}".encode())
    sync(folder)


def _bag_metadata(files: Sequence[FileContent]) -> str:
    """YAML that says what these files hold together.

    JSON is YAML, and takes a hundredth of the time and memory of its nodes: a long run has ten thousand files.
    """
    files = sorted(files, key=lambda file: (file.start_ns, file.name))
    start_ns = min((file.start_ns for file in files), default=0)
    end_ns = max((file.end_ns for file in files), default=0)
    content: dict[str, Any] = {
        "version": BAG_VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "message_count": sum(file.messages() for file in files),
        "topics_with_message_count": [_topic(topic) for topic in _merged_topics(files)],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {
                "path": file.name,
                "starting_time": {"nanoseconds_since_epoch": file.start_ns},
                "duration": {"nanoseconds": file.end_ns - file.start_ns},
                "message_count": file.messages(),
            }
            for file in files
        ],
        "custom_data": None,
        "ros_distro": "rosbags",
    }
    text = ""
    for key, value in content.items():
        listed = isinstance(value, list)
        told = f"[{_NEXT.join(map(json.dumps, value))}]" if listed else json.dumps(value)
        text += f"{key}: {told}\n"
    return text


def _merged_topics(files: Sequence[FileContent]) -> list[TopicContent]:
    """Topics of all files together, by name."""
    counts, merged = Counter[str](), dict[str, TopicContent]()
    for file in files:
        for topic in file.topics:
            counts[topic.name] += topic.count
            merged[topic.name] = topic
    return [replace(topic, count=counts[name]) for name, topic in sorted(merged.items())]


def _topic(topic: TopicContent) -> dict[str, Any]:
    return {
        "topic_metadata": {
            "name": topic.name,
            "type": topic.type_name,
            "serialization_format": "cdr",
            "offered_qos_profiles": json.loads(topic.qos),
            "type_description_hash": topic.type_hash,
        },
        "message_count": topic.count,
    }


def write_checksums(path: Path) -> None:
    """Fill in the checksums of data section and summary of a complete file.

    Raises
    ------
    ValueError
        If it is no such file.
    """
    with path.open("r+b") as file:
        for place, crc in _checksums(file.read()):
            file.seek(place)
            file.write(_CRC.pack(crc))


def is_checked(path: Path) -> bool:
    """Whether a file has checksums, which agree with it; False: an earlier version wrote none.

    Raises
    ------
    ValueError
        If one does not agree, or the file is not complete.
    OSError
        If it cannot be read.
    """
    content = path.read_bytes()
    try:
        found = [(_CRC.unpack_from(content, place)[0], crc) for place, crc in _checksums(content)]
        if not any(written for written, _ in found):
            return False
        if any(written != crc for written, crc in found):
            raise ValueError("its content does not agree with its checksums")
    except ValueError as error:
        raise _damaged(path, error) from error
    return True


def _checksums(content: bytes) -> tuple[tuple[int, int], tuple[int, int]]:
    """Place of the checksum of the data section and of the summary, and what it must be."""
    footer = len(content) - len(_FOOTER) - 20 - len(_END)
    summary = int.from_bytes(content[footer + len(_FOOTER) : footer + len(_FOOTER) + 8], "little")
    data, last = summary - 4 - len(_DATA_END), len(content) - len(_END) - 4
    if not (
        content.endswith(_END)
        and content.startswith(_FOOTER, footer)
        and content.startswith(_DATA_END, data)
        and 0 < data < footer
    ):
        raise ValueError("its records are not those of a complete file")
    view = memoryview(content)
    return (summary - 4, crc32(view[:data])), (last, crc32(view[summary:last]))
