# SPDX-License-Identifier: Apache-2.0
"""The demo on a machine that has other things to do, against the same on one that has not, and the truth.

`make load` does it at length: more loads, all sixteen points, and the wall clock.
"""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from benchmarks.load_case import BRIEFLY, Demonstration, Load, demonstrate, faults, findings

sys.path.insert(0, str(Path(__file__).parent))
from demonstrated import HOST

# nodes that hold the time, that compute, and that are not needed; the robot's client, and the robot
STOPPED = ("contact_node", "frf_node", "pole_map_node", "scan_node", *BRIEFLY)


@pytest.fixture(scope="module")
def idle(demonstration):
    """Two points of a demo that nothing disturbs."""
    shown = demonstration.shown
    assert shown.status == 0, shown.errors
    found = findings(shown.run_folder)
    assert faults(shown, found, found) == []
    assert found.points == 2
    return found


def test_a_load_costs_time_and_nothing_else(idle, demonstration, domain, tmp_path):
    # one core and a loop on it: as scarce as two cores with two, and half of what the loops use up meanwhile
    load = Load("busy, and stopped", 1, pinned=True, without_priority=True, stopped=STOPPED)
    shown = demonstrate(tmp_path, demonstration.scene, HOST, load)
    assert faults(shown, findings(shown.run_folder), idle) == []
    assert len(shown.stopped) >= 3, "it was over before they were stopped"


def test_what_a_load_may_change_is_found(idle):
    """A repeat, another tissue, a force or pole that is wrong: each is a fault."""
    well = Demonstration(1.0, 0, "", "", (), Path(), ())
    for wrong in (
        replace(idle, repeats=1),
        replace(idle, calls=idle.calls[:1]),
        replace(idle, poles=4.5),
        replace(idle, forces=float("nan")),
    ):
        assert len(faults(well, wrong, idle)) == 1
    assert len(faults(replace(well, left=(1,)), idle, idle)) == 1
    assert len(faults(replace(well, status=1), idle, idle)) == 1
