# SPDX-License-Identifier: Apache-2.0
"""One measurement of a store as a `Recording`, ready for analysis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Record
from tactile_resonance.recording.recording import Recording, make_recording
from tactile_resonance.recording.store import StoredMeasurement, choose, list_measurements


def read_store_recording(
    folder: Path, measurement_id: int | None = None, periods: int | None = None
) -> Recording:
    """One measurement of a store, ready for analysis.

    Parameters
    ----------
    folder : Path
    measurement_id : int, optional
        Which one; not needed where there is only one.
    periods : int, optional
        Use the first this many of each realisation; when absent all that were planned, or as many as the
        longest one has where the measurement ended before.

    Returns
    -------
    Recording
        Realisations of which every period is there; its notes name what was left out.

    Raises
    ------
    ValueError
        If the measurement is not named or not there, or no realisation has the periods wanted, or any.
    OSError
        If the folder cannot be listed.
    """
    entries, problems = list_measurements(folder)
    if not entries:
        raise ValueError(
            f"{folder}: no measurement in it, expected a folder of records {problems[:3]}"
        )
    return recording_of(choose(entries, measurement_id, folder).read(), periods)


def recording_of(measurement: StoredMeasurement, periods: int | None = None) -> Recording:
    """A measurement that was read, as `read_store_recording` gives it.

    Raises
    ------
    ValueError
        If no realisation has the periods asked for, or any.
    """
    key = measurement.measurement_id
    if not measurement.excitations:
        raise ValueError(f"measurement {key}: holds no readable excitation {measurement.problems}")
    first = measurement.excitations[0]
    notes = [*measurement.problems]
    played: list[tuple[Excitation, npt.NDArray, npt.NDArray]] = []
    for excitation in measurement.excitations:
        if not _same_lines(excitation, first):
            raise ValueError(
                f"measurement {key}: realisation {excitation.realisation} differs from realisation "
                f"{first.realisation} in sample rate, period or lines, expected the same"
            )
        blocks = _leading_blocks(measurement, excitation.realisation)
        n = excitation.samples_per_period
        u, y = (
            np.concatenate([np.empty(0, np.float32), *(getattr(b, name).volts() for b in blocks)])
            for name in ("actuator", "sensor")
        )
        whole = min(u.size, y.size) // n
        u, y = (x[: whole * n].reshape(whole, n) for x in (u, y))
        played.append((excitation, u, y))
    wanted, longest = periods or first.periods, max(len(u) for _, u, _ in played)
    if periods is None and 0 < longest < wanted:
        notes.append(f"the measurement ended after {longest} of {wanted} periods")
        wanted = longest
    for excitation, u, _ in played:
        if len(u) < wanted:
            notes.append(
                f"realisation {excitation.realisation} left out: {len(u)} of {wanted} consecutive "
                "periods are there"
            )
    channels = [(u[:wanted], y[:wanted]) for _, u, y in played if len(u) >= wanted]
    if len(measurement.excitations) < first.realisations:
        notes.append(
            f"{len(measurement.excitations)} of {first.realisations} realisations were played"
        )
    if not channels:
        raise ValueError(
            f"measurement {key}: no complete realisation ({'; '.join(notes)}), expected one, or "
            "fewer periods requested"
        )
    recording = make_recording(
        np.stack([u for u, _ in channels]),  # (M, P, N)
        np.stack([y for _, y in channels]),
        sample_rate_hz=first.sample_rate_hz,
        samples_per_period=first.samples_per_period,
        excited_harmonics=first.harmonics,
    )
    return replace(recording, notes=tuple(notes))


def _leading_blocks(measurement: StoredMeasurement, realisation: int) -> list[Record]:
    """Blocks of a realisation up to the first gap."""
    mine = [record for record in measurement.records if record.realisation == realisation]
    return [record for index, record in enumerate(mine) if record.block_index == index]


def _same_lines(one: Excitation, other: Excitation) -> bool:
    return (
        one.sample_rate_hz == other.sample_rate_hz
        and one.samples_per_period == other.samples_per_period
        and np.array_equal(one.harmonics, other.harmonics)
    )
