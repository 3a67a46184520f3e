# SPDX-License-Identifier: Apache-2.0
"""Named arrays of .npz, .mat and .csv files of any origin: what is wanted of them, within bounds, or one line.

SciPy's reader of .mat files ends its process at some damaged files (SIGSEGV, SIGBUS): it has one of its own.
"""

from __future__ import annotations

import csv
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import TextIO

import numpy as np

from tactile_resonance.fields import cut, one_line

Arrays = Mapping[str, np.ndarray]
ACCEPTED = ".npz, .mat and .csv"
MOST_BYTES = 1 << 32
"""Of a file, and of the arrays that are wanted of it."""
_LONGEST_LINE = 1 << 16
_NUMBERS = "biufc"  # kinds of numpy's types
_MAT_WITHIN_S = 300.0
# the arguments: file, target and the wanted names; numbers alone are taken over
_MAT_READER = """
import sys
import numpy as np, scipy.io
try:
    import resource
    most, of = 1 << 34, resource.RLIMIT_AS
    resource.setrlimit(of, tuple(most if at < 0 else min(at, most) for at in resource.getrlimit(of)))
except ImportError:  # not on Windows
    pass
path, target, *wanted = sys.argv[1:]
names = [name for name, *_ in scipy.io.whosmat(path)]
held = [name for name in names if name in wanted]
content = scipy.io.loadmat(path, variable_names=held) if held else {}
held = [n for n in held if isinstance(content[n], np.ndarray) and content[n].dtype.kind in "biufc"]
arrays = {f"a{names.index(n)}": content[n] for n in held}
np.savez(target, names=np.array(names or [""]), **arrays)
"""


def read_arrays(path: Path, wanted: Collection[str]) -> tuple[Arrays, list[str]]:
    """Arrays of a file.

    Parameters
    ----------
    path : Path
    wanted : collection of str
        Names; others are not read.

    Returns
    -------
    arrays : mapping
        Those of the wanted names that the file holds as arrays of numbers.
    names : list of str
        All that it holds.

    Raises
    ------
    ValueError
        If the suffix is none of `ACCEPTED`, or the file is damaged, too large or no regular file.
    OSError
        If it cannot be opened.
    """
    readers = {".npz": _read_npz, ".mat": _read_mat, ".csv": _read_csv}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path.name}: no record, accepted are {ACCEPTED}")
    found = os.stat(path)
    if not stat.S_ISREG(found.st_mode):  # a device has no end, a pipe would wait
        raise ValueError(f"{path.name}: a folder or device, accepted are files {ACCEPTED}")
    if not 0 < found.st_size <= MOST_BYTES:
        size = "empty file" if not found.st_size else f"{found.st_size / 1e9:.1f} GB"
        raise ValueError(f"{path.name}: {size}, accepted are {ACCEPTED} up to 4 GiB")
    return reader(path, wanted)


def _read_npz(path: Path, wanted: Collection[str]) -> tuple[Arrays, list[str]]:
    try:
        with np.load(path) as archive:
            names = list(dict.fromkeys(archive.files))
            for info in archive.zip.infolist():
                held = info.filename.removesuffix(".npy") in wanted
                if held and info.file_size > MOST_BYTES:
                    size = f"{info.file_size / 1e9:.1f} GB"
                    raise ValueError(f"an array of {size}, accepted are 4 GiB")
            # what a header promises beyond its member is never touched: numpy ends where that does
            arrays = {name: np.asarray(archive[name]) for name in names if name in wanted}
        return {name: a for name, a in arrays.items() if a.dtype.kind in _NUMBERS}, names
    except Exception as error:  # whatever zipfile and numpy meet in a damaged file
        raise ValueError(f"{path.name}: no .npz record ({one_line(error)[:120]})") from error


def _read_mat(path: Path, wanted: Collection[str]) -> tuple[Arrays, list[str]]:
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "arrays.npz"
        try:
            done = subprocess.run(
                [sys.executable, "-c", _MAT_READER, path.absolute(), target, *wanted],
                cwd=folder,  # Python imports from there first: not from where the record may lie
                capture_output=True,
                text=True,
                timeout=_MAT_WITHIN_S,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise ValueError(f"{path.name}: no .mat record (no end in sight)") from error
        if done.returncode < 0:
            reason = f"damaged: its reader ended by signal {-done.returncode}"
            raise ValueError(f"{path.name}: no .mat record ({reason})")
        last = (done.stderr.strip().splitlines() or [""])[-1]
        if "NotImplementedError" in last:
            raise ValueError(
                f"{path.name}: MATLAB 7.3 file, accepted are versions up to 7 (save with '-v7')"
            )
        if done.returncode:
            raise ValueError(f"{path.name}: no .mat record ({cut(last)[:120]})")
        with np.load(target) as archive:
            names = [str(name) for name in archive["names"] if name]
            arrays = {
                name: archive[f"a{k}"] for k, name in enumerate(names) if f"a{k}" in archive.files
            }
    return arrays, names


def _read_csv(path: Path, wanted: Collection[str]) -> tuple[Arrays, list[str]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = _Lines(file)
            head = next(lines, "")
            dialect = csv.Sniffer().sniff(head, delimiters=",;\t")
            names = [name.strip() for name in next(csv.reader([head], dialect))]
            names[0] = names[0].removeprefix("#").strip()  # as numpy.savetxt marks a header
            if all(_is_number(name) for name in names):
                raise ValueError("its first line holds numbers")
            if len(set(names)) < len(names):
                raise ValueError(f"columns named alike: {', '.join(names)}")
            if not (first := next(lines, "")):  # loadtxt warns and returns nothing
                raise ValueError("no numbers under the header")
            columns = _columns(chain([first], lines), lines, dialect.delimiter)
    except (csv.Error, ValueError, StopIteration) as error:
        raise ValueError(
            f"{path.name}: no .csv record ({one_line(error)[:120]}); expected a header line with the names "
            "of the columns, then numbers with decimal points"
        ) from error
    if columns.shape[1] != len(names):
        raise ValueError(
            f"{path.name}: {columns.shape[1]} columns under {len(names)} names, expected as many"
        )
    of_names = zip(names, columns.T, strict=True)
    return {name: column for name, column in of_names if name in wanted}, names


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _columns(rows: Iterator[str], lines: _Lines, delimiter: str) -> np.ndarray:
    """Numbers of `rows`, which end with `lines`; a row that is wrong is named by its line in the file."""
    try:
        return np.loadtxt(rows, delimiter=delimiter, ndmin=2)
    except ValueError as error:  # rows are counted from 0 or from 1, as the fault is
        raise ValueError(f"line {lines.number}: {one_line(error).partition(' at row ')[0]}") from error


class _Lines(Iterator[str]):
    """Lines that are not blank; `number` is that of the last one in the file, from 1."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self.number = 0

    def __next__(self) -> str:
        while line := self._file.readline(_LONGEST_LINE):
            self.number += 1
            if len(line) == _LONGEST_LINE:
                raise ValueError(f"a line of {_LONGEST_LINE} characters or more")
            if line.strip():
                return line
        raise StopIteration
