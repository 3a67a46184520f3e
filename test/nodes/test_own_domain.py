# SPDX-License-Identifier: Apache-2.0
"""How a session begins and ends: not among the nodes of another one, and with how to go on."""

import contextlib
import errno
import signal
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy

from tactile_resonance import cli
from tactile_resonance.commands import bench_scan
from tactile_resonance.commands.bench_scan import Silence, require_own_domain
from tactile_resonance.configuration import share_path
from tactile_resonance.nodes import client as client_module
from tactile_resonance.nodes.client import ScanClient
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import domain_is_free, free_domain_id, noting_signals


@pytest.mark.parametrize(
    ("name", "namespace", "refused"),
    [("scan_node", "", True), ("scan_node", "/left", False), ("rviz", "", False)],
)
def test_a_domain_with_nodes_of_another_session_is_refused(
    monkeypatch, tmp_path, name, namespace, refused
):
    domain = free_domain_id({})
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    require_own_domain()  # nobody is there
    with initialised(domain_id=domain):
        node = rclpy.create_node(name, namespace=namespace)
        assert not domain_is_free(domain)
        if refused:
            with pytest.raises(
                ValueError, match=rf"ROS_DOMAIN_ID: {domain} has scan_node of another"
            ):
                require_own_domain()
            # before anything is started, whose nodes would be among those of the other session
            monkeypatch.setattr(bench_scan, "NodeProcesses", None)
            job = bench_scan.Job(
                share_path("config/scenes/demo.yaml"), tmp_path / "run", "127.0.0.1"
            )
            with pytest.raises(ValueError, match=r"^ROS_DOMAIN_ID: "):
                bench_scan.run_job(job)
            assert not any(tmp_path.iterdir())
        else:
            require_own_domain()
        node.destroy_node()


@pytest.mark.parametrize(
    "error",
    [OSError(errno.EIO, "Input/output error"), FileNotFoundError("no such error")],
    ids=["of a line to the terminal", "without a number"],
)
def test_a_terminal_that_was_closed_is_told_how_to_go_on_where_a_run_was_begun(monkeypatch, tmp_path, error):
    run = tmp_path / "run"

    def scan(*_):
        run.mkdir()
        (run / "run.json").touch()
        raise error

    nodes = SimpleNamespace(bring_up=lambda *_, **__: None)
    monkeypatch.setattr(bench_scan, "NodeProcesses", lambda _: contextlib.nullcontext(nodes))
    quiet = contextlib.nullcontext(lambda: None)
    monkeypatch.setattr(bench_scan, "noting_signals", lambda: quiet)  # the tests keep their handlers
    monkeypatch.setattr(bench_scan, "_scan", scan)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain_id({})))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("TACTILE_RESONANCE_COMMAND", "tactile_resonance")
    job = bench_scan.Job(share_path("config/scenes/demo.yaml"), run, "127.0.0.1")
    with pytest.raises(OSError, match=rf"error; tactile_resonance resume {run} goes on"):
        bench_scan.run_job(job)


@pytest.mark.parametrize(
    ("seen_s", "found", "until_s"),
    [
        ({"scan_node": 8.0}, ["scan_node"], 8.0),
        ({"rviz": 1.0, "scan_node": 3.0}, ["scan_node"], 3.0),
        ({"rviz": 6.0}, [], 8.0),
        ({}, [], client_module.NOBODY_S),
    ],
)
def test_nodes_that_a_busy_machine_discovers_late_are_found(monkeypatch, seen_s, found, until_s):
    now = [0.0]
    client = ScanClient(lambda: None)
    client.spin = lambda seconds: now.__setitem__(0, now[0] + seconds)
    client._node = SimpleNamespace(
        get_name=lambda: "scan_client",
        get_namespace=lambda: "/",
        get_node_names_and_namespaces=lambda: [
            ("scan_client", "/"),
            *((name, "/") for name, at_s in seen_s.items() if at_s <= now[0]),
        ],
    )
    monkeypatch.setattr(client_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    assert client.nodes_there(["scan_node"], 2.0) == found
    assert now[0] == pytest.approx(until_s, abs=0.15)


def test_silence_counts_only_while_this_process_runs(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(bench_scan.time, "monotonic", lambda: now[0])
    silence = Silence()

    def after(seconds, count):
        now[0] += seconds
        return silence.lasts_s(count)

    assert after(0.5, 1) == 0
    assert after(0.5, 1) == 0.5
    assert after(3600.0, 1) == 1.5  # stopped meanwhile, as by Ctrl-Z
    assert after(0.5, 2) == 0
    assert after(0.5, 2) == 0.5


def test_an_interrupt_counts_also_where_an_error_ends_what_was_under_way(handlers):
    def session():
        with noting_signals():
            signal.raise_signal(signal.SIGINT)
            raise RuntimeError("scan_node ended")

    with pytest.raises(KeyboardInterrupt):
        session()


@pytest.mark.parametrize(
    "command",
    [["live", "--port", "0"], ["calibrate-table", "--points", "[[0, 0], [0.01, 0], [0, 0.01]]"]],
    ids=["live", "calibrate-table"],
)
def test_an_interrupt_that_meets_rclpy_at_work_takes_effect_after_it(monkeypatch, handlers, command):
    """Raised as a message is taken it becomes a RuntimeError: a traceback, and no tip that is drawn back."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain_id({})))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    spin, finished = client_module.NodeClient.spin, []

    def interrupted(self, seconds):
        if not finished:
            signal.raise_signal(signal.SIGINT)
            finished.append(seconds)
        spin(self, seconds)

    monkeypatch.setattr(client_module.NodeClient, "spin", interrupted)
    assert cli.main(command) == 130
    assert finished
