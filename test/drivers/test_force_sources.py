# SPDX-License-Identifier: Apache-2.0
"""From configuration to the force at the tip."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.drivers.force_sources import force_source
from tactile_resonance.simulation.cell.transducer import CellParameters

sys.path.insert(0, str(Path(__file__).parent))


def test_the_tip_feels_what_presses_on_the_cell_under_the_sample():
    """10 mN down on the cell, through CAN, is +10 mN along the normal at a tilted tip."""
    pytest.importorskip("can", reason="python-can is not installed")
    from cell_bench import CellBench

    # the surface's normal is tilted by 0.1 rad about y; the force on the cell is against it
    state = ArmSample(0, 0.0, (0.3, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0,) * 6)
    normal = state.tip.rotation.apply([0, 0, 1])
    quiet = CellParameters("quiet", 5000.0, 1e5, 1e-3, 5e-5, 5.0, 0.3)
    bench = CellBench(quiet, (*(-0.01 * normal), 0.0, 0.0, 0.0))
    source = force_source(
        bench.config(), SimpleNamespace(recent=lambda: state, clock=bench.clock)
    )
    try:
        source.start()
        samples = bench.go(source, 1000)
    finally:
        source.close()
        bench.close()
    force = np.array([sample.force_n for sample in samples])
    assert force.shape == (1000, 3)
    np.testing.assert_allclose(force.mean(axis=0), [0, 0, 0.01], atol=5 * 1e-3 / np.sqrt(1000))


def test_a_topic_needs_a_node():
    with pytest.raises(ValueError, match="topic is for nodes only"):
        force_source(read_force_config(Path("topic.yaml")), None)
