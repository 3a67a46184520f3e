# SPDX-License-Identifier: Apache-2.0
"""What the recording holds of each point beside its result: FRF, all poles, force, and the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.recording.messages import poles_from_message
from tactile_resonance.report.page_data import (
    MN,
    frf_entry,
    listed,
    mechanics_entry,
    pole_entry,
    poles_entries,
)
from tactile_resonance.scan.bench_truth import PointTruth, truth_of_point, truths_of
from tactile_resonance.scan.point_file import read_messages_of_type
from tactile_resonance.scan.point_result import POLES_TYPE, PointOutcome, PointResult
from tactile_resonance.scan.protocols import TYPE as TEST_TYPE
from tactile_resonance.scan.recorded import EXCITATION
from tactile_resonance.scan.run_content import RunContent, file_of

if TYPE_CHECKING:
    from tactile_resonance.scan.tissue_tests import TissueTest

FRF_TYPE = "tactile_resonance/msg/FRF"
STATE_TYPE = "tactile_resonance/msg/ContactState"
MOST_DETAILED = 400
"""Points of a run whose FRFs are in a page."""
MOST_TESTED = 100
"""Points of a run whose mechanical tests are in a page: each is fitted for it."""
_LINES_OF_A_PAGE = 60_000  # of all FRFs together
_LINES_OF_A_POINT = 600
_MOST_FORCES = 400  # of a point: 16 s of the topic


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
        return {
            "frf": None if self.frf is None else frf_entry(self.frf, self.poles, most_lines),
            "poles": [] if self.poles is None else poles_entries(self.poles),
            "force": force_entry(self.force),
            "truth": None if self.truth is None else truth_entry(self.truth),
            "tests": [mechanics_entry(one) for one in self.tests],
        }


def force_entry(force: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Times [s] and forces [mN] of pairs of s and N."""
    rows = np.asarray(force, float).reshape(-1, 2)
    return {"t_s": listed(rows[:, 0], 5), "force_mn": listed(MN * rows[:, 1], 5)}


def truth_entry(truth: PointTruth) -> dict[str, Any]:
    """What the simulated bench knew of a point."""
    f0_hz, damping = truth.estimate
    return {**pole_entry(f0_hz, damping, np.full((2, 2), np.nan)), "tissue": truth.tissue}


def detailed(results: Sequence[PointResult], most: int = MOST_DETAILED) -> list[PointResult]:
    """Points that were measured, at most so many of them, spread evenly over the run."""
    done = (r for r in results if r.outcome is PointOutcome.DONE and r.measurement_id)
    return _spread(list(done), most)


def _spread(results: Sequence[PointResult], most: int) -> list[PointResult]:
    if len(results) <= most:
        return list(results)
    return [results[k] for k in np.linspace(0, len(results) - 1, most).round().astype(int)]


def lines_each(points: int) -> int:
    """Lines of the FRF of each of so many points in a page."""
    return max(40, min(_LINES_OF_A_POINT, _LINES_OF_A_PAGE // max(points, 1)))


def details_of(run: RunContent, most: int = MOST_DETAILED) -> dict[int, PointDetails]:
    """By point, of those that are `detailed` or tested; a file that cannot be read has its problem instead."""
    counts, found = run.messages_at(TEST_TYPE), {}
    tested = _spread([r for r in run.latest if r.index in counts], min(most, MOST_TESTED))
    with_tests = {result.index for result in tested}
    wanted = with_tests.union(result.index for result in detailed(run.latest, most))
    for result in (r for r in run.latest if r.index in wanted):
        try:
            found[result.index] = read_details(run, result)
            if result.index in with_tests:
                # only here: what is compiled for the fits takes a second to load
                from tactile_resonance.scan.tissue_tests import fits_at

                tests = fits_at(run, result)
                found[result.index] = replace(found[result.index], tests=tests)
        except ValueError as error:
            found[result.index] = replace(
                found.get(result.index, PointDetails()), problem=str(error)
            )
    return found


def truths_with(run: RunContent, details: Mapping[int, PointDetails]) -> dict[int, PointTruth]:
    """Truth of all points of a simulated run: out of their details, and of the others out of the recording."""
    known = {index: each.truth for index, each in details.items() if each.truth is not None}
    return {**known, **truths_of(run, details)}


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
    begun_ns: int | None = None
    for time_ns, topic, message in read_messages_of_type(file_of(run.path, result), *types):
        if topic.endswith("/contact_state"):
            if begun_ns is not None and np.isfinite(message.force_n):
                force.append((1e-9 * (time_ns - begun_ns), float(message.force_n)))
        elif message.measurement_id == own:
            if topic.endswith("/excitation"):
                begun_ns = time_ns
            elif topic.endswith("/frf"):
                frf = message
            else:
                told.append(poles_from_message(message))
                if told[-1][0].status is not PolesStatus.TRUTH:
                    poles = told[-1][0]
    truth = truth_of_point(told, result) if result.simulated else None
    step = 1 + len(force) // _MOST_FORCES
    return PointDetails(frf, poles, tuple(force[::step]), truth)
