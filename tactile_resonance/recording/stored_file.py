# SPDX-License-Identifier: Apache-2.0
"""One excitation or record in one .npz file: there whole or not at all, and bit-exact."""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np
import numpy.typing as npt

from tactile_resonance.files import sync, write_whole
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Record

T = TypeVar("T", Excitation, Record)
Fields = dict[str, npt.NDArray[Any]]

_FORMAT = "tactile_resonance {} 1"
_DTYPE = ":dtype"  # suffix of the field that names the integer type an array had
_DAMAGE = (ValueError, TypeError, KeyError, EOFError, OSError, NotImplementedError, RuntimeError,
           SyntaxError, MemoryError, tokenize.TokenError, zipfile.BadZipFile, zlib.error)  # fmt: skip


def write_stored(
    path: Path, value: Excitation | Record, written: Callable[[], None] | None = None
) -> None:
    """Write one object durably: a reader, or a power cut, finds the whole file or none.

    Parameters
    ----------
    path : Path
        In a folder that exists; a file of this name is replaced.
    value : Excitation or Record
        Each field becomes one array named after it (``origin.contact.force_n``). Integer arrays are
        held in the smallest signed type that holds them exactly.
    written : callable, optional
        See `write_whole`.

    Raises
    ------
    ValueError
        If an array is neither of signed integers nor floating point.
    OSError
        If it cannot be written; nothing is left behind, unless `written` was called.
    """
    content: Fields = {"format": np.array(_FORMAT.format(type(value).__name__))}
    _flatten("", value, content)
    # a damaged zip directory can lose a field without an error
    content["fields"] = np.array(sorted(content))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:  # as numpy.savez, in a third of the time less
        for name, array in content.items():
            archive.writestr(f"{name}.npy", _header(array.dtype.str, array.shape) + array.tobytes())
    write_whole(path, buffer.getvalue(), written)
    sync(path.parent)


def read_stored(path: Path, kind: type[T]) -> T:
    """What `write_stored` wrote.

    Raises
    ------
    ValueError
        If the file is damaged or something else; one line that names it.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = {name: archive[name] for name in archive.files}
        if str(content.get("format")) != _FORMAT.format(kind.__name__):
            raise ValueError(f"no {kind.__name__} of format 1")
        if sorted(content.keys() - {"fields"}) != content["fields"].tolist():
            raise ValueError("a field is lost")
        return _unflatten("", kind, content)
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise ValueError(f"{path.name}: damaged or foreign file ({reason})") from error


@lru_cache(maxsize=256)
def _header(dtype: str, shape: tuple[int, ...]) -> bytes:
    """What stands before the values of an array of C order in an .npy file."""
    header = io.BytesIO()
    described = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, described)
    return header.getvalue()


def _flatten(prefix: str, value: Any, content: Fields) -> None:
    for field in fields(value):
        name, item = prefix + field.name, getattr(value, field.name)
        if is_dataclass(item):
            _flatten(f"{name}.", item, content)
        elif isinstance(item, tuple) and item and is_dataclass(item[0]):
            for part in fields(item[0]):
                content[f"{name}.{part.name}"] = np.array(
                    [getattr(each, part.name) for each in item]
                )
        elif isinstance(item, np.ndarray):
            content[name] = item
            if item.dtype.kind == "i":
                content[name + _DTYPE] = np.array(item.dtype.str)
                # -1 - n needs as many bits as n
                low, high = int(item.min(initial=0)), int(item.max(initial=0))
                content[name] = item.astype(np.min_scalar_type(min(low, -1 - high)))
            elif item.dtype.kind != "f":
                raise ValueError(f"{name}: values of type {item.dtype}, expected int or float")
        elif isinstance(item, Enum):
            content[name] = np.array(item.value)
        elif item is not None and item != ():  # no field of what is not there
            content[name] = np.array(item)


def _unflatten(prefix: str, kind: type, content: Mapping[str, npt.NDArray[Any]]) -> Any:
    hints = get_type_hints(kind)
    values: dict[str, Any] = {}
    for field in fields(kind):
        name, hint = prefix + field.name, hints[field.name]
        if is_dataclass(hint):
            values[field.name] = _unflatten(f"{name}.", hint, content)  # type: ignore[arg-type]
            continue
        if get_args(hint) and is_dataclass(part := get_args(hint)[0]):  # a tuple of them
            columns = [
                content.get(f"{name}.{each.name}", np.empty(0)).tolist() for each in fields(part)
            ]
            values[field.name] = tuple(part(*row) for row in zip(*columns, strict=True))  # type: ignore[operator]
            continue
        array = content.get(name)
        if array is None:
            # a file may be older than the field
            if field.default is MISSING:
                raise ValueError(f"{name} is missing")
        elif name + _DTYPE in content:
            values[field.name] = array.astype(np.dtype(str(content[name + _DTYPE])), casting="safe")
        elif array.ndim == 0:
            is_enum = isinstance(hint, type) and issubclass(hint, Enum)
            values[field.name] = hint(array.item()) if is_enum else array.item()
        else:
            is_tuple = str(field.type).startswith("tuple")
            values[field.name] = tuple(array.tolist()) if is_tuple else array
    return kind(**values)
