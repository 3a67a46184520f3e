# SPDX-License-Identifier: Apache-2.0
"""The truth of a contact that creeps is the mean over the record, as an estimate has it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from geometry_msgs.msg import PoseStamped

from tactile_resonance.nodes.truth_topic import TruthTopic
from tactile_resonance.simulation.bench import SimulatedBench
from tactile_resonance.simulation.bench_tip import BenchTip
from tactile_resonance.simulation.library import read_tissues
from tactile_resonance.simulation.truth import truth_of


def test_truth_of_a_contact_that_creeps_is_its_mean():
    bench, tissue = SimulatedBench.from_configuration(), read_tissues()["cortex"]
    tip, told = BenchTip(tissue, 0.01, 0.3, creeping=True), []
    node = SimpleNamespace(publish_on=lambda *_: SimpleNamespace(publish=told.append))
    topic = TruthTopic(node, bench, "tip")
    topic.publish(PoseStamped(), tip, over_s=3.2)
    topic.publish(PoseStamped(), replace(tip, since_s=0.3 + 1.6))
    over, middle = told
    each = []
    for part in (np.arange(400) + 0.5) / 400:
        modes = truth_of(replace(tip, since_s=0.3 + 3.2 * part).coupled(bench), ()).modes
        each.append([(mode.f0_hz, mode.damping_ratio, mode.pole_rad_s.imag) for mode in modes])
    means = np.mean(each, axis=0).T
    np.testing.assert_allclose([over.f0_hz, over.damping_ratio, over.imag_rad_s], means, rtol=1e-6)
    near = int(np.argmin(np.abs(means[0] - 250)))
    assert over.f0_hz[near] - middle.f0_hz[near] > 0.03  # it slows down
