# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

_OF_FORMULAS = ("=", "@", "+", "-", "\t", "\r")
"""A spreadsheet takes a text that begins so for a formula."""
PART = ".part"
"""After the name of a file that is being written; whole where its writer was killed waiting for the disk."""


def write_whole(path: Path, content: bytes, written: Callable[[], None] | None = None) -> None:
    """Write a file that is there whole or not at all; its name is durable after a `sync` of the folder.

    Parameters
    ----------
    path : Path
    content : bytes
    written : callable, optional
        Called once the end of this process cannot lose the content any more, before the disk has it. What
        goes wrong from then on leaves the content in the file with `PART`.

    Raises
    ------
    ValueError
        If something other than a regular file stands there: a device would be replaced.
    OSError
        If it cannot be written, with its name.
    """
    if path.exists() and not path.is_file():
        raise ValueError(
            f"output: {path} is not a regular file, expected a new one or one to replace"
        )
    part = path.with_name(path.name + PART)
    told = False
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            if written is not None:
                told = True
                written()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        if error.filename is None:  # as of a write to a full disk
            error.filename = str(path)
        raise
    finally:
        if not told:
            part.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Make a file, or the names in a folder, durable."""
    if os.name == "nt" and path.is_dir():  # cannot be opened there; its file system journals names
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Lines of a table: numbers with all their digits.

    A text that a spreadsheet would take for a formula begins with an apostrophe.
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue()


def _cell(value: object) -> str:
    if isinstance(value, float):
        return repr(float(value))
    text = str(value)
    return f"'{text}" if isinstance(value, str) and text.startswith(_OF_FORMULAS) else text
