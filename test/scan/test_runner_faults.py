# SPDX-License-Identifier: Apache-2.0
"""Points that fail or are disturbed, nodes that go away: what is repeated, what goes on, what ends."""

import errno
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.scan import runner
from tactile_resonance.scan.failures import (
    ATTEMPTS,
    ATTEMPTS_WITHOUT_NODE,
    NodeAway,
    PointDisturbed,
    PointFailed,
    ScanEnded,
)
from tactile_resonance.scan.hands import Controls, Request
from tactile_resonance.scan.messages import message_types
from tactile_resonance.scan.point_result import TYPE, PointKind, PointOutcome, from_message
from tactile_resonance.scan.recorded import recorded_results
from tactile_resonance.scan.scene import OnFailure, TimeLimits

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import Bench, begin, scan, scene


def test_a_point_that_fails_is_kept_with_its_reason_and_the_scan_goes_on(tmp_path):
    summary, run, _ = scan(tmp_path / "run", scene(), Bench(failing=(1,)))
    assert (summary.complete, summary.done, summary.failed) == (True, 3, 1)
    failed = run.latest[1]
    assert failed.outcome is PointOutcome.FAILED
    assert failed.reason == "contact: surface_missing: nothing there"
    assert np.isnan(failed.f0_hz)


def test_a_scene_may_stop_at_a_failure(tmp_path):
    made = scene(on_failure=OnFailure.STOP)
    summary, run, _ = scan(tmp_path / "run", made, Bench(failing=(1,)))
    assert not summary.complete
    assert "point 2 failed and on_failure is stop" in summary.message
    assert run.next_point.index == 2


def test_a_point_that_is_disturbed_comes_again_and_fails_in_the_end(tmp_path):
    def disturb(times):
        left = [times]

        def on_measure(bench, blocks):
            if bench.log[-1] == ("touch", 1) and left[0]:
                left[0] -= 1
                raise PointDisturbed("contact: force_stale: 11 ms", "force_stale")

        return Bench(on_measure=on_measure)

    bench = disturb(2)
    summary, run, told = scan(tmp_path / "twice", scene(), bench)
    assert (summary.done, summary.failed) == (4, 0)
    assert [entry[1] for entry in bench.log if entry[0] == "touch"] == [0, 1, 1, 1, 2, 3]
    assert [(r.index, r.attempt) for r in run.results] == [(k, 0) for k in range(4)]
    assert [(r.repeats, r.disturbances) for r in run.results] == [
        (0, ""), (2, "force_stale 2"), (0, ""), (0, "")
    ]  # fmt: skip
    assert summary.repeats == 2
    assert told[-1].repeats == 2
    summary, run, _ = scan(tmp_path / "always", scene(), disturb(ATTEMPTS))
    assert (summary.done, summary.failed) == (3, 1)
    assert "force_stale" in run.latest[1].reason
    assert run.latest[1].repeats == ATTEMPTS - 1


@pytest.mark.parametrize("asked_again", [False, True])
def test_a_finished_point_whose_repetition_is_disturbed_or_left_is_repeated_all_the_same(
    tmp_path, asked_again
):
    controls = Controls()

    class Repeated(Bench):
        @property
        def touched(self):
            return [entry[1] for entry in self.log if entry[0] == "touch"]

        def missing(self):
            if self.touched == [0, 1]:  # looked at once, before the next point
                controls.ask(Request.REPEAT)
            return None

        def measure(self, design, label, seed, enough, recording, check):
            if self.touched == [0, 1, 1]:
                if not asked_again:
                    raise PointDisturbed("contact: force_stale: 11 ms", "force_stale")
                controls.ask(Request.REPEAT)
                check()
            return super().measure(design, label, seed, enough, recording, check)

    bench = Repeated()
    summary, run, _ = scan(tmp_path / "run", scene(), bench, controls)
    assert summary.complete
    assert bench.touched == [0, 1, 1, 1, 2, 3]
    assert [(r.index, r.attempt) for r in run.results] == [(0, 0), (1, 0), (1, 1), (2, 0), (3, 0)]


@pytest.mark.parametrize("in_contact", [False, True])
def test_a_repetition_that_is_skipped_leaves_the_point_as_it_was_measured(tmp_path, in_contact):
    controls, wanted = Controls(), [([0, 1, 1], Request.SKIP), ([0, 1], Request.REPEAT)]

    def ask(touched):
        if wanted and wanted[-1][0] == touched:
            controls.ask(wanted.pop()[1])

    class Skipped(Bench):
        @property
        def touched(self):
            return [entry[1] for entry in self.log if entry[0] == "touch"]

        def missing(self):
            ask(self.touched)  # to skip, before the disturbed repetition is attempted again
            return None

        def measure(self, design, label, seed, enough, recording, check):
            if self.touched == [0, 1, 1]:
                if not in_contact:
                    raise PointDisturbed("contact: force_stale: 11 ms", "force_stale")
                ask(self.touched)
                check()
            return super().measure(design, label, seed, enough, recording, check)

    bench = Skipped()
    summary, run, _ = scan(tmp_path / "run", scene(), bench, controls)
    assert (summary.complete, summary.done, summary.skipped) == (True, 4, 0)
    assert not wanted
    assert bench.touched == [0, 1, 1, 2, 3]
    assert [(r.index, r.attempt, r.outcome) for r in run.results] == [
        (k, 0, PointOutcome.DONE) for k in range(4)
    ]


def test_a_reference_that_is_disturbed_comes_again(tmp_path):
    @dataclass
    class Disturbed(Bench):
        left: int = 2

        def measure(self, design, label, *rest):
            if label == "air" and self.left:
                self.left -= 1
                raise PointDisturbed("frf: who publishes it was started anew")
            return super().measure(design, label, *rest)

    for disturbed, kept in ((2, ["air-before", "air-after"]), (ATTEMPTS, ["air-after"])):
        path = tmp_path / f"{disturbed}"
        summary, run, _ = scan(path, scene(), Disturbed(left=disturbed))
        assert (summary.complete, summary.done) == (True, 4)
        references = [file.name for file in run.files if file.name.startswith("reference-")]
        assert [name[13:-5] for name in sorted(references)] == kept


def test_every_attempt_is_told_with_what_became_of_it(tmp_path):
    controls, left, cdrs = Controls(), [True], []

    def on_measure(bench, blocks):
        if bench.log[-1] == ("touch", 1) and left and left.pop():
            raise PointDisturbed("contact: force_stale: 11 ms", "force_stale")
        if bench.log[-1] == ("touch", 2) and blocks == 2:
            controls.ask(Request.SKIP)
        if bench.log[-1] == ("touch", 4):
            controls.ask(Request.CANCEL)

    made = scene(5)
    plan, run = begin(tmp_path / "run", made)
    bench = Bench(on_measure=on_measure, failing=(3,))
    with run:
        on_disk = []

        def publish(cdr):
            cdrs.append(cdr)
            on_disk.append(len(run.content.files))

        runner.ScanRunner(plan, run, bench, controls, lambda _: None, 1, publish).run()
    told = [from_message(message_types().deserialize_cdr(cdr, TYPE)) for cdr in cdrs]
    assert [(r.kind, r.index, r.attempt, r.outcome, r.measurement_id) for r in told] == [
        (PointKind.AIR, 5, 0, PointOutcome.DONE, 1006),
        (PointKind.TISSUE, 0, 0, PointOutcome.DONE, 1001),
        (PointKind.TISSUE, 1, 0, PointOutcome.DISCARDED, 1002),
        (PointKind.TISSUE, 1, 0, PointOutcome.DONE, 1002),
        (PointKind.TISSUE, 2, 0, PointOutcome.SKIPPED, 1003),
        (PointKind.TISSUE, 3, 0, PointOutcome.FAILED, 0),
        (PointKind.TISSUE, 4, 0, PointOutcome.DISCARDED, 1005),
    ]
    assert [r.reason for r in told] == [
        *("", "", "contact: force_stale: 11 ms", "", "skipped on request"),
        *("contact: surface_missing: nothing there", "left on request"),
    ]
    assert np.isfinite([r.f0_hz for r in told]).tolist() == [True, True, False, True, *[False] * 3]
    # what counts is on disk before it is told, and told again of a run that is gone on with
    assert on_disk == [1, 2, 2, 3, 4, 5, 5]
    kept = [
        cdr for cdr, r in zip(cdrs, told, strict=True) if r.outcome is not PointOutcome.DISCARDED
    ]
    assert list(recorded_results(run.content)) == kept


def test_a_reference_that_fails_is_told_and_so_is_one_that_ends_the_scan(tmp_path):
    class Failing(Bench):
        def measure(self, design, label, seed, enough, recording, check):
            recording.measurement_id = next(ids)
            raise next(errors)

    ids = iter((7, 8, 9))
    errors = iter((PointDisturbed("frf: lost"), PointFailed("no poles"), ScanEnded("no node")))
    made = scene(1, on_failure=OnFailure.STOP)
    plan, run = begin(tmp_path / "run", made)
    told = []
    with run:
        runner.ScanRunner(plan, run, Failing(), Controls(), lambda _: None, 1, told.append).run()
    told = [from_message(message_types().deserialize_cdr(cdr, TYPE)) for cdr in told]
    assert [(r.kind, r.index, r.outcome, r.reason, r.measurement_id) for r in told] == [
        (PointKind.AIR, 1, PointOutcome.DISCARDED, "frf: lost", 7),
        (PointKind.AIR, 1, PointOutcome.FAILED, "no poles", 8),
        (PointKind.TISSUE, 0, PointOutcome.DISCARDED, "no node", 9),
    ]


@dataclass
class Leaving(Bench):
    """At point 1 a node goes away so many times; after each it is missed for a while."""

    left: int = ATTEMPTS + 2
    away: int = 0

    def missing(self):
        assert not self.holding, "waits with the tip on the tissue"
        self.time_s += 1.0 if self.away else 0.0
        self.away = max(0, self.away - 1)
        return "frf: /frf_node is not active" if self.away else None

    def measure(self, design, label, seed, enough, recording, check):
        assert not self.away, "measured while the node was away"
        if label != "air" and self.log[-1] == ("touch", 1) and self.left:
            self.left -= 1
            self.away = 4
            raise NodeAway("frf: /frf_node is not active", "node away")
        return super().measure(design, label, seed, enough, recording, check)


def test_a_point_whose_node_is_away_comes_again_when_it_is_back(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "POLL_S", 0.001)
    # the time that the point may take is not spent on waiting
    made = scene(time_limits=TimeLimits(point_s=0.5, scan_s=3600))
    summary, run, told = scan(tmp_path / "back", made, Leaving())
    assert (summary.complete, summary.done, summary.failed) == (True, 4, 0)
    assert run.latest[1].repeats == ATTEMPTS + 2
    assert run.latest[1].disturbances == f"node away {ATTEMPTS + 2}"
    assert "waiting" in [progress.phase for progress in told]
    # a point that ends its node every time is given up at last
    summary, run, _ = scan(tmp_path / "never", made, Leaving(left=10**6))
    assert (summary.complete, summary.done, summary.failed) == (True, 3, 1)
    assert run.latest[1].repeats == ATTEMPTS_WITHOUT_NODE - 1


def test_a_scan_whose_node_stays_away_ends_with_its_name_and_can_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "NODE_BACK_WITHIN_S", 0.2)

    def leave(bench, blocks):
        if bench.log[-1] == ("touch", 2):
            bench.away = 10**6
            raise NodeAway("frf: /frf_node is not active", "node away")

    summary, run, _ = scan(tmp_path / "run", scene(), Leaving(on_measure=leave, left=0))
    assert not summary.complete
    assert "/frf_node is not active" in summary.message
    assert [result.outcome for result in run.latest] == [PointOutcome.DONE] * 2
    assert run.next_point.index == 2


def test_a_scan_waits_for_a_node_that_is_held_for_as_long_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "NODE_BACK_WITHIN_S", 0.2)
    monkeypatch.setattr(runner, "POLL_S", 0.01)

    class Held(Leaving):
        def held(self):
            return self.away > 1

    summary, _, told = scan(tmp_path / "run", scene(), Held(away=50))
    assert (summary.complete, summary.done) == (True, 4)
    waiting = [progress.waiting_for for progress in told if progress.phase == "waiting"]
    assert set(waiting) == {"frf: /frf_node is not active"}


def test_a_scan_that_waits_for_a_node_can_be_cancelled(tmp_path):
    controls = Controls()
    bench = Leaving(away=10**6)
    threading.Timer(0.2, lambda: controls.ask(Request.CANCEL)).start()
    summary, run, _ = scan(tmp_path / "run", scene(), bench, controls)
    assert summary.message == "cancelled"
    assert run.latest == ()


def test_a_point_that_takes_too_long_fails_and_a_scan_that_does_ends(tmp_path):
    made = scene(time_limits=TimeLimits(point_s=1e-9, scan_s=3600))
    summary, run, _ = scan(tmp_path / "a", made, Bench())
    assert summary.failed == 4
    assert "time_limits.point_s" in run.latest[0].reason
    made = scene(time_limits=TimeLimits(point_s=60, scan_s=1e-9))
    summary, run, _ = scan(tmp_path / "b", made, Bench())
    assert not summary.complete
    assert "time_limits.scan_s" in summary.message
    assert run.latest == ()


def test_what_cannot_go_on_ends_with_its_reason_and_the_tip_free(tmp_path):
    def gone(bench, blocks):
        raise ScanEnded("measure: no node takes the goal for 60 s")

    bench = Bench(on_measure=gone)
    summary, run, _ = scan(tmp_path / "run", scene(), bench)
    assert "no node takes the goal" in summary.message
    assert not summary.complete
    assert run.latest == ()
    assert not bench.holding


@pytest.mark.parametrize(
    ("held", "told"),
    [("the tip is held", "; the tip is held"), ("/contact_node is silent for 60 s", "")],
)
def test_a_tip_that_cannot_be_drawn_back_hides_neither_the_cause_nor_what_is_done(
    tmp_path, held, told
):
    class Held(Bench):
        gone = False

        def retract(self):
            if self.gone:
                raise ScanEnded(held)
            return super().retract()

    def silent(bench, blocks):
        if bench.log[-1] == ("touch", 2):
            bench.gone = True
            raise ScanEnded("/contact_node is silent for 60 s")

    summary, run, _ = scan(tmp_path / "run", scene(), Held(on_measure=silent))
    assert summary.message == f"/contact_node is silent for 60 s{told}"
    assert (summary.complete, summary.done) == (False, 2)
    assert run.next_point.index == 2


def test_a_full_disk_ends_the_scan_with_its_path_and_what_is_safe(tmp_path):
    def full(bench, blocks):
        if bench.log[-1] == ("touch", 2):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    bench = Bench(on_measure=full)
    summary, run, _ = scan(tmp_path / "run", scene(), bench)
    text = "No space left on device; 2 points are safe in it, resume goes on"
    assert summary.message == f"{tmp_path / 'run'}: {text}"
    assert (summary.complete, summary.done) == (False, 2)
    assert run.next_point.index == 2
    assert not bench.holding
