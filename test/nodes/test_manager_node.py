# SPDX-License-Identifier: Apache-2.0
"""Nodes are brought up one after the other, each as soon as the one before it has answered."""

import os

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")

from lifecycle_msgs.msg import State
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from spinning import spin_until

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
    log, names, appeared = [], ["first", "second", "third"], []
    on_start_of = ManagerNode._on_start_of
    monkeypatch.setattr(
        ManagerNode,
        "_on_start_of",
        lambda manager, node: (appeared.append(node.name), on_start_of(manager, node)),
    )
    arguments = ["--ros-args", "-p", f"manager_node:nodes:=[{','.join(names)}]"]
    with initialised(args=arguments, domain_id=free_domain_id(os.environ)):
        manager, nodes = ManagerNode(), [Managed(name, log) for name in names]
        executor = SingleThreadedExecutor()
        for node in (manager, *nodes):
            executor.add_node(node)

        asked = [client for each in manager._nodes for client in (each.get, each.change)]
        assert spin_until(
            executor,
            lambda: (
                sorted(appeared) == names and all(client.service_is_ready() for client in asked)
            ),
            WITHIN_S,
        )
        manager._tick()
        up = spin_until(
            executor,
            lambda: all(each.state == State.PRIMARY_STATE_ACTIVE for each in manager._nodes),
            WITHIN_S,
        )
        for node in executor.get_nodes():
            node.destroy_node()
    assert up, log
    assert log == [(step, name) for name in names for step in ("configure", "activate")]


def test_what_a_node_does_by_itself_is_followed_without_a_look(monkeypatch):
    monkeypatch.setattr(manager_node, "LOOK_S", 3600.0)
    log = []
    arguments = ["--ros-args", "-p", "manager_node:nodes:=[first]"]
    with initialised(args=arguments, domain_id=free_domain_id(os.environ)):
        executor = SingleThreadedExecutor()
        manager = ManagerNode()
        executor.add_node(manager)

        def came_up(node, times):
            def up():
                return log.count(("activate", "first")) == times and manager._was_up

            return spin_until(executor, up, WITHIN_S) and node.state_name() == "active"

        node = Managed("first", log)
        executor.add_node(node)
        assert came_up(node, 1), log
        node.fail("told to")
        assert came_up(node, 2), log
        executor.remove_node(node)
        node.destroy_node()
        node = Managed("first", log)  # started anew
        executor.add_node(node)
        assert came_up(node, 3), log
        for each in executor.get_nodes():
            each.destroy_node()


def test_a_transition_whose_answer_is_lost_does_not_hold_up_the_others(monkeypatch):
    monkeypatch.setattr(manager_node, "STATE_WITHIN_S", 0.5)
    lost = []
    ask = ManagerNode._ask

    def ask_and_lose_one(manager, node, client, request, now_s):
        ask(manager, node, client, request, now_s)
        if client is node.change and not lost:
            lost.append(node.pending)
            node.pending = Future()  # the node does as it is told, and nobody hears of it

    monkeypatch.setattr(ManagerNode, "_ask", ask_and_lose_one)
    log, names = [], ["first", "second"]
    arguments = ["--ros-args", "-p", f"manager_node:nodes:=[{','.join(names)}]"]
    arguments += ["-p", "manager_node:answer_timeout_s:=600.0"]
    with initialised(args=arguments, domain_id=free_domain_id(os.environ)):
        executor = SingleThreadedExecutor()
        manager = ManagerNode()
        executor.add_node(manager)
        for name in names:
            executor.add_node(Managed(name, log))
        assert spin_until(executor, lambda: manager._was_up, WITHIN_S), log
        assert log == [(step, name) for name in names for step in ("configure", "activate")]
        assert lost
        for each in executor.get_nodes():
            each.destroy_node()
