# SPDX-License-Identifier: Apache-2.0
"""Wrenches of another ROS 2 driver, through a real topic, on a clock that is told."""

import math
import os
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from dataclasses import replace
from pathlib import Path

from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from spinning import spin_until

from tactile_resonance.contact.cell_checks import samples_until_stuck
from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.running import initialised
from tactile_resonance.nodes.topic_wrench import EARLIEST_S, FIRST_WITHIN_S, LATEST_S, TopicWrench
from tactile_resonance.processes import free_domain_id

CONFIG = replace(read_force_config(Path("topic.yaml"), force_n=0.01), latency_s=0.003)
SILENT_S = CONFIG.limits.silent_s
AHEAD_NS = 1_700_000_000 * 10**9  # ROS time less the clock's


class Link:
    """A driver, the source that hears it, and the clock of both."""

    def __init__(self, monkeypatch):
        self.now_ns = 3_600 * 10**9
        clock = SimpleNamespace(
            simulated=False,
            now_ns=lambda: self.now_ns,
            own_ns=lambda ros_ns: ros_ns - AHEAD_NS,
        )
        self._heard, takes = [], TopicWrench._on_wrench

        def take(source, message):
            takes(source, message)
            self._heard.append(message)

        monkeypatch.setattr(TopicWrench, "_on_wrench", take)
        self.rng = np.random.default_rng(1)
        self.node = Node("topic_wrench_test")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._publisher = self.node.create_publisher(WrenchStamped, CONFIG.topic, 100)  # reliable
        self.source = TopicWrench(self.node, CONFIG, clock)
        self.source.start()
        self.wait(lambda: self._publisher.get_subscription_count() == 1)

    def wait(self, holds):
        assert spin_until(self._executor, holds)

    def close(self):
        self.source.close()
        self.node.destroy_node()

    def send(self, count=1, *, force_n=0.01, noise_n=1e-3, stamp_ns=None, later_ns=2_000_000, frame=""):
        """Send wrenches, the clock going on before each; returns what was sent."""
        sent = []
        for _ in range(count):
            self.now_ns += later_ns
            message = WrenchStamped()
            stamp = self.now_ns + AHEAD_NS if stamp_ns is None else stamp_ns
            message.header.stamp, message.header.frame_id = time_message(stamp), frame
            noise = noise_n * self.rng.standard_normal(3)
            force, torque = message.wrench.force, message.wrench.torque
            force.x, force.y, force.z = *noise[:2], force_n + noise[2]
            torque.x, torque.z = 0.01, 0.03
            heard = len(self._heard)
            self._publisher.publish(message)
            self.wait(lambda heard=heard: len(self._heard) > heard)
            sent.append((self.now_ns, (force.x, force.y, force.z, 0.01, 0.0, 0.03)))
        return sent


@pytest.fixture
def link(monkeypatch):
    with initialised(domain_id=free_domain_id(os.environ)):
        made = Link(monkeypatch)
        yield made
        made.close()


def test_wrenches_arrive_in_order_as_sent_and_dated_when_they_were_measured(link):
    sent = link.send(20)
    samples = link.source.read()
    assert [sample.wrench for sample in samples] == [wrench for _, wrench in sent]
    assert [sample.time_ns for sample in samples] == [at - 3_000_000 for at, _ in sent]
    assert not any(sample.overload for sample in samples)
    assert link.source.read() == []


STUCK = samples_until_stuck(CONFIG)


@pytest.mark.parametrize(
    ("count", "how", "fault", "text"),
    [
        (STUCK, {"noise_n": 0.0}, ForceFault.STUCK, "equal on all axes"),
        (1, {"stamp_ns": 0}, ForceFault.INVALID, "its messages have no time stamp"),
        (2, {"stamp_ns": 3_600 * 10**9 + AHEAD_NS + 2_000_000}, ForceFault.INVALID, "do not incr"),
        (3, {"force_n": 6.0}, ForceFault.OVERLOAD, "3 samples beyond the range; Fz is 6"),
        (1, {"force_n": math.nan}, ForceFault.INVALID, "Fz is not finite"),
    ],
)
def test_faults_are_named_stay_and_end_with_a_new_start(link, count, how, fault, text):
    if count > 1:
        link.send(count - 1, **how)
        link.source.read()  # not one too early
    link.send(**how)
    for _ in range(2):
        with pytest.raises(ForceError, match=text) as caught:
            link.source.read()
        assert caught.value.fault is fault
    link.send(5)
    with pytest.raises(ForceError, match=text):
        link.source.read()
    link.source.start()
    if count > 1:
        link.send(count - 1, **how)  # what was before does not count
    link.send(5)
    assert len(link.source.read()) == count - 1 + 5


def test_two_sensors_on_one_topic_are_not_taken_for_one(link):
    link.send(3, frame="cell")
    link.send(frame="wrist", force_n=0.03)
    with pytest.raises(ForceError, match="in 'cell' and in 'wrist': do two sensors") as caught:
        link.source.read()
    assert caught.value.fault is ForceFault.INVALID
    link.source.start()
    link.send(3, frame="wrist")
    assert len(link.source.read()) == 3


@pytest.mark.parametrize(
    ("age_s", "taken"),
    [(0.99 * LATEST_S, True), (1.01 * LATEST_S, False), (3.0, False)]
    + [(-0.9 * EARLIEST_S, True), (-1.1 * EARLIEST_S, False), (-3.0, False)],
)
def test_stamps_of_another_clock_are_refused(link, age_s, taken):
    link.send(stamp_ns=link.now_ns + 2_000_000 + AHEAD_NS - round(age_s * 1e9))
    if taken:
        assert len(link.source.read()) == 1
        return
    with pytest.raises(ForceError, match="are the clocks of both machines synchronised") as caught:
        link.source.read()
    assert caught.value.fault is ForceFault.INVALID
    assert f"is {age_s:.3g} s old" in str(caught.value)


def test_a_topic_that_falls_silent_is_said_to_be_so_after_its_limit(link):
    link.send(3)
    link.now_ns += round(0.99 * SILENT_S * 1e9)
    assert len(link.source.read()) == 3  # what came counts, also where it is read late
    assert link.source.read() == []
    link.now_ns += round(0.02 * SILENT_S * 1e9)
    with pytest.raises(ForceError, match=r"topic wrench_raw: silent for 20 ms") as caught:
        link.source.read()
    assert caught.value.fault is ForceFault.SILENT


def test_a_topic_on_which_nobody_speaks_is_silent_two_seconds_after_the_start(link):
    link.source.start()
    link.now_ns += round(0.99 * FIRST_WITHIN_S * 1e9)
    assert link.source.read() == []
    link.now_ns += round(0.02 * FIRST_WITHIN_S * 1e9)
    with pytest.raises(ForceError, match="silent for 2020 ms") as caught:
        link.source.read()
    assert caught.value.fault is ForceFault.SILENT
    # a driver that comes up later is heard from the next start on
    link.send(2)
    link.source.start()
    link.send(2)
    assert len(link.source.read()) == 2


def test_what_is_not_listened_to_is_not_read(link):
    link.send(2)
    link.source.close()
    link.send(2)
    with pytest.raises(ForceError, match="topic wrench_raw: not started") as caught:
        link.source.read()
    assert caught.value.fault is ForceFault.LINK_LOST
