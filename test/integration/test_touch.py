# SPDX-License-Identifier: Apache-2.0
"""A table that stands elsewhere than the scan believes is found by touch; normals too; with robot and cell."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from robot_at_hand import own_host, own_time
from scipy.spatial.transform import Rotation
from tactile_resonance.action import Scan

from tactile_resonance.client import Ending
from tactile_resonance.commands.bench_scan import NODES
from tactile_resonance.nodes.client import HANGS_S, ScanClient
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE

SURFACE = """surface:
  touch: {points_m: [[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]], form: plane}
"""
SCENE = f"""
name: tilted table
force_n: 0.01
regions:
  - {{name: gelatine 12 %, gelatine_percent: 12.0, box: {{low_m: [-0.1, -0.1], high_m: [0.1, 0.1]}}}}
{SURFACE}positions:
  list: [[0.004, -0.003]]
precision: {{f0_std_hz: 0.02}}
blocks: {{least: 2, most: 4}}
"""
HOST, TIME = own_host(7), own_time(7)
# turned to the tilt that was found, away from the surface
TILT_RAD, LIFT_M = np.array([0.035, -0.025, 0.0]), 1e-3


@pytest.mark.slow
def test_a_tilted_table_is_found_by_touch(domain, tmp_path):
    scene, run_path = tmp_path / "tilted.yaml", tmp_path / "run"
    scene.write_text(SCENE)
    told = np.array(TABLE_IN_BASE)
    believed = Rotation.from_rotvec(told[3:])
    tilt = Rotation.from_rotvec(TILT_RAD)  # in the frame of the scene
    true = np.concatenate([told[:3] + [0.0, 0.0, LIFT_M], (believed * tilt).as_rotvec()])
    with NodeProcesses(tmp_path / "log") as nodes, ScanClient(nodes.check) as client:
        nodes.bring_up(NODES, parameters_of(tmp_path, scene, true))
        client.wait_until_up(HANGS_S)
        result = client.scan(
            5 * HANGS_S, scene=scene, run_directory=run_path, notes="{tip_wetness: wet}"
        )
        assert result.ending is Ending.COMPLETE, result.message
        assert result.done == 1, read_run(run_path).latest[0].reason
        # gone on with, there is nothing left to do and nothing is touched again
        phases = []
        again = client.scan(
            HANGS_S,
            run_directory=run_path,
            resume=True,
            on_feedback=lambda feedback: phases.append(feedback.phase),
        )
        assert (again.ending, again.done) == (Ending.COMPLETE, 1)
        assert Scan.Feedback.PHASE_SURFACE not in phases
    run = read_run(run_path)
    assert run.facts["notes"] == {"tip_wetness": "wet"}
    assert len(run.facts["surface"]["touches"]) == 4
    # contact_node has told how the sensor is used, and it is clear of what was touched
    left_out = [entry["what"] for entry in run.facts["skipped"]]
    assert not [what for what in left_out if "housing" in what or what.startswith("the point")]
    normal = tilt.as_matrix()[:, 2]
    (point,) = run.points
    x, y, z = point.position_m
    true_height = LIFT_M - (normal[0] * x + normal[1] * y) / normal[2]
    # a touch of soft tissue is known to a tenth of a millimetre, over 20 mm the tilt to half a degree
    assert z == pytest.approx(true_height, abs=1.5e-4)
    assert np.arccos(np.clip(np.array(point.normal) @ normal, -1, 1)) < 0.009
    assert np.arccos(normal[2]) > 0.04
    (measured,) = run.latest
    assert measured.force_n == pytest.approx(0.01, abs=5e-4)
    assert np.isfinite(measured.f0_hz)


def parameters_of(tmp_path, scene, true):
    """Of nodes where the table stands elsewhere than the scan believes."""
    parameters = {
        "fake_hardware_node": {"scene": scene, "robot_host": HOST, "table_in_base": listed(true)},
        "excitation_node": {"record_folder": tmp_path / "records"},
        "contact_node": {"robot_host": HOST, "force_host": HOST},
        "scan_node": {"table_in_base": listed(TABLE_IN_BASE), "goal_folders": [str(tmp_path)]},
    }
    for node in parameters.values():
        node["time_server"] = TIME
    return parameters


def listed(pose):
    return [float(value) for value in pose]


@pytest.mark.slow
def test_normal_of_a_point_is_found_by_touches_around_it(domain, tmp_path):
    scene, run_path = tmp_path / "normals.yaml", tmp_path / "run"
    asked = SCENE.replace(SURFACE, "normals: {touches: 4}\n")
    assert asked != SCENE
    scene.write_text(asked)
    told = np.array(TABLE_IN_BASE)
    tilt = Rotation.from_rotvec([0.1, -0.12, 0.0])
    true = np.concatenate([told[:3], (Rotation.from_rotvec(told[3:]) * tilt).as_rotvec()])
    with NodeProcesses(tmp_path / "log") as nodes, ScanClient(nodes.check) as client:
        nodes.bring_up(NODES, parameters_of(tmp_path, scene, true))
        client.wait_until_up(HANGS_S)
        result = client.scan(5 * HANGS_S, scene=scene, run_directory=run_path)
        assert result.ending is Ending.COMPLETE, result.message
        assert result.done == 1, read_run(run_path).latest[0].reason
    run = read_run(run_path)
    (found,), (point,) = run.facts["normals"], run.points
    assert len(found["touches"]) == 4
    assert found["normal"] == list(point.normal)
    normal = tilt.as_matrix()[:, 2]
    off = np.arccos(np.clip(np.array(point.normal) @ normal, -1, 1))
    assert off < 4 * found["std_rad"] < 0.12
    assert off < 0.3 * np.arccos(normal[2])
