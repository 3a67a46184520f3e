# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance live` as a process of its own: it hears nodes, shows what they say, and ends."""

import json
import signal
import subprocess
import sys
import time
import urllib.request
from threading import Thread

import pytest

from tactile_resonance import msg
from tactile_resonance.nodes.client import HANGS_S, NodeClient
from tactile_resonance.nodes.running import POINT_RESULTS, RESULTS, STREAM

COMMAND = [sys.executable, "-m", "tactile_resonance.cli", "live", "--port", "0"]


class Nodes(NodeClient):
    """What scan_node, frf_node, poles_node and contact_node publish, with their qualities of service."""

    def join(self):
        self.out = {
            name: self._node.create_publisher(kind, f"left/{name}", qos)
            for name, kind, qos in (
                ("point_result", msg.PointResult, POINT_RESULTS),
                ("frf", msg.FRF, RESULTS),
                ("poles", msg.Poles, RESULTS),
                ("contact_state", msg.ContactState, STREAM),
            )
        }

    def heard(self):
        return all(out.get_subscription_count() for out in self.out.values())

    def others_of(self, name):
        """What else the page's node offers or asks for."""
        node = self._node
        offers = node.get_publisher_names_and_types_by_node(name, "/")
        asks = node.get_client_names_and_types_by_node(name, "/")
        return {topic for topic, _ in [*offers, *asks]}


@pytest.fixture
def live(domain):
    """The process, and the address that it prints."""
    pytest.importorskip("plotly", reason="plotly is not here")
    process = subprocess.Popen(
        [*COMMAND, "--namespace", "/left"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process, process.stdout.readline().split()[0]
    finally:
        process.kill()
        process.communicate()


def events_of(url, into):
    with urllib.request.urlopen(f"{url}events", timeout=HANGS_S) as answer:
        for line in answer:
            into.append(line.decode())


def test_it_shows_what_is_published_and_sends_nothing(live):
    process, url = live
    lines = []
    Thread(target=events_of, args=(url, lines), daemon=True).start()

    def told(name):
        return [json.loads(d[6:]) for e, d in zip(lines, lines[1:], strict=False) if e == f"event: {name}\n"]

    with Nodes("nodes", lambda: None) as nodes:
        nodes.wait(nodes.heard, HANGS_S, "the page to listen")
        state = msg.ContactState(state="hold", force_n=0.0098, message="")
        point = {"index": 3, "measurement_id": 7, "kind": "tissue", "x_m": 0.001, "y_m": 0.002, "z_m": 0.0}
        pole = {"f0_hz": 254.5, "f0_std_hz": 0.02, "damping_ratio": 0.03, "damping_ratio_std": 1e-4}
        result = msg.PointResult(**point, **pole)
        frf = msg.FRF(measurement_id=7, frequency_hz=[250.0, 252.5], real=[1.0, 2.0], imag=[0.0, 0.5])
        deadline = time.monotonic() + HANGS_S
        # again and again: who sends may know of a reader that does not know of it yet
        while not told("measuring") and time.monotonic() < deadline:
            nodes.out["contact_state"].publish(state)
            nodes.out["frf"].publish(frf)
            nodes.spin(0.05)
        nodes.out["point_result"].publish(result)
        nodes.wait(lambda: told("point"), HANGS_S, "the point")
        nodes.wait(lambda: any(now["forces"] for now in told("now")), HANGS_S, "the forces heard before it")
        # parameters' events and the log are what every node of rclpy has
        assert nodes.others_of("live_page") <= {"/parameter_events", "/rosout"}
    (event,) = told("point")
    (shown,) = event["bands"]
    assert (shown["index"], shown["f0_hz"], shown["x_mm"]) == (3, 254.5, 1.0)
    assert event["details"]["3"]["frf"]["re"] == [1.0, 2.0]
    forces = [force for now in told("now") for _, force in now["forces"]]
    assert set(forces) == {1e3 * 0.0098}
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=HANGS_S)
    # Fast DDS reports a port of shared memory that a node beside these tests took at that moment, and goes on
    own = [line for line in errors.splitlines() if "RTPS_TRANSPORT_SHM" not in line]
    assert own == ["tactile_resonance: interrupted"]
    assert process.returncode == 130


def test_a_port_that_is_taken_is_refused(live):
    _, url = live
    port = url.rstrip("/").rpartition(":")[2]
    again = subprocess.run([*COMMAND[:-1], port], capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert again.returncode == 1
    assert again.stderr.startswith(f"tactile_resonance: --port: {port} is taken")
    assert again.stderr.count("\n") == 1
