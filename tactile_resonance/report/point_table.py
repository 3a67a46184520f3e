# SPDX-License-Identifier: Apache-2.0
"""The points of a run as a table for the terminal, with the truth where the simulated bench knows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from tactile_resonance.scan.bench_truth import PointTruth, deviation, deviations
from tactile_resonance.scan.point_result import PointOutcome, PointResult

_HEAD = "point  x [mm]  y [mm]  force [mN]  f0 [Hz]   +- std   damping   +- std   tissue                  "
_TRUTH_HEAD = "true f0   dev  true damping   dev"

SURE = ("", "ok", "no covariance")
"""Status of poles that nothing speaks against."""


def point_table(results: Sequence[PointResult], truths: Mapping[int, PointTruth]) -> str:
    """One line per point, with the status of its poles where something speaks against them.

    Deviations from the truth are in standard deviations of the point.
    """
    head = _HEAD + (_TRUTH_HEAD if truths else "")
    lines = [head.rstrip(), "-" * len(head.rstrip())]
    for result in results:
        start = f"{result.index + 1:5d}  {1e3 * result.x_m:6.2f}  {1e3 * result.y_m:6.2f}  "
        if result.outcome is not PointOutcome.DONE:
            lines.append(f"{start}{result.outcome.name.lower()}: {result.reason}")
            continue
        line = (
            f"{start}{1e3 * result.force_n:10.2f}  {result.f0_hz:7.3f}  {result.f0_std_hz:7.2g}  "
            f"{result.damping_ratio:.5f}  {result.damping_ratio_std:7.1g}  {tissue_of(result):<22}"
        )
        truth = truths.get(result.index)
        if truth is not None:
            off = deviation(result, truth)
            line += f"  {truth.estimate[0]:7.3f}  {off[0]:+4.1f}       {truth.estimate[1]:.5f}  {off[1]:+4.1f}"
        if result.poles_status not in SURE:
            line += f"  {result.poles_status}"
        lines.append(line.rstrip())
    return "\n".join(lines)


def table_notes(results: Sequence[PointResult], truths: Mapping[int, PointTruth]) -> list[str]:
    """Sentences below the table: how far from the truth, how often points were repeated."""
    notes = []
    off = deviations(results, truths)
    if len(off):
        rms = np.sqrt(np.mean(off**2, axis=0))
        notes.append(
            f"deviation from the simulation's truth, in standard deviations of each point: rms {rms[0]:.2f} "
            f"of f0, {rms[1]:.2f} of the damping ratio; largest {np.max(np.abs(off)):.1f}"
        )
    notes.append(repeats_sentence(results))
    return notes


def repeats_sentence(results: Sequence[PointResult]) -> str:
    """How often points were repeated, and why."""
    points = [r for r in results if r.repeats]
    if not points:
        return "no point had to be repeated"
    why: Counter[str] = Counter()
    for result in points:
        for part in result.disturbances.split(", "):
            kind, _, count = part.rpartition(" ")
            why[kind] += int(count)
    causes = ", ".join(f"{kind} {count}" for kind, count in why.most_common())
    return (
        f"{len(points)} of {len(results)} points had to be repeated, {sum(r.repeats for r in points)} times in "
        f"all: {causes}"
    )


def tissue_of(result: PointResult) -> str:
    """The class that was called, with its probability; a dash where none was."""
    if not result.tissue_class or np.isnan(result.tissue_probability):
        return result.tissue_class or "-"
    return f"{result.tissue_class} ({100 * result.tissue_probability:.1f} %)"
