# SPDX-License-Identifier: Apache-2.0
"""The truth of a contact that creeps is the mean over the record, as an estimate has it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from geometry_msgs.msg import PoseStamped

from tactile_resonance.nodes import simulated_tip
from tactile_resonance.nodes.simulated_tip import PlantChild, truth_message
from tactile_resonance.processes import start_child
from tactile_resonance.simulation.plant.defaults import READY
from tactile_resonance.simulation.sensor.bench import BenchTip, SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues


def test_truth_of_a_contact_that_changes_is_its_mean():
    bench, tissue = SimulatedBench.from_configuration(), read_tissues()["cortex"]
    tip = BenchTip(tissue, 0.01, 0.3)
    forces = np.linspace(0.009, 0.012, 7)
    parts = [replace(tip, force_n=force).coupled(bench) for force in forces]
    over = truth_message(PoseStamped(), tip, parts, 5, "tip")
    now = truth_message(PoseStamped(), tip, [tip.coupled(bench)], 0, "tip")
    each = [[(m.f0_hz, m.damping_ratio, m.pole_rad_s.imag) for m in part.modes] for part in parts]
    means = np.mean(each, axis=0).T
    np.testing.assert_allclose([over.f0_hz, over.damping_ratio, over.imag_rad_s], means, rtol=1e-12)
    assert over.contact_force_n == pytest.approx(forces.mean())
    assert over.measurement_id == 5
    modes = tip.coupled(bench).modes
    np.testing.assert_allclose(now.f0_hz, [mode.f0_hz for mode in modes])
    assert now.contact_force_n == 0.01


def robot_that_says(text, monkeypatch):
    """What a simulated robot is to its node that prints a text at once and stays for a while, or ends."""
    program = f"import os, time; os.write(1, {text.encode()!r}); time.sleep({60 if READY in text else 0})"

    def start(_, **options):
        return start_child([sys.executable, "-c", program], **options)

    monkeypatch.setattr(simulated_tip, "start_child", start)
    return PlantChild("127.0.1.1", Path("scene.yaml"), [0.0] * 6, 1, simulated_time=True)


def test_a_robot_that_says_more_than_that_it_is_ready_is_ready(monkeypatch):
    monkeypatch.setattr(simulated_tip, "START_WITHIN_S", 30.0)
    child = robot_that_says(f"a warning\n{READY} 127.0.1.1\n", monkeypatch)
    assert child.alive
    child.close()
    assert not child.alive
    assert child._process.stdout.closed


def test_what_a_robot_said_that_ended_is_named(monkeypatch):
    with pytest.raises(ValueError, match=r"no simulated robot at 127.0.1.1: port 30004 is taken"):
        robot_that_says("port 30004\nis taken\n", monkeypatch)
