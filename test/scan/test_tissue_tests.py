# SPDX-License-Identifier: Apache-2.0
"""Mechanical tests that a scene asks for: carried out, kept, read again; refused where they cannot be."""

import csv
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.mechanics import relaxation
from tactile_resonance.cli import main
from tactile_resonance.contact.samples import Pose
from tactile_resonance.mechanics.indentation import Prony, Protocol
from tactile_resonance.scan.failures import ATTEMPTS, PointDisturbed, PointFailed
from tactile_resonance.scan.goal import Frames, GoalFiles, ScanGoal
from tactile_resonance.scan.plan import make_plan, plan_rows
from tactile_resonance.scan.point_result import PointOutcome
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_start import new_run, start_run
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.scan.tissue_tests import ProtocolRequest, fits_at, fits_of

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import Bench, scan, scene

POLES = "the contact of the poles"
SOLID = Prony(3e3, np.array([2e3]), np.array([1.5]))
RELAXATION = ProtocolRequest(Protocol.RELAXATION, hold_s=8.0, points=(2,))
CREEP = ProtocolRequest(Protocol.CREEP, hold_s=4.0, force_n=0.012, points=(2, 3))


def made(point, asked):
    test = relaxation(SOLID, np.random.default_rng(point.index), hold_s=asked.hold_s, noise_n=5e-5)
    return replace(test, protocol=asked.kind)


def test_tests_follow_the_poles_of_their_points_and_stand_in_their_files(tmp_path, capsys):
    bench = Bench(tests=made)
    scan(tmp_path / "run", scene(3, protocols=(RELAXATION, CREEP)), bench)
    log = [entry for entry in bench.log if entry[0] in ("touch", "test")]
    assert [entry[:2] for entry in log] == [
        *(("touch", 0), ("touch", 1), ("test", 1), ("test", 1)),
        *(("touch", 2), ("test", 2)),
    ]
    assert [entry[2:] for entry in log if entry[0] == "test"] == [
        (RELAXATION, 0.01),
        (CREEP, 0.012),
        (CREEP, 0.012),
    ]
    run = read_run(tmp_path / "run")
    assert run.problems == ()
    assert {result.outcome for result in run.latest} == {PointOutcome.DONE}
    found = list(fits_of(run))
    assert [(one.result.index, one.test.protocol) for one in found] == [
        (1, Protocol.RELAXATION),
        (1, Protocol.CREEP),
        (2, Protocol.CREEP),
    ]
    original = made(run.points[1], RELAXATION)
    np.testing.assert_array_equal(found[0].test.force_n, original.force_n)
    np.testing.assert_array_equal(found[0].test.depth_m, original.depth_m)
    assert math.isinf(found[0].test.ball.stiffness_n_per_m)
    value, std = found[0].fit.modulus(1.0)
    assert abs(np.log(value / SOLID.relaxation_modulus(1.0))) < 4 * std
    with (tmp_path / "run" / "mechanics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    kinds = [(row["point"], row["protocol"]) for row in rows]
    assert kinds == [("2", "relaxation"), ("2", "creep"), ("3", "creep")]
    assert float(rows[0]["modulus_1s_pa"]) == value
    followed = [row["status"].split(" at this place")[0] for row in rows]
    assert followed == [f"follows {what}" for what in (POLES, "another test", POLES)]
    assert fits_at(run, run.latest[0]) == ()
    for options in (["--rigid"], ["--radius-m", "0.002"], ["--protocol", "creep"]):
        assert main(["mechanics", str(run.path), *options]) == 1
        assert f"{options[0]}: got" in (told := capsys.readouterr()).err
        assert told.err.endswith("accepted is none beside a run, which knows it\n")


def test_a_test_that_fails_leaves_the_poles_and_says_why(tmp_path):
    def failing(point, asked):
        raise PointFailed("contact: refused: hold_s: got 8; accepted is up to 5")

    scan(tmp_path / "run", scene(2, protocols=(RELAXATION,)), Bench(tests=failing))
    first, second = read_run(tmp_path / "run").latest
    assert (first.outcome, second.outcome) == (PointOutcome.DONE, PointOutcome.DONE)
    assert "relaxation: contact: refused: hold_s" in second.reason
    assert second.f0_hz == pytest.approx(254, abs=0.1)


def test_a_test_that_is_disturbed_repeats_its_point(tmp_path):
    left = [1]

    def disturbed_once(point, asked):
        if left:
            left.pop()
            raise PointDisturbed("contact: force_stale", "force_stale")
        return made(point, asked)

    scan(tmp_path / "run", scene(2, protocols=(RELAXATION,)), Bench(tests=disturbed_once))
    run = read_run(tmp_path / "run")
    assert run.latest[1].repeats == 1
    assert [len(fits_at(run, result)) for result in run.latest] == [0, 1]


def test_a_test_that_stays_disturbed_leaves_the_poles_and_says_why(tmp_path):
    def disturbed(point, asked):
        raise PointDisturbed("contact: force_stale", "force_stale")

    scan(tmp_path / "run", scene(2, protocols=(RELAXATION,)), Bench(tests=disturbed))
    _, second = read_run(tmp_path / "run").latest
    assert (second.outcome, second.repeats) == (PointOutcome.DONE, ATTEMPTS - 1)
    assert second.f0_hz == pytest.approx(254, abs=0.1)
    assert "contact: force_stale" in second.reason


def test_the_plan_counts_tests(tmp_path):
    without, with_tests = (make_plan(scene(3, protocols=p)) for p in ((), (RELAXATION, CREEP)))
    assert with_tests.longest_s > without.longest_s + 8 + 2 * 4
    rows = [text for name, text in plan_rows(with_tests) if name == "tested"]
    assert rows == ["relaxation of 8 s at points 2", "creep of 4 s at points 2, 3"]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"kind": "relaxation"}, r"protocols\[0\].hold_s: got 0.0; accepted is above 0"),
        ({"kind": "sweep", "hold_s": 1.0}, r"protocols\[0\].kind: got 'sweep'; accepted is"),
        (
            {"kind": "creep", "hold_s": 1.0, "points": [4]},
            r"points: got \[4\]; accepted is .* 1 to 2",
        ),
        ({"kind": "creep", "hold_s": 1.0, "unload_speed_m_s": 1e-3}, "unload_speed_m_s: got 0.001"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(tmp_path, entry, message):
    path = tmp_path / "scene.yaml"
    content = {"force_n": 0.01, "positions": {"list": [[0, 0], [0.004, 0]]}, "protocols": [entry]}
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message):
        read_scan_scene(path)


def test_only_an_indentation_draws_back_while_it_presses():
    usual = ProtocolRequest(Protocol.INDENTATION)
    assert (RELAXATION.draw_back_m_s, CREEP.draw_back_m_s, usual.draw_back_m_s) == (0.0, 0.0, 5e-4)
    assert replace(usual, unload_speed_m_s=1e-3).draw_back_m_s == 1e-3


def test_a_scan_that_does_not_move_the_tip_refuses_tests(tmp_path):
    path = tmp_path / "scene.yaml"
    entry = {"kind": "relaxation", "hold_s": 5.0}
    content = {"force_n": 0.01, "positions": {"list": [[0, 0]]}, "protocols": [entry]}
    path.write_text(yaml.safe_dump(content))
    goal = ScanGoal(scene=str(path), run_directory=str(tmp_path / "run"))
    frames = Frames("table", "base", Pose.at_origin())
    with pytest.raises(ValueError, match=r"protocols: got \['relaxation.*none where scan_node's"):
        new_run(goal, frames, GoalFiles("", ["/"]), forces=False)
    # with contact that is moved, and no node that carries tests out
    how = {"seed": 1, "tip_use": None, "tell": lambda _: None, "check": lambda: None}
    with pytest.raises(ValueError, match="protocols: got .* none where no node offers the action"):
        start_run(goal, frames, GoalFiles("", ["/"]), Bench(testing=False), **how)
    assert not (tmp_path / "run").exists()
