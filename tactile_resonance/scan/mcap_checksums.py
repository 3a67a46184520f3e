# SPDX-License-Identifier: Apache-2.0
"""The checksums inside an MCAP file, which say without any other file whether it is damaged.

A finished file holds three kinds of CRC-32: of the content of each chunk, of all bytes of its data section, and
of its summary; 0: none. rosbags compares the first when it reads messages, and writes none: they are filled in
when a file is complete.

References
----------
MCAP format specification, records Chunk (op 0x06), Data End (0x0F) and Footer (0x02),
https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from zlib import crc32

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # op and length, before the content
_CRC = struct.Struct("<I")
_SIZE = struct.Struct("<Q")
_FOOTER, _CHUNK, _DATA_END = 0x02, 0x06, 0x0F
# Of a chunk's content: first and last time and size come before its checksum, then the name of the compression.
_CHUNK_CRC = 24
# Of the footer's: starts of summary and of its offsets come before the checksum.
_FOOTER_CRC = 16


def write_checksums(path: Path) -> None:
    """Fill in all checksums of a complete file without compression, as rosbags writes it.

    Raises
    ------
    ValueError
        If it is no such file.
    """
    with path.open("r+b") as file:
        content = bytearray(file.read())
        for place, crc in _checksums(content):
            _CRC.pack_into(content, place, crc)  # those that follow count it in
            file.seek(place)
            file.write(_CRC.pack(crc))


def is_checked(path: Path) -> bool:
    """Whether a file has checksums, all of which agree with it; False: an earlier version wrote none.

    Raises
    ------
    ValueError
        If one does not agree, or records do not follow each other as in a complete file.
    OSError
        If it cannot be read.
    """
    content = path.read_bytes()
    found = [(_CRC.unpack_from(content, place)[0], crc) for place, crc in _checksums(content)]
    if not any(written for written, _ in found):
        return False
    if any(written != crc for written, crc in found):
        raise ValueError("its content does not agree with its checksums")
    return True


def _checksums(content: bytes | bytearray) -> Iterator[tuple[int, int]]:
    """Place of each checksum and what it must be, in the order in which they depend on each other."""
    view = memoryview(content)
    if len(view) < 2 * len(_MAGIC) or view[:8] != _MAGIC or view[-8:] != _MAGIC:
        raise ValueError("not complete, or no MCAP file")
    end, at, summary, op = len(view) - len(_MAGIC), len(_MAGIC), None, 0
    while op != _FOOTER:
        if at + _RECORD.size > end:
            raise ValueError("its records end before its footer")
        op, size = _RECORD.unpack_from(view, at)
        begin, record = at, at + _RECORD.size
        at = record + size
        if at > end:
            raise ValueError("a record is longer than the file")
        if op == _CHUNK:
            yield record + _CHUNK_CRC, crc32(_records(view[record:at]))
        elif op == _DATA_END and size == _CRC.size and summary is None:
            yield record, crc32(view[:begin])
            summary = at
    if summary is None or at != end or size != _FOOTER_CRC + _CRC.size:
        raise ValueError("its records are not those of a complete file")
    footer = record + _FOOTER_CRC
    yield footer, crc32(view[summary:footer])


def _records(chunk: memoryview) -> memoryview:
    """Content of a chunk without compression, from that of its record."""
    try:
        (name,) = _CRC.unpack_from(chunk, _CHUNK_CRC + 4)
        begin = _CHUNK_CRC + 8 + name
        (size,) = _SIZE.unpack_from(chunk, begin)
    except struct.error as error:
        raise ValueError("a chunk is cut short") from error
    if name or begin + 8 + size != len(chunk):
        raise ValueError("a chunk is compressed or cut short")
    return chunk[begin + 8 :]
