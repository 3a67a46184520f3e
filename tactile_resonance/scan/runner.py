# SPDX-License-Identifier: Apache-2.0
"""The life of a scan: point by point contact, measure until it is enough, retract, keep the result.

What moves and measures is behind `hands.Hands`; the same loop serves nodes and tests in virtual time.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from tactile_resonance.poles.result import MainMode, Poles
from tactile_resonance.scan.decision import Decision, GateKeeper, Verdict, decide
from tactile_resonance.scan.failures import (
    NODE_BACK_WITHIN_S,
    Disturbances,
    Interrupted,
    PointDisturbed,
    PointFailed,
    ScanEnded,
)
from tactile_resonance.scan.hands import (
    Check,
    Controls,
    Hands,
    Measured,
    Phase,
    Progress,
    Request,
    Summary,
)
from tactile_resonance.scan.plan import Plan
from tactile_resonance.scan.point_outcome import (
    AFTER,
    BEFORE,
    SILENT,
    SensorHealth,
    air_point,
    attempt_at,
    measured_result,
    read_reference,
    sensor_health,
)
from tactile_resonance.scan.point_result import NAN, PointKind, PointOutcome, PointResult
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.run_content import POINT_FILE
from tactile_resonance.scan.run_directory import PointRecording, RunDirectory, ended_by_storage
from tactile_resonance.scan.scene import OnFailure, Output
from tactile_resonance.scan.tissue_tests import ProtocolRequest, fits_of, write_fits
from tactile_resonance.tissue.nominal_contact import ContactLoad

POLL_S = 0.05
ATTEMPT_SEEDS = 1_000_003
"""Between the seeds of two attempts at a point: beyond the points of a scan."""
GATE_SEEDS = 10_000_019
"""Between the seeds of two measurements in one contact."""
SKIPPED = "skipped on request"
LEFT = "left on request"
NOTHING_PLAYED = "silent record: nothing was played"


class ScanRunner:
    """Runs what is left of a run.

    Parameters
    ----------
    plan : Plan
    run : RunDirectory
    hands : Hands
    controls : Controls
    tell : callable
        Receives `Progress`.
    seed : int
        Of the first point's phases; each point has its own.
    publish : callable
        Receives the serialised ``msg/PointResult`` (CDR) of each attempt that has ended, references and what is
        discarded included; of those that are kept once they are on disk.
    """

    def __init__(
        self,
        plan: Plan,
        run: RunDirectory,
        hands: Hands,
        controls: Controls,
        tell: Callable[[Progress], None],
        seed: int = 1,
        publish: Callable[[bytes], None] = lambda cdr: None,
    ) -> None:
        self._scene, self._plan, self._run = plan.scene, plan, run
        self._hands, self._controls, self._tell = hands, controls, tell
        self._publish = publish
        self._seed = seed
        self._durations_s, self._timed = 0.0, 0  # of points, and of how many
        self._disturbed: defaultdict[int, Disturbances] = defaultdict(Disturbances)
        self._air: MainMode | None = None
        self._left_s = NAN  # when the tip was free after the newest point
        self._again: ScanPoint | None = None  # attempted last, and nothing was kept of it
        self._last: ScanPoint | None = None  # finished last

    def run(self) -> Summary:
        """Finish every point that is not; references, of free air and silent, are taken before and after."""
        try:
            message = self._ended_by(self._all_points)
        finally:
            left = self._ended_by(self._hands.retract)
        return self._summary(_joined(message, left))

    def _all_points(self) -> None:
        begun_s = self._hands.now_s()
        self._hands.retract()
        if Output.SILENT in self._scene.outputs:
            self._reference(SILENT)
        self._reference(BEFORE)
        self._air = read_reference(self._run.content, BEFORE)
        while (point := self._next()) is not None:
            longest_s = self._scene.time_limits.scan_s
            if self._hands.now_s() - begun_s > longest_s:
                raise ScanEnded(f"time_limits.scan_s: {longest_s:g} s are over")
            self._point(point)
        self._reference(AFTER)
        if self._scene.protocols:
            write_fits(self._run.path, list(fits_of(self._run.content)))

    def _ended_by(self, do: Callable[[], object]) -> str:
        """Do something; why the scan ends there, empty where it does not."""
        try:
            do()
        except ScanEnded as error:
            return str(error)
        except Interrupted:
            return "cancelled"
        except OSError as error:  # the disk is full, or gone
            return ended_by_storage(self._run.path, error, self._run.finished)
        return ""

    def _next(self) -> ScanPoint | None:
        """The point to touch next; waits while the scan is paused or a node is away.

        That whose last attempt was discarded, although an earlier one may have finished it; else the first that
        is not finished; an adaptive scan chooses and appends one where all are.
        """
        self._wait()
        again, self._again = self._again, None
        if (point := again or self._run.next_point) is None:
            content = self._run.content
            chosen = self._plan.next_point(content.points, content.latest)
            point = None if chosen is None else self._run.append(chosen)
        request = self._controls.take()
        repeats = request is Request.REPEAT and again is None
        if repeats and (content := self._run.content).results:
            names = (POINT_FILE.fullmatch(file.name) for file in reversed(content.files))
            return self._last or content.points[next(int(match[1]) for match in names if match)]
        if request is Request.SKIP and point is not None:
            if self._is_done(point):  # to be repeated: what was measured before counts
                return self._next()
            with self._run.begin_point(point.index) as recording:
                result = self._ended(point, recording, PointOutcome.SKIPPED, SKIPPED, 0.0)
                self._publish(recording.finish(result))
                self._last = point
            return self._next()
        return point

    def _is_done(self, point: ScanPoint) -> bool:
        """Whether an earlier attempt at a point counts, with its poles."""
        done = (of for of in self._run.content.latest if of.outcome is PointOutcome.DONE)
        return any(of.index == point.index for of in done)

    def _wait(self) -> None:
        """With the tip free, while the scan is paused or a node is held, and until all are at work."""
        deadline = time.monotonic() + NODE_BACK_WITHIN_S
        while not self._controls.cancelled.is_set():
            if self._controls.paused.is_set():
                self._say(None, Phase.PAUSED)
                deadline = time.monotonic() + NODE_BACK_WITHIN_S
            elif missing := self._hands.missing():
                self._say(None, Phase.WAITING, waiting_for=missing)
                if self._hands.held():
                    deadline = time.monotonic() + NODE_BACK_WITHIN_S
                elif time.monotonic() > deadline:
                    raise ScanEnded(f"{missing}, for {NODE_BACK_WITHIN_S:g} s")
            else:
                return
            time.sleep(POLL_S)
        raise Interrupted

    def _point(self, point: ScanPoint) -> None:
        """One attempt at a point, finished with a result whatever happens, unless it shall be repeated."""
        scene, design = self._scene, self._plan.measurement
        begun_s = self._hands.now_s()
        decisions: list[Decision] = []
        keeper = GateKeeper(scene.gate, scene.force_n)
        tests = [asked for asked in scene.protocols if asked.concerns(point.index)]
        longest_s = scene.time_limits.point_s + sum(asked.longest_s for asked in tests)

        def enough(measured: Measured, blocks: int) -> bool:
            force = measured.origin.contact
            pressed = ContactLoad(force.force_n, force.force_std_n, measured.contact_age_s)
            wanted = scene.nominal_contact, blocks, scene.precision, design.blocks, design.block_s
            decisions.append(decide(measured.poles, pressed, *wanted))
            self._say(point, Phase.MEASURE, blocks, measured.poles)
            return keeper.shuts(force) or decisions[-1].stop

        def check() -> None:
            self._controls.check()
            if self._hands.now_s() - begun_s > longest_s:
                raise PointFailed(f"time_limits.point_s: {longest_s:g} s are over")

        with self._run.begin_point(point.index) as recording:
            measured, outcome, reason, leaves = None, PointOutcome.FAILED, "", False
            # of the contact in which it is measured: those of tests follow
            moved_n, spent_s, not_tested = 0.0, None, ""
            # a point that is repeated on request has phases and noise of its own
            seed = self._seed + point.index + recording.attempt * ATTEMPT_SEEDS
            self._hands.begin(self._seed, point.index, recording.attempt)
            try:
                self._say(point, Phase.CONTACT)
                self._hands.touch(point, scene.force_n, scene.hold, check)
                self._say(point, Phase.MEASURE)
                while measured is None:
                    made = self._hands.measure(
                        design,
                        point.label,
                        seed + len(keeper.left_out) * GATE_SEEDS,
                        enough,
                        recording,
                        check,
                    )
                    if keeper.counts(made.origin.contact):
                        measured = made
                if tests:
                    self._say(point, Phase.RETRACT)
                    moved_n, spent_s = self._hands.retract(), self._hands.spent_s()
                    not_tested = self._test(point, tests, recording, check)
            except PointDisturbed as error:
                reason = str(error)
                if self._disturbed[point.index].again(error):
                    outcome = PointOutcome.DISCARDED
            except PointFailed as error:
                reason = str(error)
            except Interrupted:
                outcome, reason = PointOutcome.SKIPPED, SKIPPED
                leaves = self._controls.take() is Request.SKIP
                if not leaves:  # cancelled or to be repeated
                    outcome, reason = PointOutcome.DISCARDED, LEFT
                elif self._is_done(point):  # what was measured before counts
                    outcome = PointOutcome.DISCARDED
            except ScanEnded as error:
                self._discard(point, recording, str(error))
                raise
            if outcome is PointOutcome.DISCARDED:
                self._hands.retract()
                self._discard(point, recording, reason)
                self._again = None if leaves else point
                return
            self._say(point, Phase.RETRACT)
            left_n = self._hands.retract()
            if spent_s is None:
                moved_n, spent_s = left_n, self._hands.spent_s()
            duration_s = self._hands.now_s() - begun_s
            result = self._ended(point, recording, outcome, reason, duration_s)
            if measured is not None:
                measured = measured.with_zero_moved(moved_n)
                result = measured_result(result, scene, measured, decisions[-1], self._air)
            moved = f"the zero of the force moved by {1e3 * moved_n:.1f} mN in the contact"
            disturbed = self._disturbed.pop(point.index, Disturbances())
            result = replace(
                result,
                reason=_joined(result.reason, reason, moved if moved_n else "", not_tested),
                repeats=disturbed.total,
                disturbances=str(disturbed),
                gate="" if measured is None else str(keeper),
                vibration_s=len(decisions) * design.block_s,
                between_s=begun_s - self._left_s,
                **spent_s,
            )
            self._left_s = begun_s + duration_s
            self._publish(recording.finish(result))
            self._last = point
        self._durations_s += duration_s
        self._timed += 1
        if result.outcome is PointOutcome.FAILED and scene.on_failure is OnFailure.STOP:
            raise ScanEnded(
                f"point {point.index + 1} failed and on_failure is stop: {result.reason}"
            )

    def _test(
        self,
        point: ScanPoint,
        tests: Sequence[ProtocolRequest],
        recording: PointRecording,
        check: Check,
    ) -> str:
        """Carry mechanical tests out; why some failed: the poles of the point count without them."""
        failed = ""
        for asked in tests:
            self._say(point, Phase.CONTACT)
            try:
                self._hands.test(
                    point, asked, asked.force_n or self._scene.force_n, recording, check
                )
            except PointDisturbed:
                raise
            except PointFailed as error:
                failed = _joined(failed, f"{asked.kind.value}: {error}")
        return failed

    def _reference(self, name: str) -> None:
        """Measure in free air: the sensor's health and drift; one that fails does not end the scan.

        The silent one needs no free air: nothing is played.
        """
        silent = name == SILENT
        if not (self._hands.free_air or silent):
            return
        if self._run.content.paths(reference=name):
            return
        # phases and, on the bench, noise of its own: equal ones would hide how far the two may differ
        point = air_point(self._plan.most_points + (name == AFTER))
        design = self._plan.measurement.of_reference
        if silent:
            design = replace(design, silent=True)
            point = replace(point, label=SILENT)
        disturbed = Disturbances()
        while True:
            self._wait()
            self._say(None, Phase.REFERENCE)
            self._hands.begin(self._seed, point.index, 0)
            with self._run.begin_reference(name) as recording:
                begun_s = self._hands.now_s()
                try:
                    measured = self._hands.measure(
                        design,
                        point.label,
                        self._seed + point.index,
                        lambda measured, blocks: False,
                        recording,
                        self._controls.check_cancelled,
                    )
                except PointFailed as error:
                    if isinstance(error, PointDisturbed) and disturbed.again(error):
                        self._discard(point, recording, str(error))
                        continue
                    failed = self._ended(point, recording, PointOutcome.FAILED, str(error))
                    self._publish(recording.message_of(failed))
                    return
                except (Interrupted, ScanEnded) as error:
                    self._discard(point, recording, str(error) or LEFT)
                    raise
                duration_s = self._hands.now_s() - begun_s
                result = self._ended(
                    point, recording, PointOutcome.SKIPPED, NOTHING_PLAYED, duration_s
                )
                result = replace(result, simulated=measured.origin.simulated)
                if not silent:
                    in_air = replace(self._scene, tissue_classes=(), nominal_contact=None)
                    decision = Decision(Verdict.MOST_BLOCKS, design.periods)
                    result = measured_result(result, in_air, measured, decision)
                result = replace(result, repeats=disturbed.total, disturbances=str(disturbed))
                self._publish(recording.finish(result))
                return

    def _ended(
        self,
        point: ScanPoint,
        recording: PointRecording,
        outcome: PointOutcome,
        reason: str,
        duration_s: float = NAN,
    ) -> PointResult:
        """Result of an attempt that has ended, without poles."""
        kind = PointKind.AIR if point.index >= self._plan.most_points else PointKind.TISSUE
        return replace(
            attempt_at(point, recording.attempt, self._scene.frame_id),
            outcome=outcome,
            reason=reason,
            duration_s=duration_s,
            measurement_id=recording.measurement_id,
            kind=kind,
            time_ns=time.time_ns(),
        )

    def _discard(self, point: ScanPoint, recording: PointRecording, reason: str) -> None:
        """Tell that nothing is kept of an attempt."""
        result = self._ended(point, recording, PointOutcome.DISCARDED, reason)
        self._publish(recording.message_of(result))

    def _say(
        self,
        point: ScanPoint | None,
        phase: Phase,
        blocks: int = 0,
        poles: Poles | None = None,
        waiting_for: str = "",
    ) -> None:
        points, finished = self._plan.most_points, self._run.finished
        each_s = self._plan.longest_s / points
        if self._timed:
            each_s = self._durations_s / self._timed
        left_s = each_s * (points - finished)
        repeats = self._repeats()
        self._tell(
            Progress(point, phase, finished, points, blocks, poles, left_s, repeats, waiting_for)
        )

    def _repeats(self) -> int:
        """Of the points that are finished and of the one under way."""
        return self._run.repeats + sum(of_point.total for of_point in self._disturbed.values())

    def _summary(self, message: str) -> Summary:
        content = self._run.content
        latest = content.latest
        count = {o: sum(result.outcome is o for result in latest) for o in PointOutcome}
        left = content.next_point or self._plan.next_point(content.points, latest)
        health, sentence = sensor_health(content, self._scene.drift_limits)
        message = message or ("ended early" if left else "complete")
        if problems := content.problems:
            message += f"; {len(problems)} damaged files left out, the first: {problems[0]}"
        return Summary(
            complete=left is None,
            message=message,
            done=count[PointOutcome.DONE],
            failed=count[PointOutcome.FAILED],
            skipped=count[PointOutcome.SKIPPED],
            blocks=sum(result.blocks for result in latest),
            blocks_saved=sum(result.blocks_saved for result in latest),
            saved_s=float(np.nansum([result.saved_s for result in latest])),
            repeats=self._repeats(),
            sensor_drifted=health is SensorHealth.DRIFTED,
            sensor_health=sentence,
        )


def _joined(*texts: str) -> str:
    """Reasons as one; the same one once."""
    return "; ".join(dict.fromkeys(filter(None, texts)))
