# SPDX-License-Identifier: Apache-2.0
"""Checked reading of configuration: one error that names field, value and what is accepted."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

T = TypeVar("T")


def require(condition: bool, field: str, value: object, accepted: str) -> None:
    """Raise ``ValueError`` naming field, value and what is accepted, unless `condition` holds."""
    if not condition:
        raise ValueError(f"{field}: got {value!r}; accepted is {accepted}")


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping.

    Raises
    ------
    ValueError
        If the file cannot be read or parsed, or its top level is no mapping.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: cannot be read as YAML: {error}") from error
    require(isinstance(content, dict), str(path), type(content).__name__, "a mapping of sections")
    return content


def section(mapping: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    """Return the sub-mapping `key`; ``ValueError`` if it is absent or no mapping."""
    value = mapping.get(key)
    require(isinstance(value, Mapping), _join(where, key), value, "a mapping")
    assert isinstance(value, Mapping)
    return value


def known_keys(mapping: Mapping[str, Any], keys: set[str], where: str) -> None:
    """Raise ``ValueError`` if `mapping` has a key that is not among `keys`."""
    for key in mapping:
        require(key in keys, _join(where, str(key)), mapping[key], f"one of {sorted(keys)}")


def number(value: object, field: str) -> float:
    """Return `value` as a finite float; ``ValueError`` if it is not."""
    # an integer may be beyond all floats, which math.isfinite does not take
    good = (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and abs(value) <= sys.float_info.max
    )
    require(good, field, value, "a finite number (write exponents as 1.0e-3)")
    return float(value)  # type: ignore[arg-type]


def numbers(value: object, field: str, count: int | None = None) -> tuple[float, ...]:
    """Return a list of finite numbers as a tuple, of length `count` where that is given."""
    good = isinstance(value, (list, tuple)) and (count is None or len(value) == count)
    require(good, field, value, "a list of " + ("" if count is None else f"{count} ") + "numbers")
    assert isinstance(value, (list, tuple))
    return tuple(number(item, f"{field}[{i}]") for i, item in enumerate(value))


def read_dataclass(cls: type[T], mapping: Mapping[str, Any], where: str, **read: object) -> T:
    """Build a dataclass of float, int, bool and str fields from a mapping with exactly its keys.

    Fields with a default may be left out. Range checks are the dataclass's own. `read` are fields of other
    types, which the caller has read.
    """
    specifications = {
        f.name: f
        for f in dataclasses.fields(cls)  # type: ignore[arg-type]
        if f.name not in read
    }
    known_keys(mapping, set(specifications), where)
    values: dict[str, Any] = dict(read)
    for name, specification in specifications.items():
        field = _join(where, name)
        if name not in mapping:
            optional = specification.default is not dataclasses.MISSING
            require(optional, field, None, "a value (it is missing)")
            continue
        value, kind = mapping[name], str(specification.type)
        if kind == "float":
            values[name] = number(value, field)
        elif kind == "int":
            require(type(value) is int, field, value, "an integer")
            values[name] = value
        elif kind == "bool":
            require(isinstance(value, bool), field, value, "true or false")
            values[name] = value
        elif kind == "str":
            require(isinstance(value, str), field, value, "text")
            values[name] = value
        else:
            raise TypeError(f"{cls.__name__}.{name}: fields of type {kind} are read by hand")
    try:
        return cls(**values)
    except ValueError as error:
        raise ValueError(_join(where, str(error))) from error


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key
