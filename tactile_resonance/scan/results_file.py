# SPDX-License-Identifier: Apache-2.0
"""``results.csv``: one row per finished point, its latest attempt."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from pathlib import Path

from tactile_resonance.files import csv_text, write_whole
from tactile_resonance.frf.result import BandDistortion
from tactile_resonance.scan.point_result import (
    BAND_COLUMNS,
    COLUMNS,
    NAN,
    PointKind,
    PointOutcome,
    PointResult,
)

RESULTS = "results.csv"
_DISTORTION_COLUMNS = tuple(field.name for field in fields(BandDistortion))[2:]


class ResultsFile:
    """The file as it grows: a row is appended where it can be, else all are written anew.

    Parameters
    ----------
    folder : Path
        Of the run.
    results : sequence of PointResult
        Latest attempts, by index; written at once.
    """

    def __init__(self, folder: Path, results: Sequence[PointResult] = ()) -> None:
        self._path, self._last = folder / RESULTS, -1
        self._write(results)

    def add(self, result: PointResult, latest: Callable[[], Sequence[PointResult]]) -> None:
        """Take in one result more.

        Parameters
        ----------
        result : PointResult
        latest : callable
            Returns those of all points, by index, with this one; asked where all rows are written.
        """
        wider = len(result.further) > self._further or len(result.distortion) > self._distortion
        if wider or result.index <= self._last or not self._path.exists():
            self._write(latest())
            return
        with self._path.open("a", encoding="utf-8", newline="") as file:
            file.write(csv_text([_row(result, self._further, self._distortion)]))
        self._last = result.index

    def _write(self, results: Sequence[PointResult]) -> None:
        self._further, self._distortion = _widths(results)
        self._last = max((result.index for result in results), default=-1)
        write_whole(self._path, as_csv(results).encode())


def as_csv(results: Iterable[PointResult]) -> str:
    """One row each, numbers with all their digits, unknown numbers ``nan``.

    Where a result has them, columns for the poles of further bands, numbered from ``f0_hz_2``, and for the
    distortion in each band, ``distortion_even_db``, ``distortion_even_db_2``, ..., follow the others. A text
    that a spreadsheet would take for a formula begins with an apostrophe.
    """
    rows = list(results)
    further, distortion = _widths(rows)
    numbers = [f"_{k + 1}" if k else "" for k in range(1 + max(further, distortion))]
    head = [f"{name}{n}" for n in numbers[1 : 1 + further] for name in BAND_COLUMNS]
    head += [f"distortion_{name}{n}" for n in numbers[:distortion] for name in _DISTORTION_COLUMNS]
    return csv_text([[*COLUMNS, *head], *(_row(result, further, distortion) for result in rows)])


def _widths(results: Sequence[PointResult]) -> tuple[int, int]:
    """Most further bands and most bands with distortion."""
    further = max((len(result.further) for result in results), default=0)
    return further, max((len(result.distortion) for result in results), default=0)


def _row(result: PointResult, further: int, distortion: int) -> list[object]:
    row = [getattr(result, name) for name in COLUMNS]
    for bands, names, count in (
        (result.further, BAND_COLUMNS, further),
        (result.distortion, _DISTORTION_COLUMNS, distortion),
    ):
        for k in range(count):
            row += [getattr(bands[k], name) if k < len(bands) else NAN for name in names]
    return [_plain(value) for value in row]


def _plain(value: object) -> object:
    if isinstance(value, PointOutcome):
        return value.name.lower()
    if isinstance(value, PointKind):
        return value.value
    return value
