# SPDX-License-Identifier: Apache-2.0
"""A million stored points identified again: `tactile_resonance reidentify` against reading the file alone."""

from __future__ import annotations

import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.poles_plant import BAND_HZ, HARMONICS, SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, Plant
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.scan.kept_bins import BinsKind, kept_bins, write_bins
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.reidentify import reidentify
from tactile_resonance.scan.run_directory import RunDirectory

POINTS = 1_000_000
DIFFERENT = 20_000
AT_ONCE = 2_000
GOAL_S = 20.0
PLANT = Plant(0.02, 40.0, 4)
STRUCTURES = {"2nd order": ModelStructure(2, 2), "mode + 6 residual terms": ModelStructure()}


def reidentify_table(points: int = POINTS) -> list[str]:
    """Lines of the section."""
    cores = len(os.sched_getaffinity(0))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        size = _stored(run, points)
        for model, structure in STRUCTURES.items():
            read_s = _reading_s(run)
            begun_s, used_s = time.perf_counter(), _processor_s()
            counts, _ = reidentify(
                [run], Path(folder) / "out.csv", Path(folder) / "out.npz", structure=structure
            )
            wall_s, used_s = time.perf_counter() - begun_s, _processor_s() - used_s
            ok = counts["ok"] / counts.total()
            rows.append(
                f"| {model} | {wall_s:.1f} s | {used_s:.1f} s | {used_s / 2:.1f} s | {read_s:.2f} s "
                f"| {wall_s / read_s:.0f} | {100 * ok:.2f} % |"
            )
        largest = max(
            resource.getrusage(who).ru_maxrss
            for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        )
    return [
        "## Stored points again",
        "",
        f"`tactile_resonance reidentify` of {points} points ({DIFFERENT} different ones), {size} bytes each, "
        f"{PLANT.periods} periods, in the page cache, with {cores} processes; tables in CSV and npz. Goal: "
        f"{GOAL_S:g} s for a million points on 2 cores. Largest process: {largest / 1024:.0f} MiB.",
        "",
        "| Model | wall clock | processor time | on 2 free cores | reading alone | over reading | ok |",
        "|---|---|---|---|---|---|---|",
        *rows,
        "",
    ]


def _stored(run: Path, points: int) -> int:
    """Make a run whose bins are kept; bytes of a point."""
    place = ScanPoint(0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    RunDirectory.create(run, "name: million\n", [place], {}).close()
    bins = PLANT.bins()
    lines = HARMONICS[np.isin(HARMONICS * PLANT.periods, bins)]
    kind = BinsKind(
        *(int(bins[0]), 1, bins.size, tuple(lines.tolist())),
        *(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, PLANT.periods),
    )
    rng = np.random.default_rng(3)
    parts = []
    for start in range(0, DIFFERENT, AT_ONCE):
        rows = np.zeros(AT_ONCE, kind.dtype)
        rows["index"] = start + np.arange(AT_ONCE)
        rows["u"][:, 0], rows["y"][:, 0] = PLANT.noisy(rng, AT_ONCE, bins)
        parts.append(rows)
    each = ((kind, parts[k % len(parts)]) for k in range(points // AT_ONCE))
    write_bins(run, each, BAND_HZ, {}, [])
    return kind.dtype.itemsize


def _reading_s(run: Path) -> float:
    """Wall clock of reading all rows in pieces."""
    kept = kept_bins(run, BAND_HZ)
    assert kept is not None
    begun_s = time.perf_counter()
    for piece in kept.pieces:
        piece.read()
    return time.perf_counter() - begun_s


def _processor_s() -> float:
    """Of this process and those it waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
