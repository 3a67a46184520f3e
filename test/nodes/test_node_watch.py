# SPDX-License-Identifier: Apache-2.0
"""Whether nodes are at work: judged on a clock set by the test, and through the real graph."""

import os
from functools import partial
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from spinning import spin_until
from std_msgs.msg import String

from tactile_resonance.nodes import node_watch
from tactile_resonance.nodes.managed_node import BEAT_S, ManagedNode
from tactile_resonance.nodes.node_watch import SAID_AFTER_S, SILENT_S, NodeWatch
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id
from tactile_resonance.scan.failures import NodeAway

SOURCE = "/poles_node"


class Graph:
    """What `NodeWatch` asks of its node: who publishes what; and the signs of life that it is told."""

    def __init__(self, publishers):
        self.publishers = publishers
        self.beat = None

    def listen(self, kind, topic, callback, qos):
        self.beat = lambda node, state="active", instance=1, waiting_for="": callback(
            kind(node=node, state=state, instance=instance, waiting_for=waiting_for)
        )

    def resolve_topic_name(self, topic):
        return f"/{topic}"

    def get_publishers_info_by_topic(self, topic):
        names = self.publishers.get(topic, [])
        return [
            SimpleNamespace(
                node_namespace=name.rpartition("/")[0] or "/", node_name=name.split("/")[-1]
            )
            for name in names
        ]


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on when it is told."""
    told = SimpleNamespace(now_s=1000.0)
    told.monotonic = lambda: told.now_s
    monkeypatch.setattr(node_watch, "time", told)
    return told


@pytest.fixture
def watch(clock):
    made = SimpleNamespace(graph=Graph({"/poles": [SOURCE]}), clock=clock)
    made.nodes = NodeWatch(made.graph, ("poles",), SILENT_S)
    made.graph.beat(SOURCE)
    made.instances = made.nodes.instances(["poles"])
    assert made.instances == {SOURCE: 1}
    assert made.nodes.missing() is made.nodes.changed(made.instances) is None
    return made


def test_a_node_that_hangs_is_noticed_within_the_limit_and_not_before(watch):
    assert SILENT_S + BEAT_S < 2.0  # what is promised on hardware
    watch.clock.now_s += SILENT_S - 0.01
    assert watch.nodes.changed(watch.instances) is None
    watch.clock.now_s += 0.02
    assert watch.nodes.changed(watch.instances) == f"{SOURCE} is silent for 1.5 s"
    assert watch.nodes.missing() == f"poles: {SOURCE} is silent for 1.5 s"
    watch.graph.beat(SOURCE)
    assert watch.nodes.missing() is watch.nodes.changed(watch.instances) is None


def test_a_node_that_hangs_until_its_lease_ends_is_still_named(watch):
    assert watch.nodes.hung() == ""
    watch.graph.publishers["/poles"] = []
    assert watch.nodes.hung() == ""
    watch.clock.now_s += SILENT_S + 0.01
    assert watch.nodes.hung() == f"{SOURCE} is silent for 1.5 s"


def test_a_node_that_was_deactivated_is_said_to_be_so_and_not_to_hang(watch):
    for _ in range(20):
        watch.clock.now_s += BEAT_S
        watch.graph.beat(SOURCE, "inactive")
        assert watch.nodes.changed(watch.instances) == f"{SOURCE} is inactive, not active"
        assert watch.nodes.held()
    assert watch.nodes.waited_for(watch.instances) == ""
    watch.clock.now_s += SILENT_S + 0.1  # it was deactivated, and has ended since
    assert not watch.nodes.held()
    watch.graph.beat(SOURCE, "unconfigured")
    assert not watch.nodes.held()
    watch.graph.beat(SOURCE)
    assert watch.nodes.changed(watch.instances) is None


def test_a_node_that_was_started_anew_is_another(watch):
    watch.graph.beat(SOURCE, instance=2)
    assert watch.nodes.missing() is None
    assert watch.nodes.changed(watch.instances) == f"{SOURCE} was restarted"
    assert watch.nodes.changed(watch.nodes.instances(["poles"])) is None


def test_what_a_node_waits_for_counts_from_when_it_began_to(watch):
    def beats(seconds, waiting_for):
        for _ in range(round(seconds / BEAT_S)):
            watch.clock.now_s += BEAT_S
            watch.graph.beat(SOURCE, waiting_for=waiting_for)

    beats(SILENT_S - 0.1, "the arm")
    beats(SILENT_S - 0.1, "")
    beats(SILENT_S - 0.1, "the arm")  # twice shorter than the limit is not longer than it
    assert watch.nodes.changed(watch.instances) is None
    beats(0.6, "the arm")
    assert watch.nodes.changed(watch.instances).startswith(f"{SOURCE} waits for the arm, which is")
    assert watch.nodes.waited_for(watch.instances) == ""
    beats(SAID_AFTER_S, "the arm")
    assert watch.nodes.waited_for(watch.instances) == f"{SOURCE}, which waits for the arm"
    beats(0.2, "")
    assert watch.nodes.waited_for(watch.instances) == ""
    watch.clock.now_s += SAID_AFTER_S + 1.0
    assert watch.nodes.waited_for(watch.instances) == f"{SOURCE}, silent for 6 s"


def test_one_publisher_at_work_is_enough_and_all_others_are_named(watch):
    watch.graph.publishers["/poles"] = [SOURCE, "/robot/other"]
    watch.graph.beat("/robot/other", "inactive")
    assert watch.nodes.missing() is None
    watch.graph.beat(SOURCE, "unconfigured")
    assert watch.nodes.missing() == (
        f"poles: {SOURCE} is unconfigured, not active and /robot/other is inactive, not active"
    )
    watch.graph.publishers["/poles"] = []
    assert watch.nodes.missing() == "poles: no node publishes it"


def test_after_an_error_only_what_is_told_from_then_on_is_believed(watch):
    with pytest.raises(NodeAway), watch.nodes.doubted_after(NodeAway):
        raise NodeAway("it is another")
    assert watch.nodes.missing() == f"poles: {SOURCE} has given no sign of life again yet"
    watch.graph.beat(SOURCE)
    assert watch.nodes.missing() is None
    with pytest.raises(ValueError, match="else"), watch.nodes.doubted_after(NodeAway):
        raise ValueError("something else")
    assert watch.nodes.missing() is None


class Listener(ManagedNode):
    def __init__(self):
        super().__init__("scan_node", ())

    def configure(self):
        self.nodes = NodeWatch(self, ("poles",), SILENT_S)


class Source(ManagedNode):
    hangs = False

    def __init__(self):
        super().__init__("poles_node", ())

    def configure(self):
        self.publish_on(String, "poles", 10)

    def working(self):
        return not self.hangs


@pytest.fixture
def nodes(monkeypatch):
    """A watch in the real graph, the executor, something that spins until a condition holds, and the clock."""
    told = SimpleNamespace(now_s=1000.0)
    told.monotonic = lambda: told.now_s
    monkeypatch.setattr(node_watch, "time", told)
    with initialised(domain_id=free_domain_id(os.environ)):
        executor = SingleThreadedExecutor()
        listener = Listener()
        listener.trigger_configure()
        listener.trigger_activate()
        executor.add_node(listener)

        yield listener.nodes, executor, partial(spin_until, executor), told
        for node in executor.get_nodes():
            node.destroy_node()


def is_up(watch):
    """A node that was never heard counts as at work; this one was."""
    return bool(watch.instances(["poles"])) and watch.missing() is None


def heard_anew(watch, wait):
    """Wait for a sign of life that was sent from now on."""
    before = watch._signs[SOURCE].heard_s
    return wait(lambda: watch._signs[SOURCE].heard_s > before)


def test_signs_of_life_tell_how_a_node_is(nodes):
    watch, executor, wait, clock = nodes
    assert watch.missing() == "poles: no node publishes it"
    source = Source()
    executor.add_node(source)
    source.trigger_configure()  # from here on the publisher is in the graph
    assert wait(lambda: watch.missing() == f"poles: {SOURCE} is inactive, not active")
    source.trigger_activate()
    assert wait(lambda: watch.missing() is None)
    instances = watch.instances(["poles"])
    # somebody deactivates it: it beats on, and is not said to hang however long that lasts
    source.trigger_deactivate()
    assert wait(lambda: watch.changed(instances) == f"{SOURCE} is inactive, not active")
    clock.now_s += 2 * SILENT_S
    assert heard_anew(watch, wait)
    assert watch.changed(instances) == f"{SOURCE} is inactive, not active"
    source.trigger_activate()
    assert wait(lambda: watch.changed(instances) is None)


def test_a_node_whose_work_does_not_move_on_gives_no_sign_of_life(nodes):
    watch, executor, wait, clock = nodes
    source = Source()
    executor.add_node(source)
    source.trigger_configure()
    source.trigger_activate()
    assert wait(lambda: is_up(watch))
    asked = []
    source.working = lambda: bool(
        asked.append(None)
    )  # false: its thread hangs, the executor does not
    assert wait(lambda: len(asked) > 5)  # what was sent before has come by then
    clock.now_s += SILENT_S + 0.1
    assert wait(lambda: len(asked) > 10)
    assert watch.missing() == f"poles: {SOURCE} is silent for 1.6 s"


def test_each_start_of_a_node_is_another_instance(nodes):
    watch, executor, wait, _ = nodes
    seen = []
    for _ in range(2):
        source = Source()
        executor.add_node(source)
        source.trigger_configure()
        source.trigger_activate()
        assert wait(lambda: is_up(watch))
        assert not seen or wait(lambda: watch.changed(seen[0]) == f"{SOURCE} was restarted")
        seen.append(watch.instances(["poles"]))
        executor.remove_node(source)
        source.destroy_node()


def test_somebody_elses_node_that_tells_nothing_is_believed(nodes):
    watch, executor, wait, clock = nodes
    other = Node("identification", namespace="elsewhere")
    other.create_publisher(String, "/poles", 10)
    executor.add_node(other)
    assert wait(lambda: watch.missing() is None)
    clock.now_s += 10 * SILENT_S
    assert watch.missing() is None
