# SPDX-License-Identifier: Apache-2.0
"""A scan through robot, load cell and all nodes: killed in the middle, resumed, every message in its file."""

import signal
from collections import Counter

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from robot_at_hand import own_host, own_time
from rosbags.rosbag2 import Reader
from tactile_resonance.action import Scan

from tactile_resonance import msg
from tactile_resonance.client import Ending
from tactile_resonance.commands.bench_scan import NODES
from tactile_resonance.nodes.client import HANGS_S, ScanClient
from tactile_resonance.nodes.running import POINT_RESULTS
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.report.point_details import deviations, truths_of
from tactile_resonance.report.run_report import read_silent
from tactile_resonance.scan.point_result import PointOutcome
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.tissue_tests import fits_at, fits_of
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE
from tactile_resonance.simulation.tissue.library import read_tissues

SCENE = """
name: three points
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.025}}
positions:
  list: [[0.0, 0.0], [0.004, 0.0], [0.004, 0.004]]
outputs: [poles, map, silent]
precision: {f0_std_hz: 0.02}
blocks: {least: 3, most: 4}
protocols:
  - {kind: relaxation, hold_s: 5, force_n: 0.012, points: [2]}
"""
HOST, TIME = own_host(9), own_time(9)


def test_a_scan_is_killed_and_resumed(domain, tmp_path):
    scene, run_path = tmp_path / "three.yaml", tmp_path / "run"
    scene.write_text(SCENE)
    table = list(TABLE_IN_BASE)
    parameters = {
        "fake_hardware_node": {"scene": scene, "robot_host": HOST, "table_in_base": table},
        "excitation_node": {"record_folder": tmp_path / "records"},
        "contact_node": {"robot_host": HOST, "force_host": HOST},
        "scan_node": {"table_in_base": table, "goal_folders": [str(tmp_path)]},
    }
    for node in parameters.values():
        node["time_server"] = TIME
    with NodeProcesses(tmp_path / "log") as nodes, ScanClient(lambda: None) as client:
        nodes.bring_up(NODES, parameters)
        client.wait_until_up(HANGS_S)
        heard = []
        killed = client.tactile.scan(scene=scene, run_directory=run_path, on_feedback=heard.append)
        client.wait(
            lambda: (
                heard and heard[-1].finished >= 1 and heard[-1].phase == Scan.Feedback.PHASE_MEASURE
            ),
            HANGS_S,
            "a point",
        )
        process = nodes._processes.pop("scan_node")
        process.send_signal(signal.SIGKILL)
        process.wait()
        before = read_run(run_path)
        assert before.problems == ()
        # the scan went on until the kill
        assert [r.index for r in before.results] in ([0], [0, 1])
        # started anew, brought up by the manager, and on it goes
        nodes.start("scan_node", parameters["scan_node"])
        client.wait(killed.done, HANGS_S, "the loss of the scan to be noticed")
        assert killed.result().ending is Ending.LOST
        result = client.scan(5 * HANGS_S, run_directory=run_path, resume=True)
        told = []
        client._node.create_subscription(
            msg.PointResult, "point_result", told.append, POINT_RESULTS
        )
        client.wait(lambda: len(told) == 6, HANGS_S, "all results")
        done = {r.measurement_id for r in told if r.outcome == PointOutcome.DONE}
        records = tmp_path / "records"
        client.wait(
            lambda: done.isdisjoint(int(path.name.split("-")[1]) for path in records.iterdir()),
            HANGS_S,
            "records that are in the run to be removed beside it",
        )
        (silent,) = (r.measurement_id for r in told if r.outcome != PointOutcome.DONE)
        assert list(records.glob(f"*-{silent}"))  # its result does not vouch for its records
    assert result.ending is Ending.COMPLETE, result.message
    assert (result.done, result.failed, result.skipped) == (3, 0, 0)
    run = read_run(run_path)
    assert run.problems == ()
    assert [(r.index, r.attempt) for r in run.results] == [(0, 0), (1, 0), (2, 0)]
    kept = [(r.measurement_id, r.f0_hz, r.damping_ratio) for r in before.results]
    assert [(r.measurement_id, r.f0_hz, r.damping_ratio) for r in run.results][: len(kept)] == kept

    # poles of this gelatine at that force and age of the contact: what the bench knows of each point
    off = deviations(run.results, truths_of(run))
    assert off.shape == (3, 2)
    assert np.abs(off).max() < 4

    for point in run.results:
        # a centinewton, as the load cell of 1 mN noise tells it, over the blocks of the point
        assert point.force_n == pytest.approx(0.01, abs=3e-4)
        assert 1.01 < point.f0_over_air < 1.05  # the pole in air, not in the silent record
        assert point.simulated

    # the test at the second point is in its file, and says what the tissue is
    assert [len(fits_at(run, result)) for result in run.results] == [0, 1, 0]
    (tested,) = fits_of(run)
    assert (tested.result.index, tested.test.protocol.value) == (1, "relaxation")
    assert tested.fit is not None, tested.reason
    value, std = tested.fit.modulus(1.0)
    truth = read_tissues().gelatine(10.0).prony.relaxation_modulus(1.0)
    assert abs(np.log(value / truth)) < 4 * std
    assert (run_path / "mechanics.csv").read_text().count("\n") == 2

    # an independent reader finds every block's record, FRF and poles
    with Reader(run_path / "recording") as reader:
        counts = Counter(connection.topic for connection, _, _ in reader.messages())
    references = 3 * 3  # silent, and in free air before and after
    blocks = sum(point.blocks for point in run.results) + references
    assert counts["/indentation"] == 1
    assert counts["/record"] == counts["/frf"] == counts["/poles"] == blocks
    assert counts["/point_result"] == 3 + 3
    # a late reader gets those of the node that was killed too
    assert [(r.kind, r.index, r.outcome) for r in told] == [
        ("air", 3, PointOutcome.SKIPPED),
        *[("air", 3, PointOutcome.DONE), *[("tissue", k, PointOutcome.DONE) for k in range(3)]],
        ("air", 4, PointOutcome.DONE),
    ]
    assert max(r.f0_hz for r in told if r.kind == "air" and r.outcome == PointOutcome.DONE) < min(
        r.f0_hz for r in told if r.kind == "tissue"
    )
    assert counts["/wrench"] > 100
    assert np.isfinite([point.force_std_n for point in run.results]).any()

    # nothing was played: noise of the bench's sensor channel, and no hum
    silent = read_silent(run)
    assert silent.tones == ()
    # 0.5 mV rms in 25 kHz, of the sensor's configuration
    assert silent.sensor_noise == pytest.approx(5e-4 / np.sqrt(25e3), rel=0.05)
    assert silent.actuator_noise == 0
