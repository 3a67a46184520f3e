# SPDX-License-Identifier: Apache-2.0
"""Bins of the band of every point of a run, kept beside its recording: what poles are identified from again.

``RUN/bins.npz`` follows from the recording and is made when it is first asked for: transforming the records
takes a hundred times as long as the fit. Its arrays ``points_0``, ``points_1`` ... hold one row a point, one
array for each kind of record: index, attempt, measurement_id, x_m, y_m, z_m, and u and y, (M, K) bins in single
precision. ``kinds`` says in JSON what the rows of each have in common, which files all were made of, and what
was left out.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.excited import find_excited_harmonics
from tactile_resonance.frf.result import BandBins, band_bins
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.recorded import recording_of_point
from tactile_resonance.scan.run_content import RECORDING, read_run

if TYPE_CHECKING:
    from typing_extensions import Self

NAME = "bins.npz"
FORMAT = "tactile_resonance bins 1"
PLACE = {"index": "<i4", "attempt": "<i4", "measurement_id": "<i8"}
PLACE |= dict.fromkeys(("x_m", "y_m", "z_m"), "<f8")
"""Types of what says which point a row is of, by name."""
_LOCAL_HEADER = (
    30  # bytes of a member's header before its name (PKWARE APPNOTE 6.3.10, section 4.3.7)
)
_LENGTHS = 26  # where the lengths of its name and of what follows it stand


@dataclass(frozen=True)
class BinsKind:
    """What the records of some points have in common; see `BandBins`."""

    first_bin: int
    realisations: int
    count: int
    harmonics: tuple[int, ...]
    sample_rate_hz: float
    samples_per_period: int
    periods: int

    @classmethod
    def of(cls, bins: BandBins) -> BinsKind:
        """Of the bins of a point."""
        realisations, count = bins.u.shape
        return cls(
            int(bins.first_bin),
            realisations,
            count,
            tuple(bins.harmonics.tolist()),
            float(bins.sample_rate_hz),
            int(bins.samples_per_period),
            int(bins.periods),
        )

    @property
    def dtype(self) -> np.dtype:
        """Of the row of a point."""
        shape = (self.realisations, self.count)
        return np.dtype([*PLACE.items(), ("u", "<c8", shape), ("y", "<c8", shape)])

    def bins(self, row: npt.NDArray) -> BandBins:
        """Of one point."""
        return BandBins(
            self.first_bin,
            row["u"].astype(complex),
            row["y"].astype(complex),
            np.array(self.harmonics, np.int64),
            self.sample_rate_hz,
            self.samples_per_period,
            self.periods,
        )


@dataclass(frozen=True)
class KeptBins:
    """The points of a run by the kinds of their records; points without bins, and why."""

    kinds: tuple[tuple[BinsKind, Rows], ...]
    left_out: tuple[str, ...]


def kept_bins(run: Path, band_hz: tuple[float, float]) -> KeptBins | None:
    """What is kept of a run; None where nothing is, or not of this band, or the recording has changed since.

    Raises
    ------
    OSError
        If the folder cannot be read.
    """
    path = run / NAME
    if not path.is_file():
        return None
    try:
        with np.load(path) as arrays:
            if arrays.zip.testzip() is not None:  # rows are read past its checksums
                return None
            content = json.loads(str(arrays["kinds"]))
        low_hz, high_hz = content["band_hz"]
        if content["format"] != FORMAT or content["files"] != _files(run):
            return None
        kinds = [
            BinsKind(**{**kind, "harmonics": tuple(kind["harmonics"])}) for kind in content["kinds"]
        ]
        rows = [Rows.of(path, f"points_{k}") for k in range(len(kinds))]
    except (
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        NotImplementedError,
        zipfile.BadZipFile,
        struct.error,
    ):  # damaged: it is made again
        return None
    within = low_hz <= band_hz[0] and band_hz[1] <= high_hz
    pairs = tuple(zip(kinds, rows, strict=True))
    return KeptBins(pairs, tuple(content["left_out"])) if within else None


def bins_of_point(
    job: tuple[Path, PointResult, tuple[float, float]],
) -> tuple[BinsKind, npt.NDArray] | str:
    """Kind and row (1,) of a point of a run in a band, from its records; why there is none as text."""
    run, result, band_hz = job
    name = f"point {result.index}"
    try:
        recording = recording_of_point(run, result)
        record, harmonics = Spectrum.of(recording.u, recording.y), recording.excited_harmonics
        rate_hz = recording.sample_rate_hz
        if harmonics is None:
            harmonics = find_excited_harmonics(record)
        bins = band_bins(record, harmonics, sample_rate_hz=rate_hz, band_hz=band_hz)
    except ValueError as error:
        return f"{name}: {error}"
    if bins is None:
        return f"{name}: no excited line in {band_hz[0]:g}-{band_hz[1]:g} Hz"
    kind = BinsKind.of(bins)
    row = np.zeros(1, kind.dtype)
    for field in PLACE:
        row[field] = getattr(result, field)
    row["u"], row["y"] = bins.u, bins.y
    return kind, row


def keep_bins(
    run: Path,
    band_hz: tuple[float, float],
    each: Callable[[Callable, Iterable], Iterable] = map,
    progress: Callable[[str, int, int], None] = lambda what, done, of: None,
) -> KeptBins:
    """Make ``bins.npz`` of a run, of the latest attempt at each finished point.

    Parameters
    ----------
    run : Path
    band_hz : (low, high)
    each : callable
        As `map`, in whatever processes.
    progress : callable
        Told what is done, how many points are, and of how many.

    Raises
    ------
    ValueError
        If it is no run.
    OSError
        If the folder cannot be written.
    """
    files, content = _files(run), read_run(run)
    kinds: dict[BinsKind, str] = {}
    left_out = list(content.problems)
    with RowsWriter(run / NAME) as writer:
        jobs = ((run, result, band_hz) for result in content.latest)
        for done, found in enumerate(each(bins_of_point, jobs), start=1):
            progress(f"bins of {run.name}", done, len(content.latest))
            if isinstance(found, str):
                left_out.append(found)
                continue
            kind, row = found
            writer.append(kinds.setdefault(kind, f"points_{len(kinds)}"), row)
        finish(writer, list(kinds), band_hz, files, left_out)
    kept = kept_bins(run, band_hz)
    assert kept is not None
    return kept


def finish(
    writer: RowsWriter,
    kinds: list[BinsKind],
    band_hz: tuple[float, float],
    files: dict[str, int],
    left_out: list[str],
) -> None:
    """Complete a file of bins whose rows ``points_0`` ... are written."""
    content: dict[str, Any] = {
        "format": FORMAT,
        "band_hz": list(band_hz),
        "kinds": [asdict(kind) for kind in kinds],
        "files": files,
        "left_out": left_out,
    }
    writer.finish(kinds=np.array(json.dumps(content)))


def _files(run: Path) -> dict[str, int]:
    """Sizes of the finished files of a recording by their names."""
    return {file.name: file.stat().st_size for file in sorted((run / RECORDING).glob("*.mcap"))}


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
        """Array of a file that was found to be whole."""
        with path.open("rb") as file, zipfile.ZipFile(file) as members:
            info = members.getinfo(f"{name}.npy")
            file.seek(info.header_offset + _LENGTHS)
            lengths = struct.unpack("<HH", file.read(4))
            file.seek(info.header_offset + _LOCAL_HEADER + sum(lengths))
            np.lib.format.read_magic(file)
            shape, _, dtype = np.lib.format.read_array_header_2_0(file)
            return cls(path, dtype, shape[0], file.tell())

    def read(self, start: int, stop: int) -> npt.NDArray:
        """(stop - start,) rows."""
        offset = self.offset + start * self.dtype.itemsize
        return np.fromfile(self.path, self.dtype, stop - start, offset=offset)
