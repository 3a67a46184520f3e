# SPDX-License-Identifier: Apache-2.0
"""References from runs, by the command: labels, library, trial, figures, and what is refused."""

import csv
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.cli import main
from tactile_resonance.front import read_run
from tactile_resonance.scan.labels import (
    PLACE_M,
    labelled_frfs,
    nominal_of,
    read_labels,
    reference_points,
)
from tactile_resonance.scan.messages import to_cdr
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.tissue.references import read_classes

sys.path.insert(0, str(Path(__file__).resolve().parent))
from run_tables import START_NS, measurement, plan, result

SCENE = """
force_n: 0.01
positions: {list: [[0.0, 0.0]]}
regions:
  - {name: gel 10 %, gelatine_percent: 10.0, box: {low_m: [-0.01, -0.01], high_m: [0.0071, 0.01]}}
  - {name: gel 12 %, gelatine_percent: 12.0, box: {low_m: [0.0071, -0.01], high_m: [0.1, 0.01]}}
"""
NOMINAL = Path("config/scenes/two_gelatines.yaml")
MEANS = np.array([[254.0, 0.0336], [256.5, 0.0361]])
STD = np.array([0.3, 3e-4])


def make_run(folder, rng, points=8, scene=SCENE, periods_of=(), **values):
    """Points 2 mm apart, two at each place, the first half of one tissue, its casting that of the run."""
    castings = MEANS + STD * rng.standard_normal((2, 1))
    with RunDirectory.create(folder, scene, plan(points), {}) as run:
        for index in range(points):
            f0_hz, damping = castings[2 * index // points] + 0.1 * STD * rng.standard_normal(2)
            given = {
                "x_m": 0.002 * (index - index % 2),
                "f0_hz": f0_hz,
                "damping_ratio": damping,
                "force_n": 0.01,
                "force_std_n": 1e-5,
                "contact_age_s": 1.0,
                "simulated": True,
            }
            with run.begin_point(index) as recording:
                if index in periods_of:
                    modes = [(f0_hz, damping)]
                    for k, (topic, name, message) in enumerate(
                        measurement(100 + index, modes=modes)
                    ):
                        recording.write(topic, name, START_NS + k, to_cdr(message))
                    given["measurement_id"] = 100 + index
                recording.finish(result(index, recording.attempt, **{**given, **values}))
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("runs"), np.random.default_rng(1)
    return [
        make_run(folder / f"day {k}", rng, periods_of=range(8) if k < 2 else ()) for k in range(6)
    ]


def called(arguments, capsys, status=0):
    """What the command prints, of errors where it fails."""
    assert main([str(each) for each in arguments]) == status
    printed = capsys.readouterr()
    return printed.err if status else printed.out


def test_a_library_of_runs_serves_a_scene(runs, tmp_path, capsys):
    library, figure = tmp_path / "library.yaml", tmp_path / "library.png"
    printed = called(
        [
            *("references", "build", *runs, "--labels", "scene", "--nominal", NOMINAL),
            *("--output", library, "--figure", figure),
        ],
        capsys,
    )
    assert "gel 10 %: 24 points" in printed
    assert "preparation" in printed
    assert "5 degrees of freedom" in printed
    assert "called right: 4" in printed
    assert "smallest step from 10 to 12 %, separated at 99 %" in printed
    assert figure.stat().st_size > 40_000
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "force_n: 0.01\npositions: {list: [[0, 0]]}\ntissue_classes: library.yaml\n"
        "precision: {separate: [gel 10 %, gel 12 %], probability: 0.99}\n"
    )
    read = read_scan_scene(scene)
    assert [each.name for each in read.tissue_classes] == ["gel 10 %", "gel 12 %"]
    assert read.nominal_contact.sensitivity.per_n[0] == 266.0
    for each, mean in zip(read.tissue_classes, MEANS, strict=True):
        assert np.all(np.abs(each.mean - mean) < 4 * STD / np.sqrt(6))
        # six castings: twice the deviation, or half, is one in a thousand
        assert 0.5 < np.sqrt(each.spread[0, 0]) / STD[0] < 2.5


def test_the_smallest_step_names_a_source_that_is_not_in_it(runs, tmp_path, capsys):
    build = ["--labels", "scene", "--nominal", NOMINAL, "--pool", "--output", tmp_path / "library.yaml"]
    printed = called(["references", "build", runs[0], *build], capsys)
    assert "% with all sources but preparation, not determined, " in printed
    printed = called(["references", "build", *runs[:3], *build], capsys)
    assert "% with all sources, " in printed


def test_a_library_is_checked_on_another_run(runs, tmp_path, capsys):
    library = tmp_path / "library.yaml"
    called(
        [
            "references",
            "build",
            *runs[:5],
            "--labels",
            "scene",
            "--nominal",
            NOMINAL,
            "--output",
            library,
        ],
        capsys,
    )
    labels = tmp_path / "labels.csv"
    # the first four are no longer what they are said to be
    labels.write_text(
        "index,tissue\n" + "".join(f"{k},gel {10 + 2 * (k > 3)} %\n" for k in range(7))
    )
    figure = tmp_path / "check.svg"
    check = ["references", "check", runs[5], "--library", library, "--labels", labels]
    printed = called([*check, "--figure", figure], capsys)
    assert "left out: 1 point, no label" in printed
    assert "called right: 7 of 7" in printed
    assert figure.read_text().startswith("<?xml")
    labels.write_text("tissue\nliver\n")
    printed = called(check, capsys)
    assert "liver, not in the library: 0 of 8" in printed


def test_one_preparation_is_declared(runs, tmp_path, capsys):
    library = tmp_path / "library.yaml"
    build = [
        "references",
        "build",
        runs[0],
        "--labels",
        "scene",
        "--nominal",
        NOMINAL,
        "--pool",
        "--output",
        library,
    ]
    printed = called(build, capsys)
    assert "preparation  not determined: one preparation" in printed
    assert "does not hold for another preparation" in printed
    assert "not tried: preparations" in printed
    assert "gel 12 %: spread of preparation not determined" in library.read_text()
    labels = tmp_path / "labels.csv"
    labels.write_text("index,tissue\n0,gel\n")
    build[build.index("scene")] = labels
    message = called(build, capsys, status=1)
    assert "gel: degrees_of_freedom: got 0.0" in message
    assert "more preparations, or spreads pooled" in message


def test_variance_by_source_of_runs(runs, tmp_path, capsys):
    figure = tmp_path / "variance.png"
    printed = called(
        ["references", "variance", *runs[:2], "--labels", "scene", "--figure", figure], capsys
    )
    lines = [line for line in printed.splitlines() if line.startswith("over ")]
    assert [line.split(":")[0] for line in lines] == [
        f"over {name}" for name in ("period", "repetition", "position", "preparation")
    ]
    # two tissues of two castings, four places, two repetitions, three settled periods of each
    assert [int(line.split(", ")[1].split()[0]) for line in lines] == [32, 8, 4, 2]
    level_db = [float(line.split()[2]) for line in lines]
    assert level_db[0] < level_db[1] < level_db[3]
    assert figure.stat().st_size > 20_000


def test_points_of_a_map_are_compared(runs, tmp_path, capsys):
    library, output = tmp_path / "library.yaml", tmp_path / "compared"
    arguments = ["--labels", "scene", "--nominal", NOMINAL, "--output", library]
    called(["references", "build", *runs, *arguments], capsys)
    compare = ["compare", runs[0], "--output", output]
    printed = called([*compare, "--library", library], capsys)
    assert "4 of 8 points differ from the rest" in printed
    assert "; 5 % of them or fewer are expected not to" in printed
    assert "; 0.4 % of them or fewer" in called([*compare, "--library", library, "--rate", "0.004"], capsys)
    assert "16 of 28 pairs differ" in printed
    assert "2 groups" in printed
    rows = list(csv.DictReader((tmp_path / "compared.csv").open()))
    assert [row["group"] for row in rows] == ["1"] * 4 + ["2"] * 4
    assert {row["pairs_that_differ"] for row in rows} == {"4"}
    assert len({row["differs"] for row in rows[:4]}) == 1
    assert (tmp_path / "compared.png").stat().st_size > 40_000
    # one preparation, one point: nothing is known of the spread within
    source = "{f0_std_hz: 1, damping_ratio_std: 0.01, degrees_of_freedom: 3}"
    library.write_text(f"spread: {{gel: {{preparation: {source}}}}}")
    compare += ["--nominal", NOMINAL]
    message = called([*compare, "--library", library], capsys, status=1)
    assert "spread: got []; accepted is position among them: two positions of one preparation" in message


def test_runs_of_another_sensor_or_band_are_named(runs, tmp_path, capsys):
    wide = SCENE + "sensor: {band_high_hz: 320.0}\n"
    other = make_run(tmp_path / "wide", np.random.default_rng(9), scene=wide)
    compare = ["compare", runs[0], other, "--nominal", NOMINAL, "--output", tmp_path / "compared"]
    told = "warning: wide beside day 0: band 200 to 320 Hz against 200 to 300 Hz\n"
    assert called(compare, capsys).startswith(told)


def test_labels_of_points_places_and_what_is_left_out(tmp_path):
    rng = np.random.default_rng(2)
    run = make_run(tmp_path / "one", rng, 4)
    bad = make_run(tmp_path / "two", rng, 2, force_n=-0.001)
    contents = [read_run(path) for path in (run, bad)]
    path = tmp_path / "labels.csv"
    path.write_text(
        "run, index, tissue, preparation\none, , gel, dish 1\none, 3, fat, \ntwo, , gel, dish 1\n"
    )
    _, nominal = read_classes(NOMINAL)
    points, left_out = reference_points(contents, read_labels(path, contents), nominal)
    assert points.tissue.tolist() == ["gel"] * 3 + ["fat"]
    assert points.preparation.tolist() == ["dish 1"] * 3 + ["one"]
    assert points.position.tolist() == ["0, 0"] * 2 + [f"{round(0.004 / PLACE_M)}, 0"] * 2
    assert left_out == {"the force is -1 mN: the tip was not pressed on": 2}
    # what force and age add is beside what was measured
    assert np.all(points.covariance[:, 0, 0] > points.measured[:, 0, 0])
    assert nominal_of(contents) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("index\n0\n", "columns: got .'index'.; accepted is tissue among them"),
        ("tissue,batch\ngel,1\n", "column: got 'batch'; accepted is one of run, index, tissue"),
        ("run,tissue\nthree,gel\n", "line 2: run: got 'three'; accepted is one of one"),
        ("index,tissue\n-1,gel\n", "line 2: index: got '-1'"),
        ("index,tissue\n0,gel,fat\n", "line 2: cells: got .'fat'.; accepted is 2 of them"),
        ('tissue\n"' + "x" * 200_000, "labels.csv: cannot be read as CSV: field larger"),
        ("index,tissue\n0,unknown\n", "line 2: tissue: got 'unknown'"),
        ("index,tissue\n0,gel\n0,gel\n", "line 3: index: got '0'; accepted is one row"),
        ("index,tissue\n,gel\n2,fat\n", "line 3: index: got '2'; accepted is that of a point of one"),
        ("tissue,tissue\ngel,fat\n", "columns: got .'tissue', 'tissue'.; accepted is each once"),
        ('tissue\n"gel\nfat"\n', "line 2: tissue: got 'gel.nfat'; accepted is text of one line"),
        ("tissue,position\ngel,a\0b\n", "line 2: position: got .*; accepted is text of one line"),
    ],
)
def test_wrong_labels_are_refused(tmp_path, text, message):
    contents = [read_run(make_run(tmp_path / "one", np.random.default_rng(3), 2))]
    path = tmp_path / "labels.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_labels(path, contents)


def test_refusals(tmp_path, capsys):
    rng = np.random.default_rng(4)
    run = make_run(tmp_path / "one", rng, 2)
    with_classes = SCENE + NOMINAL.read_text().partition("tissue_classes:")[2].join(
        ["tissue_classes:", ""]
    )
    other = make_run(tmp_path / "two", rng, 2, with_classes)
    contents = [read_run(path) for path in (run, other)]
    with pytest.raises(ValueError, match="two: nominal_contact: .*give one for all with --nominal"):
        nominal_of(contents)
    label_of = read_labels_of_all(tmp_path, contents)
    with pytest.raises(ValueError, match="runs: .*folders of different names"):
        reference_points([contents[0], contents[0]], label_of, None)
    with pytest.raises(ValueError, match="points: .*one labelled point with poles"):
        reference_points(contents, lambda run, result: None, None)
    with pytest.raises(ValueError, match="nothing was measured.*one labelled point of two blocks"):
        labelled_frfs(contents, label_of)
    with pytest.raises(ValueError, match="runs: .*folders of different names"):
        labelled_frfs([contents[0], contents[0]], label_of)
    shutil.copytree(run, tmp_path / "copy")
    copied = [contents[0], read_run(tmp_path / "copy")]
    with pytest.raises(ValueError, match="runs: got 'point 1 of copy as in one'; accepted is no copy"):
        reference_points(copied, label_of, None)
    compare = ["compare", run, "--output", tmp_path / "x"]
    assert "runs: got ['one', 'one']" in called(["compare", run, *compare[1:]], capsys, status=1)
    message = called([*compare, "--spread", "-1", "1e-3"], capsys, status=1)
    assert "--spread: got [-1.0, 0.001]; accepted is two finite numbers" in message
    assert not list(tmp_path.glob("x.*"))
    check = ["references", "check", run, other, "--library", NOMINAL]
    check += ["--labels", tmp_path / "all.csv", "--figure", tmp_path / "x.docx"]
    message = called(check, capsys, status=1)
    assert "--figure: got" in message
    assert "x.docx'; accepted is a file that ends in .png, .pdf, .svg" in message
    labels = tmp_path / "all.csv"
    message = called(["references", "build", run, "--labels", labels, "--output", labels], capsys, status=1)
    assert "all.csv'; accepted is a file that ends in .yaml, .yml" in message
    arguments = ["references", "build", run, "--labels", "scene", "--output", tmp_path / "x.yaml"]
    damaged = next((other / "recording").glob("point-00001*"))
    damaged.write_bytes(damaged.read_bytes()[:50])
    printed = called(["compare", other, "--output", tmp_path / "y"], capsys)
    assert "two: damaged: " in printed
    empty = tmp_path / "empty.yaml"
    empty.write_text("name: x\n")
    message = called([*arguments, "--nominal", empty], capsys, status=1)
    assert "empty.yaml: nominal_contact: got None" in message
    message = called([*arguments, "--unknown-level", "5"], capsys, status=1)
    assert "--unknown-level: got 5.0; accepted is a number above 0, below 1" in message


def read_labels_of_all(folder, contents):
    path = folder / "all.csv"
    path.write_text("run,tissue\n" + "".join(f"{run.path.name},gel\n" for run in contents))
    return read_labels(path, contents)
