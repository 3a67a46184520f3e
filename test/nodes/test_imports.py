# SPDX-License-Identifier: Apache-2.0
"""What nodes do not load: each that is started pays for it, and on a small machine all wait for all."""

import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

HEAVY = ("scipy.stats", "matplotlib", "numba", "tactile_resonance.simulation.bimorph")
LOADED = """
import sys
for name in ("frf_node", "poles_node", "excitation_node", "contact_node", "manager_node", "scan_node"):
    __import__(f"tactile_resonance.nodes.{name}")
print(*(name for name in sys.argv[1:] if name in sys.modules))
"""


def test_nodes_of_the_stream_load_no_statistics_figures_compiler_or_simulated_sensor():
    answer = subprocess.run(
        [sys.executable, "-c", LOADED, *HEAVY], capture_output=True, text=True, check=True
    )
    assert answer.stdout.split() == []
