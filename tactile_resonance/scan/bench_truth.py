# SPDX-License-Identifier: Apache-2.0
"""What the simulated bench knew of the points of a run, out of its recording."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.record import Origin
from tactile_resonance.recording.messages import poles_from_message
from tactile_resonance.scan.point_file import read_messages_of_type
from tactile_resonance.scan.point_result import POLES_TYPE, PointOutcome, PointResult
from tactile_resonance.scan.run_content import RunContent, file_of

SAME_MIDDLE_NS = 50_000_000
"""Between the middles of an estimate and of its truth, at most."""


@dataclass(frozen=True, eq=False)
class PointTruth:
    """The true mode of one point, the mean over its measurement: contacts creep.

    Attributes
    ----------
    estimate : (2,) float
        f0 [Hz] and damping ratio.
    tissue : str
        Under the tip.
    force_n, force_rms_n : float
        Mean, and root mean square of its motion over parts of 40 ms [N].
    """

    estimate: FloatArray
    tissue: str
    force_n: float
    force_rms_n: float


def truths_of(run: RunContent, known: Container[int] = ()) -> dict[int, PointTruth]:
    """Truth of the latest attempts, by point; empty for a run on hardware.

    Parameters
    ----------
    run : RunContent
    known : container of int
        Points that are left out.

    Raises
    ------
    ValueError
        If a file is damaged.
    """
    truths, told_at = {}, run.messages_at(POLES_TYPE)
    for result in run.latest:
        done = result.simulated and result.outcome is PointOutcome.DONE
        if not done or result.index in known or result.index not in told_at:
            continue
        messages = read_messages_of_type(file_of(run.path, result), POLES_TYPE)
        told = [poles_from_message(message) for _, _, message in messages]
        if truth := truth_of_point(told, result):
            truths[result.index] = truth
    return truths


def deviations(results: Iterable[PointResult], truths: Mapping[int, PointTruth]) -> FloatArray:
    """(n, 2) estimate less truth of f0 and damping ratio in standard deviations, where both are known."""
    rows = [deviation(r, truths[r.index]) for r in results if r.index in truths]
    return np.array(rows).reshape(-1, 2)


def deviation(result: PointResult, truth: PointTruth) -> FloatArray:
    """(2,) estimate less truth in standard deviations of the point."""
    return (result.estimate - truth.estimate) / np.sqrt(np.diag(result.covariance))


def truth_of_point(
    poles_and_truths: Iterable[tuple[Poles, Origin]], result: PointResult
) -> PointTruth | None:
    """The bench's truth over the blocks that the last poles rest on; its mode nearest to the estimate.

    Parameters
    ----------
    poles_and_truths : iterable of (Poles, Origin)
        All that the file of an attempt holds, in order.
    result : PointResult
        Of the attempt.
    """
    told, middle_ns = [], 0
    for poles, origin in poles_and_truths:
        if origin.measurement_id != result.measurement_id:
            continue
        if poles.status is PolesStatus.TRUTH:
            told.append((poles, origin))
        else:
            middle_ns = origin.time_ns
    if not told:
        return None
    # the bench may have played on
    poles, origin = min(told, key=lambda each: abs(each[1].time_ns - middle_ns))
    if abs(origin.time_ns - middle_ns) > SAME_MIDDLE_NS:
        return None
    k = int(np.argmin(np.abs(poles.f0_hz - result.f0_hz)))
    estimate = np.array([poles.f0_hz[k], poles.damping_ratio[k]])
    contact = origin.contact
    return PointTruth(estimate, origin.label, contact.force_n, contact.spread.rms_n)
