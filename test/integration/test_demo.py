# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.recording.store import read_store

COMMAND = [sys.executable, "-m", "tactile_resonance.cli", "demo"]


def processes_of(folder):
    """Ids of processes whose command line or output lies in the demo's folder."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            outputs = os.readlink(entry / "fd" / "1")
        except OSError:
            continue
        if str(folder) in outputs:
            found.append(int(entry.name))
    return found


def test_four_concentrations_are_told_apart(domain, tmp_path):
    answer = subprocess.run(
        [*COMMAND, "--points", "2", "--output", tmp_path / "run"],
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert answer.returncode == 0, answer.stderr
    with (tmp_path / "run" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["phantom"] for row in rows] == [
        f"gelatine {percent} %" for percent in (10, 12, 14, 16) for _ in range(2)
    ]
    for estimate, std, truth in (
        ("f0_hz", "f0_std_hz", "f0_true_hz"),
        ("damping_ratio", "damping_ratio_std", "damping_ratio_true"),
    ):
        values, stds, truths = (
            np.array([float(row[name]) for row in rows]) for name in (estimate, std, truth)
        )
        assert np.all(np.abs(values - truths) < 4 * stds)
        # each concentration above the one before by far more than the uncertainty
        means = values.reshape(4, 2).mean(axis=1)
        assert np.all(np.diff(means) > 20 * stds.max())
    content = read_store(tmp_path / "run" / "records")
    assert content.problems == ()
    points = content.measurements[-8:]  # after those that warmed up
    assert [len(point.records) for point in points] == [8] * 8
    assert all(point.gaps == () and point.records[-1].origin.final for point in points)
    assert (tmp_path / "run" / "phantoms.png").stat().st_size > 50_000
    for percent in (10, 12, 14, 16):
        assert f"gelatine {percent} %" in answer.stdout
    assert processes_of(tmp_path) == []
    # the records lie there too, and give the same poles again
    records = tmp_path / "run" / "records"
    options = ["--measurement", rows[0]["measurement_id"], "--band", "200", "300"]
    answer = subprocess.run(
        [sys.executable, "-m", "tactile_resonance.cli", "analyze", records, *options]
        + ["--json", tmp_path / "again.json"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert answer.returncode == 0, answer.stderr
    again = json.loads((tmp_path / "again.json").read_text())
    assert again["method"] == rows[0]["method"] == "joint maximum likelihood of poles and transient"
    again = again["poles"][0]
    # streamed and at once agree to rounding of the bins; a millionth of the standard deviation here
    assert abs(again["f0_hz"] - float(rows[0]["f0_hz"])) < 1e-6 * float(rows[0]["f0_std_hz"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_demo_leaves_no_process(domain, tmp_path, number):
    demo = subprocess.Popen(
        [*COMMAND, "--real-time", "--output", tmp_path / "run"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while len(processes_of(tmp_path)) < 5 and time.monotonic() < deadline:
        time.sleep(0.1)
    assert len(processes_of(tmp_path)) == 5
    time.sleep(3)
    demo.send_signal(number)
    _, errors = demo.communicate(timeout=20)
    assert demo.returncode == 130
    assert "Traceback" not in errors
    assert processes_of(tmp_path) == []


def test_killed_demo_takes_its_nodes_along(domain, tmp_path):
    demo = subprocess.Popen(
        [*COMMAND, "--real-time", "--output", tmp_path / "run"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 60
    while len(processes_of(tmp_path)) < 5 and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(2)
    demo.kill()
    demo.wait()
    deadline = time.monotonic() + 10
    while processes_of(tmp_path) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert processes_of(tmp_path) == []


def test_bad_options_are_refused_in_one_line(capsys):
    from tactile_resonance import cli

    for options, message in (
        (["--points", "0"], "points: 0, expected at least 1"),
        (["--periods", "2"], "periods: 2, expected at least 3"),
        (["--scene", "nowhere.yaml"], "nowhere.yaml"),
    ):
        assert cli.main(["demo", *options]) == 1
        printed = capsys.readouterr()
        assert message in printed.err
        assert printed.err.count("\n") == 1
