# SPDX-License-Identifier: Apache-2.0
"""Which domain nodes are started in, which of them have ended, and threads of a process."""

import ctypes
import os
import platform
import socket
import subprocess
import sys
import threading
import time

import pytest
import yaml

from tactile_resonance.processes import (
    NodeProcesses,
    free_domain_id,
    hold_domain,
    loose_timers,
    may_take_priority,
    take_priority,
    thread_ids,
)


@pytest.mark.parametrize("participant", [0, 3, 119])
def test_a_domain_with_a_participant_left_is_not_chosen(participant):
    """Nodes of a run before may be ending; the first of them need not be the last."""
    chosen = free_domain_id({})
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as left:
        left.bind(("127.0.0.1", 7410 + 250 * chosen + 2 * participant))
        assert free_domain_id({}) != chosen
    assert free_domain_id({}) == chosen


def test_a_domain_that_another_process_is_about_to_use_is_not_chosen(monkeypatch):
    monkeypatch.setattr(os, "getpid", lambda: 4242)  # the search of both begins at the same number
    chosen = free_domain_id({})
    assert free_domain_id({}) == chosen  # by this process, again
    monkeypatch.setattr("tactile_resonance.processes._TAKEN", {})
    other = free_domain_id({})  # as by another
    assert other != chosen
    assert hold_domain(other) is None


def test_a_domain_that_is_given_is_taken():
    assert free_domain_id({"ROS_DOMAIN_ID": "7"}) == 7
    with pytest.raises(ValueError, match="ROS_DOMAIN_ID: '233', expected a number from 0 to 232"):
        free_domain_id({"ROS_DOMAIN_ID": "233"})


def told_of_ended(nodes, count):
    """What `check` reports once so many nodes have ended."""
    told = ""
    while told.count("ended with") < count:
        time.sleep(0.01)
        try:
            nodes.check()
        except RuntimeError as error:
            told = str(error)
    return told


def test_every_node_that_has_ended_is_named_with_its_last_line(tmp_path):
    with NodeProcesses(tmp_path, ("sh", "-c", "echo begun; echo cause; kill -9 $$")) as nodes:
        for node in ("poles_node", "frf_node"):
            nodes.start(node)
        told = told_of_ended(nodes, 2)
    ended = "ended with exit status -9: cause"
    assert told == f"frf_node {ended}; poles_node {ended}"


def test_a_node_that_draws_the_tip_back_as_it_ends_is_not_killed(tmp_path, monkeypatch):
    """The grace period begins when the node's own time to end is over."""
    monkeypatch.setattr("tactile_resonance.processes.GRACE_S", 0.0)
    script = "trap 'sleep 0.2; echo drawn back; exit' INT; echo begun; while :; do sleep 0.01; done"
    log = tmp_path / "contact_node.log"
    with NodeProcesses(tmp_path, ("sh", "-c", script)) as nodes:
        nodes.start("contact_node")
        while "begun" not in log.read_text():
            time.sleep(0.01)
    assert log.read_text() == "begun\ndrawn back\n"


def test_parameters_reach_a_node_as_they_are(tmp_path):
    texts = ("", "a: b", "on", "null", "1e3", "[x]", "# no comment", "it's \"so\"", "ü", "a folder/b")
    given = {f"text{k}": text for k, text in enumerate(texts)}
    given |= {"flag": True, "rate_hz": 2.5, "count": 3, "names": ["1", "on"]}
    with NodeProcesses(tmp_path, ("printf", "%s\\n")) as nodes:
        nodes.start("poles_node", {**given, "folder": tmp_path})
        told_of_ended(nodes, 1)
    words = (tmp_path / "poles_node.log").read_text().split("--ros-args\n")[1].split("\n")
    read = dict(word.split(":=", 1) for word in words if ":=" in word)
    assert {name: yaml.safe_load(text) for name, text in read.items()} == {**given, "folder": str(tmp_path)}


def test_nodes_that_compute_give_way_to_others(tmp_path):
    own = os.getpriority(os.PRIO_PROCESS, 0)
    with NodeProcesses(tmp_path, ("sh", "-c", "nice")) as nodes:
        nodes.bring_up(["contact_node", "poles_node"], niceness={"poles_node": 5})
        told_of_ended(nodes, 3)
    said = {node: int((tmp_path / f"{node}.log").read_text()) for node in ("contact_node", "poles_node")}
    assert said == {"contact_node": own, "poles_node": min(19, own + 5)}


@pytest.mark.skipif(sys.platform != "linux", reason="the slack of timers is known on Linux")
@pytest.mark.parametrize("priority", [0, 1])
def test_a_thread_keeps_the_slack_of_timers_with_which_it_was_started(priority):
    """Also where the one that starts it has real-time priority, and where it has that itself for a while."""
    if priority and not may_take_priority(priority):
        pytest.skip("real-time priority is not permitted")
    found, ends = [], threading.Event()

    def slack_ns():
        return ctypes.CDLL(None).prctl(30)  # PR_GET_TIMERSLACK, linux/prctl.h

    def start():
        if priority:
            take_priority(priority)
        before, threads = (slack_ns(), os.sched_getscheduler(0)), thread_ids()
        with loose_timers(3_000_000):
            thread = threading.Thread(target=lambda: ends.wait() and found.append(slack_ns()))
            thread.start()
        found.append((slack_ns(), os.sched_getscheduler(0)) == before)
        found.append(thread_ids() - threads == {thread.native_id})
        os.sched_setscheduler(thread.native_id, os.sched_getscheduler(0), os.sched_getparam(0))
        os.sched_setscheduler(thread.native_id, os.SCHED_OTHER, os.sched_param(0))
        ends.set()
        thread.join()

    starter = threading.Thread(target=start)  # its priority ends with it
    starter.start()
    starter.join()
    assert found == [True, True, 3_000_000]


MADE_AGAIN = """
import resource
import numpy as np
from tactile_resonance.processes import keep_memory

{0}
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [np.ones(2**17) for _ in range(16)]  # 16 MiB
    made = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    del arrays
print(made)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the allocator is that of glibc")
def test_memory_that_is_kept_is_not_mapped_anew():
    def pages(first):
        command = [sys.executable, "-c", MADE_AGAIN.format(first)]
        return int(subprocess.run(command, capture_output=True, check=True, text=True).stdout)

    assert pages("keep_memory()") < 100 < 1000 < pages("")
