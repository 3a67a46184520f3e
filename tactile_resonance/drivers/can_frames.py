# SPDX-License-Identifier: Apache-2.0
"""How a load cell puts wrenches into CAN frames, as a description read from YAML.

Not a DBC file: several cells send a number across the border of two frames (Tx of Robotous), which DBC
cannot express, nor pairs of frames that belong together, nor the commands that start the stream. What is
needed is one ``struct`` format over the joined bytes, which the standard library reads.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any

from tactile_resonance.configuration import shared_file
from tactile_resonance.fields import known_keys, read_yaml, require, section

CHANNELS = ("fx", "fy", "fz", "tx", "ty", "tz")


@dataclass(frozen=True)
class CellCommand:
    """A frame to the cell, and whether it answers."""

    name: str
    data: bytes
    reply: bool


@dataclass(frozen=True)
class Reply:
    """Where an answer says whether the command was done.

    Attributes
    ----------
    result_byte, good : int
        Offset into the joined bytes (from 0), and its value where all is well.
    error_byte : int
        Offset of the reason.
    errors : dict
        Reasons in words.
    """

    result_byte: int
    good: int
    error_byte: int
    errors: dict[int, str]


@dataclass(frozen=True)
class CanDescription:
    """Frames and commands of one make of cell; see ``config/force/frames``.

    Attributes
    ----------
    name : str
    frame_ids : tuple of int
        Identifiers of the frames of one wrench, in the order in which they are sent.
    extended_ids : bool
    layout : struct.Struct
        Of the joined bytes of these frames.
    fields : tuple of str
        Name of each value of the layout; `CHANNELS` are among them.
    constant : dict
        Values that distinguish a wrench from other answers.
    overload : tuple of str and int, or None
        Field and mask of the overload bits.
    invalid_counts : tuple of int
        Counts that mean an invalid value.
    full_scale_counts : int or None
        At and beyond which a count is an overload.
    command_id : int or None
    stop, start, setup : CellCommand or None, tuple of CellCommand
    rates : dict
        From wrenches a second to the command that sets it; empty where the rate is fixed.
    request : bytes or None
        Sent for each wrench, where the cell does not stream by itself.
    reply : Reply or None
    """

    name: str
    frame_ids: tuple[int, ...]
    extended_ids: bool
    layout: struct.Struct
    fields: tuple[str, ...]
    constant: dict[str, int] = field(default_factory=dict)
    overload: tuple[str, int] | None = None
    invalid_counts: tuple[int, ...] = ()
    full_scale_counts: int | None = None
    command_id: int | None = None
    stop: CellCommand | None = None
    start: CellCommand | None = None
    setup: tuple[CellCommand, ...] = ()
    rates: dict[int, CellCommand] = field(default_factory=dict)
    request: bytes | None = None
    reply: Reply | None = None

    def decode(self, data: bytes) -> tuple[tuple[float, ...], bool] | None:
        """Counts (6,) and overload of the joined bytes; NaN for a count that means an invalid value.

        None where the bytes are another answer.
        """
        if len(data) != self.layout.size:
            return None
        values = self.layout.unpack(data)
        for at, wanted in self._constants:
            if values[at] != wanted:
                return None
        counts = self._counts_of(values)
        over = self._overload_at is not None and bool(
            values[self._overload_at] & self.overload[1]  # type: ignore[index]
        )
        full_scale, invalid = self.full_scale_counts, self.invalid_counts
        if full_scale is not None and (max(counts) >= full_scale or min(counts) <= -full_scale):
            over |= any(abs(count) >= full_scale and count not in invalid for count in counts)
        if invalid and not self._invalid.isdisjoint(counts):
            counts = tuple([math.nan if count in invalid else count for count in counts])
        return counts, over

    @cached_property
    def _counts_of(self) -> Callable[[tuple[float, ...]], tuple[float, ...]]:
        return itemgetter(*map(self.fields.index, CHANNELS))

    @cached_property
    def _invalid(self) -> frozenset[int]:
        return frozenset(self.invalid_counts)

    @cached_property
    def _constants(self) -> tuple[tuple[int, int], ...]:
        return tuple((self.fields.index(name), value) for name, value in self.constant.items())

    @cached_property
    def _overload_at(self) -> int | None:
        return None if self.overload is None else self.fields.index(self.overload[0])


class Assembler:
    """Joins the frames of one wrench.

    Order alone does not tell wrenches apart: where the last frame of one and the first of the next are lost,
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
        self._ids, self._within_s = frame_ids, within_s
        self._first_s = 0.0
        self._parts: list[bytes] = []
        self.lost = 0

    def add(self, can_id: int, data: bytes, time_s: float) -> bytes | None:
        """Take the next frame with its stamp; return the joined bytes where it completes them.

        Frames of others are passed over.
        """
        if can_id not in self._ids:
            return None
        parts, ids = self._parts, self._ids
        late = bool(parts) and not abs(time_s - self._first_s) <= self._within_s
        if can_id != ids[len(parts)] or late:
            self.lost += 1
            parts.clear()
            if can_id != ids[0]:
                return None
        if not parts:
            self._first_s = time_s
        parts.append(data)
        if len(parts) < len(ids):
            return None
        whole = b"".join(parts)
        parts.clear()
        return whole


def read_can_description(path: Path) -> CanDescription:
    """Read a description; a bare name that is no file here is one of ``config/force/frames``.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.
    """
    path = shared_file(path, "config/force/frames")
    content = read_yaml(path)
    try:
        return _description(content)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def _description(content: dict[str, Any]) -> CanDescription:
    known_keys(
        content,
        {"name", "frame_ids", "extended_ids", "layout", "fields", "constant", "overload"}
        | {"invalid_counts", "full_scale_counts", "commands"},
        "",
    )
    extended = content.get("extended_ids", False)
    require(type(extended) is bool, "extended_ids", extended, "true or false")
    most_id = 0x1FFFFFFF if extended else 0x7FF
    ids = _integers(content.get("frame_ids"), "frame_ids", most_id)
    require(bool(ids) and len(set(ids)) == len(ids), "frame_ids", ids, "different identifiers")
    layout_text = content.get("layout")
    try:
        layout = struct.Struct(str(layout_text))
        count = len(layout.unpack(bytes(layout.size)))
    except struct.error as error:
        raise ValueError(f"layout: got {layout_text!r}; accepted is a struct format") from error
    fits = 0 < layout.size <= 8 * len(ids)
    require(fits, "layout", layout_text, f"at most 8 bytes a frame, {8 * len(ids)} here")
    names = content.get("fields")
    good = isinstance(names, list) and len(names) == count and set(CHANNELS) <= set(names)
    require(good, "fields", names, f"{count} names as in layout, {', '.join(CHANNELS)} among them")
    constant = dict(content.get("constant") or {})
    for name, value in constant.items():
        require(
            name in names and type(value) is int, f"constant.{name}", value, "a field's integer"
        )
    overload = None
    if content.get("overload") is not None:
        part = section(content, "overload", "")
        known_keys(part, {"field", "mask"}, "overload")
        require(part.get("field") in names, "overload.field", part.get("field"), "one of fields")
        require(type(part.get("mask")) is int, "overload.mask", part.get("mask"), "an integer")
        overload = (part["field"], part["mask"])
    full_scale = content.get("full_scale_counts")
    good = full_scale is None or (type(full_scale) is int and full_scale > 0)
    require(good, "full_scale_counts", full_scale, "a positive integer")
    commands = content.get("commands")
    parsed: dict[str, Any] = {}
    if commands is not None:
        parsed = _commands(section(content, "commands", ""), most_id, layout.size)
    return CanDescription(
        name=str(content.get("name", "")),
        frame_ids=ids,
        extended_ids=extended,
        layout=layout,
        fields=tuple(names),
        constant=constant,
        overload=overload,
        invalid_counts=_integers(content.get("invalid_counts", []), "invalid_counts", None),
        full_scale_counts=full_scale,
        **parsed,
    )


def _commands(part: Any, most_id: int, size: int) -> dict[str, Any]:
    known_keys(part, {"id", "stop", "start", "setup", "rates", "request", "reply"}, "commands")
    (command_id,) = _integers([part.get("id")], "commands.id", most_id)
    result: dict[str, Any] = {"command_id": command_id}
    for name in ("stop", "start"):
        if part.get(name) is not None:
            result[name] = CellCommand(name, _bytes(part[name], f"commands.{name}"), False)
    if part.get("request") is not None:
        result["request"] = _bytes(part["request"], "commands.request")
    setup = []
    for i, item in enumerate(part.get("setup") or []):
        where = f"commands.setup[{i}]"
        require(isinstance(item, dict), where, item, "fields with values")
        known_keys(item, {"name", "data", "reply"}, where)
        data = _bytes(item.get("data"), f"{where}.data")
        setup.append(CellCommand(str(item.get("name", where)), data, bool(item.get("reply", True))))
    result["setup"] = tuple(setup)
    rates = part.get("rates") or {}
    require(isinstance(rates, dict), "commands.rates", rates, "commands by rate")
    result["rates"] = {
        rate: CellCommand(f"rate {rate} Hz", _bytes(data, f"commands.rates.{rate}"), True)
        for rate, data in rates.items()
    }
    if part.get("reply") is not None:
        reply = section(part, "reply", "commands")
        names = {"result_byte", "good", "error_byte", "errors"}
        known_keys(reply, names, "commands.reply")
        numbers = [reply.get(name) for name in ("result_byte", "good", "error_byte")]
        result["reply"] = Reply(
            *_integers(numbers, "commands.reply", 255), errors=dict(reply.get("errors") or {})
        )
        for name in ("result_byte", "error_byte"):
            require(reply[name] < size, f"commands.reply.{name}", reply[name], f"below {size}")
    answered = [c.name for c in (*setup, *result["rates"].values()) if c.reply]
    missing = bool(answered) and "reply" not in result
    require(not missing, "commands.reply", None, f"where {answered[:1]} are answered")
    return result


def _integers(value: Any, name: str, most: int | None) -> tuple[int, ...]:
    good = isinstance(value, list) and all(
        type(item) is int and (most is None or 0 <= item <= most) for item in value
    )
    require(good, name, value, "integers" + ("" if most is None else f" from 0 to {most:#x}"))
    return tuple(value)


def _bytes(value: Any, name: str) -> bytes:
    data = _integers(value, name, 255)
    require(0 < len(data) <= 8, name, value, "1 to 8 bytes")
    return bytes(data)
