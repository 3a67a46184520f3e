# SPDX-License-Identifier: Apache-2.0
"""The page of a scan under way: what is heard comes out as events, to this machine alone; nothing goes in."""

import argparse
import contextlib
import http.client
import json
import math
import socket
import struct
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance import cli
from tactile_resonance.report.live import LOOPBACK, MOST_OF_A_MAP, MOST_READERS, LiveRun, LiveServer
from tactile_resonance.report.page import point_entry
from tactile_resonance.report.point_details import FRF_TYPE, MOST_DETAILED
from tactile_resonance.scan.messages import make_message
from tactile_resonance.scan.point_result import PointKind, PointOutcome, PointResult
from tactile_resonance.scan.run_content import read_run

sys.path.insert(0, str(Path(__file__).resolve().parent))
from page_runs import HOSTILE, scan, write_scene

from browser import browser

WITHIN_S = 20.0


class Heard(list):
    """Events that were published."""

    def __call__(self, name, data):
        self.append((name, data))

    def of(self, name):
        return [data for own, data in self if own == name]


def result(index, **values):
    place = {"x_m": 1e-3 * index, "y_m": 0.0, "z_m": 0.0, "time_ns": 10**9 * (index + 1)}
    pole = {"f0_hz": 250.0 + index, "f0_std_hz": 0.02, "damping_ratio": 0.03, "damping_ratio_std": 1e-4}
    both = {"f0_damping_covariance_hz": 0.0, "measurement_id": index + 1}
    return PointResult(index, **{**place, **pole, **both, **values})


def frf_of(measurement_id):
    lines = np.arange(200.0, 300.0, 2.5)
    arrays = {"frequency_hz": lines, "real": np.ones(lines.size)}
    arrays["imag"] = np.full(lines.size, float(measurement_id))
    return make_message(FRF_TYPE, measurement_id=measurement_id, label="p", **arrays)


def test_points_come_out_as_the_report_shows_them():
    live = LiveRun(heard := Heard())
    results = [result(0), result(1, outcome=PointOutcome.FAILED, f0_hz=math.nan), result(2)]
    for each in results:
        live.take_result(each, None)
    assert [e["bands"][0] for e in heard.of("point")] == [point_entry(r) for r in results]
    snapshot = live.snapshot()
    assert snapshot["bands"][0]["points"] == [point_entry(r) for r in results]
    assert snapshot["newest"] == 2


def test_a_point_that_is_skipped_has_not_failed():
    live = LiveRun(heard := Heard())
    live.take_result(result(0), None)
    live.take_result(result(1, outcome=PointOutcome.FAILED, f0_hz=math.nan), None)
    live.take_result(result(2, outcome=PointOutcome.SKIPPED, f0_hz=math.nan), None)
    live.take_result(result(3, f0_hz=math.nan), None)
    live.tick()
    assert (heard.of("now")[-1]["points"], heard.of("now")[-1]["failed"]) == (4, 2)


def test_what_does_not_count_is_not_shown():
    live = LiveRun(heard := Heard())
    live.take_result(result(0, outcome=PointOutcome.DISCARDED), None)
    live.take_result(result(0, kind=PointKind.AIR), None)
    assert heard == []
    live.take_result(result(0), None)
    live.take_result(result(0), None)  # a latched one once more
    assert len(heard.of("point")) == 1
    live.take_result(result(0, attempt=1, time_ns=5, f0_hz=260.0), None)  # repeated
    (point,) = live.snapshot()["bands"][0]["points"]
    assert point["f0_hz"] == 260.0


@pytest.mark.parametrize("first", [{}, {"attempt": 1, "x_m": 5e-3}])
def test_another_scan_begins_anew(first):
    """Its first attempt may be a second one: a file of the first may be damaged. Its place tells it then."""
    live = LiveRun(heard := Heard())
    for index in range(3):
        live.take_result(result(index), None)
    live.take_result(result(0, time_ns=10**12, **first), None)
    (run,) = heard.of("run")
    assert [p["index"] for p in run["bands"][0]["points"]] == [0]


def test_a_point_has_the_frf_and_the_force_of_its_own_measurement():
    live = LiveRun(heard := Heard())
    for k in range(2):
        live.take_state(10.0 * k, "approach", math.nan)
        for cycle in range(5):
            live.take_state(10.0 * k + 0.04 * (cycle + 1), "hold", 0.01 + 1e-3 * k)
        live.take_frf(frf_of(k + 1))
        live.tick()
        live.take_result(result(k), None)
        live.take_state(10.0 * k + 1, "retract", 0.0)
    for k, event in enumerate(heard.of("point")):
        detail = event["details"][str(k)]
        assert set(detail["frf"]["im"]) == {k + 1.0}
        np.testing.assert_allclose(detail["force"]["force_mn"], 10 + k)
        np.testing.assert_allclose(detail["force"]["t_s"], 0.04 * np.arange(5), atol=1e-6)
    under_way = [e["detail"]["frf"]["im"][0] for e in heard.of("measuring")]
    assert under_way == [1.0, 2.0]
    # one that was not heard has none: not that of another
    live.take_result(result(2, measurement_id=77), None)
    assert heard.of("point")[-1]["details"]["2"]["frf"] is None


def test_state_and_every_force_come_once():
    now = [0.0]
    live = LiveRun(heard := Heard(), lambda: now[0])
    live.tick()
    assert heard.of("now")[-1]["text"] == "nothing is heard of contact_node"
    live.take_state(1.0, "hold", 0.01, "moving tissue: 200 um at 1.2 Hz")
    live.take_state(1.04, "hold", math.nan)
    live.tick()
    live.tick()
    told = heard.of("now")
    assert told[1]["forces"] == [[1.0, 10.0], [1.04, None]]
    assert told[2]["forces"] == []
    assert told[1]["text"].startswith("contact: hold")
    now[0] = 4.0
    live.tick()
    assert heard.of("now")[-1]["text"] == "nothing is heard of contact_node"


def test_the_map_between_points_costs_a_bounded_share_of_the_time():
    now = [0.0]

    def clock():
        now[0] += 0.01  # so that each map seems to take some time
        return now[0]

    live = LiveRun(heard := Heard(), clock)
    rng = np.random.default_rng(1)
    for index in range(20):
        x_m, y_m = rng.uniform(0, 0.01, 2)
        live.take_result(result(index, x_m=x_m, y_m=y_m), None)
        live.tick()
    assert len(heard.of("surface")) < 20
    live = LiveRun(heard := Heard())
    for index in range(MOST_OF_A_MAP + 1):
        live.take_result(result(index, y_m=1e-3 * (index % 7)), None)
    live.tick()
    (event,) = heard.of("surface")
    assert event["surface"] is None


def test_a_page_that_cannot_go_on_ends_its_command(monkeypatch):
    pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
    from tactile_resonance.commands import report as command
    from tactile_resonance.nodes import client

    until_s = time.monotonic() + 20.0

    class Nobody(contextlib.nullcontext):
        def __init__(self, live, namespace):
            super().__init__(self)

        def spin(self, seconds):
            time.sleep(0.01)
            assert time.monotonic() < until_s, "the command goes on"

    def broken(live):
        raise ZeroDivisionError("of a map")

    monkeypatch.setattr(client, "LiveListener", Nobody)
    monkeypatch.setattr(LiveServer, "readers", 1)
    monkeypatch.setattr(LiveRun, "tick", broken)
    monkeypatch.setattr(command, "noting_signals", lambda: contextlib.nullcontext(lambda: None))
    with pytest.raises(ZeroDivisionError, match="of a map"):
        command.listen(argparse.Namespace(port=0, namespace=""))


def test_details_of_a_long_scan_are_bounded():
    live = LiveRun(Heard())
    for index in range(MOST_DETAILED + 10):
        live.take_result(result(index), None)
    details = live.snapshot()["details"]
    assert len(details) == MOST_DETAILED
    assert min(map(int, details)) == 10


@pytest.fixture
def served():
    """A run, its server."""
    live = LiveRun(lambda name, data: server.publish(name, data))
    with LiveServer(0, live.snapshot) as server:
        yield live, server


def port_of(server):
    return int(server.url.rstrip("/").rpartition(":")[2])


def ask(server, method="GET", path="/", host=None):
    connection = http.client.HTTPConnection(LOOPBACK, port_of(server), timeout=WITHIN_S)
    connection.request(method, path, headers={"Host": host} if host else {})
    return connection.getresponse()


class Reader:
    """A page that listens."""

    def __init__(self, server):
        self.answer = ask(server, path="/events")

    def next(self):
        name = data = None
        while True:
            line = self.answer.readline().decode().rstrip("\n")
            if line.startswith("event: "):
                name = line[7:]
            elif line.startswith("data: "):
                data = json.loads(line[6:])
            elif name:
                return name, data


def test_it_serves_the_page_and_allows_nothing_else(served):
    _, server = served
    answer = ask(server)
    page = answer.read().decode()
    assert answer.status == 200
    assert "This page only shows" in page
    assert page.count("plotly.js v") == 1
    headers = {name.lower(): value for name, value in answer.getheaders()}
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "connect-src 'self'" in headers["content-security-policy"]
    assert headers["x-frame-options"] == "DENY"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert not [name for name in headers if name.startswith("access-control")]
    assert ask(server, path="/../etc/passwd").status == 404
    assert ask(server, path="/events?x").status == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH", "DELETE", "OPTIONS", "HEAD", "TRACE"])
@pytest.mark.parametrize("path", ["/", "/events"])
def test_it_is_read_only(served, method, path):
    answer = ask(served[1], method, path)
    assert answer.status == 405
    assert answer.getheader("Allow") == "GET"


def test_other_hosts_are_refused(served):
    _, server = served
    port = port_of(server)
    assert ask(server, host=f"localhost:{port}").status == 200
    others = (f"evil.example:{port}", f"{LOOPBACK}:{port + 1}", f"127.0.0.2:{port}")
    for host in ("evil.example", LOOPBACK, *others):
        for method in ("GET", "POST"):
            assert ask(server, method, host=host).status == 421, host
    # none, and two
    for head in ("", f"Host: {LOOPBACK}:{port}\r\nHost: evil.example\r\n"):
        with socket.create_connection((LOOPBACK, port), WITHIN_S) as raw:
            raw.sendall(f"GET / HTTP/1.1\r\n{head}\r\n".encode())
            assert raw.recv(100).split()[1] == b"421"


def test_it_listens_on_loopback_alone(served):
    port = port_of(served[1])
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", port), 2.0)
    with pytest.raises(ValueError, match=f"--port: {port} is taken"):
        LiveServer(port, dict)


def test_a_reader_gets_all_and_then_what_is_new(served):
    live, server = served
    live.take_result(result(0), None)
    reader = Reader(server)
    name, run = reader.next()
    assert name == "run"
    assert [p["index"] for p in run["bands"][0]["points"]] == [0]
    live.take_result(result(1, label=HOSTILE), None)
    name, point = reader.next()
    assert name == "point"
    assert point["bands"][0] == point_entry(result(1, label=HOSTILE))


def test_readers_are_bounded_and_one_that_is_slow_begins_anew(served):
    _, server = served
    readers = [Reader(server) for _ in range(MOST_READERS)]
    for reader in readers:
        assert reader.next()[0] == "run"
    assert ask(server, path="/events").status == 503
    # nobody reads: what does not fit into sockets and queues ends the connection
    filling = threading.Thread(
        target=lambda: [server.publish("now", {"text": "x" * 100_000}) for _ in range(2000)], daemon=True
    )
    filling.start()
    filling.join(60)
    assert not filling.is_alive(), "a slow reader keeps the scan waiting"
    assert server.readers == 0


def test_a_reader_that_goes_leaves_no_word(served, capfd):
    _, server = served
    for path in ("/", "/events"):
        for _ in range(3):
            with socket.create_connection((LOOPBACK, port_of(server)), WITHIN_S) as raw:
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset
                raw.sendall(f"GET {path} HTTP/1.1\r\nHost: {LOOPBACK}:{port_of(server)}\r\n\r\n".encode())
                raw.recv(10)
    deadline = time.monotonic() + WITHIN_S
    while server.readers and time.monotonic() < deadline:
        server.publish("now", {})
        time.sleep(0.05)
    assert server.readers == 0
    assert ask(server).status == 200
    assert capfd.readouterr().err == ""


def test_the_live_page_shows_points_as_they_come(served, tmp_path):
    live, server = served
    folder = tmp_path / "run"
    recorded = scan(write_scene(tmp_path / "scene.yaml", tissue=HOSTILE), folder, most=5)
    *first, last = read_run(folder).latest
    for each in first:
        live.take_result(each, recorded[each.index][1])
    with browser() as page:
        page.show(server.url, "document.querySelector('h2')?.textContent === 'point 4'")
        live.take_state(1.0, "hold", 0.01)
        live.tick()
        page.wait("document.querySelector('.state').textContent.startsWith('contact: hold')")
        assert page.value("document.querySelectorAll('.main-svg').length") >= 2 * 5
        live.take_result(last, recorded[last.index][1])
        page.wait("document.querySelector('h2').textContent === 'point 5'")
        assert f"{last.f0_hz:.3f}" in page.value("document.querySelector('.facts').textContent")
        live.take_poles(recorded[0][1], 99, HOSTILE)
        live.tick()
        page.wait("document.querySelector('h2').textContent.startsWith('under way')")
        assert page.value("document.querySelector('h2').textContent") == f"under way: {HOSTILE}"
        assert page.value("document.querySelectorAll('script, img').length") == 3
        assert page.console == []
        assert set(page.requests) == {server.url, f"{server.url}events"}


def test_a_namespace_that_is_none_is_refused(capsys):
    pytest.importorskip("rclpy")
    assert cli.main(["live", "--port", "0", "--namespace", "bad name!"]) == 1
    message = "tactile_resonance: --namespace: got 'bad name!'; accepted is a ROS namespace"
    assert capsys.readouterr().err.startswith(message)
