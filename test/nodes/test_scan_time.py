# SPDX-License-Identifier: Apache-2.0
"""The time of a scan over benches that end and are started anew."""

import contextlib
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from robot_at_hand import own_time

from tactile_resonance.clock import Demand, SimulatedClock
from tactile_resonance.nodes.fake_hardware_node import BenchServer
from tactile_resonance.nodes.node_watch import SILENT_S
from tactile_resonance.nodes.scan_time import ScanTime
from tactile_resonance.nodes.tip_contact import UNKNOWN, TipContact
from tactile_resonance.scan.point_outcome import StateTimes

SERVER = own_time(41)
BLOCK_NS = 400_000_000


@contextlib.contextmanager
def device():
    """A bench, and a device of it that hands over blocks."""
    with contextlib.closing(BenchServer(SERVER)):
        clock = SimulatedClock(SERVER, "device", hands_over=True)
        with contextlib.closing(clock):
            yield clock


def patience(seconds=60.0):
    """To be called while waiting: fails where a wait does not end."""
    end_s = time.monotonic() + seconds

    def check():
        assert time.monotonic() < end_s, "time does not go on"

    return check


def stands(scan):
    """Whether time stands while this machine's goes on."""
    before_s = scan.now_s()
    time.sleep(0.1)
    return scan.now_s() == before_s


def test_while_a_scan_conducts_each_go_lets_one_block_pass():
    scan = ScanTime(SERVER, 60.0)
    assert scan.simulated
    assert scan.silent_s == 60.0
    with device() as clock:
        with scan.conducted():
            assert stands(scan)
            begun_ns = clock.ask_ns()
            for n in (1, 2, 3):
                scan.go()
                clock.hold(begun_ns + n * BLOCK_NS, Demand.FAST)
                clock.wait_told(patience())
                assert stands(scan)
                assert round(scan.now_s() * 1e9) == begun_ns + n * BLOCK_NS
            clock.free()
        begun_ns, begun_s = clock.ask_ns(), time.monotonic()
        while clock.ask_ns() == begun_ns:  # nobody conducts: at its own pace
            assert time.monotonic() < begun_s + 60.0


def test_blocks_of_somebody_else_do_not_stop_the_time_of_a_contact():
    scan, ends = ScanTime(SERVER, 60.0), patience()
    tip = TipContact.__new__(TipContact)
    tip._time, tip._times, tip._state, tip.touching = scan, StateTimes(), UNKNOWN, False
    with device() as clock, scan.conducted():
        begun_ns = clock.ask_ns()

        def follow(goal, check, poll):
            for n in (1, 2, 3):
                clock.hold(begun_ns + n * BLOCK_NS, Demand.FAST)
                clock.wait_told(lambda: (ends(), poll()))
                assert stands(scan)
            return "reached"

        goals = SimpleNamespace(send=lambda goal, check, poll: goal, follow=follow)
        assert tip._sent(goals, "goal", ends, lambda: None) == "reached"


def test_time_of_a_scan_never_goes_back_though_a_bench_begins_anew():
    scan = ScanTime(SERVER, 60.0)
    with scan.conducted():  # no bench yet: tried again by `go`
        assert scan.now_s() == 0.0
        last_s = 0.0
        for _ in range(2):
            with device() as clock:
                scan.go()
                clock.wait_until(clock.ask_ns() + BLOCK_NS, Demand.FAST)
                now_s = scan.now_s()
                assert round(now_s * 1e9) >= round(last_s * 1e9) + BLOCK_NS
                last_s = now_s
            assert scan.now_s() == last_s  # the bench has ended
            scan.go()


def test_a_port_in_use_is_refused_and_free_again_once_closed():
    with device(), pytest.raises(ValueError, match=SERVER.partition(":")[0]):
        BenchServer(SERVER)
    BenchServer(SERVER).close()


def test_on_the_wall_clock_a_scan_has_this_machines_time():
    scan = ScanTime("", 60.0)
    with scan.conducted():
        scan.go()
        scan.seed(1)
        assert scan.silent_s == SILENT_S
        before_s = time.monotonic()
        assert before_s <= scan.now_s() <= time.monotonic()
