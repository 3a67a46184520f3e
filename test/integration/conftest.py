# SPDX-License-Identifier: Apache-2.0
"""Nodes as real processes in a domain of their own, on loopback."""

import contextlib
import os
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")


@contextlib.contextmanager
def _fresh_domain():
    """Environment of a domain that no other test has, also none of this process."""
    from tactile_resonance.processes import domain_is_free, hold_domain

    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
        for step in range(100):
            number = 1 + (os.getpid() + step) % 100
            if domain_is_free(number) and (held := hold_domain(number)):
                stack.enter_context(held)
                break
        else:
            raise RuntimeError("no ROS domain is free")
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield number


@pytest.fixture
def domain():
    """Environment of a fresh domain; processes started from here inherit it."""
    with _fresh_domain() as number:
        yield number


@pytest.fixture(scope="module")
def module_domain():
    """The same for nodes that the tests of one file share: starting them takes longer than most tests."""
    with _fresh_domain() as number:
        yield number


@pytest.fixture(scope="session")
def demonstration(tmp_path_factory):
    """A whole demo that nothing disturbs."""
    pytest.importorskip("rtde_control", reason="ur-rtde is not here")
    sys.path.insert(0, str(Path(__file__).parent))
    from demonstrated import undisturbed

    with _fresh_domain() as number:
        return undisturbed(tmp_path_factory.mktemp("demonstration"), number)


@pytest.fixture(scope="module")
def bench(module_domain, tmp_path_factory):
    """contact_node on a simulated robot, for the tests of one file."""
    sys.path.insert(0, str(Path(__file__).parent))
    from contact_rig import Bench

    made = Bench(tmp_path_factory.mktemp("log"))
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def client(bench):
    """Of the contact_node of `bench`, which has nothing under way."""
    from contact_rig import ContactClient

    bench.recover()
    with ContactClient(bench.nodes.check) as made:
        made.back()
        if bench.order("state")["runtime_state"] != "PLAYING":  # a stop while nothing was under way
            made.wait(lambda: made.retract().success, 60.0, "the arm's program to be started again")
            made.idle()
        bench.let_pass(1.5)  # a device that is still dead then is connected anew
        made.back()
        yield made
