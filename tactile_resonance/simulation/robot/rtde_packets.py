# SPDX-License-Identifier: Apache-2.0
"""Packets of the Real-Time Data Exchange (RTDE) of Universal Robots, protocol version 2.

Big-endian: size of the packet with its header (u16), type (u8), payload. Source: Universal Robots,
"Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any

PROTOCOL_VERSION = 2
LONGEST_PAYLOAD = 0xFFFF - 3

# type -> struct code and count
_LAYOUT = {
    "BOOL": ("?", 1),
    "UINT8": ("B", 1),
    "UINT32": ("I", 1),
    "UINT64": ("Q", 1),
    "INT32": ("i", 1),
    "DOUBLE": ("d", 1),
    "VECTOR3D": ("d", 3),
    "VECTOR6D": ("d", 6),
    "VECTOR6INT32": ("i", 6),
    "VECTOR6UINT32": ("I", 6),
}


class Kind(IntEnum):
    """Types of packets."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    TEXT = ord("M")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


def packet(kind: Kind, payload: bytes) -> bytes:
    """Return a packet with its header; ValueError where it does not fit into one."""
    if len(payload) > LONGEST_PAYLOAD:
        raise ValueError(f"RTDE packet: {len(payload)} bytes, expected at most {LONGEST_PAYLOAD}")
    return struct.pack(">HB", 3 + len(payload), kind) + payload


class PacketReader:
    """Cuts a stream of bytes into packets."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def add(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield the type and payload of each packet that is complete.

        Raises
        ------
        ValueError
            Where a size is smaller than a header.
        """
        self._buffer += data
        while len(self._buffer) >= 3:
            size, kind = struct.unpack_from(">HB", self._buffer)
            if size < 3:
                raise ValueError(f"RTDE packet: size {size}, expected at least 3")
            if len(self._buffer) < size:
                return
            payload = bytes(self._buffer[3:size])
            del self._buffer[:size]
            yield kind, payload


class Layout:
    """How the variables of a recipe lie in a data packet.

    Parameters
    ----------
    types : sequence of str
        RTDE types.
    """

    def __init__(self, types: Sequence[str]) -> None:
        self._lengths = [_LAYOUT[name][1] for name in types]
        codes = "".join(f"{_LAYOUT[name][1]}{_LAYOUT[name][0]}" for name in types)
        self._struct = struct.Struct(">B" + codes)
        self._packet = struct.Struct(">HBB" + codes)
        if self._struct.size > LONGEST_PAYLOAD:
            raise ValueError(
                f"RTDE recipe: {self._struct.size} bytes, expected at most {LONGEST_PAYLOAD}"
            )

    def pack(self, recipe: int, values: Sequence[Any]) -> bytes:
        """Return a data packet; a vector is a sequence of its length."""
        flat: list[Any] = []
        for value, length in zip(values, self._lengths, strict=True):
            if length == 1:
                flat.append(value)
            else:
                flat += value
        return self._packet.pack(self._packet.size, Kind.DATA, recipe, *flat)

    def unpack(self, payload: bytes) -> list | None:
        """Return the values of a data packet; None where its size is not that of the recipe."""
        if len(payload) != self._struct.size:
            return None
        flat = self._struct.unpack(payload)[1:]
        if len(flat) == len(self._lengths):  # no vectors
            return list(flat)
        values: list = []
        start = 0
        for length in self._lengths:
            values.append(flat[start] if length == 1 else list(flat[start : start + length]))
            start += length
        return values
