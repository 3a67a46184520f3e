# SPDX-License-Identifier: Apache-2.0
"""What a plan says of a scene, and what is said of it once it was carried out."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_resonance.cli import main
from tactile_resonance.commands import plan
from tactile_resonance.configuration import share_path
from tactile_resonance.mechanics.indentation import Protocol
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.scan.decision import BlockLimits, Decision, Gate, Precise, Verdict, decide
from tactile_resonance.scan.plan import CONTACT_S, make_plan, plan_against_outcome, plan_rows
from tactile_resonance.scan.scene import Output, TimeLimits, read_run_scene, read_scan_scene
from tactile_resonance.scan.surface import NormalRequest, TouchRequest
from tactile_resonance.scan.tissue_tests import ProtocolRequest
from tactile_resonance.tissue.nominal_contact import ContactLoad

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import SPREAD_HZ, Bench, scan, scene


def told(asked):
    rows = plan_rows(make_plan(asked))
    return {name: [text for other, text in rows if other == name] for name, _ in rows}


def test_a_plan_says_what_each_part_of_a_scene_leads_to():
    asked = scene(points=3)
    rows = told(asked)
    assert rows["touches"] == ["3: 3 points"]
    more = " (8 follow a mode close beside the band, with less bias and less precision)"
    assert rows["poles"] == ["200 to 300 Hz, order 2 and 6 residual terms" + more]
    enough = replace(asked, sensor=replace(asked.sensor, residual_terms=8))
    assert told(enough)["poles"] == ["200 to 300 Hz, order 2 and 8 residual terms"]
    assert rows["drawn"] == ["report.html, pole_map.png, map.mcap"]
    assert any("distortion is not wanted" in text for text in rows["skipped"])
    bands = (PoleBand(600.0, 800.0, 0),)
    asked = replace(
        asked,
        sensor=replace(asked.sensor, further_bands=bands),
        outputs=(Output.POLES, Output.DISTORTION),
        normals=NormalRequest(touches=4),
        surface=TouchRequest(((0.0, 0.0), (0.01, 0.0), (0.0, 0.01))),
    )
    rows = told(asked)
    assert rows["touches"] == ["18: 3 points, 15 for surface and normals"]
    (time,) = rows["time"]  # each touch about as long as a contact
    assert time.endswith(f" s, and about {15 * CONTACT_S:.0f} s for surface and normals before")
    assert rows["poles"][1] == "600 to 800 Hz, one to three modes, as the data choose"
    assert rows["distortion"] == ["even and odd, at input and output, in each band of poles"]
    assert rows["drawn"] == ["report.html"]
    assert any("no map is wanted" in text for text in rows["skipped"])


def test_tests_take_what_they_hold_or_longer_at_the_points_they_are_asked_for():
    asked = scene(points=3)
    relaxation = ProtocolRequest(Protocol.RELAXATION, hold_s=10.0, points=(1, 3))
    plans = [make_plan(replace(asked, protocols=tests)) for tests in ((), (relaxation,))]
    shortest_s, longest_s = ([getattr(plan, name) for plan in plans] for name in ("shortest_s", "longest_s"))
    assert np.diff(shortest_s) == pytest.approx(2 * 10.0)
    assert np.diff(longest_s) == pytest.approx(2 * relaxation.longest_s)
    # no limit is reported for a scan that has enough time
    limits = TimeLimits(scan_s=shortest_s[1] + 1.0)
    assert "limit" not in told(replace(asked, protocols=(relaxation,), time_limits=limits))


def test_the_outcome_stands_beside_the_plan(tmp_path):
    asked = scene(points=4)
    _, run, _ = scan(tmp_path / "run", asked, Bench(failing=(2,)))
    rows = {name: (planned, came) for name, planned, came in plan_against_outcome(asked, run)}
    assert rows["points"] == ("4", "4 finished, 3 with poles")
    assert rows["blocks"] == ("8 to 32", "12")
    planned, came = rows["poles, 200 to 300 Hz"]
    assert planned == f"f0 +- {SPREAD_HZ / 2:g} Hz"
    assert came.startswith("3 found, +- 0.01 Hz")
    assert came.endswith("3 as precise as wanted")


def test_a_point_is_enough_once_each_band_is():
    class Band:
        def __init__(self, std_hz, further=()):
            self.main, self.further = self, further
            self.estimate = np.array([254.0, 0.03])
            self.covariance = self.noise = np.diag([std_hz**2, 1e-12])

        @property
        def bands(self):
            return (self, *self.further)

    wanted, limits = Precise(f0_std_hz=0.01), BlockLimits(1, 8)
    for first, second, verdict in (
        (0.009, 0.009, Verdict.PRECISE),
        (0.009, 0.012, Verdict.CONTINUE),
        (0.012, 0.009, Verdict.CONTINUE),
    ):
        poles = Band(first, (Band(second),))
        assert decide(poles, ContactLoad(), None, 2, wanted, limits, 0.4).verdict is verdict
    # as precise as it gets: what is not precise says why it ends
    for first, second, blocks, verdict in (
        (0.009, 0.012, 8, Verdict.MOST_BLOCKS),
        (0.012, 0.009, 8, Verdict.MOST_BLOCKS),
        (0.009, 0.2, 2, Verdict.HOPELESS),
        (0.009, 0.009, 8, Verdict.PRECISE),
    ):
        poles = Band(first, (Band(second),))
        decision = decide(poles, ContactLoad(), None, blocks, wanted, limits, 0.4)
        assert decision.stop
        assert decision.verdict is verdict


def test_the_command_compiles_the_packages_own_scenes(capsys, tmp_path):
    path = share_path("config/scenes/demo.yaml")
    figure = tmp_path / "plan.png"
    assert main(["plan", str(path), "--figure", str(figure)]) == 0
    text = capsys.readouterr().out
    assert "16 points" in text
    assert "expected  on gel10_gel16 (simulated), 1 s old, after" in text
    assert figure.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ("sensor: {order: 0, band_high_hz: 620, samples_per_period: auto}", ", 1 s old, after 3 blocks: f0 25"),
        (
            "sensor: {order: 0, band_high_hz: 620}\nblocks: {least: 1, most: 1}",
            ", 1 s old, after 1 block: no poles: ",
        ),
        (
            "sensor: {calibrated: true, band_high_hz: 400, samples_per_period: auto}",
            "precision unknown: it follows from the calibration, which the scene does not name",
        ),
        ("normals: {}", "time 10 s"),
    ],
    ids=["one block has no order", "nor has the only one", "calibrated", "touches for normals"],
)
def test_what_a_plan_expects(more, expected, tmp_path, capsys):
    path = tmp_path / "scene.yaml"
    path.write_text(
        f"force_n: 0.01\npositions: {{list: [[0, 0]]}}\n{more}\nprecision: {{f0_std_hz: 0.2}}\n"
        "regions: [{gelatine_percent: 10, disc: {center_m: [0, 0], radius_m: 0.02}}]\n"
    )
    assert main(["plan", str(path)]) == 0
    assert expected in capsys.readouterr().out


def test_what_is_expected_names_a_status_that_is_not_ok_and_counts_each_point(monkeypatch):
    """Three points of one tissue after 4 blocks, one of another after 40: 13 blocks a point."""
    made = make_plan(scene(points=4))
    tissues = {point.position_m: SimpleNamespace(name="gel") for point in made.first_points[:3]}
    phantoms = SimpleNamespace(tissue_at=lambda at: tissues.get(at, SimpleNamespace(name="ball")))
    w = 2 * np.pi * 250.0
    poles = Poles(
        poles_rad_s=np.array([-0.03 * w + 1j * w]),
        f0_hz=np.array([250.0]),
        damping_ratio=np.array([0.03]),
        residues=np.ones(1, complex),
        covariance=np.diag([0.02**2, 1e-8])[None],
    )
    measured = {
        "gel": (replace(poles, status=PolesStatus.OK), Decision(Verdict.PRECISE, 4)),
        "ball": (replace(poles, status=PolesStatus.MODEL_ERROR), Decision(Verdict.MOST_BLOCKS, 40)),
    }
    monkeypatch.setattr(plan, "_rehearsed", lambda _, tissue: measured[tissue.name])
    gel, ball, time = plan._expected(phantoms, made)
    pole = "f0 250.00 +- 0.02 Hz, damping ratio 0.03000 +- 0.0001"
    assert gel == f"on gel (simulated), 1 s old, after 4 blocks: {pole}"
    assert ball == f"on ball (simulated), 1 s old, after 40 blocks: {pole}, model error; most blocks reached"
    assert time == f"time {made.duration_s(13) + made.search_s:.0f} s"


def test_a_run_of_an_earlier_version_is_read_with_outputs_that_are_refused_today(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text("force_n: 0.01\npositions: {list: [[0, 0]]}\noutputs: [map, relaxation]\n")
    assert read_run_scene(path).outputs == (Output.POLES, Output.MAP)
    with pytest.raises(ValueError, match="relaxation"):
        read_scan_scene(path)


def test_a_plan_names_each_limit_that_its_scan_would_meet():
    asked = scene(points=3)
    assert "limit" not in told(asked)
    short = replace(
        asked,
        time_limits=TimeLimits(point_s=0.5, scan_s=2.0),
        sensor=replace(asked.sensor, level_v=1000.0),
    )
    whole, point, level = told(short)["limit"]
    assert whole.startswith("time_limits.scan_s: 2 s are over before all points")
    assert point.startswith("time_limits.point_s: 0.5 s")
    assert level.startswith("sensor.level_v: ")
    (force,) = told(replace(asked, force_n=0.5))["limit"]
    assert force.startswith("force_n: 0.5 N, contact_node refuses more than")
    (little,) = told(replace(asked, force_n=1e-5))["limit"]
    assert little.startswith("force_n: 1e-05 N, contact_node refuses less than 0.001 N")
    (gate,) = told(replace(asked, gate=Gate(force_rms_n=1e-5)))["limit"]
    assert gate.startswith("gate.force_rms_n: 1e-05 N;")
    long = ProtocolRequest(Protocol.RELAXATION, hold_s=500.0)
    (held,) = told(replace(asked, protocols=(long,)))["limit"]
    assert held.startswith("protocols: relaxation of 500 s at every point: contact_node holds for 120 s")
    tested = replace(asked, protocols=(replace(long, hold_s=100.0),))
    assert "limit" not in told(tested)  # time_limits.point_s, 60 s, is of the poles alone
    limits = told(replace(asked, positions_m=1e3 * asked.positions_m))["limit"]
    assert any(text.startswith("positions: up to 2 m from the origin") for text in limits)


REGIONS = "regions: [{gelatine_percent: %s, disc: {center_m: [0, 0], radius_m: 0.02}}]\n"


@pytest.mark.parametrize("command", ["plan", "scan --scene"])
@pytest.mark.parametrize(
    ("bench", "refused"),
    [
        (REGIONS % 500, r"regions\[0\].gelatine_percent: got 500"),
        ("buried: []\n", "regions: got None"),
    ],
)
def test_what_the_bench_would_refuse_is_refused_before_anything_starts(
    bench, refused, command, capsys, tmp_path
):
    path = tmp_path / "scene.yaml"
    path.write_text(f"force_n: 0.01\npositions: {{list: [[0, 0]]}}\n{bench}")
    assert main([*command.split(), str(path)]) != 0
    told = capsys.readouterr()
    assert re.search(refused, told.err)
    assert not told.out


def test_a_scene_of_hardware_is_planned_without_regions_and_not_scanned_on_the_bench(
    capsys, tmp_path
):
    path = tmp_path / "scene.yaml"
    path.write_text("force_n: 0.01\npositions: {list: [[0, 0]]}\n")
    assert main(["plan", str(path)]) == 0
    assert "precision unknown: the scene has no regions" in capsys.readouterr().out
    assert main(["scan", "--scene", str(path)]) != 0
    assert "regions: got None" in capsys.readouterr().err
