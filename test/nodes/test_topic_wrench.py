# SPDX-License-Identifier: Apache-2.0
"""Wrenches of another ROS 2 driver, through a real topic."""

import contextlib
import os
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.nodes.conversions import time_message
from tactile_resonance.nodes.running import initialised
from tactile_resonance.nodes.topic_wrench import TopicWrench
from tactile_resonance.processes import free_domain_id

CONFIG = read_force_config(Path("topic.yaml"), force_n=0.01)
PATIENCE_S = 30.0


class Driver:
    """Publishes noise of 1 mN about 10 mN, as fast as it can up to 500 Hz, from a thread of its own."""

    def __init__(self, node):
        self._publisher = node.create_publisher(WrenchStamped, CONFIG.topic, 100)  # reliable
        self.offset_s = 0.0
        self.noise_n = 1e-3
        self.force_n = 0.01
        self.stamped = self.speaking = True
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self):
        self._ended.set()
        self._thread.join()

    def _run(self):
        rng = np.random.default_rng(1)
        while not self._ended.wait(0.002):
            if not self.speaking:
                continue
            message = WrenchStamped()
            stamp_ns = time.time_ns() + round(self.offset_s * 1e9)
            message.header.stamp = time_message(stamp_ns if self.stamped else 0)
            noise = self.noise_n * rng.standard_normal(3)
            message.wrench.force.x, message.wrench.force.y = noise[:2]
            message.wrench.force.z = self.force_n + noise[2]
            self._publisher.publish(message)


@pytest.fixture
def driver_and_source():
    with initialised(domain_id=free_domain_id(os.environ)):
        node = Node("topic_wrench_test")
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        spinning = threading.Thread(target=executor.spin)
        spinning.start()
        driver = Driver(node)
        # tests share their machine: slower to call the topic silent
        config = replace(CONFIG, limits=replace(CONFIG.limits, silent_s=1.0))
        source = TopicWrench(node, config)
        yield driver, source
        driver.end()
        source.close()
        executor.shutdown()
        spinning.join()
        node.destroy_node()


def read_until(source, count):
    """Samples in a row; begins anew where this machine stood still meanwhile."""
    deadline_s = time.monotonic() + PATIENCE_S
    samples = []
    while len(samples) < count:
        try:
            samples += source.read()
        except ForceError:
            assert time.monotonic() < deadline_s
            samples = []
            start(source)
        time.sleep(0.002)
    return samples


def start(source):
    """Start; again where this machine stood still meanwhile."""
    for _ in range(5):
        with contextlib.suppress(ForceError):
            return source.start()
    return source.start()


def faults_of(source):
    """Names of five faults on end: one that comes from a stall of this machine does not stay."""
    names = []
    deadline_s = time.monotonic() + PATIENCE_S
    while len(names) < 5 and time.monotonic() < deadline_s:
        try:
            source.read()
        except ForceError as error:
            names.append(error.fault)
            try:
                source.start()
            except ForceError as again:
                names.append(again.fault)
        time.sleep(0.002)
    return names


def test_wrenches_arrive_in_order_and_as_sent(driver_and_source):
    _, source = driver_and_source
    start(source)
    samples = read_until(source, 200)
    stamps = [sample.time_ns for sample in samples]
    assert stamps == sorted(set(stamps))
    mean = np.mean([sample.wrench for sample in samples], axis=0)
    np.testing.assert_allclose(mean, [0, 0, 0.01, 0, 0, 0], atol=5e-3 / np.sqrt(len(samples)))


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("speaking", False, ForceFault.SILENT),
        ("noise_n", 0.0, ForceFault.STUCK),
        ("stamped", False, ForceFault.INVALID),
        ("offset_s", -3.0, ForceFault.INVALID),
        ("offset_s", 3.0, ForceFault.INVALID),
        ("force_n", 6.0, ForceFault.OVERLOAD),
        ("force_n", float("nan"), ForceFault.INVALID),
    ],
)
def test_faults_are_named_and_end(driver_and_source, name, value, fault):
    driver, source = driver_and_source
    start(source)
    good = getattr(driver, name)
    setattr(driver, name, value)
    assert faults_of(source).count(fault) >= 3
    setattr(driver, name, good)
    time.sleep(0.1)
    start(source)
    read_until(source, 20)


def test_a_topic_on_which_nobody_speaks_is_silent(driver_and_source):
    driver, source = driver_and_source
    driver.speaking = False
    time.sleep(0.1)
    with pytest.raises(ForceError, match="no wrench within") as caught:
        source.start()
    assert caught.value.fault is ForceFault.SILENT
