# SPDX-License-Identifier: Apache-2.0
"""Poles of all points of one or several runs, again, with another model or band.

Points of one kind are fitted together, some thousand at a time, in as many processes as there are cores. What
such a fit is not sure of is then fitted alone, as `analyse` does, which also looks for tones, for modes that
change and for disturbances of the generator.
"""

from __future__ import annotations

import os
import signal
import tempfile
import zipfile
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from functools import lru_cache
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray
from tactile_resonance.fields import read_dataclass, read_yaml, section
from tactile_resonance.poles.estimator import identify_poles_from_bins
from tactile_resonance.poles.joint import PoleEstimator
from tactile_resonance.poles.result import STATUS_CODE, STATUSES, PolesBatch, PolesStatus
from tactile_resonance.poles.structure import ModelStructure, PoleBand
from tactile_resonance.processes import end_with_parent
from tactile_resonance.scan.kept_bins import (
    PLACE,
    BinsKind,
    Piece,
    keep_bins,
    kept_bins,
    whole_files,
    write_array,
)
from tactile_resonance.scan.point_result import MODE
from tactile_resonance.scan.run_content import SCENE, read_index, read_plan
from tactile_resonance.scan.scene import SensorUse

STATUS = "poles_status"
# What one process is given beforehand, so that none waits for work.
_AHEAD = 2
# A fit of these found nothing that another one could explain.
_SURE = (PolesStatus.OK, PolesStatus.NO_COVARIANCE)
_MODE = (*MODE, "pole_real_rad_s", "pole_imag_rad_s")
_COSTS = ("cost", "expected_cost")
_STATUSES = [status.value for status in STATUSES]

Task = TypeVar("Task")
Found = TypeVar("Found")


def scene_band(run: Path) -> PoleBand:
    """Main band that a run was scanned for, and the model there.

    Raises
    ------
    ValueError
        If its scene cannot be read, or is no longer that of the scan.
    """
    path = run / SCENE
    where = f"{path}:"
    entry = read_index(run)[0].get(SCENE)
    if entry is not None and (damage := entry.damage(path)):
        raise ValueError(f"{where} {damage}; expected as it was, for the band and the order that are not given")
    content = read_yaml(path)
    sensor = section(content, "sensor", where) if "sensor" in content else {}
    return read_dataclass(SensorUse, sensor, f"{where} sensor").bands[0]


def row_type(places: int) -> np.dtype:
    """Of the result of a point: the mode with the highest peak, then others with ``_2``, ``_3`` ... behind."""
    modes = [
        name if place == 0 else f"{name}_{place + 1}"
        for place in range(max(places, 1))
        for name in _MODE
    ]
    return np.dtype(
        [("run", "<i4"), *PLACE.items()]
        + [(name, "<f8") for name in (*modes, *_COSTS)]
        + [(STATUS, "<u1")]
    )


def reidentify(
    runs: Sequence[Path],
    csv: Path,
    npz: Path,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, of: None,
) -> tuple[Counter[str], list[str]]:
    """Poles of every finished point of some runs, into two files that are there whole or not at all.

    Parameters
    ----------
    runs : sequence of Path
    csv, npz : Path
        Replaced. One row a point; the second holds a structured array ``points``, whose ``run`` counts in
        ``runs`` and whose ``poles_status`` counts in ``poles_statuses``.
    band_hz : (low, high), optional
        Of each run's scene when absent.
    structure : ModelStructure, optional
        That of the main band of each run's scene when absent; one mode where the data chose there.
    progress : callable
        Told what is done, how many points are, and of how many.

    Returns
    -------
    counts : Counter
        Points by status.
    left_out : list of str
        Points without a record, damaged files.

    Raises
    ------
    ValueError
        If a folder is no run, or the model does not suit a band, before any point is read; or if there is
        no point.
    OSError
        If a file cannot be read or written, or a process was ended from outside.
    """
    for run in runs:
        read_plan(run)
    of_scene = lru_cache(scene_band)
    bands = [band_hz or of_scene(run).ends_hz for run in runs]
    structures = [
        structure or ModelStructure.with_residual(of_scene(run).order or 2, of_scene(run).residual_terms)
        for run in runs
    ]
    dtype = row_type(max(each.order // 2 for each in structures))
    counts, left_out = Counter[str](), list[str]()
    with _Processes() as processes, ExitStack() as scratch:
        kept = []
        for run, band, model in zip(runs, bands, structures, strict=True):
            bins = kept_bins(run, band)
            if bins is None:
                folder = run
                if not os.access(run, os.W_OK):  # as of an archive
                    beside = tempfile.TemporaryDirectory(dir=csv.parent)
                    folder = Path(scratch.enter_context(beside))
                bins = keep_bins(run, band, processes.in_order, progress, folder)
            kept.append(bins)
            left_out += [f"{run}: {text}" for text in kept[-1].left_out]
            for piece in kept[-1].pieces:
                _plan(piece.kind, band, model)  # raises what does not suit
        total, done = sum(piece.count for of_run in kept for piece in of_run.pieces), 0
        if total == 0:
            raise ValueError(f"no point to identify: {'; '.join(left_out[:3]) or 'none is finished'}")
        jobs = (
            (dtype, k, str(runs[k]), piece, bands[k], structures[k])
            for k, of_run in enumerate(kept)
            for piece in of_run.pieces
        )
        head = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (total,)}
        with whole_files(csv, npz) as (text, arrays), zipfile.ZipFile(arrays, "w") as members:
            text.write((",".join(dtype.names or ()) + "\n").encode())
            with members.open("points.npy", "w", force_zip64=True) as points:
                np.lib.format.write_array_header_2_0(points, head)
                for rows, lines in processes.in_order(_identified, jobs):
                    points.write(rows.tobytes())
                    text.write(lines.encode())
                    codes = np.bincount(rows[STATUS], minlength=len(STATUSES))
                    counts.update(dict(zip(_STATUSES, codes.tolist(), strict=True)))
                    done += rows.size
                    progress("poles", done, total)
            write_array(members, "runs", np.array([str(run) for run in runs]))
            write_array(members, "poles_statuses", np.array(_STATUSES))
            write_array(members, "bands_hz", np.array(bands))
    return +counts, left_out


@lru_cache(maxsize=32)
def _plan(kind: BinsKind, band_hz: tuple[float, float], structure: ModelStructure) -> PoleEstimator:
    return PoleEstimator(
        kind.sample_rate_hz,
        kind.samples_per_period,
        kind.periods,
        np.array(kind.harmonics, np.int64),
        band_hz,
        structure,
    )


def _identified(job: tuple) -> tuple[npt.NDArray, str]:
    """(n,) results of some points of one kind, and their lines of the table."""
    piece: Piece
    dtype, run, name_of_run, piece, band_hz, structure = job
    points, kind = piece.read(), piece.kind
    plan = _plan(kind, band_hz, structure)
    first = plan.bins[0] - kind.first_bin
    here = slice(first, first + plan.bins.size)
    u, y = (points[name][..., here].astype(complex) for name in ("u", "y"))  # (n, M, K)
    batch = plan.from_bins(u, y)
    rows = np.zeros(points.size, dtype)
    rows["run"] = run
    for name in PLACE:
        rows[name] = points[name]
    total = batch.total_covariance
    known = np.isfinite(total).all(axis=(2, 3), keepdims=True)
    there = np.isfinite(batch.poles_rad_s) & batch.significant
    _fill(rows, batch, there, np.where(known, total, batch.covariance))
    rows[STATUS] = batch.status_code
    sure = np.isin(batch.status_code, [STATUS_CODE[status] for status in _SURE])
    if kind.realisations == 1:  # others have distortion, which no line has as much of as the next
        sure &= batch.variance_model == "flat"
    for k in np.flatnonzero(~sure):
        poles = identify_poles_from_bins(kind.bins(points[k]), band_hz, structure)
        names = ("poles_rad_s", "residues", "f0_hz", "damping_ratio", *_COSTS)
        alone = SimpleNamespace(**{name: np.asarray(getattr(poles, name))[None] for name in names})
        there = np.ones((1, poles.f0_hz.size), bool)
        _fill(rows[k : k + 1], alone, there, poles.best_covariance[None])
        rows[STATUS][k] = STATUS_CODE[poles.status]
    return rows, _as_csv(rows, name_of_run)


def _fill(
    rows: npt.NDArray,
    found: PolesBatch | SimpleNamespace,
    there: BoolArray,
    covariance: npt.NDArray,
) -> None:
    """Of a batch (n,): modes that are there (n, places), the one that `Poles.main` means first, with theirs."""
    with np.errstate(all="ignore"):
        peak = np.abs(found.residues) / np.abs(found.poles_rad_s.real)
    rank = np.where(there, 0, 1)  # those that are there as they are, behind the one of the highest peak
    if rank.shape[1]:
        rank[np.arange(len(rank)), np.argmax(np.where(there, peak, -np.inf), axis=1)] = -1
    order = np.argsort(rank, axis=1, kind="stable")

    def taken(values: npt.NDArray) -> npt.NDArray:
        wide = (..., *[None] * (values.ndim - 2))
        return np.take_along_axis(np.where(there[wide], values, np.nan), order[wide], axis=1)

    covariance, poles_rad_s = taken(covariance), taken(found.poles_rad_s)
    with np.errstate(invalid="ignore"):
        std = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
    columns = (
        *(taken(found.f0_hz), std[..., 0], taken(found.damping_ratio), std[..., 1]),
        *(covariance[..., 0, 1], poles_rad_s.real, poles_rad_s.imag),
    )
    for name in rows.dtype.names or ():
        if name.startswith(_MODE):
            rows[name] = np.nan
    for name, values in zip(_MODE, columns, strict=True):
        for place in range(values.shape[1]):
            rows[name if place == 0 else f"{name}_{place + 1}"] = values[:, place]
    for name in _COSTS:
        rows[name] = getattr(found, name)


def _as_csv(rows: npt.NDArray, run: str) -> str:
    """Lines of a table, numbers with twelve digits. The run is the first column, the status the last one."""
    if any(mark in run for mark in ',"\n\r'):
        run = '"{}"'.format(run.replace('"', '""'))
    kinds = [rows.dtype[name].kind for name in (rows.dtype.names or ())[1:-1]]
    numbers = ",".join("%.12g" if kind == "f" else "%d" for kind in kinds)
    line = f"{run.replace('%', '%%')},{numbers},%s\n"
    return "".join([line % (*row[1:-1], _STATUSES[row[-1]]) for row in rows.tolist()])


class _Processes:
    """One a core, which end with the context; after an error all children born meanwhile do."""

    def __init__(self) -> None:
        self._count = len(os.sched_getaffinity(0))
        self._before = set(active_children())
        self._pool = ProcessPoolExecutor(self._count, initializer=_begin_process)

    def __enter__(self) -> _Processes:
        return self

    def __exit__(self, kind: Any, *_: object) -> None:
        if kind is None:
            self._pool.shutdown()
            return
        # an interrupt may have left a lock of the pool taken, for which a shutdown would wait for ever
        for process in set(active_children()) - self._before:
            process.kill()
            process.join()

    def in_order(self, function: Callable[[Task], Found], jobs: Iterable[Task]) -> Iterator[Found]:
        """What a function gives for each of some jobs, few of which are under way at a time."""
        waiting: deque[Future[Found]] = deque()
        try:
            for job in jobs:
                waiting.append(self._pool.submit(function, job))
                if len(waiting) > _AHEAD * self._count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool as error:
            raise OSError(
                "a process of the fit was ended from outside, as for want of memory"
            ) from error


def _begin_process() -> None:
    # an interrupt reaches the whole group; the parent ends its processes
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with_parent()  # which cannot where it was killed, as for want of memory
    # The allocator keeps what a process has once used; pages that are new each time take longer than the sums.
    np.ones(4_000_000)
