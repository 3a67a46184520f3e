# SPDX-License-Identifier: Apache-2.0
"""Whether the node behind a topic is at work, through the real graph and its diagnostics."""

import os
import time

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from tactile_resonance.nodes import stream_nodes
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import initialised
from tactile_resonance.nodes.stream_nodes import StreamNodes
from tactile_resonance.processes import free_domain_id
from tactile_resonance.scan.hands import NodeAway

WITHIN_S = 20.0


class Listener(ManagedNode):
    def __init__(self):
        super().__init__("scan_node", ())

    def configure(self):
        self.nodes = StreamNodes(self, ("poles",))


class Source(ManagedNode):
    def __init__(self):
        super().__init__("poles_node", ())

    def configure(self):
        self.publish_on(String, "poles", 10)


@pytest.fixture
def nodes(monkeypatch):
    """The listener, and something that spins until a condition holds, or for so long."""
    monkeypatch.setattr(stream_nodes, "FRESH_S", 2.5)
    with initialised(domain_id=free_domain_id(os.environ)):
        executor = SingleThreadedExecutor()
        listener = Listener()
        listener.trigger_configure()
        listener.trigger_activate()
        executor.add_node(listener)

        def wait(holds, within_s=WITHIN_S):
            deadline_s = time.monotonic() + within_s
            while not holds() and time.monotonic() < deadline_s:
                executor.spin_once(0.05)
            return holds()

        yield listener.nodes, executor, wait
        for node in executor.get_nodes():
            node.destroy_node()


def test_a_node_is_at_work_only_while_it_says_so(nodes):
    stream, executor, wait = nodes
    assert stream.missing() == "poles: nobody publishes it"
    source = Source()
    executor.add_node(source)
    source.trigger_configure()  # from here on the publisher is in the graph
    assert wait(lambda: stream.missing() == "poles: /poles_node is not active")
    source.trigger_activate()
    assert wait(lambda: stream.missing() is None)
    # what was told before it was lost is not believed any more; what it tells then is
    with pytest.raises(NodeAway), stream.doubted_after(NodeAway):
        raise NodeAway("it is another")
    assert stream.missing() == "poles: /poles_node is not active"
    assert wait(lambda: stream.missing() is None)
    # killed: its publisher stays in the graph, and it tells nothing
    executor.remove_node(source)
    assert wait(lambda: stream.missing() == "poles: /poles_node is not active")
    source.destroy_node()


def test_somebody_elses_node_that_tells_nothing_is_believed(nodes):
    stream, executor, wait = nodes
    other = Node("identification", namespace="elsewhere")
    other.create_publisher(String, "/poles", 10)
    executor.add_node(other)
    assert wait(lambda: stream.missing() is None)
