# SPDX-License-Identifier: Apache-2.0
"""Nodes are brought up one after the other, each as soon as the one before it has answered."""

import os

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")

from lifecycle_msgs.msg import State
from rclpy.executors import SingleThreadedExecutor

from tactile_resonance.nodes import manager_node
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.manager_node import ManagerNode
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id
from test.spinning import spin_until


class Managed(ManagedNode):
    """Notes when it comes up."""

    def __init__(self, name, log):
        super().__init__(name, ())
        self._log = log

    def configure(self):
        self._log.append(("configure", self.get_name()))

    def activate(self):
        self._log.append(("activate", self.get_name()))


class Stack:
    """A manager without a timer of its own, and the nodes that it manages, in one executor."""

    def __init__(self, *names):
        self.log = []
        self.manager = ManagerNode()
        self.nodes = {name: Managed(name, self.log) for name in names}
        self._executor = SingleThreadedExecutor()
        for node in (self.manager, *self.nodes.values()):
            self._executor.add_node(node)

    def spin_until(self, done):
        return spin_until(self._executor, done)

    def bring_up(self):
        """One tick of the manager once it knows all nodes; whether all came up."""
        managed = self.manager._nodes
        asked = [client for each in managed for client in (each.get, each.change)]
        assert self.spin_until(lambda: all(client.service_is_ready() for client in asked))
        self.manager._tick()
        return self.spin_until(
            lambda: all(each.state == State.PRIMARY_STATE_ACTIVE for each in managed)
        )

    def close(self):
        for node in self._executor.get_nodes():
            node.destroy_node()


@pytest.fixture
def stack(monkeypatch):
    monkeypatch.setattr(manager_node, "TICK_S", 3600.0)
    monkeypatch.setattr(manager_node, "QUIET_S", 3600.0)
    names = ("first", "second", "third")
    arguments = ["--ros-args", "-p", f"manager_node:nodes:=[{','.join(names)}]"]
    with initialised(args=arguments, domain_id=free_domain_id(os.environ)):
        made = Stack(*names)
        yield made
        made.close()


def test_one_tick_brings_all_up_in_order(stack):
    assert stack.bring_up(), stack.log
    assert stack.log == [(step, name) for name in stack.nodes for step in ("configure", "activate")]


def test_that_all_are_active_is_logged_once(stack, monkeypatch):
    """Where the events of the last node come before the answers to what it was asked."""
    logged, late = [], []
    logger = type(stack.manager.get_logger())
    monkeypatch.setattr(logger, "info", lambda _, text, **__: logged.append(text))
    managed, hear = stack.manager._nodes[-1], ManagerNode._hear

    def hear_late(manager, node, answer):
        if node is managed and node.client is node.change:
            late.append(answer)
        else:
            hear(manager, node, answer)

    monkeypatch.setattr(ManagerNode, "_hear", hear_late)
    last = stack.nodes["third"]
    assert stack.spin_until(lambda: last.count_subscribers("third/transition_event") == 1)
    asked = [client for each in stack.manager._nodes for client in (each.get, each.change)]
    assert stack.spin_until(lambda: all(client.service_is_ready() for client in asked))
    stack.manager._tick()
    for state in (State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE):
        assert stack.spin_until(lambda: late and managed.state == state), stack.log  # noqa: B023
        hear(stack.manager, managed, late.pop())
    assert stack.spin_until(lambda: managed.pending is None)
    assert logged == ["all active: first, second, third"]


def test_a_node_that_is_deactivated_and_cleaned_up_at_once_is_held(stack):
    """No question of the manager falls in between; the node publishes its transitions."""
    assert stack.bring_up(), stack.log
    # once it is known that the events are heard; the newest question may still be under way
    managed, node = stack.manager._nodes[1], stack.nodes["second"]
    assert stack.spin_until(lambda: node.count_subscribers("second/transition_event") == 1)
    del stack.log[:]
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert stack.spin_until(lambda: managed.state == State.PRIMARY_STATE_UNCONFIGURED)
    assert managed.held
    for _ in range(2):  # asked, it is unconfigured, and is not brought up again
        stack.manager._tick()
        assert stack.spin_until(lambda: managed.pending is None)
    assert stack.log == []
    assert managed.held


def test_it_looks_seldom_once_all_are_up_and_often_while_one_is_not(stack, monkeypatch):
    monkeypatch.setattr(manager_node, "QUIET_S", 7200.0)
    often, seldom = 3600 * 10**9, 7200 * 10**9

    def periods_ns():
        return {timer.timer_period_ns for timer in stack.manager.timers}

    assert often in periods_ns()
    assert stack.bring_up(), stack.log
    assert stack.spin_until(lambda: seldom in periods_ns())
    assert often not in periods_ns()
    node = stack.nodes["second"]
    assert stack.spin_until(lambda: node.count_subscribers("second/transition_event") == 1)
    node.trigger_deactivate()
    assert stack.spin_until(lambda: often in periods_ns())
    assert seldom not in periods_ns()
