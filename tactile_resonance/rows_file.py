# SPDX-License-Identifier: Apache-2.0
"""Files of rows that need not fit the memory: ``.npz`` of structured arrays, there whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from typing_extensions import Self

_LOCAL_HEADER = (
    30  # bytes of a member's header before its name (PKWARE APPNOTE 6.3.10, section 4.3.7)
)
_LENGTHS = 26  # where the lengths of its name and of what follows it stand


class RowsWriter:
    """Writes an ``.npz`` file of structured arrays that grow; a context that leaves no half file behind.

    Parameters
    ----------
    path : Path
        Replaced by `finish`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._part = path.with_name(path.name + ".part")
        self._rows: dict[str, tuple[np.dtype, IO[bytes]]] = {}
        self._files = contextlib.ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()
        self._part.unlink(missing_ok=True)

    def append(self, name: str, rows: npt.NDArray) -> None:
        """Add rows (n,) to an array; all of them have one type."""
        if name not in self._rows:
            # without a name: whatever ends this process, nothing of it is left
            file = self._files.enter_context(
                tempfile.TemporaryFile(dir=self._path.parent)  # noqa: SIM115
            )
            self._rows[name] = rows.dtype, file
        rows.tofile(self._rows[name][1])

    def finish(self, **arrays: npt.NDArray) -> None:
        """Give the file its name, with some whole arrays beside those of rows."""
        with self._part.open("wb") as file:
            with zipfile.ZipFile(file, "w", allowZip64=True) as members:
                for name, (dtype, rows) in self._rows.items():
                    count = rows.tell() // dtype.itemsize
                    rows.seek(0)
                    with members.open(f"{name}.npy", "w", force_zip64=True) as member:
                        head = {
                            "descr": np.lib.format.dtype_to_descr(dtype),
                            "fortran_order": False,
                            "shape": (count,),
                        }
                        np.lib.format.write_array_header_2_0(member, head)
                        shutil.copyfileobj(rows, member, 1 << 20)
                for name, array in arrays.items():
                    with members.open(f"{name}.npy", "w") as member:
                        np.lib.format.write_array(member, array, allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        self._part.replace(self._path)


@dataclass(frozen=True)
class Rows:
    """Rows in a file of `RowsWriter`, read in pieces.

    Attributes
    ----------
    path : Path
    dtype : numpy.dtype
    count : int
    offset : int
        Of the first one in the file [bytes].
    """

    path: Path
    dtype: np.dtype
    count: int
    offset: int

    @classmethod
    def of(cls, path: Path, name: str) -> Rows:
        """Array of a file.

        Raises
        ------
        ValueError
            If it is damaged, or of another kind.
        """
        try:
            with path.open("rb") as file, zipfile.ZipFile(file) as members:
                info = members.getinfo(f"{name}.npy")
                file.seek(info.header_offset + _LENGTHS)
                file.seek(
                    info.header_offset + _LOCAL_HEADER + sum(struct.unpack("<HH", file.read(4)))
                )
                if np.lib.format.read_magic(file) != (2, 0):
                    raise ValueError("another version of its arrays")
                shape, _, dtype = np.lib.format.read_array_header_2_0(file)
                return cls(path, dtype, shape[0], file.tell())
        except (KeyError, NotImplementedError, zipfile.BadZipFile, struct.error) as error:
            raise ValueError(f"{path}: damaged or foreign file ({error})") from error

    def read(self, start: int, stop: int) -> npt.NDArray:
        """(stop - start,) rows."""
        if not 0 <= start <= stop <= self.count:
            raise ValueError(f"rows: {start} to {stop}, {self.path} holds {self.count}")
        offset = self.offset + start * self.dtype.itemsize
        return np.fromfile(self.path, self.dtype, stop - start, offset=offset)
