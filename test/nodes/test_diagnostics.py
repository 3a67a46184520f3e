# SPDX-License-Identifier: Apache-2.0
"""What a node tells of its own health."""

import os

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticStatus

from tactile_resonance.bringup import NODES
from tactile_resonance.configuration import share_path
from tactile_resonance.nodes.running import (
    ERROR_REMEMBERED_S,
    LONGEST,
    MEAN,
    PERIOD_S,
    Health,
    initialised,
)
from tactile_resonance.processes import free_domain_id


def test_how_long_messages_kept_the_node_is_told_once_for_each_report(monkeypatch):
    told = []
    with initialised(domain_id=free_domain_id(os.environ)):
        node = rclpy.create_node("health")
        node.state_name, node.details = lambda: "active", dict
        health = Health(node)
        monkeypatch.setattr(health._publisher, "publish", told.append)
        for seconds in (0.002, 0.003, 0.010):
            health.saw("record", seconds)
        health._publish()
        health._publish()  # nothing came since
        node.destroy_node()
    first, second = ({v.key: v.value for v in array.status[0].values} for array in told)
    assert float(first[f"record{MEAN}"]) == pytest.approx(5.0)
    assert float(first[f"record{LONGEST}"]) == pytest.approx(10.0)
    assert first["record: messages"] == second["record: messages"] == "3"
    assert f"record{MEAN}" not in second


@pytest.mark.parametrize(
    ("state", "with_error", "after"),
    [("active", "WARN", "OK"), ("unconfigured", "ERROR", "WARN"), ("held: poles_node", "ERROR", "WARN")],
)
def test_a_node_that_is_not_active_is_not_well_however_old_its_error(
    monkeypatch, state, with_error, after
):
    """A node that cannot be configured is retried after up to 16 s; its error is reported for 10 s."""
    told = []
    with initialised(domain_id=free_domain_id(os.environ)):
        node = rclpy.create_node("health")
        node.state_name, node.details = lambda: state, dict
        health = Health(node)
        monkeypatch.setattr(health._publisher, "publish", told.append)
        health.error("calibration: no such file")
        health._publish()
        health._error_s -= ERROR_REMEMBERED_S
        health._publish()
        node.destroy_node()
    levels, texts = zip(*((a.status[0].level, a.status[0].message) for a in told), strict=True)
    assert levels == (getattr(DiagnosticStatus, with_error), getattr(DiagnosticStatus, after))
    assert texts == (f"{state}: calibration: no such file", state)


def test_the_aggregator_puts_each_node_into_one_group():
    file = yaml.safe_load(share_path("config/diagnostics.yaml").read_text())
    groups = [g for g in file["analyzers"]["ros__parameters"].values() if isinstance(g, dict)]
    for node in NODES:
        for namespace in ("", "/left"):
            status = f"{namespace}/{node}"
            matching = [g["path"] for g in groups if any(part in status for part in g["contains"])]
            assert len(matching) == 1, status
    assert all(group["timeout"] > 2 * PERIOD_S for group in groups)
