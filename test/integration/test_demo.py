# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it: a whole scan, through robot, load cell and all nodes."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from robot_at_hand import own_host

from tactile_resonance.scan.bench_truth import deviations, truths_of
from tactile_resonance.scan.run_content import read_run

COMMAND = [sys.executable, "-m", "tactile_resonance.cli", "demo"]
HOST = own_host(8)
HANGS_S = 180.0
NODES = 9  # with the manager and the simulated robot
SCENE = """
name: two dishes
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.025}}
  - {name: gelatine 16 %, gelatine_percent: 16.0, disc: {center_m: [0.06, 0.0], radius_m: 0.025}}
positions:
  around: {centres_m: [[0.0, 0.0], [0.06, 0.0]], offsets_m: [[0.0, 0.0]]}
precision: {f0_std_hz: 0.02, damping_ratio_std: 1.0e-4}
blocks: {least: 2, most: 8}
notes: {temperature_c: 21.5, tip_wetness: dry}
tissue_classes:
  soft: {f0_hz: 253.84, damping_ratio: 0.0339, f0_std_hz: 0.5, damping_ratio_std: 0.0005, correlation: 0.9}
  stiff: {f0_hz: 262.2, damping_ratio: 0.0428, f0_std_hz: 0.5, damping_ratio_std: 0.0005, correlation: 0.9}
"""


def processes_of(domain):
    """Ids of the processes that were started in a domain."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            environment = (entry / "environ").read_bytes().split(b"\0")
        except OSError:
            continue
        if f"ROS_DOMAIN_ID={domain}".encode() in environment:
            found.append(int(entry.name))
    return found


def test_two_dishes_are_told_apart_and_nothing_is_left_running(domain, tmp_path):
    (tmp_path / "scene.yaml").write_text(SCENE)
    options = ["--scene", tmp_path / "scene.yaml", "--output", tmp_path / "run"]
    answer = subprocess.run(
        [*COMMAND, *options, "--robot-host", HOST],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert answer.returncode == 0, answer.stderr
    assert processes_of(domain) == []
    run = read_run(tmp_path / "run")
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
    rows = re.findall(r"^ +(\d) +(-?[\d.]+) +0.00 +(\S+) +(\S+) ", answer.stdout, re.MULTILINE)
    assert [(row[0], float(row[1])) for row in rows] == [("1", 0.0), ("2", 60.0)]
    assert "sensor steady" in answer.stdout
    assert str(tmp_path / "run") in answer.stdout
    page = (tmp_path / "run" / "report.html").read_text()
    for text in ("sensor steady", "temperature_c: 21.5", "true f0 [Hz]"):
        assert text in page


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_demo_leaves_no_process(domain, tmp_path, number):
    demo = start(tmp_path, domain)
    demo.send_signal(number)
    _, errors = demo.communicate(timeout=HANGS_S)
    assert demo.returncode == 130
    assert "Traceback" not in errors
    assert processes_of(domain) == []


def test_an_interrupted_scan_says_how_to_go_on_and_its_folder_is_taken(domain, tmp_path):
    demo, run = start(tmp_path, domain), tmp_path / "run"
    deadline = time.monotonic() + HANGS_S
    while not (run / "scene.yaml").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    demo.send_signal(signal.SIGINT)
    _, errors = demo.communicate(timeout=HANGS_S)
    end = f"interrupted; tactile_resonance resume {run} goes on with the run"
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
    while len(processes_of(domain)) < 1 + NODES and time.monotonic() < deadline:
        time.sleep(0.1)
    assert len(processes_of(domain)) >= 1 + NODES
    return demo


def test_bad_options_are_refused_in_one_line(capsys):
    from tactile_resonance import cli

    for options, message in (
        (["--seed", "0"], "seed: 0, expected 1 to 2^31"),
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
