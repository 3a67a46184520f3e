# SPDX-License-Identifier: Apache-2.0
"""Reading recordings from .npz, .mat and .csv files."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.io

from tactile_resonance.fields import require, whole
from tactile_resonance.recording.recording import Recording, make_recording

ACCEPTED = ".npz, .mat and .csv"


def read_recording(
    path: Path,
    *,
    u: str = "u",
    y: str = "y",
    sample_rate_hz: float | None = None,
    samples_per_period: int | None = None,
    periods: int | None = None,
    segments: Sequence[tuple[int, int]] | None = None,
    excited_harmonics: npt.ArrayLike | None = None,
) -> Recording:
    """Read both channels and what belongs to them.

    Parameters
    ----------
    path : Path
        ``.npz`` and ``.mat`` (up to version 7) hold the fields `u`, `y`, ``sample_rate_hz``,
        ``samples_per_period`` and optionally ``excited_harmonics``; ``.csv`` has a header line that names
        its columns, among them `u`, `y` and optionally ``time_s``.
    u, y : str
        Names of the actuator and sensor field.
    sample_rate_hz, samples_per_period, excited_harmonics
        Win over what the file says.
    periods, segments
        See `make_recording`.

    Raises
    ------
    ValueError
        If the file is no record or a field is missing or wrong; one line that says what is accepted.
    OSError
        If the file cannot be opened.
    """
    fields = read_fields(path)
    for option, name in (("u", u), ("y", y)):
        present = isinstance(name, str) and name in fields
        held = f"a field of {path.name}, which holds {', '.join(sorted(fields))}"
        require(present, option, name, held)
    if sample_rate_hz is None:
        sample_rate_hz = _sample_rate(fields, path)
    if samples_per_period is None and "samples_per_period" in fields:
        samples_per_period = whole(_scalar(fields, "samples_per_period"), "samples_per_period", 4)
    if excited_harmonics is None:
        excited_harmonics = fields.get("excited_harmonics")
    return make_recording(
        fields[u],
        fields[y],
        sample_rate_hz=sample_rate_hz,
        samples_per_period=samples_per_period,
        periods=periods,
        segments=segments,
        excited_harmonics=excited_harmonics,
        u_name=u,
        y_name=y,
    )


def read_fields(path: Path) -> Mapping[str, np.ndarray]:
    """Named arrays of a file; see `read_recording`."""
    readers = {".npz": _read_npz, ".mat": _read_mat, ".csv": _read_csv}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path.name}: no record, accepted are {ACCEPTED}")
    with path.open("rb") as file:  # one OSError for all formats
        if not file.read(1):
            raise ValueError(f"{path.name}: empty file, accepted are {ACCEPTED}")
    return reader(path)


def _read_npz(path: Path) -> Mapping[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:
        raise ValueError(f"{path.name}: no .npz record ({_first_line(error)})") from error


def _read_mat(path: Path) -> Mapping[str, np.ndarray]:
    try:
        content = scipy.io.loadmat(path)
    except NotImplementedError as error:
        raise ValueError(
            f"{path.name}: MATLAB 7.3 file, accepted are versions up to 7 (save with '-v7')"
        ) from error
    except Exception as error:
        raise ValueError(f"{path.name}: no .mat record ({_first_line(error)})") from error
    return {name: value for name, value in content.items() if not name.startswith("__")}


def _read_csv(path: Path) -> Mapping[str, np.ndarray]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            dialect = csv.Sniffer().sniff(file.readline(), delimiters=",;\t")
            file.seek(0)
            names = [name.strip() for name in next(csv.reader(file, dialect))]
            names[0] = names[0].removeprefix("#").strip()  # as numpy.savetxt marks a header
            rows = [line for line in file if line.strip()]
        if not rows:
            raise ValueError("no numbers under the header")
        if len(set(names)) < len(names):
            raise ValueError(f"columns named alike: {', '.join(names)}")
        columns = np.loadtxt(rows, delimiter=dialect.delimiter, ndmin=2)
    except (csv.Error, ValueError, StopIteration, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path.name}: no .csv record ({_first_line(error)}); expected a header line with the names "
            "of the columns, then numbers"
        ) from error
    if columns.shape[1] != len(names):
        raise ValueError(
            f"{path.name}: {columns.shape[1]} columns under {len(names)} names, expected as many"
        )
    return dict(zip(names, columns.T, strict=False))


def _sample_rate(fields: Mapping[str, np.ndarray], path: Path) -> float:
    if "sample_rate_hz" in fields:
        return _scalar(fields, "sample_rate_hz")
    if "time_s" in fields:
        time_s = np.ravel(fields["time_s"])
        step = np.diff(time_s)
        if step.size == 0 or not np.all(np.abs(step - step.mean()) < 0.01 * step.mean()):
            raise ValueError("time_s: not evenly spaced, expected one sample rate")
        return float(1 / step.mean())
    raise ValueError(f"sample_rate_hz: missing in {path.name}, expected there or given")


def _scalar(fields: Mapping[str, np.ndarray], name: str) -> float:
    value = np.ravel(fields[name])
    if value.size != 1 or value.dtype.kind not in "iuf" or not np.isfinite(value[0]):
        raise ValueError(f"{name}: {np.array2string(value, threshold=5)}, expected one number")
    return float(value[0])


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0][:120] or type(error).__name__
