# SPDX-License-Identifier: Apache-2.0
"""A scan of the inclusion from scene to report, on the simulated bench with its exact truth."""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.cli import main
from tactile_resonance.configuration import share_path
from tactile_resonance.report.run_report import pole_maps_of
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory

sys.path.insert(0, str(Path(__file__).resolve().parent))
from run_tables import assert_same, table_of
from scanned import begin, go_on, true_poles

SCENE = share_path("config/scenes/inclusion_scan.yaml")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """Ended twice on the way, and gone on with."""
    folder = tmp_path_factory.mktemp("scan") / "run"
    with begin(SCENE, folder) as run:
        go_on(SCENE, run, 7)
    with RunDirectory.open(folder) as run:
        assert run.content.next_point.index == 7
        go_on(SCENE, run, 5)
    with RunDirectory.open(folder) as run:
        go_on(SCENE, run)
    return folder


def test_every_point_is_right_as_far_as_it_says(run_folder):
    results = read_run(run_folder).latest
    assert [r.index for r in results] == list(range(25))
    assert all(r.outcome is PointOutcome.DONE for r in results)
    errors = np.array([r.estimate - true_poles(SCENE, r.position_m) for r in results])
    covariances = np.array([r.covariance for r in results])
    distance2 = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    # chi-square with 2 degrees of freedom each: mean 2, and none beyond one in 25 000
    assert np.mean(distance2) == pytest.approx(2, abs=4 * 2 / np.sqrt(25))
    assert distance2.max() < 20


def test_it_stops_where_it_is_precise_and_says_what_that_saved(run_folder):
    run = read_run(run_folder)
    for r in run.latest:
        assert r.f0_std_hz <= 0.01
        assert r.damping_ratio_std <= 5e-5
        assert r.verdict == "precision reached"
        assert r.blocks + r.blocks_saved == 8
        assert r.saved_s == pytest.approx(0.4 * r.blocks_saved)
    assert sum(r.blocks_saved for r in run.latest) > 75
    left_out = " ".join(s["what"] + s["why"] for s in run.facts["skipped"])
    assert "of 3997 lines" in left_out
    assert "distortion is not wanted" in left_out
    assert run.facts["versions"]["tactile_resonance"]


def test_the_inclusion_is_found_where_it_lies(run_folder):
    pole_map = pole_maps_of(read_run(run_folder))[0]
    called = {
        tuple(np.round(1e3 * p.position_m[:2]).astype(int)) for p in pole_map.points
        if p.result.tissue_class == "inclusion"
    }  # fmt: skip
    # the ball is 12 mm wide and round: from 6 mm on beside its middle the poles are those of 11 % gelatine too
    middle = np.array([2.0, -1.0])
    near = {
        tuple(np.round(1e3 * p.position_m[:2]).astype(int)) for p in pole_map.points
        if np.linalg.norm(1e3 * p.position_m[:2] - middle) < 6
    }  # fmt: skip
    assert len(near) == 4
    assert called == near
    surface = pole_map.surface(40)
    peak = np.unravel_index(np.argmax(surface.f0_hz), surface.f0_hz.shape)
    np.testing.assert_allclose(surface.position_m[peak][:2], [0.002, -0.001], atol=0.0015)


def test_between_the_points_the_truth_lies_within_the_uncertainty(run_folder):
    kriged = pole_maps_of(read_run(run_folder))[0].krige()
    rng = np.random.default_rng(21)
    at = rng.uniform(-0.01, 0.01, (40, 2))
    truth = np.array([true_poles(SCENE, (*p, 0.0))[0] for p in at])
    value, std = kriged.predict(at)
    inside = np.abs(truth - value) < 1.96 * std
    # one surface, not a draw of the process: nearly all, and none far out
    assert inside.mean() >= 0.85
    assert np.max(np.abs(truth - value) / std) < 5
    assert std.mean() < 1.0  # of a range of 5 Hz


class Page(HTMLParser):
    def __init__(self):
        super().__init__()
        self.links, self.rows, self.open = [], 0, []

    def handle_starttag(self, tag, attributes):
        self.rows += tag == "tr"
        self.links += [v for k, v in attributes if k in ("src", "href")]
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_report_needs_nothing_else(run_folder, capsys):
    assert main(["report", str(run_folder)]) == 0
    printed = capsys.readouterr().out
    assert "25 of 25 points finished: 25 with poles, 0 failed, 0 skipped." in printed
    assert re.search(r"\d+ blocks measured; \d+ more were allowed and not taken", printed)
    assert "Tissue is called from 25 poles at the nominal force and age of contact" in printed
    text = (run_folder / "report.html").read_text()
    assert "nominal f0 [Hz]" in text
    for result in read_run(run_folder).latest:
        for value, std in (
            (result.f0_hz, result.f0_std_hz),
            (result.nominal_f0_hz, result.nominal_f0_std_hz),
        ):
            assert f"{value:.3f} ± {std:.2g}" in text
    page = Page()
    page.feed(text)
    assert page.open == []
    assert page.rows == 57  # each point in both tables, and the plan with its outcome
    assert [link[:22] for link in page.links] == ["data:image/png;base64,"]
    assert "simulated, not measured" in text
    assert "gelatine with an inclusion" in text
    assert (run_folder / "pole_map.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_report_of_a_run_with_failures_and_gaps(tmp_path, capsys):
    folder = tmp_path / "run"
    with begin(SCENE, folder) as run:
        assert main(["report", str(folder)]) == 0  # nothing measured yet
        assert not (folder / "pole_map.png").exists()
        go_on(SCENE, run, 2)
        for index, outcome, reason in (
            (2, PointOutcome.FAILED, "contact <lost>"),
            (3, PointOutcome.SKIPPED, "on request"),
        ):
            with run.begin_point(index) as recording:
                x_m, y_m, z_m = run.content.points[index].position_m
                recording.finish(
                    PointResult(index, 0, "", outcome, reason, x_m=x_m, y_m=y_m, z_m=z_m)
                )
    capsys.readouterr()
    assert main(["report", str(folder)]) == 0
    assert "4 of 25 points finished: 2 with poles, 1 failed, 1 skipped." in capsys.readouterr().out
    assert "contact &lt;lost&gt;" in (folder / "report.html").read_text()
    assert len(pole_maps_of(read_run(folder))[0].failures) == 1


def test_report_of_no_run_says_so(tmp_path, capsys):
    assert main(["report", str(tmp_path)]) == 1
    assert "is a folder without run.json" in capsys.readouterr().err


def test_table_and_recording_hold_the_same_bits(run_folder):
    results = read_run(run_folder).latest
    rows = table_of(run_folder)
    assert len(rows) == 25
    for a, b in zip(results, rows, strict=True):
        assert_same(a, b)
