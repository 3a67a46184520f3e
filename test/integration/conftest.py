# SPDX-License-Identifier: Apache-2.0
"""Nodes as real processes in a domain of their own, on loopback."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")


@pytest.fixture
def domain(monkeypatch):
    """Environment of a fresh domain; processes started from here inherit it."""
    from tactile_resonance.processes import free_domain_id

    number = free_domain_id({})
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return number
