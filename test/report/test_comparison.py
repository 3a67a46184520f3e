# SPDX-License-Identifier: Apache-2.0
"""Runs beside each other: common places, differences in their standard deviations, one page."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tactile_resonance.cli import main
from tactile_resonance.report import comparison
from tactile_resonance.report.comparison import as_comparison, differences, sentence, unlike
from tactile_resonance.report.run_tables import COLUMNS, MOST_ROWS, results_table
from tactile_resonance.scan.point_result import PointKind, PointOutcome, PointResult
from tactile_resonance.scan.run_content import RunContent, read_run

sys.path.insert(0, str(Path(__file__).resolve().parent))
from page_runs import HOSTILE, scan, write_scene

from browser import browser

STD = np.array([0.02, 1e-4])
COVARIANCE = np.outer(STD, STD) * [[1, 0.4], [0.4, 1]]


def run_of(results):
    return RunContent(Path("r"), "", {}, (), results=tuple(results))


def drawn(count, seed, shift=(0.0, 0.0), **values):
    """A run of so many places 1 mm apart, of one pole."""
    poles = np.random.default_rng(seed).multivariate_normal(np.add([250.0, 0.034], shift), COVARIANCE, count)
    columns = {"f0_std_hz": STD[0], "damping_ratio_std": STD[1], "y_m": 0.0, "z_m": 0.0}
    columns |= {"f0_damping_covariance_hz": COVARIANCE[0, 1], "frame_id": "table"} | values
    return run_of(
        PointResult(k, f0_hz=f0, damping_ratio=z, **{"x_m": 1e-3 * k, **columns})
        for k, (f0, z) in enumerate(poles)
    )


def test_a_long_table_names_the_file_that_has_all_of_it_where_there_is_one():
    run = drawn(MOST_ROWS + 1, 1)
    differing = comparison._differences_table(differences(run, run))
    assert "<p>1 further row is left out here.</p>" in differing
    points = results_table(COLUMNS, [*run.latest, replace(run.latest[0], index=len(run.latest))])
    assert "<p>2 further rows are left out here; results.csv has all.</p>" in points


def test_differences_of_equal_runs_are_as_large_as_they_say():
    found = differences(drawn(1000, 1), drawn(1000, 2))
    assert len(found) == 1000
    assert not any(each.nominal for each in found)
    total = sum(each.distance2 for each in found)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 2000)  # 99.9 %
    assert low < total < high
    off = np.array([each.deviations for each in found])
    low, high = stats.chi2.ppf([0.0005, 0.9995], 1000)
    assert np.all((low < np.sum(off**2, axis=0)) & (np.sum(off**2, axis=0) < high))


def test_a_change_shows_with_its_sign_and_size():
    found = differences(drawn(200, 1), drawn(200, 2, shift=(0.2, 0.0)))
    change = np.array([each.change for each in found])
    assert np.mean(change[:, 0]) == pytest.approx(0.2, abs=4 * np.sqrt(2 / 200) * STD[0])
    told = sentence("b", "a", found)
    assert "200 places in common, poles as measured" in told
    assert float(re.search(r"probability (\S+)\.$", told)[1]) < 1e-6
    assert int(re.search(r"(\d+) places differ by more than 3", told)[1]) > 195


def test_only_equal_places_with_poles_are_compared():
    first, other = drawn(6, 1), drawn(6, 2)
    changed = [
        other.results[0],
        replace(other.results[1], y_m=2e-4),
        replace(other.results[2], frame_id="base"),
        replace(other.results[3], outcome=PointOutcome.FAILED, f0_hz=np.nan),
        replace(other.results[4], kind=PointKind.AIR),
        replace(other.results[5], f0_std_hz=np.nan),
    ]
    found = differences(first, run_of(changed))
    assert [(each.first.index, each.other.index) for each in found] == [(0, 0)]
    assert "no place in common" in sentence("b", "a", [])
    # there may be places where one has no pole, or none with a covariance
    assert comparison._figure("b less a", [])["note"].endswith("where both have poles with a covariance.")
    assert differences(first, run_of([])) == []


def test_of_repetitions_at_one_place_each_is_compared_once():
    # what chance gives is uniform only where no two differences share a point
    chances = []
    for seed in range(200):
        runs = (drawn(20, [seed, which], x_m=0.0) for which in range(2))
        found = differences(*runs)
        assert len({each.other.index for each in found}) == len(found) == 20
        chances.append(stats.chi2.sf(sum(each.distance2 for each in found), 40))
    assert stats.kstest(chances, "uniform").pvalue > 1e-3
    some = differences(drawn(3, 1, x_m=0.0), drawn(2, 2, x_m=0.0))
    assert [(each.first.index, each.other.index) for each in some] == [(0, 0), (1, 1)]


def test_the_nearest_points_of_the_same_frame_are_compared():
    first, other = drawn(2, 1, x_m=0.0), drawn(3, 2, x_m=0.0)
    moved = [replace(each, x_m=x) for each, x in zip(other.results, (5e-5, 0.0, 1e-5), strict=True)]
    moved[1] = replace(moved[1], frame_id="base")
    found = differences(first, run_of(moved))
    assert [(each.first.index, each.other.index) for each in found] == [(0, 2), (1, 0)]


def test_poles_at_the_nominal_contact_are_compared_where_both_are_known():
    values = {"nominal_f0_hz": 251.0, "nominal_f0_std_hz": 0.06, "nominal_damping_ratio": 0.034}
    values |= {"nominal_damping_ratio_std": 2e-4, "nominal_f0_damping_covariance_hz": 0.0}
    first = drawn(1, 1, **values)
    (each,) = differences(first, drawn(1, 2, **{**values, "nominal_f0_hz": 251.3}))
    assert each.nominal
    assert each.change[0] == pytest.approx(0.3)
    assert each.deviations[0] == pytest.approx(0.3 / (0.06 * np.sqrt(2)))
    found = differences(first, drawn(1, 2))
    assert not found[0].nominal
    told = sentence("b", "a", found)
    assert "1 place in common, poles as measured" in told
    assert "Were nothing different, force and age of contact included, chance" in told
    assert "Were nothing different, chance" in sentence("b", "a", [each])
    mixed = replace(drawn(2, 1), results=(*first.results, drawn(2, 1).results[1]))
    moved = (replace(r, f0_hz=r.f0_hz + 0.01, nominal_f0_hz=250.0) for r in mixed.results)
    again = replace(mixed, results=tuple(moved))
    told = sentence("b", "a", differences(mixed, again))
    assert "2 places in common, poles at the nominal contact at 1 of them, else as measured" in told


def test_what_a_copy_of_a_run_shares_with_it_says_nothing_of_the_points_that_were_measured_again():
    """Ten points that moved by 1.4 deviations, of 200 runs: with ten copies beside them p < 5 % for three."""
    first, other = drawn(20, 1), drawn(20, 2, shift=(1.4 * STD[0], 0.0))
    resumed = run_of([*first.latest[:10], *other.latest[10:]])
    moved = differences(first, run_of(other.latest[10:]))
    told = sentence("b", "a", differences(first, resumed))
    assert told.startswith("At 10 common places b and a hold one measurement to the last digit")
    assert told.endswith(sentence("b", "a", moved))
    assert sentence("b", "a", differences(first, first)).endswith("it says nothing.")


def test_what_sets_two_scenes_apart_is_named_and_no_pole_taken_as_one_of_the_others_contact(tmp_path):
    values = {"nominal_f0_hz": 251.0, "nominal_f0_std_hz": 0.06, "nominal_damping_ratio": 0.034}
    values |= {"nominal_damping_ratio_std": 2e-4, "nominal_f0_damping_covariance_hz": 0.0}
    runs = []
    for k, force_n in enumerate([0.01, 0.01, 0.02]):
        folder = tmp_path / str(k)
        folder.mkdir()
        text = write_scene(folder / "scene.yaml").read_text()
        text, count = re.subn(r"(?m)^( *force_n:) 0.01", rf"\1 {force_n}", text)
        assert count == 2  # of the contact, and the nominal one
        (folder / "scene.yaml").write_text(text)
        runs.append(replace(drawn(3, k, **values), path=folder))
    assert all(each.nominal for each in differences(*runs[:2]))
    assert unlike(*runs[:2]) == []
    assert not any(each.nominal for each in differences(runs[0], runs[2]))
    apart = unlike(runs[0], runs[2])
    assert apart[0] == "force 20 mN against 10 mN"
    assert apart[1].startswith("nominal contact 20 mN and ")
    told = sentence("b", "a", differences(runs[0], runs[2]), apart)
    assert "Beside what was touched they differ by force 20 mN against 10 mN; nominal contact 20 mN" in told


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Comparison of two runs of one name, and the runs."""
    folder = tmp_path_factory.mktemp("comparison")
    scene = write_scene(folder / "scene.yaml", spacing_m=0.02, tissue=HOSTILE)
    runs = [folder / "a" / "run", folder / "b" / "run"]
    for run in runs:
        run.parent.mkdir()
        scan(scene, run)
    output = folder / "both.html"
    assert main(["report", *map(str, runs), "--output", str(output)]) == 0
    return output, runs


def test_the_page_holds_both_runs_and_one_plotly(page, capsys):
    output, runs = page
    text = output.read_text(encoding="utf-8")
    assert text.count("plotly.js v") == 1
    assert "<script>alert" not in text
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])
    assert [run["name"] for run in data["runs"]] == ["run (1)", "run (2)"]
    for entry, folder in zip(data["runs"], runs, strict=True):
        wanted = [r.f0_hz for r in read_run(folder).latest]
        assert [p["f0_hz"] for p in entry["bands"][0]["points"]] == wanted
    # the same seeds: nothing differs
    (figure,) = data["figures"]
    assert figure["traces"][0]["marker"]["color"] == [0.0] * 4
    assert "run (1): simulated, not measured" in text


def test_the_page_shows_both_runs_at_one_place(page):
    wanted = "run (1), point 3 and run (2), point 3"
    with browser() as shown:
        address = f"{page[0].as_uri()}#run=2&point=3"
        shown.show(address, f"document.querySelector('h2')?.textContent === '{wanted}'")
        assert shown.console == []


def test_a_click_shows_no_point_of_another_frame_or_height_as_one_of_its_place(page, tmp_path):
    first, other = map(read_run, page[1])
    moved = [replace(r, frame_id="base") if r.index == 1 else r for r in other.results]
    moved = [replace(r, z_m=r.z_m + 1e-3) if r.index == 2 else r for r in moved]
    path = tmp_path / "moved.html"
    path.write_text(as_comparison([first, replace(other, results=tuple(moved))]), encoding="utf-8")
    both = "run (1), point 1 and run (2), point 1"
    with browser() as shown:
        for point, wanted in ((1, both), (2, "run (1), point 2"), (3, "run (1), point 3")):
            shown.show("about:blank", "true")
            address = f"{path.as_uri()}#run=1&point={point}"
            shown.show(address, f"document.querySelector('h2')?.textContent === '{wanted}'")
        assert shown.console == []


def test_output_is_for_comparisons(page, tmp_path, capsys):
    assert main(["report", str(page[1][0]), "--output", str(tmp_path / "x.html")]) == 1
    assert "accepted is none with one run" in capsys.readouterr().err


def test_a_comparison_never_replaces_a_file_of_another_kind(page, tmp_path, capsys):
    (record := tmp_path / "record.npz").write_bytes(b"measured")
    assert main(["report", *map(str, page[1]), "--output", str(record)]) == 1
    assert f"--output: got '{record}'; accepted is a file that ends in .html" in capsys.readouterr().err
    assert record.read_bytes() == b"measured"
