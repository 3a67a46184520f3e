# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

PART = ".part"
"""After the name of a file that is being written; whole where its writer was killed waiting for the disk."""


def write_whole(path: Path, content: bytes, written: Callable[[], None] | None = None) -> None:
    """Write a file that is there whole or not at all.

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
    finally:
        if not told:
            part.unlink(missing_ok=True)
