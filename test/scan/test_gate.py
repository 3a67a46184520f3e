# SPDX-License-Identifier: Apache-2.0
"""Only what was measured while the force was quiet counts; nothing is lost, and the point says so."""

import math
import sys
from pathlib import Path

import pytest

from tactile_resonance.scan.point_file import read_messages
from tactile_resonance.scan.point_result import PointOutcome
from tactile_resonance.scan.scene import Gate, read_scan_scene

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import Bench, scan, scene

GATE = Gate(3e-4, measurements=4)


def of_points(bench):
    return [entry for entry in bench.log if entry[0] == "touch" or entry[1] != "air"]


def test_a_measurement_that_the_force_disturbs_is_begun_again_in_the_same_contact(tmp_path):
    # the first is loud in its first block, the second in its third, the third is quiet
    loud = {(0, 1): 9e-4, (1, 3): 5e-4}
    bench = Bench(rms_n=lambda number, blocks: loud.get((number, blocks), 1e-4))
    _, run, _ = scan(tmp_path / "run", scene(1, gate=GATE), bench)
    (result,) = run.latest
    touch, *measured = of_points(bench)
    assert touch == ("touch", 0)
    assert [entry[3] for entry in measured] == [1, 3, 4]
    seeds = [entry[2] for entry in measured]
    assert len(set(seeds)) == 3  # phases and simulated noise of its own
    assert (result.outcome, result.attempt, result.blocks) == (PointOutcome.DONE, 0, 4)
    assert result.measurement_id == 1000 + seeds[-1]
    assert result.force_rms_n == 1e-4
    assert result.gate == (
        "measurements left out: 2, with a force of 10.00 (rms 0.90), 10.00 (rms 0.50) mN; "
        "accepted is rms up to 0.3 mN"
    )
    # nothing is lost
    (path,) = (run.path / "recording").glob("point-00000-*.mcap")
    assert len(list(read_messages(path, "std_msgs/msg/String"))) == 3


def test_a_force_that_is_never_quiet_fails_the_point_with_the_figures(tmp_path):
    bench = Bench(rms_n=lambda number, blocks: 4e-4 + 1e-4 * number if number < 4 else 0.0)
    summary, run, _ = scan(tmp_path / "run", scene(2, gate=GATE), bench)
    first, second = run.latest
    assert (summary.done, summary.failed) == (1, 1)
    assert first.outcome is PointOutcome.FAILED
    assert first.reason == (
        "gate: the force was never quiet: measurements left out: 4, with a force of 10.00 (rms 0.40), "
        "10.00 (rms 0.50), 10.00 (rms 0.60), 10.00 (rms 0.70) mN; accepted is rms up to 0.3 mN"
    )
    assert math.isnan(first.f0_hz)
    assert (second.outcome, second.gate) == (PointOutcome.DONE, "")
    assert not bench.holding


def test_a_quiet_force_that_is_not_the_one_asked_for_is_left_out_too(tmp_path):
    bench = Bench(rms_n=lambda number, blocks: 1e-4, force_n=0.0093)
    for limit_n, outcome in ((5e-4, PointOutcome.FAILED), (8e-4, PointOutcome.DONE)):
        made = scene(1, gate=Gate(3e-4, limit_n, measurements=2))
        _, run, _ = scan(tmp_path / outcome.name, made, bench)
        (result,) = run.latest
        assert result.outcome is outcome
        assert ("9.5 to 10.5 mN, rms up to 0.3 mN" in result.reason) == (limit_n < 7e-4)


def test_without_a_gate_every_measurement_counts(tmp_path):
    bench = Bench(rms_n=lambda number, blocks: 9e-4)
    _, run, _ = scan(tmp_path / "run", scene(1), bench)
    (result,) = run.latest
    assert (result.outcome, result.blocks, result.force_rms_n) == (PointOutcome.DONE, 4, 9e-4)


def test_a_gate_needs_a_force_whose_motion_is_known(tmp_path):
    _, run, _ = scan(tmp_path / "run", scene(1, gate=GATE), Bench())
    (result,) = run.latest
    assert result.outcome is PointOutcome.FAILED
    assert result.reason == "gate: how the force moved is unknown: too few forces were measured"


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ("{}", r"gate\.force_rms_n.*missing"),
        ("{force_rms_n: 0.0}", r"gate\.force_rms_n: got 0.0; accepted is a number above 0"),
        ("{force_rms_n: 3.0e-4, force_error_n: -1.0}", r"force_error_n: got -1.0; accepted is"),
        ("{force_rms_n: 3.0e-4, measurements: 0}", r"measurements: got 0; accepted is 1 to 100"),
        ("{rms: 1.0}", r"gate\.rms.*one of"),
        ("3.0e-4", r"gate: got 0.0003; accepted is a mapping"),
    ],
)
def test_a_wrong_gate_is_refused_by_name(tmp_path, given, named):
    path = tmp_path / "scene.yaml"
    text = "force_n: 0.01\npositions: {list: [[0.0, 0.0]]}\n"
    path.write_text(text + "gate: {force_rms_n: 3.0e-4}\n")
    assert read_scan_scene(path).gate == Gate(3e-4, math.inf, 20)
    path.write_text(text + f"gate: {given}\n")
    with pytest.raises(ValueError, match=named):
        read_scan_scene(path)
