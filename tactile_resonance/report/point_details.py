# SPDX-License-Identifier: Apache-2.0
"""What the recording holds of each point beside its result: FRF, all poles, force, and the truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.record import Origin
from tactile_resonance.recording.messages import poles_from_message, time_from_message
from tactile_resonance.report.page import (
    MN,
    evenly,
    frf_entry,
    listed,
    mechanics_entry,
    pole_entry,
    poles_entries,
)
from tactile_resonance.scan.point_file import read_messages
from tactile_resonance.scan.point_result import POLES_TYPE, PointOutcome, PointResult
from tactile_resonance.scan.recorded import EXCITATION
from tactile_resonance.scan.run_content import RunContent, file_of
from tactile_resonance.scan.tissue_tests import TYPE as TEST_TYPE
from tactile_resonance.scan.tissue_tests import TissueTest, fits_at

FRF_TYPE = "tactile_resonance/msg/FRF"
STATE_TYPE = "tactile_resonance/msg/ContactState"
MOST_DETAILED = 400
"""Points of a run whose FRFs are in a page."""
MOST_TESTED = 100
"""Points of a run whose mechanical tests are in a page: each is fitted for it."""
_LINES_OF_A_PAGE = 60_000  # of all FRFs together
_LINES_OF_A_POINT = 600
_MOST_FORCES = 400  # of a point: 16 s of the topic
SAME_MIDDLE_NS = 50_000_000
"""Between the middles of an estimate and of its truth, at most."""


@dataclass(frozen=True, eq=False)
class PointDetails:
    """What a click on a point shows.

    Attributes
    ----------
    frf : message or None
        The last one of the measurement that counts, as rosbags knows it.
    poles : Poles or None
        Likewise.
    force : tuple of (float, float)
        Times [s] after the first, and forces [N], while it was measured.
    truth : PointTruth or None
        What the simulated bench knew.
    tests : tuple of TissueTest
        Mechanical ones, with their fits.
    problem : str
        Why the file was not read, as where an earlier version recorded it; empty: it was.
    """

    frf: Any = None
    poles: Poles | None = None
    force: tuple[tuple[float, float], ...] = ()
    truth: PointTruth | None = None
    tests: tuple[TissueTest, ...] = ()
    problem: str = ""

    def entry(self, most_lines: int) -> dict[str, Any]:
        """As the page shows it, with so many lines of the FRF at the most."""
        force, truth = np.asarray(self.force, float).reshape(-1, 2), None
        if self.truth is not None:
            f0_hz, damping = self.truth.estimate
            unknown = np.full((2, 2), np.nan)
            truth = {**pole_entry(f0_hz, damping, unknown), "tissue": self.truth.tissue}
        return {
            "frf": None if self.frf is None else frf_entry(self.frf, self.poles, most_lines),
            "poles": [] if self.poles is None else poles_entries(self.poles),
            "force": {"t_s": listed(force[:, 0], 5), "force_mn": listed(MN * force[:, 1], 5)},
            "truth": truth,
            "tests": [mechanics_entry(one) for one in self.tests],
        }


def detailed(results: Sequence[PointResult], most: int = MOST_DETAILED) -> list[PointResult]:
    """Points that were measured, at most so many of them, spread evenly over the run."""
    done = [r for r in results if r.outcome is PointOutcome.DONE and r.measurement_id]
    return [done[k] for k in evenly(len(done), most)]


def lines_each(points: int) -> int:
    """Lines of the FRF of each of so many points in a page."""
    return max(40, min(_LINES_OF_A_POINT, _LINES_OF_A_PAGE // max(points, 1)))


def details_of(run: RunContent, most: int = MOST_DETAILED) -> dict[int, PointDetails]:
    """By point, of those that are `detailed` or tested; a file that cannot be read has its problem instead."""
    counts, found = run.messages_at(TEST_TYPE), {}
    tested = [r.index for r in run.latest if r.index in counts]
    with_tests = {tested[k] for k in evenly(len(tested), min(most, MOST_TESTED))}
    wanted = with_tests.union(result.index for result in detailed(run.latest, most))
    for result in (r for r in run.latest if r.index in wanted):
        details = PointDetails()
        try:
            details = read_details(run, result)
            if result.index in with_tests:
                details = replace(details, tests=fits_at(run, result))
        except ValueError as error:
            details = replace(details, problem=str(error))
        found[result.index] = details
    return found


def read_details(run: RunContent, result: PointResult) -> PointDetails:
    """What the file of one attempt holds; nothing of what an earlier version did not record.

    Raises
    ------
    ValueError
        If the file is damaged, or of a version whose messages cannot be read any more.
    """
    own = result.measurement_id
    frf, poles, told, force = None, None, [], []
    types = (FRF_TYPE, POLES_TYPE, STATE_TYPE, EXCITATION)
    begun = False
    for _, topic, message in read_messages(file_of(run.path, result), *types):
        if topic.endswith("/contact_state"):
            if begun and np.isfinite(message.force_n):
                # of the nodes' clock: in simulated time that of the recording goes on otherwise
                force.append((time_from_message(message.header.stamp), float(message.force_n)))
        elif message.measurement_id == own:
            if topic.endswith("/excitation"):
                begun = True
            elif topic.endswith("/frf"):
                frf = message
            else:
                told.append(poles_from_message(message))
                if told[-1][0].status is not PolesStatus.TRUTH:
                    poles = told[-1][0]
    truth = truth_of_point(told, result) if result.simulated else None
    step = 1 + len(force) // _MOST_FORCES
    shown = tuple((1e-9 * (at_ns - force[0][0]), force_n) for at_ns, force_n in force[::step])
    return PointDetails(frf, poles, shown, truth)


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


def truths_of(
    run: RunContent, details: Mapping[int, PointDetails] = MappingProxyType({})
) -> dict[int, PointTruth]:
    """Truth of the latest attempts, by point; empty for a run on hardware.

    Parameters
    ----------
    run : RunContent
    details : mapping of int to PointDetails
        Of points whose files were read: theirs is taken from there.

    Raises
    ------
    ValueError
        If a file is damaged.
    """
    truths = {index: each.truth for index, each in details.items() if each.truth is not None}
    told_at = run.messages_at(POLES_TYPE)
    for result in run.latest:
        done = result.simulated and result.outcome is PointOutcome.DONE
        if not done or result.index in details or result.index not in told_at:
            continue
        messages = read_messages(file_of(run.path, result), POLES_TYPE)
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
