# SPDX-License-Identifier: Apache-2.0
"""What became of one scan point: one message, published and in the recording, one row of ``results.csv``."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from enum import Enum, IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.files import csv_text, write_whole
from tactile_resonance.frf.result import BandDistortion
from tactile_resonance.poles.result import Poles
from tactile_resonance.recording.messages import (
    each_from_message,
    poles_from_message,
    time_from_message,
)
from tactile_resonance.scan.messages import header_message, make_message, to_cdr

TOPIC = "point_result"
TYPE = "tactile_resonance/msg/PointResult"
DISTORTION_TYPE = "tactile_resonance/msg/Distortion"
POLES_TYPE = "tactile_resonance/msg/Poles"
RESULTS_DEPTH = 4096  # of the nodes that publish them
RESULTS = "results.csv"
NAN = float("nan")
MODE = ("f0_hz", "f0_std_hz", "damping_ratio", "damping_ratio_std", "f0_damping_covariance_hz")
"""Fields of one mode, of a point and of a band."""


class PointOutcome(IntEnum):
    """What came of a point; the numbers are those of the message."""

    DONE = 0
    FAILED = 1
    SKIPPED = 2
    DISCARDED = 3


class PointKind(str, Enum):
    """What was measured."""

    TISSUE = "tissue"
    AIR = "air"


@dataclass(frozen=True)
class BandResult:
    """The pole of one further band; fields as in `PointResult`, where that of the first band stands."""

    band_low_hz: float
    band_high_hz: float
    f0_hz: float = NAN
    f0_std_hz: float = NAN
    damping_ratio: float = NAN
    damping_ratio_std: float = NAN
    f0_damping_covariance_hz: float = NAN
    poles_status: str = ""


@dataclass(frozen=True, slots=True)  # a run keeps one for each of its points
class PointResult:
    """One attempt at one scan point; ``msg/PointResult.msg`` gives unit and meaning of each field.

    ``time_ns`` and ``frame_id`` stand for the message's header. Of its ``poles`` only those of further bands
    are part of it, as ``further``.
    """

    index: int
    attempt: int = 0
    label: str = ""
    outcome: PointOutcome = PointOutcome.DONE
    reason: str = ""
    x_m: float = NAN
    y_m: float = NAN
    z_m: float = NAN
    normal_x: float = NAN
    normal_y: float = NAN
    normal_z: float = NAN
    force_n: float = NAN
    force_std_n: float = NAN
    force_rms_n: float = NAN
    force_min_n: float = NAN
    force_max_n: float = NAN
    contact_age_s: float = NAN
    f0_hz: float = NAN
    f0_std_hz: float = NAN
    damping_ratio: float = NAN
    damping_ratio_std: float = NAN
    f0_damping_covariance_hz: float = NAN
    nominal_f0_hz: float = NAN
    nominal_f0_std_hz: float = NAN
    nominal_damping_ratio: float = NAN
    nominal_damping_ratio_std: float = NAN
    nominal_f0_damping_covariance_hz: float = NAN
    f0_shift_hz: float = NAN
    f0_shift_std_hz: float = NAN
    f0_over_air: float = NAN
    f0_over_air_std: float = NAN
    damping_shift: float = NAN
    damping_shift_std: float = NAN
    f0_drift_hz_per_s: float = NAN
    f0_drift_std_hz_per_s: float = NAN
    damping_drift_per_s: float = NAN
    damping_drift_std_per_s: float = NAN
    pole_real_rad_s: float = NAN
    pole_imag_rad_s: float = NAN
    cost: float = NAN
    expected_cost: float = NAN
    poles_status: str = ""
    tissue_class: str = ""
    tissue_probability: float = NAN
    tissue_reason: str = ""
    blocks: int = 0
    blocks_saved: int = 0
    verdict: str = ""
    gate: str = ""
    saved_s: float = NAN
    duration_s: float = NAN
    travel_s: float = NAN
    tare_s: float = NAN
    approach_s: float = NAN
    press_s: float = NAN
    hold_s: float = NAN
    vibration_s: float = NAN
    retract_s: float = NAN
    between_s: float = NAN
    measurement_id: int = 0
    simulated: bool = False
    repeats: int = 0
    disturbances: str = ""
    notes: str = ""
    kind: PointKind = PointKind.TISSUE
    time_ns: int = 0
    frame_id: str = ""
    distortion: tuple[BandDistortion, ...] = ()
    further: tuple[BandResult, ...] = ()

    def of_band(self, k: int) -> PointResult:
        """The same with the pole of band k, from 0, in place of the first's; no tissue is called from it."""
        if k == 0:
            return self
        nothing = BandResult(NAN, NAN)
        band = self.further[k - 1] if k <= len(self.further) else nothing
        values: dict[str, Any] = {name: getattr(band, name) for name in BAND_COLUMNS}
        values |= dict.fromkeys(_OF_FIRST_BAND, NAN)
        return replace(self, **values, tissue_class="", tissue_probability=NAN, tissue_reason="")

    @property
    def failed(self) -> bool:
        """Whether there is no pole."""
        return self.outcome is not PointOutcome.DONE or math.isnan(self.f0_hz)

    @property
    def position_m(self) -> FloatArray:
        """(3,) point on the surface [m]."""
        return np.array([self.x_m, self.y_m, self.z_m])

    @property
    def normal(self) -> FloatArray:
        """(3,) outward unit normal of the surface."""
        return np.array([self.normal_x, self.normal_y, self.normal_z])

    @property
    def estimate(self) -> FloatArray:
        """(2,) f0 [Hz] and damping ratio; NaN where not estimated."""
        return np.array([self.f0_hz, self.damping_ratio])

    @property
    def std(self) -> FloatArray:
        """(2,) of f0 [Hz] and damping ratio; NaN where unknown."""
        return np.array([self.f0_std_hz, self.damping_ratio_std])

    @property
    def covariance(self) -> FloatArray:
        """(2, 2) of f0 [Hz] and damping ratio; NaN where unknown."""
        return self.pole()[1]

    def pole(self, prefix: str = "") -> tuple[FloatArray, FloatArray]:
        """`estimate` and `covariance`; with ``nominal_`` those at the nominal contact."""
        f0_hz, f0_std_hz, damping, damping_std, cross = (getattr(self, prefix + name) for name in MODE)
        return np.array([f0_hz, damping]), np.array([[f0_std_hz**2, cross], [cross, damping_std**2]])


_OF_BANDS = ("distortion", "further")
# in the order of the message, the header's two last
COLUMNS = tuple(field.name for field in fields(PointResult) if field.name not in _OF_BANDS)
BAND_COLUMNS = tuple(field.name for field in fields(BandResult))[2:]
_DISTORTION_COLUMNS = tuple(field.name for field in fields(BandDistortion))[2:]
_OF_FIRST_BAND = tuple(
    name
    for name in COLUMNS
    if name.startswith(("nominal_", "f0_shift", "f0_over", "damping_shift", "pole_"))
    or "_per_s" in name
    or name.endswith("cost")
)
_HEADER = ("time_ns", "frame_id")


def is_poles(topic: str) -> bool:
    """Whether messages of `POLES_TYPE` on a topic are estimates, not truths of a simulation."""
    return topic.rsplit("/", 1)[-1] == "poles"


def serialised(result: PointResult, poles: Any = None) -> bytes:
    """The message of a result as it travels (CDR).

    Parameters
    ----------
    poles : message or None
        The last one of the attempt, as rosbags knows it; None where none came.
    """
    content = {name: getattr(result, name) for name in COLUMNS if name not in _HEADER}
    content["kind"] = result.kind.value
    content["distortion"] = [
        make_message(DISTORTION_TYPE, **asdict(band)) for band in result.distortion
    ]
    header = header_message(result.frame_id, result.time_ns)
    bands = [] if poles is None else [poles]
    return to_cdr(make_message(TYPE, header=header, poles=bands, **content))


def from_message(message: Any) -> PointResult:
    """Result of a message, of rosbags or of ROS."""
    content = {name: _shared(getattr(message, name)) for name in COLUMNS if name not in _HEADER}
    content["outcome"] = PointOutcome(message.outcome)
    content["kind"] = PointKind(message.kind or PointKind.TISSUE)
    poles = poles_from_message(message.poles[0])[0] if len(message.poles) else Poles()
    return PointResult(
        **content,
        time_ns=time_from_message(message.header.stamp),
        frame_id=message.header.frame_id,
        distortion=each_from_message(BandDistortion, message.distortion),
        further=band_results(poles),
    )


def _shared(value: Any) -> Any:
    """One object for all equal texts and for all NaN: a run keeps ten thousand results."""
    if isinstance(value, str):
        return sys.intern(value)
    return NAN if value != value else value


def mode_columns(estimate: FloatArray, covariance: FloatArray, prefix: str = "") -> dict[str, Any]:
    """Numbers of one mode, by the names of their fields in `PointResult` and `BandResult`.

    Parameters
    ----------
    estimate : (2,) float
        f0 [Hz] and damping ratio.
    covariance : (2, 2) float
    prefix : str
        Of the names.
    """
    f0_std_hz, damping_ratio_std = np.sqrt(np.diag(covariance))
    values = (estimate[0], f0_std_hz, estimate[1], damping_ratio_std, covariance[0, 1])
    return {prefix + name: float(value) for name, value in zip(MODE, values, strict=True)}


def band_results(poles: Poles) -> tuple[BandResult, ...]:
    """Of the bands beyond the first, of each the pole with the highest peak."""
    return tuple(
        BandResult(
            *band.band_hz,
            **mode_columns(band.main.estimate, band.main.covariance),
            poles_status=band.status.value,
        )
        for band in poles.further
    )


class ResultsFile:
    """``results.csv`` as it grows: a row is appended where it can be, else all are written anew.

    Numbers stand with all their digits, unknown ones are ``nan``. Where a result has them, columns for the
    poles of further bands, numbered from ``f0_hz_2``, and for the distortion in each band,
    ``distortion_even_db``, ``distortion_even_db_2``, ..., follow the others. A text that a spreadsheet would
    take for a formula begins with an apostrophe.

    Parameters
    ----------
    folder : Path
        Of the run.
    results : sequence of PointResult
        Latest attempts, by index; written at once.
    """

    def __init__(self, folder: Path, results: Sequence[PointResult] = ()) -> None:
        self._path = folder / RESULTS
        self._last, self._columns = -1, list[str]()
        self._write(results)

    def add(self, result: PointResult, latest: Callable[[], Sequence[PointResult]]) -> None:
        """Take in one result more.

        Parameters
        ----------
        result : PointResult
        latest : callable
            Returns those of all points, by index, with this one; asked where all rows are written.
        """
        row = _row(result)
        fits = result.index > self._last and row.keys() <= set(self._columns)
        if not (fits and self._path.exists()):
            self._write(latest())
            return
        with self._path.open("a", encoding="utf-8", newline="") as file:
            file.write(csv_text([_cells(row, self._columns)]))
        self._last = result.index

    def _write(self, results: Sequence[PointResult]) -> None:
        self._last = max((result.index for result in results), default=-1)
        rows = [_row(result) for result in results]
        # those that any row has, distortion last
        names = dict.fromkeys([*COLUMNS, *(name for row in rows for name in row)])
        self._columns = sorted(names, key=lambda name: name.startswith("distortion_"))
        text = csv_text([self._columns, *(_cells(row, self._columns) for row in rows)])
        write_whole(self._path, text.encode())


def _row(result: PointResult) -> dict[str, object]:
    """By column."""
    row: dict[str, object] = {name: getattr(result, name) for name in COLUMNS}
    row |= {"outcome": result.outcome.name.lower(), "kind": result.kind.value}
    for k, band in enumerate(result.further):
        row |= {f"{name}_{k + 2}": getattr(band, name) for name in BAND_COLUMNS}
    for k, each in enumerate(result.distortion):
        number = f"_{k + 1}" if k else ""
        row |= {f"distortion_{n}{number}": getattr(each, n) for n in _DISTORTION_COLUMNS}
    return row


def _cells(row: Mapping[str, object], columns: Iterable[str]) -> list[object]:
    return [row.get(name, NAN) for name in columns]
