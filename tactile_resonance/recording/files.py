# SPDX-License-Identifier: Apache-2.0
"""Reading recordings from .npz, .mat and .csv files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tactile_resonance.array_files import read_arrays
from tactile_resonance.fields import cut, require, whole
from tactile_resonance.recording.recording import Recording, make_recording

_FIELDS = ("sample_rate_hz", "samples_per_period", "excited_harmonics", "time_s")


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
    fields, names = read_arrays(path, {u, y, *_FIELDS})
    for option, name in (("u", u), ("y", y)):
        present = isinstance(name, str) and name in fields
        held = cut(", ".join(sorted(names)))  # names may be damaged too
        require(present, option, name, f"an array of numbers in {path.name}, which holds {held}")
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
