# SPDX-License-Identifier: Apache-2.0
"""Checked reading of configuration: one error that names field, value and what is accepted.

The one reader of files, and of plain values from elsewhere: the annotations of a frozen dataclass say what a
file may hold, `read_file` or `read` makes it from the content, and its ``__post_init__`` checks ranges. Kinds
of fields: float (finite), int, bool, str, enumerations (by value), ``Literal``, dataclasses, tuples, mappings,
arrays of numbers, each of these or None, ``Annotated[KIND, read_it]``: ``read_it(value, field)`` reads it, and
numbers of a `Range` (`Checked`).
"""

from __future__ import annotations

import dataclasses
import math
import os
import stat
import sys
import types
from collections.abc import Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from reprlib import Repr
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from tactile_resonance.configuration import parse_yaml

T = TypeVar("T")

MOST_BYTES = 1 << 24
"""Of a file of configuration: 100 000 positions take a fifth of it."""

LONGEST = 200
"""Characters of a value in a message."""

_SHOWN = Repr()
_SHOWN.maxstring = _SHOWN.maxother = _SHOWN.maxlong = LONGEST
_SHOWN.maxlist = _SHOWN.maxtuple = _SHOWN.maxdict = _SHOWN.maxset = 12
_PLAIN: dict[Any, str] = {int: "an integer", bool: "true or false", str: "text"}


def require(condition: bool, field: str, value: object, accepted: str) -> None:
    """Raise ``ValueError`` naming field, value and what is accepted, unless `condition` holds."""
    if not condition:
        raise ValueError(f"{field}: got {cut(_SHOWN.repr(value))}; accepted is {accepted}")


def require_kind(value: object, field: str, *kinds: type) -> None:
    """Raise ``ValueError`` naming field, type and what is accepted, unless `value` is of one of `kinds`."""
    if not isinstance(value, kinds):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"{field}: got a {type(value).__name__}; accepted is a {names}")


class Range(NamedTuple):
    """Between which ends, included, the number of a field is: ``Annotated[KIND, Range(low, high)]``."""

    low: float
    high: float
    words: str = ""


AboveZero = Annotated[float, Range(math.ulp(0.0), sys.float_info.max, "a number above 0")]
NotNegative = Annotated[float, Range(0.0, sys.float_info.max, "a number, 0 or above")]
BelowOne = Annotated[
    float, Range(math.ulp(0.0), math.nextafter(1.0, 0.0), "a number above 0, below 1")
]
Seed = Annotated[int, Range(0, math.inf, "a number, 0 or above")]


class Checked:
    """A dataclass whose numbers are, as it is made, within the `Range` of their fields; None passes."""

    def __post_init__(self) -> None:
        for name, _, _, of in _fields(cast(Any, type(self))).values():
            value = getattr(self, name)
            if of is not None and value is not None:
                words = of.words or f"{of.low:g} to {of.high:g}"
                require(of.low <= value <= of.high, name, value, words)


def cut(text: str) -> str:
    """Return one line of at most `LONGEST` characters."""
    line = " ".join(text.split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 3]}..."


def one_line(error: BaseException) -> str:
    """Message of an error, or its kind where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def counted(count: int, thing: str, plural: str = "") -> str:
    """``1 point``, ``3 points``; with a plural of its own where that is not the thing and an s."""
    return f"{count} {thing}" if count == 1 else f"{count} {plural or thing + 's'}"


def read_file_name(value: object, field: str) -> str:
    """Return `value` as a name that a file may have; ``ValueError`` if it is not."""
    good = isinstance(value, str) and 0 < len(value) <= LONGEST and value.isprintable()
    require(good, field, value, "the name of a file")
    return str(value)


FileName = Annotated[str, read_file_name]


def read_text(path: Path) -> str:
    """Text of a regular file of at most `MOST_BYTES`.

    Raises
    ------
    ValueError
        If it is something else, or cannot be read.
    """
    try:
        regular = stat.S_ISREG(os.stat(path).st_mode)  # to open a pipe would wait
        require(regular, str(path), "a folder or device", "a regular file")
        with open(path, "rb") as file:
            content = file.read(MOST_BYTES + 1)
        require(len(content) <= MOST_BYTES, str(path), "a larger one", "a file of at most 16 MiB")
        return content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read: {cut(str(error))}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping.

    Raises
    ------
    ValueError
        If the file cannot be read or parsed, or its top level is no mapping.
    """
    text = read_text(path)
    try:
        content = parse_yaml(text)
    except ValueError as error:
        raise ValueError(f"{path}: cannot be read as YAML: {cut(str(error))}") from error
    require(isinstance(content, dict), str(path), type(content).__name__, "a mapping of sections")
    return content


def read_file(kind: type[T], path: Path) -> T:
    """Read a YAML file as a dataclass.

    Raises
    ------
    ValueError
        One line that names file, field, value and what is accepted.
    """
    return read_dataclass(kind, read_yaml(path), f"{path.name}:")


def section(mapping: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    """Return the sub-mapping `key`; ``ValueError`` if it is absent or no mapping."""
    require(key in mapping, join(where, key), None, "a mapping (it is missing)")
    return _mapping(mapping[key], join(where, key))


def known_keys(mapping: Mapping[str, Any], keys: set[str], where: str) -> None:
    """Raise ``ValueError`` if `mapping` has a key that is not among `keys`."""
    for key in mapping:
        require(key in keys, join(where, key), mapping[key], f"one of {', '.join(sorted(keys))}")


def one_of(
    kinds: Mapping[str, Any],
    mapping: Mapping[str, Any],
    where: str,
    beside: frozenset[str] = frozenset(),
) -> tuple[str, Any]:
    """Read the one entry of a mapping whose key names its kind; return key and what was read.

    Parameters
    ----------
    kinds : mapping
        From each accepted key to the type of what stands under it.
    mapping : mapping
    where : str
    beside : frozenset of str
        Keys that may stand beside it, and are left to the caller.
    """
    known_keys(mapping, {*kinds, *beside}, where)
    given = [key for key in mapping if key in kinds]
    require(len(given) == 1, where, given, f"exactly one of {', '.join(kinds)}")
    return given[0], read(kinds[given[0]], mapping[given[0]], join(where, given[0]))


def number(value: object, field: str) -> float:
    """Return `value` as a finite float; ``ValueError`` if it is not. Of numpy scalars and arrays of () too."""
    plain = _plain(value)
    # an integer may be beyond all floats, which math.isfinite does not take
    good = (
        isinstance(plain, (int, float))
        and not isinstance(plain, bool)
        and abs(plain) <= sys.float_info.max
    )
    require(good, field, value, "a finite number")
    return float(plain)


def whole(value: object, field: str, least: int = 0) -> int:
    """Return `value` as an integer from `least` on, also where it is a float such as 2000.0."""
    plain = _plain(value)
    real = isinstance(plain, (int, float)) and not isinstance(plain, bool)
    good = real and least <= plain < math.inf and plain % 1 == 0
    require(good, field, value, f"a whole number, at least {least}")
    return int(plain)


def band(value: Any, field: str = "band_hz", most_hz: float = math.inf) -> tuple[float, float]:
    """Return `value` as the two ends of a band [Hz]; ``ValueError`` unless 0 <= low < high <= `most_hz`."""
    try:
        low, high = (number(edge, field) for edge in value)
    except (TypeError, ValueError):
        low = high = math.nan
    ends = "(low, high) in Hz with 0 <= low < high"
    if most_hz < math.inf:
        ends += f" <= {most_hz:g}, half the sample rate"
    # rounding: half of a rate that is no binary fraction
    require(0 <= low < high <= most_hz * (1 + 1e-9), field, value, ends)
    return low, high


def _plain(value: Any) -> Any:
    """A numpy scalar, or an array of shape (), as Python's own number."""
    return value.item() if getattr(value, "ndim", None) == 0 else value


def known(value: float) -> float | None:
    """The number; None, as JSON and YAML have it, where it is not finite."""
    return float(value) if math.isfinite(value) else None


def read_or_unknown(value: object, field: str) -> float:
    """The number; NaN, as `known` writes it, for None."""
    return math.nan if value is None else number(value, field)


OrUnknown = Annotated[float, read_or_unknown]


def numbers(value: Any, field: str, count: int | None = None) -> tuple[float, ...]:
    """Return a list, or an array (n,), of finite numbers as a tuple, of length `count` where that is given."""
    value = value.tolist() if getattr(value, "ndim", None) == 1 else value
    return _tuple((float, ...) if count is None else (float,) * count, value, field)


def read_dataclass(cls: type[T], mapping: Any, where: str, **given: object) -> T:
    """Build a dataclass from a mapping with exactly its keys.

    Fields with a default may be left out. `given` are fields that do not come from the mapping.

    Raises
    ------
    ValueError
        If a key is unknown or missing, a value is not accepted, or the dataclass refuses it.
    """
    mapping = _mapping(mapping, where)
    wanted = {key: of for key, of in _fields(cast(Any, cls)).items() if of[0] not in given}
    known_keys(mapping, set(wanted), where)
    values = dict(given)
    for key, (name, kind, optional, _) in wanted.items():
        if key in mapping:
            values[name] = read(kind, mapping[key], join(where, key))
        else:
            require(optional, join(where, key), None, f"{accepted(kind)} (it is missing)")
    return build(cls, where, **values)


def build(make: Any, where: str, *arguments: Any, **values: Any) -> Any:
    """Call `make`, with what it refuses named from `where` on."""
    try:
        return make(*arguments, **values)
    except ValueError as error:
        raise ValueError(f"{_inside(where)}{error}") from error


def read(kind: Any, value: object, field: str) -> Any:
    """Return a plain value as an object of a kind; see the module.

    Raises
    ------
    ValueError
        Naming field, value and what is accepted.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return arguments[1](value, field)
    if origin in (Union, types.UnionType):
        (kind,) = (argument for argument in arguments if argument is not types.NoneType)
        return None if value is None else read(kind, value, field)
    if origin is tuple:
        return _tuple(arguments, value, field)
    if origin in (dict, Mapping):
        return {
            read(arguments[0], key, join(field, key)): read(arguments[1], item, join(field, key))
            for key, item in _mapping(value, field).items()
        }
    if getattr(origin, "__name__", "") == "ndarray":
        return _array(value, field)
    if origin is Literal or (isinstance(kind, type) and issubclass(kind, Enum)):
        choices = {choice: choice for choice in arguments} or {item.value: item for item in kind}
        chosen = [it for text, it in choices.items() if type(text) is type(value) and text == value]
        require(bool(chosen), field, value, accepted(kind))
        return chosen[0]
    if dataclasses.is_dataclass(kind):
        return read_dataclass(cast(type, kind), value, field)
    if kind is float:
        return number(value, field)
    if kind is not Any:
        require(type(value) is kind, field, value, accepted(kind))
    return value


def accepted(kind: Any) -> str:
    """What is accepted for a kind, in words."""
    enumeration = isinstance(kind, type) and issubclass(kind, Enum)
    choices = [item.value for item in kind] if enumeration else get_args(kind)
    if enumeration or get_origin(kind) is Literal:
        return f"{'one of ' if len(choices) > 1 else ''}{', '.join(map(str, choices))}"
    if dataclasses.is_dataclass(kind):
        return f"a mapping with {', '.join(_fields(cast(type, kind)))}"
    return _PLAIN.get(kind, "a number" if kind is float else "a value")


def join(where: str, key: object) -> str:
    """Name of a field inside of another; one that ends in a colon is a file."""
    return f"{_inside(where)}{cut(str(key) if str(key).isprintable() else repr(key))}"


def _inside(where: str) -> str:
    return f"{where} " if where.endswith(":") else f"{where}." if where else ""


@cache
def _fields(cls: type) -> dict[str, tuple[str, Any, bool, Range | None]]:
    """By key: name and kind of each field of a dataclass, whether it may be left out, and its range.

    Names are keys, but for a last ``_`` that distinguishes them from Python's own words.
    """
    hints, bare = get_type_hints(cls, include_extras=True), get_type_hints(cls)
    found, nothing = {}, dataclasses.MISSING
    for f in dataclasses.fields(cls):
        kind, of = hints[f.name], None
        for each in (kind, *get_args(kind)):  # of those that may be None, too
            for mark in getattr(each, "__metadata__", ()):
                if isinstance(mark, Range):
                    kind, of = bare[f.name], mark
        optional = f.default is not nothing or f.default_factory is not nothing
        if f.init:
            found[f.name.rstrip("_")] = (f.name, kind, optional, of)
    return found


def _mapping(value: object, field: str) -> Mapping[str, Any]:
    require(isinstance(value, Mapping), field.rstrip(":"), value, "a mapping")
    return cast(Mapping[str, Any], value)


def _tuple(kinds: tuple[Any, ...], value: object, field: str) -> tuple[Any, ...]:
    """Tuple of a list: of these kinds, or any number of the first."""
    endless = kinds[-1] is Ellipsis
    what = "numbers" if kinds[0] is float else "entries"
    good = isinstance(value, (list, tuple)) and (endless or len(value) == len(kinds))
    require(good, field, value, f"a list of {what if endless else f'{len(kinds)} {what}'}")
    assert isinstance(value, (list, tuple))
    each = kinds[:1] * len(value) if endless else kinds
    return tuple(
        read(kind, item, f"{field}[{i}]")
        for i, (kind, item) in enumerate(zip(each, value, strict=True))
    )


def _array(value: object, field: str) -> Any:
    """Array of a list of numbers, or of lists of them of one length."""
    import numpy as np  # a node that reads no arrays need not load it

    require(isinstance(value, (list, tuple)), field, value, "a list of numbers, or of such lists")
    assert isinstance(value, (list, tuple))
    if not any(isinstance(item, (list, tuple)) for item in value):
        return np.array(numbers(value, field))
    rows = [_array(item, f"{field}[{i}]") for i, item in enumerate(value)]
    for i, row in enumerate(rows):
        require(row.shape == rows[0].shape, f"{field}[{i}]", row.shape, f"shape {rows[0].shape}")
    return np.array(rows)
