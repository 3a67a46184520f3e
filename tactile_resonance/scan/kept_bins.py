# SPDX-License-Identifier: Apache-2.0
"""Bins of the band of every point of a run, kept beside its recording: what poles are identified from again.

``RUN/bins.npz`` follows from the recording and is made when it is first asked for: transforming the records
takes a hundred times as long as the fit. Its arrays hold one row a point: index, attempt, measurement_id, x_m,
y_m, z_m, and u and y, (M, K) bins in single precision. ``points_0_0``, ``points_0_1`` ... are of one kind of
record, ``points_1_0`` ... of the next, each no larger than what a process takes at once. ``kinds`` says in JSON
what the rows of each kind have in common and how many each array has, which files all were made of, and what
was left out.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from tactile_resonance.fields import read
from tactile_resonance.frf.result import BandBins, band_bins
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.recorded import recording_of_point
from tactile_resonance.scan.run_content import RECORDING, read_run

NAME = "bins.npz"
FORMAT = "tactile_resonance bins 2"
BYTES_AT_ONCE = 16_000_000
"""Of the bins that a process takes together: one array of the file."""
PLACE = {"index": "<i4", "attempt": "<i4", "measurement_id": "<i8"}
PLACE |= dict.fromkeys(("x_m", "y_m", "z_m"), "<f8")
"""Types of what says which point a row is of, by name."""


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
class Piece:
    """Rows of one kind, an array of a file found to be whole; its ``kinds`` have the checksum `kinds_crc`."""

    kind: BinsKind
    path: Path
    name: str
    count: int
    kinds_crc: int

    def read(self) -> npt.NDArray:
        """(count,) rows; ``ValueError`` where the file was replaced: its rows may be of another band."""
        with np.load(self.path) as arrays:
            if _kinds_crc(arrays.zip) != self.kinds_crc:
                raise ValueError(
                    f"{self.path}: replaced meanwhile, by a command with another band or as the run has grown; "
                    "accepted is one such command at a time"
                )
            return np.asarray(arrays[self.name])


@dataclass(frozen=True)
class KeptBins:
    """The points of a run, one kind of their records after the other; points without bins, and why."""

    pieces: tuple[Piece, ...]
    left_out: tuple[str, ...]


def kept_bins(run: Path, band_hz: tuple[float, float]) -> KeptBins | None:
    """What is kept of a run; None where nothing is, or not of this band, or the recording has changed since.

    Raises
    ------
    OSError
        If the folder cannot be read.
    """
    path, files = run / NAME, _files(run)
    if not path.is_file():
        return None
    try:
        with np.load(path) as arrays:
            if arrays.zip.testzip() is not None:
                return None
            content, kinds_crc = json.loads(str(arrays["kinds"])), _kinds_crc(arrays.zip)
        low_hz, high_hz = content["band_hz"]
        if content["format"] != FORMAT or content["files"] != files:
            return None
        kinds = read(tuple[BinsKind, ...], content["kinds"], "kinds")
        pieces = [
            Piece(kind, path, f"points_{k}_{j}", count, kinds_crc)
            for k, (kind, counts) in enumerate(zip(kinds, content["counts"], strict=True))
            for j, count in enumerate(counts)
        ]
    except Exception as error:
        # a wrong offset in the file is damage, too
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise
        return None  # whatever zipfile and numpy met in a damaged file: it is made again
    within = low_hz <= band_hz[0] and band_hz[1] <= high_hz
    return KeptBins(tuple(pieces), tuple(content["left_out"])) if within else None


def bins_of_point(
    job: tuple[Path, PointResult, tuple[float, float]],
) -> tuple[BinsKind, npt.NDArray] | str:
    """Kind and row (1,) of a point of a run in a band, from its records; why there is none as text."""
    run, result, band_hz = job
    name = f"point {result.index + 1}"
    try:
        recording = recording_of_point(run, result)
        record, harmonics = Spectrum.of(recording.u, recording.y), recording.excited_harmonics
        assert harmonics is not None  # the store's recordings know them
        bins = band_bins(record, harmonics, sample_rate_hz=recording.sample_rate_hz, band_hz=band_hz)
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
    folder: Path | None = None,
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
    folder : Path, optional
        Of the file; that of the run when absent.

    Raises
    ------
    ValueError
        If it is no run.
    OSError
        If the folder cannot be written.
    """
    files, content = _files(run), read_run(run)
    left_out = list(content.problems)
    if left_out:
        files = {}  # of no run: what is damaged may be restored, so bins are made again

    def rows() -> Iterator[tuple[BinsKind, npt.NDArray]]:
        jobs = ((run, result, band_hz) for result in content.latest)
        for done, found in enumerate(each(bins_of_point, jobs), start=1):
            progress(f"bins of {run.name}", done, len(content.latest))
            if isinstance(found, str):
                left_out.append(found)
            else:
                yield found

    return write_bins(folder or run, rows(), band_hz, files, left_out)


def write_bins(
    folder: Path,
    found: Iterable[tuple[BinsKind, npt.NDArray]],
    band_hz: tuple[float, float],
    files: dict[str, int],
    left_out: list[str],
) -> KeptBins:
    """Write ``bins.npz`` of rows with their kinds; what is left out may be added to while these come.

    Where there are no rows, as of a band without lines, the file that is there stays.
    """
    found = iter(found)
    if (first := next(found, None)) is None:
        return KeptBins((), tuple(left_out))
    waiting: dict[BinsKind, list[npt.NDArray]] = {}  # in the order in which kinds came first
    pieces: dict[BinsKind, list[tuple[str, int]]] = {}  # name and rows of each
    with whole_files(folder / NAME) as (growing,), zipfile.ZipFile(growing, "w") as members:

        def write(kind: BinsKind) -> None:
            rows, of_kind = np.concatenate(waiting[kind]), pieces.setdefault(kind, [])
            name = f"points_{[*waiting].index(kind)}_{len(of_kind)}"
            write_array(members, name, rows)
            of_kind.append((name, rows.size))
            waiting[kind].clear()

        for kind, rows in chain([first], found):
            own = waiting.setdefault(kind, [])
            if own and (len(own) + 1) * rows.nbytes > BYTES_AT_ONCE:
                write(kind)
            own.append(rows)
        for kind in waiting:
            write(kind)
        content = {
            "format": FORMAT,
            "band_hz": list(band_hz),
            "kinds": [asdict(kind) for kind in waiting],
            "counts": [[count for _, count in pieces[kind]] for kind in waiting],
            "files": files,
            "left_out": left_out,
        }
        write_array(members, "kinds", np.array(json.dumps(content)))
    crc = _kinds_crc(members)
    made = (Piece(kind, folder / NAME, *piece, crc) for kind in waiting for piece in pieces[kind])
    return KeptBins(tuple(made), tuple(left_out))


def _kinds_crc(members: zipfile.ZipFile) -> int:
    """Checksum of what a file holds, of which band and of which files."""
    return members.getinfo("kinds.npy").CRC


def _files(run: Path) -> dict[str, int]:
    """Sizes of the finished files of a recording by their names."""
    return {file.name: file.stat().st_size for file in sorted((run / RECORDING).glob("*.mcap"))}


@contextlib.contextmanager
def whole_files(*paths: Path) -> Iterator[list[IO[bytes]]]:
    """Files to be written piece by piece, which are there whole or not at all, all of them together."""
    parts = [path.with_name(path.name + ".part") for path in paths]
    with contextlib.ExitStack() as open_files:
        # without a name: whatever ends this process, nothing of it is left, and no other one writes to it
        growing: list[IO[bytes]] = [
            open_files.enter_context(tempfile.TemporaryFile(dir=path.parent)) for path in paths
        ]
        yield growing
        try:
            for part, content in zip(parts, growing, strict=True):
                content.seek(0)
                with part.open("wb") as file:
                    shutil.copyfileobj(content, file, 1 << 20)
                    file.flush()
                    os.fsync(file.fileno())
            for part, path in zip(parts, paths, strict=True):
                part.replace(path)
        finally:
            for part in parts:
                part.unlink(missing_ok=True)


def write_array(members: zipfile.ZipFile, name: str, array: npt.NDArray) -> None:
    """Add an array to an ``.npz`` file that is written array by array."""
    with members.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)
