# SPDX-License-Identifier: Apache-2.0
"""How a load cell puts wrenches into CAN frames, as a description read from YAML.

Not a DBC file: several cells send a number across the border of two frames (Tx of Robotous), which DBC
cannot express, nor pairs of frames that belong together, nor the commands that start the stream. What is
needed is one ``struct`` format over the joined bytes, which the standard library reads.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Annotated

from tactile_resonance.configuration import shared_file
from tactile_resonance.fields import Checked, Range, read, read_file, require

CHANNELS = ("fx", "fy", "fz", "tx", "ty", "tz")


def _read_data(value: object, where: str) -> bytes:
    numbers = read(tuple[int, ...], value, where)
    good = 0 < len(numbers) <= 8 and all(0 <= number <= 255 for number in numbers)
    require(good, where, value, "1 to 8 bytes, integers from 0 to 255")
    return bytes(numbers)


def _read_layout(value: object, where: str) -> struct.Struct:
    try:
        return struct.Struct(read(str, value, where).encode("ascii"))
    except (struct.error, UnicodeEncodeError) as error:
        raise ValueError(f"{where}: got {value!r}; accepted is a struct format") from error


Data = Annotated[bytes, _read_data]


@dataclass(frozen=True)
class CellCommand:
    """A frame to the cell, and whether it answers."""

    data: Data
    name: str = "set-up"
    reply: bool = True


@dataclass(frozen=True)
class Reply(Checked):
    """Where an answer says whether the command was done.

    Attributes
    ----------
    result_byte, good : int
        Offset into the joined bytes (from 0), and its value where all is well.
    error_byte : int
        Offset of the reason.
    errors : mapping
        Reasons in words.
    """

    result_byte: Annotated[int, Range(0, 255)]
    good: Annotated[int, Range(0, 255)]
    error_byte: Annotated[int, Range(0, 255)]
    errors: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CellCommands:
    """What is sent to the cell.

    Attributes
    ----------
    id : int
        Identifier of the frames that carry commands.
    stop, start : bytes or None
    setup : tuple of CellCommand
    rates : mapping
        From wrenches a second to the command that sets it; empty where the rate is fixed.
    request : bytes or None
        Sent for each wrench, where the cell does not stream unasked.
    reply : Reply or None
    """

    id: int
    stop: Data | None = None
    start: Data | None = None
    setup: tuple[CellCommand, ...] = ()
    rates: Mapping[int, Data] = field(default_factory=dict)
    request: Data | None = None
    reply: Reply | None = None

    def __post_init__(self) -> None:
        answered = bool(self.rates) or any(command.reply for command in self.setup)
        good = self.reply is not None or not answered
        require(good, "reply", None, "where the answers to set-up and rates say what was done")


@dataclass(frozen=True)
class Overload:
    """Field and mask of the overload bits."""

    field: str
    mask: int


@dataclass(frozen=True)
class CanDescription(Checked):
    """Frames and commands of one make of cell; see ``config/force/frames``.

    Attributes
    ----------
    frame_ids : tuple of int
        Identifiers of the frames of one wrench, in the order in which they are sent.
    layout : struct.Struct
        Of the joined bytes of these frames.
    fields : tuple of str
        Name of each value of the layout; `CHANNELS` are among them.
    name : str
    extended_ids : bool
    constant : mapping
        Values that distinguish a wrench from other answers.
    overload : Overload or None
    invalid_counts : tuple of int
        Counts that mean an invalid value.
    full_scale_counts : int or None
        At and beyond which a count is an overload.
    commands : CellCommands
        None of them where the cell takes none and streams unasked.
    """

    frame_ids: tuple[int, ...]
    layout: Annotated[struct.Struct, _read_layout]
    fields: tuple[str, ...]
    name: str = ""
    extended_ids: bool = False
    constant: Mapping[str, int] = field(default_factory=dict)
    overload: Overload | None = None
    invalid_counts: tuple[int, ...] = ()
    full_scale_counts: Annotated[int, Range(1, 2**63, "a number above 0")] | None = None
    commands: CellCommands = field(default_factory=lambda: CellCommands(id=0))

    def __post_init__(self) -> None:
        ids, size = self.frame_ids, self.layout.size
        most = 0x1FFFFFFF if self.extended_ids else 0x7FF
        good = bool(ids) and len(set(ids)) == len(ids) and all(0 <= i <= most for i in ids)
        require(good, "frame_ids", ids, f"different integers from 0 to {most:#x}")
        most_bytes = f"at most 8 bytes a frame, {8 * len(ids)} here"
        require(0 < size <= 8 * len(ids), "layout", self.layout.format, most_bytes)
        count = len(self.layout.unpack(bytes(size)))
        good = len(self.fields) == count and set(CHANNELS) <= set(self.fields)
        needed = f"{count} names as in layout, {', '.join(CHANNELS)} among them"
        require(good, "fields", self.fields, needed)
        for name, value in self.constant.items():
            require(name in self.fields, f"constant.{name}", value, "a value of one of fields")
        if self.overload is not None:
            name = self.overload.field
            require(name in self.fields, "overload.field", name, "one of fields")
        super().__post_init__()
        command_id, reply = self.commands.id, self.commands.reply
        require(0 <= command_id <= most, "commands.id", command_id, f"0 to {most:#x}")
        for name in ("result_byte", "error_byte") if reply else ():
            offset = getattr(reply, name)
            require(offset < size, f"commands.reply.{name}", offset, f"below {size}")

    def decode(self, data: bytes) -> tuple[tuple[float, ...], bool] | None:
        """Counts (6,) and overload of the joined bytes; NaN for a count that means an invalid value.

        None where the bytes are another answer.
        """
        layout, constants, counts_of, overload_at, mask, plain = self._plan
        if len(data) != layout.size:
            return None
        values = layout.unpack(data)
        for at, wanted in constants:
            if values[at] != wanted:
                return None
        counts, over = counts_of(values), bool(values[overload_at] & mask) if mask else False
        if -plain < min(counts) and max(counts) < plain:
            return counts, over
        full_scale, invalid = self.full_scale_counts, self.invalid_counts
        if full_scale is not None:
            over |= any(abs(count) >= full_scale and count not in invalid for count in counts)
        return tuple([math.nan if count in invalid else count for count in counts]), over

    @cached_property
    def _plan(self) -> tuple:
        """What `decode` needs of all this; last the count below which none has another meaning."""
        place = self.fields.index
        constants = tuple([(place(name), value) for name, value in self.constant.items()])
        over = (0, 0) if self.overload is None else (place(self.overload.field), self.overload.mask)
        special = [*self.invalid_counts, self.full_scale_counts]
        plain = min([abs(count) for count in special if count is not None], default=math.inf)
        return self.layout, constants, itemgetter(*map(place, CHANNELS)), *over, plain


class Assembler:
    """Joins the frames of one wrench.

    Order alone does not separate wrenches: where the last frame of one and the first of the next are lost,
    what is left looks whole. So frames must also be close in time.

    Parameters
    ----------
    frame_ids : tuple of int
    within_s : float
        From the first to the last frame of a wrench [s]: below the period between wrenches.

    Attributes
    ----------
    lost : int
        Wrenches of which a frame was missing.
    """

    def __init__(self, frame_ids: tuple[int, ...], within_s: float) -> None:
        self._place_of = {can_id: place for place, can_id in enumerate(frame_ids)}
        self._within_s, self._first_s = within_s, 0.0
        self._place = -1  # of the newest frame
        self._joined, self._count = b"", 0  # so far, and of how many frames; -1: one is missing
        self.lost = 0

    def add(self, can_id: int, data: bytes, time_s: float) -> bytes | None:
        """Take the next frame with its stamp; return the joined bytes where it completes them.

        Frames of others are passed over.
        """
        place = self._place_of.get(can_id)
        if place is None:
            return None
        if place <= self._place or not abs(time_s - self._first_s) <= self._within_s:
            self.lost += self._count > 0
            self._first_s, self._joined, self._count = time_s, b"", 0
        self._place = place
        if place != self._count:
            self.lost += self._count >= 0
            self._count = -1
            return None
        self._joined += data
        self._count += 1
        if self._count < len(self._place_of):
            return None
        self._count = 0
        return self._joined


def read_can_description(path: Path) -> CanDescription:
    """Read a description; a bare name that is no file here is one of ``config/force/frames``.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.
    """
    return read_file(CanDescription, shared_file(path, "config/force/frames"))
