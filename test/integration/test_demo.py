# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it: a whole scan, through robot, load cell and all nodes."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from robot_at_hand import own_host

from tactile_resonance.report.point_details import deviations, truths_of
from tactile_resonance.scan.run_content import read_run

sys.path.insert(0, str(Path(__file__).parent))
from demonstrated import processes_of

COMMAND = [sys.executable, "-m", "tactile_resonance.cli", "demo"]
HOST = own_host(8)
HANGS_S = 180.0
NODES = 9  # with the manager and the simulated robot


def test_two_dishes_are_told_apart_and_nothing_is_left_running(demonstration):
    shown = demonstration.shown
    assert shown.status == 0, shown.errors
    assert demonstration.left == []
    run = read_run(shown.run_folder)
    soft, stiff = run.latest
    assert (soft.tissue_class, stiff.tissue_class) == ("soft", "stiff")
    assert stiff.f0_hz - soft.f0_hz > 7
    # as far from the truth of a contact that creeps as they say, and nothing was late
    truths = truths_of(run)
    assert [truths[k].tissue for k in (0, 1)] == ["gel10", "gel16"]
    assert np.max(np.abs(deviations(run.latest, truths))) < 4
    assert [r.attempt for r in run.results] == [0, 0]
    for result in run.latest:
        # in air the mode is lower: Hertz contact adds stiffness
        assert result.f0_shift_hz == pytest.approx(result.f0_hz - result.f0_hz / result.f0_over_air)
        assert 5 < result.f0_shift_hz < 20
        assert result.f0_shift_std_hz > result.f0_std_hz
        assert result.damping_shift > 0.01
    assert run.facts["notes"] == {"temperature_c": 21.5, "tip_wetness": "dry"}
    # what the user sees
    rows = re.findall(r"^ +(\d) +(-?[\d.]+) +0.00 +(\S+) +(\S+) ", shown.printed, re.MULTILINE)
    assert [(row[0], float(row[1])) for row in rows] == [("1", 0.0), ("2", 60.0)]
    assert "sensor steady" in shown.printed
    assert str(shown.run_folder) in shown.printed
    page = (shown.run_folder / "report.html").read_text()
    for text in ("sensor steady", "temperature_c: 21.5", "true f0 [Hz]"):
        assert text in page


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_interrupted_while_nodes_come_up_it_leaves_no_process(domain, tmp_path, number):
    handler = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # a terminal's, also under nohup
    try:
        demo = start(tmp_path, domain)
    finally:
        signal.signal(signal.SIGHUP, handler)
    interrupt(demo, number, domain)


def interrupt(demo, number, domain):
    """End a demo by a signal; what it wrote to stderr."""
    demo.send_signal(number)
    _, errors = demo.communicate(timeout=HANGS_S)
    assert demo.returncode == 130, errors
    assert "Traceback" not in errors
    assert processes_of(domain) == []
    return errors


def test_an_interrupted_scan_says_how_to_go_on_and_its_folder_is_taken(domain, tmp_path):
    demo, run = start(tmp_path, domain), tmp_path / "run"
    deadline = time.monotonic() + HANGS_S
    while not (run / "run.json").exists() and time.monotonic() < deadline:
        assert demo.poll() is None, f"ended with {demo.returncode}: {demo.communicate()}"
        time.sleep(0.05)
    errors = interrupt(demo, signal.SIGINT, domain)
    command = os.environ.get("TACTILE_RESONANCE_COMMAND", "tactile_resonance")
    end = f"interrupted; {command} resume {run} goes on with the run"
    assert errors.splitlines()[-1] == f"tactile_resonance: {end}"
    again = subprocess.run(
        [*COMMAND, "--output", run], capture_output=True, text=True, timeout=HANGS_S, check=False
    )
    assert again.returncode == 1
    assert again.stderr == (
        f"tactile_resonance: run: {run} holds something; accepted is a new or empty folder\n"
    )
    assert again.stdout == "", "nodes were started"


def test_killed_demo_takes_its_nodes_along(domain, tmp_path):
    demo = start(tmp_path, domain)
    demo.kill()
    demo.communicate()
    deadline = time.monotonic() + HANGS_S
    while processes_of(domain) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert processes_of(domain) == []


def start(folder, domain):
    """A demo whose nodes have all been started."""
    demo = subprocess.Popen(
        [*COMMAND, "--output", folder / "run", "--robot-host", HOST],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + HANGS_S
    while len(processes_of(domain)) < 1 + NODES:
        assert demo.poll() is None, f"ended with {demo.returncode}: {demo.communicate()}"
        assert time.monotonic() < deadline, processes_of(domain)
        time.sleep(0.1)
    return demo


def test_a_run_that_is_complete_is_not_begun_again(demonstration, tmp_path, capsys):
    from tactile_resonance import cli

    run = tmp_path / "run"
    shutil.copytree(demonstration.shown.run_folder, run)
    assert cli.main(["resume", str(run)]) == 0
    assert f"{run} is complete: nothing is left to measure" in capsys.readouterr().out
    # no node was started: there is no folder for their logs
    assert not run.with_name("run.work").exists()
    assert [f.name for f in read_run(run).files] == [
        f.name for f in read_run(demonstration.shown.run_folder).files
    ]


def test_a_resumed_run_keeps_the_seed_of_its_bench(demonstration, tmp_path):
    from argparse import Namespace

    from tactile_resonance.commands import bench_scan

    run = tmp_path / "run"
    shutil.copytree(demonstration.shown.run_folder, run)
    for seed in (7, 42):
        content = json.loads((run / "run.json").read_text())
        content["facts"]["seed"] = seed
        (run / "run.json").write_text(json.dumps(content))
        options = Namespace(output=run, robot_host="127.0.2.9", real_time=False, calibration=None)
        job = bench_scan._resumed_job(options)
        parameters = bench_scan.node_parameters(job, classes=False, work=tmp_path)
        assert parameters["fake_hardware_node"]["seed"] == seed


def test_bad_options_are_refused_in_one_line(capsys):
    from tactile_resonance import cli

    for options, message in (
        (["--seed", "0"], "--seed: got 0; accepted is 1 to 2^31"),
        (["--scene", "nowhere.yaml"], "nowhere.yaml"),
        (
            ["--notes", "{tip_wetness: damp}"],
            "tip_wetness: got 'damp'; accepted is one of dry, wet",
        ),
        (["--output", f"{__file__}/run"], f"is below the file {__file__}; accepted is a folder"),
    ):
        assert cli.main(["demo", *options]) == 1
        printed = capsys.readouterr()
        assert message in printed.err
        assert printed.err.count("\n") == 1
    assert cli.main(["resume", "nowhere"]) == 1
    assert "nowhere'; accepted is the folder of a run, to resume it" in capsys.readouterr().err


def test_a_run_whose_scene_was_cut_short_is_told_so(tmp_path, capsys):
    """What is left may be no scene, which says nothing of its cause."""
    from tactile_resonance import cli
    from tactile_resonance.scan.points import ScanPoint
    from tactile_resonance.scan.run_directory import RunDirectory

    point = ScanPoint(0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), "point 1")
    scene = "force_n: 0.01\npositions: {adaptive: {map: {}}}\n"
    with RunDirectory.create(tmp_path / "run", scene, [point], {}):
        pass
    (tmp_path / "run" / "scene.yaml").write_text(scene[:-9])
    assert cli.main(["resume", str(tmp_path / "run")]) == 1
    told = capsys.readouterr().err
    assert f"scene.yaml: has {len(scene) - 9} bytes, {len(scene)} when it was finished" in told
