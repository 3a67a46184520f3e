# SPDX-License-Identifier: Apache-2.0
"""What nodes do not load: each that is started pays for it, and on a small machine all wait for all."""

import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

HARDWARE = (
    *("excitation_node", "frf_node", "poles_node", "contact_node", "scan_node"),
    *("pole_map_node", "manager_node", "scan_goal"),
)
"""All nodes but the simulated bench."""
STREAM = ("frf_node", "poles_node", "excitation_node", "contact_node", "manager_node", "scan_node")
HEAVY = ("scipy.stats", "scipy.optimize", "scipy.interpolate", "matplotlib", "numba")
COMPILED = ("poles_node", "contact_node")
"""What numba compiles: fits of poles, the filter of the control loop."""
LOADED = """
import sys
for name in sys.argv[1:]:
    __import__(f"tactile_resonance.nodes.{name}")
print(*sys.modules)
"""


def loaded_by(nodes):
    command = [sys.executable, "-c", LOADED, *nodes]
    return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())


def test_nodes_of_the_stream_load_no_statistics_figures_or_compiler():
    assert loaded_by([node for node in STREAM if node not in COMPILED]).isdisjoint(HEAVY)
    assert loaded_by(COMPILED).isdisjoint(set(HEAVY) - {"numba"})


def test_what_only_plays_loads_no_scipy():
    """Its first subpackage takes as long to import as all else of that node."""
    found = loaded_by(("excitation_node",))
    assert "tactile_resonance.multisine" in found
    assert not [name for name in found if name.startswith("scipy.")]


def test_nodes_of_the_hardware_load_nothing_of_the_simulation():
    found = loaded_by(HARDWARE)
    assert "tactile_resonance.sensor" in found
    assert not [name for name in found if name.startswith("tactile_resonance.simulation")]


def test_what_plays_and_measures_loads_nothing_of_scenes_and_runs():
    found = loaded_by(("excitation_node", "frf_node", "poles_node", "contact_node"))
    assert "tactile_resonance.nodes.goals" in found
    assert found.isdisjoint({f"tactile_resonance.scan.{name}" for name in ("scene", "plan", "run_content")})


def test_the_bench_loads_nothing_of_the_robot_that_it_starts():
    found = loaded_by(("fake_hardware_node",))
    assert "tactile_resonance.simulation.sensor.bench" in found
    assert found.isdisjoint({*HEAVY, "scipy.spatial", "tactile_resonance.simulation.plant.simulated_robot"})
