# SPDX-License-Identifier: Apache-2.0
"""The examples of the client's page, run as they stand there, on the bench with ideal contact."""

import os
import runpy
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rosbags.highlevel import AnyReader

from tactile_resonance.contact.samples import Pose
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.scan.point_result import PointOutcome
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE

DOCS = Path(__file__).resolve().parents[2] / "docs"
EXAMPLE = DOCS / "examples" / "scan_client.py"
BENCH = DOCS / "examples" / "bench.py"
SCENE = """
name: a dish
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.03}}
positions: {list: [[0.0, 0.0]]}
"""


def test_the_page_shows_the_example():
    _, _, code = EXAMPLE.read_text().partition("License-Identifier: Apache-2.0\n")
    assert f"```python\n{code}```" in (DOCS / "client.md").read_text()


def test_the_example_scans_its_poses_and_steers_the_scan(domain, tmp_path):
    (tmp_path / "dish.yaml").write_text(SCENE)
    files = (f"scene:={tmp_path / 'dish.yaml'}", f"run_folder:={tmp_path / 'runs'}")
    home = {**os.environ, "ROS_HOME": str(tmp_path / "home")}
    bench = subprocess.Popen(
        [sys.executable, BENCH, "robot:=ideal", *files], cwd=tmp_path, env=home
    )
    try:
        answer = subprocess.run(
            [sys.executable, EXAMPLE], capture_output=True, text=True, timeout=600
        )
    finally:
        bench.terminate()  # all nodes with it
        assert bench.wait(60) == 0
    assert answer.returncode == 0, answer.stderr
    *told, last = answer.stdout.splitlines()
    assert last == "cancelled: 3 of 6 points; cancelled"
    (path,) = (tmp_path / "runs").iterdir()
    assert answer.stderr.splitlines()[-1] == str(path)
    run = read_run(path)
    assert [point.position_m for point in run.points] == [(0.003 * k, 0.0, 0.0) for k in range(6)]
    # the second is repeated in a pause, the fourth skipped, the fifth cancelled
    assert [(r.index, r.attempt) for r in run.results] == [(0, 0), (1, 0), (1, 1), (2, 0), (3, 0)]
    outcomes = [*[PointOutcome.DONE] * 4, PointOutcome.SKIPPED]
    assert [result.outcome for result in run.results] == outcomes
    assert [line[:14] for line in told] == [f"poses, point {k}" for k in (1, 2, 2, 3)]
    done = [result for result in run.results if result.outcome is PointOutcome.DONE]
    for result in done:
        # the force of the goal, not of the bench's scene, at exactly the place of the pose
        assert result.force_n == pytest.approx(0.012, abs=1e-12)
        assert result.f0_std_hz < 0.1
        assert result.blocks == 3  # without the precision of the goal they would be eight
        assert result.f0_hz == pytest.approx(254.3, abs=0.5)
    table_in_base = Pose.from_vector(np.array(TABLE_IN_BASE))
    # a point may have been measured in part before the request to skip it came: that is kept too
    places = {0.003 * result.index for result in run.results}
    with AnyReader([path / "recording"]) as reader:
        topics = [c for c in reader.connections if c.topic == "/poles"]
        for connection, _, cdr in reader.messages(connections=topics):
            message = reader.deserialize(cdr, connection.msgtype)
            if message.label == "air":
                continue
            tip = message.tip_pose.pose.position
            at = np.array([tip.x, tip.y, tip.z]) - table_in_base.position_m
            x, y, z = table_in_base.rotation.inv().apply(at)
            assert min(abs(x - place) for place in places) < 1e-9
            assert (y, z) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_the_bench_takes_the_arguments_of_the_launch_file_or_refuses_them(tmp_path, monkeypatch):
    """One that it passed over would leave the default in force without a word."""
    (tmp_path / "mine.yaml").write_text("/**/poles_node: {ros__parameters: {order: 4}}")
    told = {}

    def bring_up(_, nodes, parameters):
        told.update(parameters)
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(NodeProcesses, "bring_up", bring_up)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "argv", [str(BENCH), "robot:=ideal", "params_file:=mine.yaml"])
    runpy.run_path(str(BENCH))
    assert told["poles_node"]["order"] == 4
    assert told["fake_hardware_node"]["serve_contact"] is True
    monkeypatch.setattr(sys, "argv", [str(BENCH), "namespace:=left"])
    with pytest.raises(SystemExit, match=r"^namespace: not among "):
        runpy.run_path(str(BENCH))
    for wrong, told in (
        ("robot", r"^robot: expected NAME:=VALUE"),
        ("robot:=maybe", r"^robot: got 'maybe'; accepted is one of true, ideal, false$"),
        ("real_time:=yes", r"^real_time: got 'yes'; accepted is true or false$"),
        ("params_file:=none.yaml", r"^params_file: none.yaml: "),
    ):
        monkeypatch.setattr(sys, "argv", [str(BENCH), wrong])
        with pytest.raises(SystemExit, match=told):
            runpy.run_path(str(BENCH))
