# SPDX-License-Identifier: Apache-2.0
"""The truth of a contact that creeps is the mean over the record, as an estimate has it."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from geometry_msgs.msg import PoseStamped

from tactile_resonance.nodes.simulated_tip import truth_message
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
