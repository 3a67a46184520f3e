# SPDX-License-Identifier: Apache-2.0
"""The life of a scan: every planned point finished once, whoever asks for what, or kills it, on the way."""

import os
import random
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.poles.result import Poles
from tactile_resonance.report.run_report import pole_maps_of
from tactile_resonance.report.run_report import summary as sentences
from tactile_resonance.report.run_tables import point_table
from tactile_resonance.scan.decision import Separate
from tactile_resonance.scan.hands import Controls, Request
from tactile_resonance.scan.messages import message_types
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.point_file import read_messages
from tactile_resonance.scan.point_result import TYPE, PointKind, PointOutcome, from_message
from tactile_resonance.scan.recorded import recorded_results
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scene import Output
from tactile_resonance.tissue.classify import TissueClass
from tactile_resonance.tissue.nominal_contact import ForceSensitivity, NominalContact

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import AGE_S, BLOCK_S, SPREAD_HZ, TOUCH_S, Bench, begin, scan, scene
from run_tables import START_NS, record_point


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
    # simulated noise is that of run, place and attempt, whatever was measured before
    assert bench.seeds == [(1, 4, 0), *((1, index, 0) for index in range(4)), (1, 5, 0)]
    # durations are those of the bench's time
    assert [result.duration_s for result in run.latest] == pytest.approx(
        [TOUCH_S + 4 * BLOCK_S] * 4
    )
    assert not bench.holding
    assert told[-1].finished == 4


def test_a_silent_record_is_taken_before_all_else_where_the_scene_asks_for_it(tmp_path):
    bench = Bench()
    made = scene(2, outputs=(Output.POLES, Output.SILENT))
    summary, run, _ = scan(tmp_path / "run", made, bench)
    assert summary.complete
    measured = [entry[1] for entry in bench.log if entry[0] == "measure"]
    assert measured == ["silent", "air", *(point.label for point in run.points), "air"]
    assert bench.silent == [True, *4 * [False]]
    assert [file.name for file in run.files if "silent" in file.name] == [
        "reference-00-silent.mcap"
    ]
    # it is taken once
    with RunDirectory.open(tmp_path / "run") as again:
        ScanRunner(make_plan(made), again, bench, Controls(), print).run()
    assert len([entry for entry in bench.log if entry[1] == "silent"]) == 1


@pytest.mark.parametrize("weak_std_hz", [1e-4, 1.0])
def test_of_two_modes_the_main_one_ends_the_measurement_and_is_on_the_map(tmp_path, weak_std_hz):
    """Whether the weak mode beside it is known far better or far worse makes no difference to anything."""
    weak = Poles(
        poles_rad_s=np.array([-50 + 1400j]),
        f0_hz=np.array([222.0]),
        damping_ratio=np.array([0.036]),
        residues=np.array([1 + 0j]),
        covariance=np.diag([weak_std_hz**2, 1e-12])[None],
        total_covariance=np.diag([weak_std_hz**2, 1e-12])[None],
    )
    summary, run, told = scan(tmp_path / "run", scene(3), Bench(beside=weak))
    assert summary.complete
    blocks = 4  # 0.02 Hz of one, 0.01 Hz asked for
    for result in run.latest:
        assert (result.verdict, result.blocks) == ("precision reached", blocks)
        assert (result.f0_hz, result.damping_ratio) == (254.0, 0.03)
        assert result.f0_std_hz == pytest.approx(SPREAD_HZ / np.sqrt(blocks))
        assert (result.pole_real_rad_s, result.pole_imag_rad_s) == (-50.0, 1600.0)
    np.testing.assert_array_equal(pole_maps_of(run)[0].f0_hz, 254.0)
    std_hz = [point.result.f0_std_hz for point in pole_maps_of(run)[0].points]
    np.testing.assert_allclose(std_hz, SPREAD_HZ / np.sqrt(blocks))
    measured = [p.poles.main for p in told if p.poles is not None]
    assert {mode.f0_hz for mode in measured} == {254.0}
    assert "254.000" in point_table(run.latest, {})


def test_the_best_covariance_is_the_total_one_where_it_is_known():
    noise, total = np.diag([1.0, 1e-6]), np.diag([4.0, 1e-6])
    modes = Poles(
        poles_rad_s=np.array([-50 + 1400j, -50 + 1500j]),
        f0_hz=np.array([222.0, 240.0]),
        damping_ratio=np.array([0.03, 0.03]),
        residues=np.array([1 + 0j, 2 + 0j]),
        covariance=np.array([noise, noise]),
        total_covariance=np.array([total, np.full((2, 2), np.nan)]),
    )
    np.testing.assert_array_equal(modes.best_covariance, [total, noise])
    np.testing.assert_array_equal(modes.main.covariance, noise)
    unknown = replace(modes, covariance=None, total_covariance=None)
    assert np.isnan(unknown.best_covariance).all()
    assert unknown.main.found
    assert not Poles().main.found


def pressed_scene():
    """Two tissues 2.5 Hz apart, which the tip moves by 2 Hz per mN."""
    a, b = (TissueClass(n, np.array([f0, 0.03]), np.diag([0.1**2, 1e-6])) for n, f0 in TISSUES)
    sensitivity = ForceSensitivity(np.array([2000.0, 0.0]), np.diag([10.0**2, 1e-4]))
    return scene(
        2,
        precision=Separate(a, b, 0.99),
        tissue_classes=(a, b),
        nominal_contact=NominalContact(0.01, AGE_S, sensitivity, creep=0.02),
    )


TISSUES = (("a", 255.0), ("b", 252.5))


def test_tissues_are_told_apart_at_the_nominal_force(tmp_path):
    """The measured 254 Hz are of neither; at 9.5 mN they are those of one."""
    summary, run, _ = scan(tmp_path / "run", pressed_scene(), Bench(force_n=0.0095))
    assert summary.complete
    for result in run.latest:
        assert (result.verdict, result.tissue_class) == ("classes separated", "a")
        assert (result.blocks, result.tissue_reason) == (2, "")
        # measured and referred pole beside each other, each with its own uncertainty
        assert (result.f0_hz, result.force_n, result.contact_age_s) == (254.0, 0.0095, AGE_S)
        assert result.f0_std_hz == pytest.approx(SPREAD_HZ / np.sqrt(2))
        assert result.nominal_f0_hz == pytest.approx(255.0)
        # the force is known to 0.1 mN, which is 0.2 Hz
        assert result.nominal_f0_std_hz == pytest.approx(np.hypot(0.2, result.f0_std_hz), rel=0.05)
        assert result.nominal_damping_ratio == pytest.approx(0.03)
    _, run, _ = scan(tmp_path / "nominal", pressed_scene(), Bench(force_n=0.01))
    assert [r.tissue_class for r in run.latest] == ["unknown", "unknown"]
    (air,) = [f for f in run.files if f.name.endswith("-air-before.mcap")]
    ((_, _, reference),) = read_messages(run.path / "recording" / air.name, TYPE)
    assert np.isnan(reference.nominal_f0_hz)
    assert reference.tissue_class == ""


def test_a_zero_that_moved_in_the_contact_makes_the_force_less_certain(tmp_path):
    _, run, _ = scan(tmp_path / "run", pressed_scene(), Bench(force_n=0.0095, zero_moved_n=-2e-3))
    for result in run.latest:
        # half of 2 mN, beside 0.1 mN of noise; at 2 Hz per mN that is 2 Hz of the pole at 10 mN
        assert result.force_std_n == pytest.approx(np.hypot(1e-4, 1e-3))
        assert result.nominal_f0_std_hz == pytest.approx(2.0, rel=0.05)
        assert "the zero of the force moved by -2.0 mN" in result.reason
    _, run, _ = scan(tmp_path / "steady", pressed_scene(), Bench(force_n=0.0095))
    assert all("zero" not in result.reason for result in run.latest)


def test_a_report_states_that_force_and_age_are_not_accounted_for(tmp_path):
    _, run, _ = scan(tmp_path / "run", replace(pressed_scene(), nominal_contact=None), Bench())
    reason = "force and age of contact are not accounted for: no nominal_contact is given"
    assert all(reason in result.tissue_reason for result in run.latest)
    assert any(
        line.startswith("No pole is referred to a nominal contact") and reason in line
        for line in sentences(run)
    )


def test_nothing_is_said_of_tissue_where_the_force_is_unknown(tmp_path):
    _, run, _ = scan(tmp_path / "run", pressed_scene(), Bench(force_n=np.nan))
    for result in run.latest:
        assert (result.verdict, result.blocks) == ("most blocks reached", 8)
        assert (result.tissue_class, result.f0_hz) == ("unknown", 254.0)
        assert np.isnan([result.tissue_probability, result.nominal_f0_hz]).all()
        assert result.tissue_reason.startswith("the force is unknown")


def test_without_free_air_nothing_is_called_a_reference(tmp_path):
    bench = Bench(free_air=False)
    summary, run, _ = scan(tmp_path / "run", scene(), bench)
    assert summary.complete
    assert "air" not in [entry[1] for entry in bench.log]
    assert not [file.name for file in run.files if file.name.startswith("reference-")]
    assert not summary.sensor_drifted
    assert summary.sensor_health.startswith("sensor health unknown")
    assert all(np.isnan(result.f0_over_air) for result in run.latest)


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
        PointOutcome.SKIPPED,
        PointOutcome.DONE,
        PointOutcome.DONE,
    ]
    assert run.next_point.index == 3
    assert not bench.holding
    # and resumed it goes on with the point that was cancelled
    made = scene(5)
    with RunDirectory.open(tmp_path / "run") as again:
        bench = Bench()
        summary = ScanRunner(make_plan(made), again, bench, Controls(), lambda progress: None).run()
    assert summary.complete
    assert [entry[1] for entry in bench.log if entry[0] == "touch"] == [3, 4]


@pytest.mark.parametrize(
    ("request_", "first"),
    [(Request.SKIP, PointOutcome.SKIPPED), (Request.REPEAT, PointOutcome.DONE)],
)
def test_what_is_asked_of_a_point_during_the_reference_does_not_end_the_scan(
    tmp_path, request_, first
):
    controls, asked = Controls(), [request_]

    class Asked(Bench):
        def measure(self, design, label, seed, enough, recording, check):
            if asked and label == "air":
                controls.ask(asked.pop())
            check()
            return super().measure(design, label, seed, enough, recording, check)

    summary, run, _ = scan(tmp_path / "run", scene(2), Asked(), controls)
    assert not asked
    assert summary.complete
    assert [result.outcome for result in run.latest] == [first, PointOutcome.DONE]
    assert len([file for file in run.files if file.name.startswith("reference-")]) == 2


def test_repeat_between_points_makes_a_second_attempt(tmp_path):
    controls = Controls()
    made = scene(2)
    plan, run = begin(tmp_path / "run", made)
    with run:
        ScanRunner(plan, run, Bench(), controls, lambda progress: None).run()
        controls.ask(Request.REPEAT)
        again = Bench()
        ScanRunner(plan, run, again, controls, lambda progress: None).run()
    assert again.seeds == [(1, 1, 1)]  # it has noise of its own
    content = read_run(tmp_path / "run")
    assert [(r.index, r.attempt) for r in content.results] == [(0, 0), (1, 0), (1, 1)]


def test_a_clock_that_is_set_back_changes_neither_last_point_nor_latest_attempt_nor_order(
    tmp_path, monkeypatch
):
    controls, set_s, time_ns = Controls(), [0.0], time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: time_ns() + round(1e9 * set_s[0]))

    class Repeated(Bench):
        def missing(self):
            touched = [entry[1] for entry in self.log if entry[0] == "touch"]
            if touched == [0, 1]:
                set_s[0] = -3600.0
            if touched == [0, 1, 2]:
                controls.ask(Request.REPEAT)
            return None

    bench = Repeated()
    _, run, _ = scan(tmp_path / "set", scene(4), bench, controls)
    assert [entry[1] for entry in bench.log if entry[0] == "touch"] == [0, 1, 2, 2, 3]
    names = ["reference-00-air-before", "point-00000-00", "point-00001-00", "point-00002-00"]
    names += ["point-00002-01", "point-00003-00", "reference-01-air-after"]
    assert [file.name for file in run.files] == [f"{name}.mcap" for name in names]
    assert [path.stem for path in run.paths()] == names  # and so a replay plays them
    set_s[0] = 0.0
    scan(tmp_path / "run", scene(2), Bench())
    set_s[0] = -3600.0
    with RunDirectory.open(tmp_path / "run") as again:
        controls.ask(Request.REPEAT)
        ScanRunner(make_plan(scene(2)), again, Bench(), controls, lambda progress: None).run()
    types = message_types()
    told = [
        from_message(types.deserialize_cdr(cdr, TYPE))
        for cdr in recorded_results(read_run(tmp_path / "run"))
    ]
    attempts = [(each.index, each.attempt) for each in told if each.kind is PointKind.TISSUE]
    assert attempts == [(0, 0), (1, 0), (1, 1)]


def test_the_last_point_of_an_earlier_session_is_the_one_finished_last_whatever_the_clock(tmp_path):
    controls, bench = Controls(), Bench()
    plan, run = begin(tmp_path / "run", scene(3))
    with run:
        record_point(run, 0)
        record_point(run, 1, time_ns=START_NS - 3600 * 10**9)  # set back between the two
        controls.ask(Request.REPEAT)
        ScanRunner(plan, run, bench, controls, lambda progress: None).run()
    assert [entry[1] for entry in bench.log if entry[0] == "touch"] == [1, 2]


def test_a_paused_scan_waits_with_the_tip_free(tmp_path):
    controls = Controls()
    controls.paused.set()
    bench = Bench()
    made = scene(2)
    plan, run = begin(tmp_path / "run", made)
    phases = []
    with run:
        scanning = ScanRunner(plan, run, bench, controls, lambda p: phases.append(p.phase))
        thread = threading.Thread(target=scanning.run)
        thread.start()
        while "paused" not in phases:
            time.sleep(0.01)
        assert not bench.holding
        assert run.content.latest == ()
        controls.paused.clear()
        thread.join()
    assert len(read_run(tmp_path / "run").latest) == 2


SCANS = """
    import os, signal, sys, time
    sys.path.insert(0, sys.argv[2])
    from pathlib import Path
    import bench_hands as t
    from tactile_resonance.scan.plan import make_plan
    from tactile_resonance.scan.run_directory import RunDirectory
    from tactile_resonance.scan.hands import Controls
    from tactile_resonance.scan.runner import ScanRunner
    path, made = Path(sys.argv[1]), t.scene(8)
    def scan():
        run = RunDirectory.open(path) if path.exists() else t.begin(path, made)[1]
        bench = t.Bench(on_measure=lambda bench, blocks: time.sleep(3e-3))
        with run:
            ScanRunner(make_plan(made), run, bench, Controls(), lambda progress: None).run()
    for line in sys.stdin:  # a scan in a process of its own for each, which is killed so much later
        process = os.fork()
        if process == 0:
            scan()
            os._exit(0)
        time.sleep(float(line))
        os.kill(process, signal.SIGKILL)
        print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
"""


def test_killed_at_random_moments_no_finished_point_is_lost_or_repeated(tmp_path):
    rng = random.Random(1)
    path = tmp_path / "run"
    # once there is a run to go on with: what is killed before that leaves none
    begin(path, scene(8))[1].close()
    finished, kills = [], 0
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(SCANS), str(path), os.path.dirname(__file__)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as scans:
        for run in range(60):
            # ever longer: a machine with much other work comes to the end too
            print(rng.uniform(0.0, 0.15 * 1.12**run), file=scans.stdin, flush=True)
            status = int(scans.stdout.readline())
            assert status in (0, -signal.SIGKILL)
            kills += status != 0
            content = read_run(path)
            assert content.problems == ()
            now = [(r.index, r.attempt) for r in content.results]
            assert now[: len(finished)] == finished, "a finished point was lost"
            finished = now
            if status == 0:
                break
        scans.stdin.close()
    assert kills >= 2
    # every point once: none was repeated after it was finished
    assert finished == [(index, 0) for index in range(8)]
