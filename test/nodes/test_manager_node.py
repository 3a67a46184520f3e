# SPDX-License-Identifier: Apache-2.0
"""Nodes are brought up one after the other, each as soon as the one before it has answered."""

import os
import time

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")

from lifecycle_msgs.msg import State
from rclpy.executors import SingleThreadedExecutor

from tactile_resonance.nodes import manager_node
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.manager_node import ManagerNode
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id

WITHIN_S = 10.0


class Managed(ManagedNode):
    """Notes when it comes up."""

    def __init__(self, name, log):
        super().__init__(name, ())
        self._log = log

    def configure(self):
        self._log.append(("configure", self.get_name()))

    def activate(self):
        self._log.append(("activate", self.get_name()))


def test_one_tick_brings_all_up_in_order(monkeypatch):
    monkeypatch.setattr(manager_node, "TICK_S", 3600.0)
    log, names = [], ["first", "second", "third"]
    arguments = ["--ros-args", "-p", f"manager_node:nodes:=[{','.join(names)}]"]
    with initialised(args=arguments, domain_id=free_domain_id(os.environ)):
        manager, nodes = ManagerNode(), [Managed(name, log) for name in names]
        executor = SingleThreadedExecutor()
        for node in (manager, *nodes):
            executor.add_node(node)

        def spin_until(done):
            deadline_s = time.monotonic() + WITHIN_S
            while not done() and time.monotonic() < deadline_s:
                executor.spin_once(0.05)
            return done()

        asked = [client for each in manager._nodes for client in (each.get, each.change)]
        assert spin_until(lambda: all(client.service_is_ready() for client in asked))
        manager._tick()
        up = spin_until(
            lambda: all(each.state == State.PRIMARY_STATE_ACTIVE for each in manager._nodes)
        )
        for node in executor.get_nodes():
            node.destroy_node()
    assert up, log
    assert log == [(step, name) for name in names for step in ("configure", "activate")]
