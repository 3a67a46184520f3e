# SPDX-License-Identifier: Apache-2.0
"""Some rows of `tactile_resonance benchmark faults`; docs/reliability.md has what all of them gave."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from benchmarks.faults import session

ROWS = (
    "record to frf_node: duplicated",
    "poles to scan_node: duplicated",
    "record to frf_node: NaN",
    "contact_state to scan_node: NaN",
    "poles_node killed",
)


def test_a_fault_loses_nothing_and_does_no_harm(domain):
    rows = list(session(ROWS))
    assert [row.name for row in rows] == list(ROWS)
    assert [f"{row.name}: {row.wrong}" for row in rows if row.wrong] == []
