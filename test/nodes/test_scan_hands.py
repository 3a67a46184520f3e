# SPDX-License-Identifier: Apache-2.0
"""The hands of a scan, and its time over benches that end and are started anew."""

import contextlib
import math
import os
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from robot_at_hand import own_time

from tactile_resonance import msg
from tactile_resonance.clock import Demand, SimulatedClock
from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import HoldMode
from tactile_resonance.nodes import scan_hands
from tactile_resonance.nodes.contact_node import ContactNode
from tactile_resonance.nodes.fake_hardware_node import BenchServer, FakeHardwareNode
from tactile_resonance.nodes.managed_node import HUNG_AFTER, TIME_SERVER, ManagedNode
from tactile_resonance.nodes.messages import poles_to_message
from tactile_resonance.nodes.node_watch import SILENT_S, ScanTime
from tactile_resonance.nodes.parameters import Fixed
from tactile_resonance.nodes.running import BEATS, RESULTS, initialised
from tactile_resonance.nodes.scan_hands import NodeHands
from tactile_resonance.nodes.tip_contact import UNKNOWN, TipContact
from tactile_resonance.poles.result import Poles
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Contact, Origin
from tactile_resonance.scan.clearance import Standoffs
from tactile_resonance.scan.failures import PointDisturbed, PointFailed, SurfaceEarly
from tactile_resonance.scan.measurement import design_measurement
from tactile_resonance.scan.point_outcome import StateTimes
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.scene import ScanScene
from tactile_resonance.scan.surface import Plane
from test.spinning import spin_until

PLACE_M = (0.004, -0.003, 0.0)
COMMON = (Fixed("base_frame", "base", "."), TIME_SERVER, HUNG_AFTER)


class Scanning(ManagedNode):
    def __init__(self):
        super().__init__("scan_node", (Fixed("contact", "none", "."), *COMMON))

    def configure(self):
        self.hands = NodeHands(self, lambda _: None)


@pytest.fixture
def alone():
    """Nodes under names of their own: any other subscriber of tcp_pose would be taken for the bench."""
    own = ["--ros-args", "-r", f"__ns:=/hands_{os.getpid()}"]
    with initialised(args=own, domain_id=free_domain_id(os.environ)):
        executor = SingleThreadedExecutor()
        nodes = []

        def start(kind):
            nodes.append(kind())
            nodes[-1].trigger_configure()
            nodes[-1].trigger_activate()
            executor.add_node(nodes[-1])
            return nodes[-1]

        try:
            yield SimpleNamespace(start=start, executor=executor)
        finally:
            for node in nodes:
                node.destroy_node()


def test_a_bench_discovered_after_the_scan_began_takes_up_the_first_place(alone):
    hands = alone.start(Scanning).hands
    point = ScanPoint(0, PLACE_M, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    touch = threading.Thread(target=hands.touch, args=(point, 0.01, HoldMode.FORCE, lambda: None))
    with hands.listening():
        touch.start()
        assert not spin_until(alone.executor, lambda: not touch.is_alive(), 0.5)
        bench = alone.start(FakeHardwareNode)
        assert spin_until(alone.executor, lambda: not touch.is_alive())
    touch.join()
    spin_until(alone.executor, lambda: bench._touch.stays.newest.pose.pose.position.x != 0.0, 1.0)
    taken = bench._touch.stays.newest.pose.pose.position
    assert (taken.x, taken.y, taken.z) == PLACE_M


def test_a_measurement_at_an_unknown_place_is_disturbed_one_without_poles_has_failed(
    alone, monkeypatch
):
    hands = alone.start(Scanning).hands
    design = design_measurement(ScanScene("a", 0.01, (PLACE_M,)))
    came = []
    monkeypatch.setattr(hands._measure, "measure", lambda *_: came[-1] if came else None)
    monkeypatch.setattr(hands, "missing", lambda: None)

    def measure():
        recording = SimpleNamespace()
        return hands.measure(design, "", 1, lambda poles, blocks: True, recording, lambda: None)

    with hands.listening():
        with pytest.raises(PointFailed, match="ended before its first block"):
            measure()
        nowhere = Origin()
        came.append(poles_to_message(Poles(), nowhere))
        with pytest.raises(PointDisturbed, match="place of the tip is unknown"):
            measure()
        there = replace(nowhere, contact=Contact(position_m=PLACE_M, frame_id="base"))
        came.append(poles_to_message(Poles(), there))
        assert measure().origin.contact.position_m == PLACE_M
        assert math.isnan(measure().contact_age_s)  # nobody touched anything
        # since the first touch, in the middle of what the poles rest on
        hands._tip = SimpleNamespace(
            touched_ns=5_000_000_000, touching=True, stopped=False, check=print
        )
        pressing = replace(there, time_ns=6_500_000_000)
        pressing = replace(pressing, contact=replace(there.contact, force_n=0.01, force_std_n=0.0))
        came.append(poles_to_message(Poles(), pressing))
        assert measure().contact_age_s == pytest.approx(1.5)
        hands._tip = None


class Tip:
    """In place of contact_node: the surface is where its `off_m` says, or too early."""

    def __init__(self):
        self.off_m, self.early_below_m, self.tissue_moves_m, self.stopped = 1e-4, 0.0, 0.0, False
        self.asked_m = []

    def hold(self, pose, force_n, hold, check, standoff_m=math.inf):
        self.asked_m.append(standoff_m)
        if standoff_m <= self.early_below_m:
            raise SurfaceEarly("contact: surface_early")
        return SimpleNamespace(surface_m=self.off_m, surface_std_m=2e-5)

    def retract(self):
        return 0.0


def test_points_beside_each_other_are_begun_low_until_the_surface_is_met_too_early(alone):
    hands = alone.start(Scanning).hands
    with hands.listening():
        tip = hands._tip = Tip()
        hands.standoffs = Standoffs(Plane())

        def touch(x_m):
            point = ScanPoint(0, (x_m, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
            hands.touch(point, 0.01, HoldMode.FORCE, lambda: None)
            hands.retract()

        for x_m in (0.0, 5e-3, 10e-3):
            touch(x_m)
        assert tip.asked_m[0] == math.inf
        assert 7e-4 < tip.asked_m[2] < tip.asked_m[1] < 2e-3
        touch(40e-3)
        assert tip.asked_m[3] == math.inf
        tip.early_below_m = 1.0
        touch(45e-3)  # refused low, made from the usual standoff
        assert tip.asked_m[4] < 2e-3
        assert tip.asked_m[5:] == [math.inf]
        touch(50e-3)
        assert tip.asked_m[6:] == [math.inf]
        tip.early_below_m = math.inf
        with pytest.raises(PointFailed, match="surface_early"):
            touch(55e-3)
        tip.early_below_m = 0.0
        hands.standoffs = Standoffs(Plane())
        for moves_m, known in ((2e-5, True), (2e-4, False)):
            tip.tissue_moves_m = moves_m
            for x_m in (0.0, 5e-3):
                touch(x_m)
            assert math.isfinite(tip.asked_m[-1]) == known
        hands._tip = None


def test_a_touch_of_a_surface_is_repeated_with_a_contact_node_that_was_started_anew(alone):
    node = alone.start(Scanning)
    other = Node("contact_node", namespace=node.get_namespace())
    alone.executor.add_node(other)
    other.create_publisher(msg.ContactState, "contact_state", RESULTS)
    beats = other.create_publisher(msg.Heartbeat, "heartbeat", BEATS)
    name, hands, attempts = other.get_fully_qualified_name(), node.hands, []

    def beat(instance):
        beats.publish(msg.Heartbeat(node=name, state="active", instance=instance))
        return bool(hands._nodes.instances(["contact_state"]))

    def touch(pose, force_n, check):
        attempts.append(None)
        while len(attempts) == 1:  # until the restart is noticed
            check()
        ends = patience()
        while beats.get_subscription_count() and len(found) < 5:  # and from then on it is at work
            check()
            ends()
            found.append(None)
        return SimpleNamespace(surface_m=1e-4, surface_std_m=2e-5, force_n=force_n)

    found = []
    point = ScanPoint(0, PLACE_M, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    with hands.listening():
        hands._tip = SimpleNamespace(touch=touch, stopped=False)
        assert spin_until(alone.executor, lambda: beat(1))
        search = threading.Thread(
            target=lambda: found.append(hands.find(point, 0.01, 1e-3, patience()))
        )
        search.start()
        assert spin_until(alone.executor, lambda: attempts)
        assert spin_until(alone.executor, lambda: beat(2) and not search.is_alive())
        search.join()
        hands._tip = None
    assert found[-1].ball_m[2] == pytest.approx(1.1e-3)


GIVEN = {"beam_tilt_rad": 0.2, "limits.depth_m": 3.5e-3, "contact.standoff_m": 4e-3}
GIVEN_AS = ["--ros-args", *(word for k, v in GIVEN.items() for word in ("-p", f"{k}:={v}"))]


class Asker(ManagedNode):
    def __init__(self):
        super().__init__("scan_node", (Fixed("contact", "robot", "."), *COMMON))

    def configure(self):
        self.hands = NodeHands(self, print)


@pytest.fixture
def ask(monkeypatch):
    """What is told beside a node of a kind."""
    monkeypatch.setattr(scan_hands, "ANSWERED_WITHIN_S", 2.0)
    with initialised(args=GIVEN_AS, domain_id=free_domain_id(os.environ)):
        executor, made = SingleThreadedExecutor(), []

        def told(make):
            made.extend([Asker(), make()])
            made[0].trigger_configure()
            told = []
            thread = threading.Thread(target=lambda: told.append(made[0].hands.tip_use("bimorph")))
            for node in made:
                executor.add_node(node)
            thread.start()
            while thread.is_alive():
                executor.spin_once(0.05)
            return told[0], made[1]

        yield told
        for node in made:
            node.destroy_node()


def test_figures_are_those_of_contact_node(ask):
    use, node = ask(ContactNode)
    settings = node._settings
    settings.read()
    assert use.tip == TipGeometry(beam_tilt_rad=0.2)
    assert use.limits.depth_m == 3.5e-3
    assert use.parameters.standoff_m == 4e-3
    for name in scan_hands.TIP_LIMITS:
        assert getattr(use.limits, name) == getattr(settings.limits, name)
    for name in scan_hands.TIP_PARAMETERS:
        assert getattr(use.parameters, name) == getattr(settings.parameters, name)


@pytest.mark.parametrize("name", ["contact_node", "another"])
def test_nothing_is_told_by_another_node(ask, name):
    assert ask(lambda: Node(name))[0] is None


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

        def follow(goal, check):
            for n in (1, 2, 3):
                clock.hold(begun_ns + n * BLOCK_NS, Demand.FAST)
                clock.wait_told(check)
                assert stands(scan)
            return "reached"

        goals = SimpleNamespace(send=lambda goal, check: goal, follow=follow)
        assert tip._sent(goals, "goal", ends) == "reached"


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
