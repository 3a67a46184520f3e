# SPDX-License-Identifier: Apache-2.0
"""Where a scan without a robot puts the tip, as the bench takes it up."""

import os
import threading

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor

from tactile_resonance.nodes.fake_hardware_node import FakeHardwareNode
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import initialised
from tactile_resonance.nodes.scan_hands import NodeHands
from tactile_resonance.nodes.scan_time import ScanTime
from tactile_resonance.processes import free_domain_id
from tactile_resonance.scan.scan_point import ScanPoint
from tactile_resonance.scan.scene import Hold
from test.spinning import spin_until

PLACE_M = (0.004, -0.003, 0.0)


class Scanning(ManagedNode):
    def __init__(self):
        super().__init__("scan_node", ())

    def configure(self):
        scan_time = ScanTime("", 60.0)
        self.hands = NodeHands(self, "base", False, scan_time, lambda _: None)


def test_a_bench_discovered_after_the_scan_began_takes_up_the_first_place():
    # names of its own: any other subscriber of tcp_pose would be taken for the bench
    own = ["--ros-args", "-r", f"__ns:=/hands_{os.getpid()}"]
    with initialised(args=own, domain_id=free_domain_id(os.environ)):
        executor = SingleThreadedExecutor()
        nodes = []

        def start(kind):
            nodes.append(kind())
            nodes[-1].trigger_configure()
            nodes[-1].trigger_activate()
            executor.add_node(nodes[-1])
            return nodes[-1]

        try:
            hands = start(Scanning).hands
            point = ScanPoint(0, PLACE_M, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
            touch = threading.Thread(target=hands.touch, args=(point, 0.01, Hold.FORCE, lambda: None))
            with hands.listening():
                touch.start()
                assert not spin_until(executor, lambda: not touch.is_alive(), 0.5)
                bench = start(FakeHardwareNode)
                assert spin_until(executor, lambda: not touch.is_alive())
            touch.join()
            spin_until(executor, lambda: bench._stays.newest.pose.pose.position.x != 0.0, 1.0)
            taken = bench._stays.newest.pose.pose.position
            assert (taken.x, taken.y, taken.z) == PLACE_M
        finally:
            for node in nodes:
                node.destroy_node()
