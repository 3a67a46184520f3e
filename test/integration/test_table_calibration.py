# SPDX-License-Identifier: Apache-2.0
"""A table found by touch through the nodes, against the truth of the simulated bench."""

import math
import signal
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import yaml
from geometry_msgs.msg import Point, Pose
from robot_at_hand import own_host, own_time
from tactile_resonance.msg import ContactState

from tactile_resonance.bringup import plan_bringup
from tactile_resonance.cli import main
from tactile_resonance.client import Ending
from tactile_resonance.commands.bench_scan import Job, node_parameters
from tactile_resonance.commands.calibrate_table import NODES, SIMULATED_POINTS, TRUTH, true_table
from tactile_resonance.configuration import share_path
from tactile_resonance.nodes.client import HANGS_S, ScanClient
from tactile_resonance.nodes.running import STREAM
from tactile_resonance.nodes.scan_actions import RUNNING
from tactile_resonance.processes import NodeProcesses, noting_signals
from tactile_resonance.scan.table_calibration import read_table

SCENE = share_path("config/scenes/inclusion_scan.yaml")
POINTS = [Point(x=float(x), y=float(y)) for x, y in yaml.safe_load(SIMULATED_POINTS)]
IDEAL = (1e-6, 5e-5, 5e-5)
HOST, ROBOT_HOST = own_host(96), own_host(97)


def listed(pose):
    return [float(value) for value in pose]


def correction(outcome):
    return np.array([outcome.height_m, outcome.tilt_x_rad, outcome.tilt_y_rad])


def deviations(outcome):
    return np.sqrt(np.diag(np.reshape(outcome.covariance, (3, 3))))


class Bench:
    """Nodes whose simulated table stands elsewhere than scan_node expects it, and a client."""

    def __init__(self, folder, nodes, host, ideal):
        self.folder, self.names = folder, nodes
        parameters = node_parameters(Job(SCENE, folder / "run", host), False, folder)
        table = listed(true_table())
        parameters["fake_hardware_node"]["table_in_base"] = table
        parameters["scan_node"]["run_folder"] = folder / "runs"
        if ideal:
            parameters["fake_hardware_node"].update(
                serve_contact=True, robot_host="", time_server=own_time(96)
            )
            parameters["scan_node"]["time_server"] = own_time(96)
        self.parameters = parameters

    def __enter__(self):
        self.nodes = NodeProcesses(self.folder / "log").__enter__()
        self.client = ScanClient(self.nodes.check).__enter__()
        self.nodes.bring_up(self.names, self.parameters)
        self.client.wait_until_up(HANGS_S)
        return self

    def __exit__(self, *raised):
        self.client.__exit__(*raised)
        self.nodes.__exit__(*raised)

    def calibrate(self, points=POINTS, **wanted):
        return self.client.calibrate_table(5 * HANGS_S, points=points, **wanted)

    def idle(self):
        """The tip is free, by what contact says from now on."""
        node, states = self.client._node, []
        # a new one, which has nothing from before in its queue
        topic = node.create_subscription(ContactState, "contact_state", states.append, STREAM)
        self.client.wait(lambda: states, HANGS_S, "the state of the contact")
        node.destroy_subscription(topic)
        return states[-1].state == ContactState.STATE_IDLE


@pytest.fixture(scope="module")
def ideal(module_domain, tmp_path_factory):
    nodes = ("fake_hardware_node", "scan_node")
    with Bench(tmp_path_factory.mktemp("ideal"), nodes, HOST, ideal=True) as bench:
        yield bench


def test_the_table_is_found_and_the_next_launch_takes_its_file(ideal):
    path, heights = ideal.folder / "table.yaml", []
    outcome = ideal.calibrate(
        file=path, on_feedback=lambda feedback: heights.append(feedback.height_m)
    )
    assert outcome.ending is Ending.COMPLETE, outcome.message
    # ideal contacts tell the distance along the true normal: of 3 mm at 1 deg 0.5 um less than the height
    assert np.all(np.abs(correction(outcome) - TRUTH) < IDEAL)
    np.testing.assert_allclose(outcome.table_in_base, true_table(), atol=5e-5)
    np.testing.assert_allclose(outcome.residuals_m, 0.0, atol=1e-6)
    np.testing.assert_allclose(outcome.std_m, 2e-5)  # what pose and time leave unknown
    assert outcome.reduced_chi_square < 0.01
    assert math.isnan(heights[0])
    assert heights[1] == pytest.approx(TRUTH[0], abs=1e-3)
    assert ideal.idle()
    arguments = {"use_mock_hardware": "true", "table_in_base": str(path)}
    launched = plan_bringup(arguments, {}).nodes["scan_node"]["table_in_base"]
    assert launched == list(outcome.table_in_base)
    content = yaml.safe_load(path.read_text())
    assert content["made_by"].startswith("/scan_node on ")
    assert content["made_by"].endswith(", simulated")
    # nothing changed in the running node: the same is found again, against the table as it was
    refused = ideal.calibrate(file=path)
    assert (refused.ending, refused.message[-10:]) == (Ending.REJECTED, "a new file")
    beside = ideal.calibrate(file="tables/mine.yaml")
    assert beside.file == str(ideal.folder / "runs" / "tables" / "mine.yaml")
    assert read_table(Path(beside.file), "base") == launched
    again = ideal.calibrate()
    np.testing.assert_array_equal(correction(again), correction(outcome))
    assert again.file == ""


def test_three_touches_are_checked_by_none(ideal):
    outcome = ideal.calibrate(POINTS[:3])
    assert outcome.ending is Ending.COMPLETE, outcome.message
    assert math.isnan(outcome.reduced_chi_square)
    assert "no residual checks them" in outcome.message
    assert np.all(np.abs(correction(outcome) - TRUTH) < IDEAL)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"points": POINTS[:2]}, "points: got 2; accepted is three points or more"),
        ({"points": [Point(x=0.01 * k) for k in range(4)]}, "points: "),
        ({"force_n": -0.01}, "force_n: got -0.01; accepted is a number above 0"),
        ({"force_n": math.nan}, "force_n: got nan; accepted is a number above 0"),
        ({"sensor": "nose"}, "got 'nose'; accepted is one of config/sensors"),
        ({"file": "/nowhere/table.yaml"}, "file: got '/nowhere/table.yaml'; accepted is a path in"),
        ({"file": "../../../table.yaml"}, "accepted is a path in"),
        ({"file": "."}, "accepted is a new file"),
    ],
)
def test_a_wrong_goal_is_rejected_with_the_reason(ideal, changes, reason):
    outcome = ideal.calibrate(**changes)
    assert outcome.ending is Ending.REJECTED
    assert reason in outcome.message


def test_where_nothing_can_be_touched_nothing_is_known(ideal):
    beside = [*POINTS[:2], Point(y=0.04)]  # beyond the dish
    path = ideal.folder / "none.yaml"
    outcome = ideal.calibrate(beside, file=path)
    assert outcome.ending is Ending.ENDED
    assert outcome.message.startswith("touch 3: contact: surface_missing")
    assert np.all(np.isnan([*outcome.table_in_base, *correction(outcome), *outcome.covariance]))
    assert ideal.idle()
    tilted = ideal.calibrate(most_tilt_rad=0.01, file=path)
    assert tilted.ending is Ending.REFUSED
    assert "accepted is up to 0.01 rad (most_tilt_rad)" in tilted.message
    assert np.all(np.isnan(tilted.table_in_base))
    assert not path.exists()


def test_a_file_that_cannot_be_new_is_refused_before_anything_is_touched_and_never_replaced(ideal):
    runs, heard = ideal.folder / "runs", []
    runs.mkdir(exist_ok=True)
    (runs / "afile").touch()
    for name in ("afile/table.yaml", 300 * "x"):
        outcome = ideal.calibrate(file=name, on_feedback=heard.append)
        assert outcome.ending is Ending.REFUSED
        assert outcome.message.startswith(f"file: got '{runs / name}'; accepted is a new file")
    assert heard == []
    target = ideal.folder / "elsewhere"
    (runs / "mine.yaml.part").symlink_to(target)
    outcome = ideal.calibrate(file="mine.yaml", on_feedback=heard.append)
    assert outcome.file == str(runs / "mine.yaml")
    assert not target.exists()
    rejected = ideal.calibrate(file="~nobody-has-it/table.yaml")
    assert (rejected.ending, "file: got '~nobody" in rejected.message) == (Ending.REJECTED, True)


def test_one_goal_at_a_time_and_a_cancelled_one_draws_the_tip_back(ideal):
    client, heard = ideal.client, []
    scan = {"poses": [Pose()], "frame": "table", "force_n": 0.01}
    with ScanClient(ideal.nodes.check, "other") as other:
        long = POINTS * 400  # nobody waits for its end
        future = client.tactile.calibrate_table(long, on_feedback=heard.append)
        client.wait(lambda: len(heard) > 1, HANGS_S, "the second touch")
        assert other.calibrate_table(HANGS_S, points=POINTS).message == RUNNING
        outcome = other.scan(HANGS_S, **scan)
        assert (outcome.ending, outcome.message) == (Ending.REJECTED, RUNNING)
        client.tactile.cancel()
        client.wait(future.done, HANGS_S, "the end")
        outcome = future.result()
        assert outcome.ending is Ending.CANCELLED
        assert np.all(np.isnan(outcome.table_in_base))
        assert ideal.idle()
        # and a calibration waits for the end of a scan: this one waits for nodes that are not there
        heard.clear()
        path = ideal.folder / "scan"
        future = client.tactile.scan(**scan, run_directory=path, on_feedback=heard.append)
        client.wait(lambda: heard, HANGS_S, "the scan")
        outcome = other.calibrate_table(HANGS_S, points=POINTS)
        assert (outcome.ending, outcome.message) == (Ending.REJECTED, RUNNING)
        client.tactile.cancel()
        client.wait(future.done, HANGS_S, "the end")


def test_the_command_prints_what_was_found_or_why_it_was_not(ideal, capsys):
    path = ideal.folder / "by_command.yaml"
    points = ["calibrate-table", "--points", SIMULATED_POINTS]
    assert main([*points, "--output", str(path)]) == 0
    told = capsys.readouterr().out
    lines = {line[:6].strip(): line.split() for line in told.splitlines()}
    found = [float(lines[name][column]) for name, column in (("height", 1), ("tilt x", 2))]
    np.testing.assert_allclose(found, [1e6 * TRUTH[0], 1e3 * TRUTH[1]], atol=1.0)
    assert f"table_in_base:={path}" in told
    assert "x, y and the turn about the normal: not estimated" in told
    table = yaml.safe_load(path.read_text())["table_in_base"]
    np.testing.assert_allclose(table, true_table(), atol=5e-5)
    assert main(["calibrate-table", "--points", "[[0, 0], [0.01, 0]]"]) == 1
    assert "points: got 2; accepted is three points or more" in capsys.readouterr().err


def test_an_interrupt_has_the_tip_drawn_back_and_ends_the_goal(ideal, handlers):
    heard, interrupts = [], [signal.SIGINT]

    def check():
        if len(heard) > 1 and interrupts:
            signal.raise_signal(interrupts.pop())
        check_signals()

    with noting_signals() as check_signals, ScanClient(check, "interrupted") as client:
        with pytest.raises(KeyboardInterrupt):
            client.calibrate_table(HANGS_S, points=POINTS * 400, on_feedback=heard.append)
        # its end was waited for, else the client would refuse another one
        assert client.calibrate_table(HANGS_S, points=POINTS).ending is Ending.COMPLETE
    assert ideal.idle()


@pytest.mark.slow
def test_robot_and_load_cell_find_a_table_that_stands_elsewhere(domain, tmp_path):
    pytest.importorskip("rtde_control", reason="ur-rtde is not here")
    with Bench(tmp_path, NODES, ROBOT_HOST, ideal=False) as bench:
        # 2.6 mm above its place, and a contact takes 2 mm
        early = bench.calibrate()
        assert early.ending is Ending.ENDED
        assert early.message.startswith("touch 1: contact: surface_early")
        assert bench.idle()
        outcome = bench.calibrate(search_m=5e-3)
        assert outcome.ending is Ending.COMPLETE, outcome.message
        assert bench.idle()
    error, std = correction(outcome) - TRUTH, deviations(outcome)
    assert np.all(np.abs(error) < 4 * std), (error, std)
    # worth having: 3 mm are known to 0.05, 12 mrad to 2
    assert np.all(std < [5e-5, 2e-3, 2e-3])
    assert (
        outcome.reduced_chi_square < 18.5 / 2
    )  # chi-square of 2 degrees of freedom, one in 10^4 above
