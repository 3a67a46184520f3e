# SPDX-License-Identifier: Apache-2.0
"""From the bench to the map, all nodes as processes, and a reader who comes late."""

import time

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from robot_at_hand import own_time
from sensor_msgs.msg import PointCloud2
from tactile_resonance.action import Measure

from tactile_resonance.configuration import share_path
from tactile_resonance.nodes.running import LATCHED
from tactile_resonance.nodes.scan_session import ScanSession
from tactile_resonance.processes import NodeProcesses

NODES = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node", "pole_map_node")
TIME = own_time(16)
PLACES = ((-0.01, -0.01, 0.0), (0.002, -0.001, 0.0), (0.01, 0.01, 0.0))


def test_measured_points_are_on_the_map(domain, tmp_path):
    scene = share_path("config/scenes/inclusion_scan.yaml")
    parameters = {
        "fake_hardware_node": {"scene": scene, "time_server": TIME},
        "excitation_node": {"record_folder": tmp_path / "records", "time_server": TIME},
        "pole_map_node": {"classes_file": scene},
    }
    with NodeProcesses(tmp_path / "log") as nodes, ScanSession(nodes.check) as session:
        nodes.bring_up(NODES, parameters)
        session.wait_for_nodes(30.0)
        session.warm_up(PLACES[0], 30.0)
        found = [
            session.measure(place, Measure.Goal(periods=4, seed=5), lambda *_: None)
            for place in PLACES
        ]
        rows = late_reader(len(PLACES))
    expected = [result.poles.f0_hz[0] for result in found]
    order = np.argsort(rows["x"])
    np.testing.assert_allclose(rows["f0_hz"][order], expected, rtol=1e-6)
    np.testing.assert_allclose(
        np.stack([rows["x"], rows["y"], rows["z"]], axis=1)[order], PLACES, atol=1e-9
    )
    assert list(rows["tissue_class"][order]) == [0, 1, 0]
    assert np.all(rows["force_n"] == np.float32(0.01))


def late_reader(count, timeout_s=20.0):
    """Rows of the latched cloud, once it has `count` points."""
    context, heard = rclpy.Context(), []
    rclpy.init(context=context)
    node = rclpy.create_node("late_reader", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        node.create_subscription(PointCloud2, "pole_map", heard.append, LATCHED)
        deadline = time.monotonic() + timeout_s
        while not (heard and heard[-1].width == count) and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert [m.width for m in heard][-1:] == [count]
    cloud = heard[-1]
    kinds = ["<f4" if f.datatype == f.FLOAT32 else "u1" for f in cloud.fields]
    names, offsets = [f.name for f in cloud.fields], [f.offset for f in cloud.fields]
    dtype = {"names": names, "formats": kinds, "offsets": offsets, "itemsize": cloud.point_step}
    return np.frombuffer(bytes(cloud.data), np.dtype(dtype))
