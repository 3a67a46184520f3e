# SPDX-License-Identifier: Apache-2.0
"""The life of a scan: every planned point finished once, whatever happens on the way."""

import os
import random
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from tactile_resonance.identification.result import Poles
from tactile_resonance.record import Contact, Origin
from tactile_resonance.scan import runner
from tactile_resonance.scan.controls import Controls, Request
from tactile_resonance.scan.decision import BlockLimits, Precise
from tactile_resonance.scan.hands import (
    ATTEMPTS,
    ATTEMPTS_WITHOUT_NODE,
    Measured,
    NodeAway,
    PointDisturbed,
    PointFailed,
    ScanEnded,
)
from tactile_resonance.scan.messages import message_types
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.point_result import Outcome
from tactile_resonance.scan.references import SensorHealth
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scene import OnFailure, ScanScene, TimeLimits

SPREAD_HZ = 0.02


@dataclass
class Bench:
    """Hands on a bench whose poles have a spread that falls with the root of the blocks."""

    log: list = field(default_factory=list)
    failing: tuple = ()
    on_measure: object = None
    holding: bool = False
    free_air: bool = True

    def missing(self):
        return None

    def touch(self, point, force_n, hold, check):
        check()
        assert not self.holding, "the tip was not drawn back before the next point"
        if point.index in self.failing:
            raise PointFailed("contact: surface_missing: nothing there")
        self.holding = True
        self.log.append(("touch", point.index))

    def measure(self, design, label, seed, enough, recording, check):
        blocks = 0
        recording.write("/note", "std_msgs/msg/String", time.time_ns(), note(label))
        while blocks < design.periods:
            check()
            blocks += 1
            covariance = np.diag([SPREAD_HZ**2, 1e-9]) / blocks
            poles = Poles(
                poles_rad_s=np.array([-50 + 1600j]),
                f0_hz=np.array([254.0]),
                damping_ratio=np.array([0.03]),
                residues=np.array([100 + 0j]),
                covariance=covariance[None],
                total_covariance=covariance[None],
            )
            if self.on_measure is not None and label != "air":
                self.on_measure(self, blocks)
            if enough(poles, blocks):
                break
        self.log.append(("measure", label, seed, blocks))
        contact = Contact(0.01, 1e-4, (0.0, 0.0, 0.0), frame_id="base", time_ns=1)
        return Measured(poles, Origin(measurement_id=1000 + seed, contact=contact, simulated=True))

    def retract(self):
        self.holding = False


def note(text):
    types = message_types()
    kind = "std_msgs/msg/String"
    return types.serialize_cdr(types.types[kind](data=text), kind)


def scene(points=4, **changes):
    positions = np.zeros((points, 3))
    positions[:, 0] = 1e-3 * np.arange(points)
    made = ScanScene(
        name="test",
        force_n=0.01,
        positions_m=positions,
        precision=Precise(f0_std_hz=SPREAD_HZ / 2),
        blocks=BlockLimits(least=2, most=8),
    )
    return replace(made, **changes)


def begin(path, made):
    plan = make_plan(made)
    run = RunDirectory.create(path, "name: test\n", plan.points, {"seed": 1})
    return plan, run


def scan(path, made, bench, controls=None):
    plan, run = begin(path, made)
    told = []
    with run:
        summary = ScanRunner(made, plan, run, bench, controls or Controls(), told.append).run()
    return summary, read_run(path), told


def test_each_point_is_measured_until_it_is_precise_enough_and_kept(tmp_path):
    bench = Bench()
    summary, run, told = scan(tmp_path / "run", scene(), bench)
    assert summary.complete
    assert (summary.done, summary.failed, summary.skipped) == (4, 0, 0)
    # spread over root n below half of the spread: 4 blocks of 8, at every point
    assert [result.blocks for result in run.latest] == [4] * 4
    assert (summary.blocks, summary.blocks_saved) == (16, 16)
    assert [result.verdict for result in run.latest] == ["precision reached"] * 4
    assert summary.saved_s == pytest.approx(16 * 0.4)
    assert [result.f0_std_hz for result in run.latest] == pytest.approx([SPREAD_HZ / 2] * 4)
    # phases differ from point to point, and references of free air were taken before and after
    seeds = [entry[2] for entry in bench.log if entry[0] == "measure" and entry[1] != "air"]
    assert seeds == [1, 2, 3, 4]
    assert [entry[1] for entry in bench.log if entry[0] == "measure"][::5] == ["air", "air"]
    assert not bench.holding
    assert told[-1].finished == 4


def test_a_point_that_fails_is_kept_with_its_reason_and_the_scan_goes_on(tmp_path):
    summary, run, _ = scan(tmp_path / "run", scene(), Bench(failing=(1,)))
    assert (summary.complete, summary.done, summary.failed) == (True, 3, 1)
    failed = run.latest[1]
    assert failed.outcome is Outcome.FAILED
    assert failed.reason == "contact: surface_missing: nothing there"
    assert np.isnan(failed.f0_hz)


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


@dataclass
class Leaving(Bench):
    """At point 1 a node goes away so many times; after each it is missed for a while."""

    left: int = ATTEMPTS + 2
    away: int = 0

    def missing(self):
        assert not self.holding, "waits with the tip on the tissue"
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
    assert [result.outcome for result in run.latest] == [Outcome.DONE] * 2
    assert run.next_point.index == 2


def test_a_scan_that_waits_for_a_node_can_be_cancelled(tmp_path):
    controls = Controls()
    bench = Leaving(away=10**6)
    threading.Timer(0.2, lambda: controls.ask(Request.CANCEL)).start()
    summary, run, _ = scan(tmp_path / "run", scene(), bench, controls)
    assert summary.message == "cancelled"
    assert run.latest == ()


def test_without_free_air_nothing_is_called_a_reference(tmp_path):
    bench = Bench(free_air=False)
    summary, run, _ = scan(tmp_path / "run", scene(), bench)
    assert summary.complete
    assert "air" not in [entry[1] for entry in bench.log]
    assert not [file.name for file in run.files if file.name.startswith("reference-")]
    assert summary.health is SensorHealth.UNKNOWN
    assert all(np.isnan(result.f0_over_air) for result in run.latest)


def test_a_scene_may_stop_at_a_failure(tmp_path):
    made = scene(on_failure=OnFailure.STOP)
    summary, run, _ = scan(tmp_path / "run", made, Bench(failing=(1,)))
    assert not summary.complete
    assert "point 2 failed and on_failure is stop" in summary.message
    assert run.next_point.index == 2


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


def test_skip_repeat_and_cancel(tmp_path):
    controls = Controls()
    asked = iter([(Request.SKIP, 0), (Request.REPEAT, 1), (Request.CANCEL, 3)])
    waiting = [next(asked)]

    def on_measure(bench, blocks):
        if waiting and blocks == 2 and bench.log[-1] == ("touch", waiting[0][1]):
            controls.ask(waiting.pop()[0])
            waiting.extend([a for a in [next(asked, None)] if a])

    bench = Bench(on_measure=on_measure)
    summary, run, _ = scan(tmp_path / "run", scene(5), bench, controls)
    assert summary.message == "cancelled"
    touched = [entry[1] for entry in bench.log if entry[0] == "touch"]
    # 0 is left for good; 1 is left, done again; 3 is left when the scan is cancelled
    assert touched == [0, 1, 1, 2, 3]
    assert [result.outcome for result in run.latest] == [
        Outcome.SKIPPED,
        Outcome.DONE,
        Outcome.DONE,
    ]
    assert run.next_point.index == 3
    assert not bench.holding
    # and resumed it goes on with the point that was cancelled
    made = scene(5)
    with RunDirectory.open(tmp_path / "run") as again:
        bench = Bench()
        summary = ScanRunner(
            made, make_plan(made), again, bench, Controls(), lambda progress: None
        ).run()
    assert summary.complete
    assert [entry[1] for entry in bench.log if entry[0] == "touch"] == [3, 4]


def test_repeat_between_points_makes_a_second_attempt(tmp_path):
    controls = Controls()
    made = scene(2)
    plan, run = begin(tmp_path / "run", made)
    with run:
        ScanRunner(made, plan, run, Bench(), controls, lambda progress: None).run()
        controls.ask(Request.REPEAT)
        ScanRunner(made, plan, run, Bench(), controls, lambda progress: None).run()
    content = read_run(tmp_path / "run")
    assert [(r.index, r.attempt) for r in content.results] == [(0, 0), (1, 0), (1, 1)]


def test_a_paused_scan_waits_with_the_tip_free(tmp_path):
    controls = Controls()
    controls.paused.set()
    bench = Bench()
    made = scene(2)
    plan, run = begin(tmp_path / "run", made)
    phases = []
    with run:
        scanning = ScanRunner(made, plan, run, bench, controls, lambda p: phases.append(p.phase))
        thread = threading.Thread(target=scanning.run)
        thread.start()
        while "paused" not in phases:
            time.sleep(0.01)
        assert not bench.holding
        assert run.content.latest == ()
        controls.paused.clear()
        thread.join()
    assert len(read_run(tmp_path / "run").latest) == 2


def test_what_cannot_go_on_ends_with_its_reason_and_the_tip_free(tmp_path):
    def gone(bench, blocks):
        raise ScanEnded("measure: no node takes the goal for 60 s")

    bench = Bench(on_measure=gone)
    summary, run, _ = scan(tmp_path / "run", scene(), bench)
    assert "no node takes the goal" in summary.message
    assert not summary.complete
    assert run.latest == ()
    assert not bench.holding


SCAN = """
    import sys, time
    sys.path.insert(0, sys.argv[2])
    from pathlib import Path
    import test_runner as t
    from tactile_resonance.scan.plan import make_plan
    from tactile_resonance.scan.run_directory import RunDirectory
    from tactile_resonance.scan.controls import Controls
    from tactile_resonance.scan.runner import ScanRunner
    path, made = Path(sys.argv[1]), t.scene(8)
    run = RunDirectory.open(path) if path.exists() else t.begin(path, made)[1]
    bench = t.Bench(on_measure=lambda bench, blocks: time.sleep(3e-3))
    with run:
        print("running", flush=True)
        ScanRunner(made, make_plan(made), run, bench, Controls(), lambda progress: None).run()
    print("complete", flush=True)
"""


def test_killed_at_random_moments_no_finished_point_is_lost_or_repeated(tmp_path):
    rng = random.Random(1)
    path = tmp_path / "run"
    finished, kills = [], 0
    for run in range(60):
        process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(SCAN), str(path), os.path.dirname(__file__)],
            stdout=subprocess.PIPE,
            text=True,
        )
        process.stdout.readline()
        try:
            # longer from run to run: a machine with much other work comes to the end too
            process.wait(rng.uniform(0.0, 0.15 + 0.01 * run))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            kills += 1
        ended = "complete" in process.stdout.read()
        process.wait()
        content = read_run(path)
        assert content.problems == ()
        now = [(r.index, r.attempt) for r in content.results]
        assert now[: len(finished)] == finished, "a finished point was lost"
        finished = now
        if ended:
            break
    assert kills >= 2
    # every point once: none was repeated after it was finished
    assert finished == [(index, 0) for index in range(8)]
