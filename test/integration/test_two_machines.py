# SPDX-License-Identifier: Apache-2.0
"""A scan whose FRFs and poles come from another machine: two network namespaces and a cable between them."""

from collections import Counter

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rosbags.highlevel import AnyReader

from benchmarks.two_machines import TwoMachines, not_permitted, on_two_machines
from tactile_resonance.scan.run_content import read_run
from test.recording.stores import read_store


def test_a_scan_over_the_network_loses_no_record(tmp_path):
    if reason := not_permitted():
        pytest.skip(reason)
    with TwoMachines() as machines:
        told = on_two_machines(machines, tmp_path, ["scan"])
    assert told["ending"] == "complete", told["message"]
    run = read_run(tmp_path / "run")
    assert (told["done"], told["failed"]) == (4, 0), [r.reason for r in run.results]
    assert run.problems == ()
    assert [(r.index, r.attempt, r.blocks) for r in run.results] == [(k, 0, 4) for k in range(4)]
    counts, ids = Counter(), set()
    with AnyReader([tmp_path / "run" / "recording"]) as reader:
        for connection, _, cdr in reader.messages():
            counts[connection.topic] += 1
            if connection.topic == "/record":
                ids.add(int(reader.deserialize(cdr, connection.msgtype).measurement_id))
    # every record of the scan that was published gave an FRF over there, whose poles came back
    stored = read_store(tmp_path / "records")
    assert stored.problems == []
    published = sum(len(m.records) for m in stored.measurements if m.measurement_id in ids)
    assert counts["/record"] == counts["/frf"] == counts["/poles"] == published >= 16
    # none was lost, and its point measured again: beside these only what was measured before the scan
    begun = min(ids)
    assert {m.measurement_id for m in stored.measurements if m.measurement_id >= begun} == ids
    # it was the cable that carried them, not the memory of this machine
    assert told["carried_bytes"] > counts["/record"] * 2 * 20000 * 4
