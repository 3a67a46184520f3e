# SPDX-License-Identifier: Apache-2.0
"""How a node ends."""

import os
import signal
import time

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")

import rclpy

from tactile_resonance.nodes.running import initialised, run_node


@pytest.fixture
def node(monkeypatch):
    """What `run_node` is given; the test's own handler of interrupts is put back."""
    from tactile_resonance.processes import free_domain_id

    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain_id(os.environ)))
    before = signal.getsignal(signal.SIGINT)
    yield lambda: rclpy.create_node("ending")
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_that_meets_the_middleware_at_work_is_no_crash(node, monkeypatch):
    def spin(_):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            # as pybind11 hands on what is raised while it converts a message
            raise RuntimeError("Unable to convert call argument '0'") from error

    monkeypatch.setattr(rclpy, "spin", spin)
    run_node(node)


def test_what_goes_wrong_without_an_interrupt_is_told(node, monkeypatch):
    def spin(_):
        raise RuntimeError("a defect")

    monkeypatch.setattr(rclpy, "spin", spin)
    with pytest.raises(RuntimeError, match="a defect"):
        run_node(node)


def test_an_interrupt_shuts_ros_down_each_time_it_is_initialised(node):
    for _ in range(2):
        signal.signal(signal.SIGINT, signal.default_int_handler)  # run_node sets its own
        with initialised():
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            deadline = time.monotonic() + 10.0
            while rclpy.ok() and time.monotonic() < deadline:
                time.sleep(0.01)
            assert not rclpy.ok()
