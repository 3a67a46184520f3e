# SPDX-License-Identifier: Apache-2.0
"""How a node ends."""

import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")

import rclpy
from rclpy.lifecycle.node import LifecycleNodeMixin

from tactile_resonance.nodes import running
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import END_WITHIN_S, RCLError, initialised, run_node
from tactile_resonance.processes import free_domain_id


@pytest.fixture
def limits(monkeypatch):
    """What is to end the process that hangs: when, and what then; this one goes on after its node."""
    set_to = []

    def later(seconds, exit, file):
        assert exit
        set_to.append(seconds)

    monkeypatch.setattr(running, "faulthandler", SimpleNamespace(dump_traceback_later=later))
    return set_to


@pytest.fixture
def node(monkeypatch, limits, handlers):
    """What `run_node` is given; the test's own handlers of signals are put back."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain_id(os.environ)))
    return lambda: rclpy.create_node("ending")


def test_an_interrupt_that_meets_the_middleware_at_work_is_no_crash(node, monkeypatch, limits):
    def spin(_):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            # as pybind11 hands on what is raised while it converts a message
            raise RuntimeError("Unable to convert call argument '0'") from error

    monkeypatch.setattr(rclpy, "spin", spin)
    run_node(node)
    assert limits == [END_WITHIN_S]


def test_a_shutdown_that_meets_the_middleware_at_work_is_no_crash(node, monkeypatch, limits):
    """On SIGTERM rclpy shuts down in a thread of its own, and what the executor does then may fail."""

    def spin(_):
        signal.raise_signal(signal.SIGTERM)
        raise RCLError("failed to initialize wait set: the given context is not valid")

    monkeypatch.setattr(rclpy, "spin", spin)
    run_node(node)
    assert limits == [END_WITHIN_S]


def test_an_interrupt_that_meets_a_node_as_it_is_made_is_no_crash(node, monkeypatch, limits):
    """Within LifecycleNode: rclpy knows the node by then, and destroys it as it shuts down."""

    def begin(*_, **__):
        raise KeyboardInterrupt  # as the handler does, here before rclpy's own shuts down

    monkeypatch.setattr(LifecycleNodeMixin, "__init__", begin)
    run_node(lambda: ManagedNode("ending", ()))


def test_a_node_that_is_asked_to_end_and_hangs_is_ended(node, monkeypatch, limits):
    monkeypatch.setattr(rclpy, "spin", lambda _: signal.raise_signal(signal.SIGTERM))
    run_node(node)
    assert limits == [END_WITHIN_S]


def test_what_goes_wrong_without_an_interrupt_is_told(node, monkeypatch, limits):
    def spin(_):
        raise RuntimeError("a defect")

    monkeypatch.setattr(rclpy, "spin", spin)
    with pytest.raises(RuntimeError, match="a defect"):
        run_node(node)
    assert limits == []


def test_an_interrupt_shuts_ros_down_each_time_it_is_initialised(node):
    for _ in range(2):
        signal.signal(signal.SIGINT, signal.default_int_handler)  # run_node sets its own
        with initialised():
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            deadline = time.monotonic() + 60.0
            while rclpy.ok() and time.monotonic() < deadline:
                time.sleep(0.01)
            assert not rclpy.ok()


@pytest.mark.parametrize("further", [signal.SIGINT, signal.SIGTERM])
def test_further_signals_do_not_end_a_node_half_way(tmp_path, further):
    """Until the process has ended: people press Ctrl-C more than once, launch sends SIGTERM after 5 s."""
    ended = tmp_path / "ended"
    program = f"""
import time
from pathlib import Path
from rclpy.node import Node
from tactile_resonance.nodes.running import run_node

class Late:
    def __del__(self):  # called as the interpreter ends
        time.sleep(0.5)

class Slow(Node):
    late = Late()

    def __init__(self):
        super().__init__("slow")
        self.up = self.create_timer(0.01, self.say)

    def say(self):
        self.up.cancel()
        print("up", flush=True)

    def destroy_node(self):
        time.sleep(0.5)
        super().destroy_node()
        Path({str(ended)!r}).touch()

run_node(Slow)
"""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(free_domain_id(os.environ))}
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout.readline() == "up\n"
        process.send_signal(signal.SIGINT)
        while process.poll() is None:
            time.sleep(0.01)
            process.send_signal(further)
    assert process.returncode == 0
    assert ended.exists()


def test_a_node_that_hangs_with_the_interpreters_lock_is_ended_all_the_same():
    """As in the middleware, where another process was killed while it held the shared memory's lock."""
    program = """
import ctypes
from rclpy.node import Node
from tactile_resonance.nodes import running

class Hanging(Node):
    def __init__(self):
        super().__init__("hanging")
        print("up", flush=True)

    def destroy_node(self):
        ctypes.PyDLL(None).sleep(600)

running.END_WITHIN_S = 0.5
running.run_node(Hanging)
"""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(free_domain_id(os.environ))}
    command = [sys.executable, "-c", program]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes, env=environment) as process:
        try:
            assert process.stdout.readline() == "up\n"
            process.send_signal(signal.SIGTERM)
            _, errors = process.communicate(timeout=60.0)
        finally:
            process.kill()
    assert process.returncode == 1
    assert "in destroy_node" in errors  # where it hung


@pytest.mark.parametrize("opened", ["LiveListener(None)", "initialised()"])
def test_a_log_that_cannot_be_written_leaves_no_context_open(tmp_path, opened):
    """An open one that is dropped ends Python with a segmentation fault at a later interrupt."""
    program = f"""
import rclpy
from tactile_resonance.nodes.client import LiveListener
from tactile_resonance.nodes.running import RCLError, initialised

context = rclpy.Context()
rclpy.Context = lambda: context
try:
    with {opened}:
        print("opened")
except RCLError as error:
    print(error)
print(context.ok() or rclpy.ok())
"""
    (tmp_path / "file").touch()
    environment = {**os.environ, "ROS_DOMAIN_ID": str(free_domain_id(os.environ))}
    environment["ROS_LOG_DIR"] = str(tmp_path / "file" / "log")
    command = [sys.executable, "-c", program]
    told = subprocess.check_output(command, text=True, env=environment).splitlines()
    assert "log directory" in told[0]
    assert told[-1] == "False"
