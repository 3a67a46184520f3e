# SPDX-License-Identifier: Apache-2.0
"""Calibration of the table by scan_node: what becomes of its file."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from tactile_resonance.contact.samples import Pose
from tactile_resonance.nodes import scan_node
from tactile_resonance.nodes.scan_actions import no_table
from tactile_resonance.scan.hands import Touch
from tactile_resonance.scan.table_calibration import CalibrationRequest
from tactile_resonance.sensor import sensor_named

POINTS_M = ((0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.02, 0.02, 0.0))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full, a file on a full disk")
def test_a_table_that_was_touched_is_told_where_the_disk_is_full(tmp_path, monkeypatch):
    path = tmp_path / "table.yaml"

    def full(name):
        Path(name).touch()
        return open("/dev/full", "wb")

    monkeypatch.setattr(scan_node, "_new_file", full)
    radius_m = sensor_named("bimorph").tip.radius_m

    def find(point, *_):
        x, y, _ = point.position_m
        return Touch((float(x), float(y), radius_m + 0.01), 1e-5, 5e-3)

    hands = SimpleNamespace(find=find, at_work=nullcontext, retract=lambda: 0.0)
    node = SimpleNamespace(
        _hands=hands,
        _frames=SimpleNamespace(table_in_base=Pose.at_origin(), base="base", table="table"),
        _goals=SimpleNamespace(controls=SimpleNamespace(check_cancelled=lambda: None)),
        get_fully_qualified_name=lambda: "/scan_node",
        time_server="",
    )
    result, goal = no_table(), SimpleNamespace(publish_feedback=lambda _: None)
    request = CalibrationRequest(POINTS_M, sensor="bimorph", file=str(path))
    scan_node.ScanNode._calibrate(node, goal, request, result)
    assert result.outcome == result.DONE
    assert "NOT WRITTEN" in result.message
    assert "No space left" in result.message
    assert result.file == ""
    assert not path.exists()
    assert np.isclose(result.height_m, 0.01, atol=1e-6)
