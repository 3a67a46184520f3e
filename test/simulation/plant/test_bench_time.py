# SPDX-License-Identifier: Apache-2.0
"""Simulated time: it goes on as far as everybody lets it, whoever is late, gone, or conducts."""

import contextlib
import itertools
import math
import threading
import time
from types import SimpleNamespace

import pytest

from tactile_resonance.clock import (
    ENDLESS_NS,
    MESSAGE,
    ClockLostError,
    Demand,
    SimulatedClock,
    ToBench,
    time_address,
)
from tactile_resonance.simulation.plant import bench_time
from tactile_resonance.simulation.plant.bench_time import START_NS, BenchTime
from tactile_resonance.simulation.ur5e.reactor import Reactor

HOST = "127.0.6.7"
PATIENCE_S = 60.0
STEP_NS = 2_000_000


class Bench:
    """A bench that only counts its steps, run by a thread."""

    def __init__(self):
        self.reactor = Reactor(HOST)
        self.time = BenchTime(self.reactor, STEP_NS, simulated=True)
        self.port = self.reactor.listen(0, self.time.serve)
        self.stepped_ns = []
        self.time.steps.append(lambda: self.stepped_ns.append(self.time.now_ns))
        self._thread = threading.Thread(target=self.time.run)
        self._clocks = contextlib.ExitStack()

    def join(self, name, **how):
        clock = SimulatedClock(f"{HOST}:{self.port}", name, **how)
        self._clocks.callback(clock.close)
        return clock

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._clocks.close()
        self.time.stop()
        self._thread.join()
        self.reactor.close()


@pytest.fixture
def bench():
    with Bench() as made:
        yield made


@pytest.fixture
def conductor(bench):
    """Without one time goes on by itself, at the pace of real time."""
    return bench.join("conductor", conducts=True)


def stands(clock, seconds=0.1):
    """Whether time stands while this machine's goes on; what it then is."""
    before = clock.ask_ns()
    time.sleep(seconds)
    return clock.ask_ns() == before, before


def goes_on(clock):
    """Wait until time has gone on."""
    before, end_s = clock.ask_ns(), time.monotonic() + PATIENCE_S
    while clock.ask_ns() == before:
        assert time.monotonic() < end_s, "time stands"
        time.sleep(0.01)


def test_it_begins_above_zero_and_goes_on_by_itself_at_the_pace_of_real_time():
    with Bench() as bench:
        clock = bench.join("anybody")
        begun_ns, begun_s = clock.ask_ns(), time.monotonic()
        assert begun_ns >= START_NS > 0
        time.sleep(0.3)
        goes_on(clock)
        passed_s = (clock.ask_ns() - begun_ns) * 1e-9
        assert passed_s <= time.monotonic() - begun_s + 2 * STEP_NS * 1e-9
        assert passed_s > 0


def test_it_comes_exactly_to_where_somebody_wants_it_and_stands_there(bench, conductor):
    clock = bench.join("loop")
    begun_ns = clock.ask_ns()
    for n in range(1, 50):
        clock.wait_until(begun_ns + n * STEP_NS)
        assert clock.now_ns() == begun_ns + n * STEP_NS
    assert stands(clock) == (True, begun_ns + 49 * STEP_NS)
    # between two steps it is the next one
    clock.wait_until(begun_ns + 50 * STEP_NS + 1)
    assert clock.now_ns() == begun_ns + 51 * STEP_NS


def test_the_slowest_decides(bench, conductor):
    quick, slow = bench.join("quick"), bench.join("slow")
    begun_ns = quick.ask_ns()
    slow.hold(begun_ns + 10 * STEP_NS, Demand.NONE)
    waited = threading.Thread(target=lambda: quick.wait_until(begun_ns + 100 * STEP_NS))
    waited.start()
    time.sleep(0.1)
    assert slow.ask_ns() == begun_ns + 10 * STEP_NS
    slow.free()
    waited.join(PATIENCE_S)
    assert quick.now_ns() == begun_ns + 100 * STEP_NS


def test_whoever_goes_away_holds_nothing(bench, conductor):
    quick, dying = bench.join("quick"), bench.join("dying")
    begun_ns = quick.ask_ns()
    dying.hold(begun_ns, Demand.NONE)
    assert stands(quick)[0]
    dying.close()
    quick.wait_until(begun_ns + STEP_NS)
    assert quick.now_ns() == begun_ns + STEP_NS


def test_while_somebody_conducts_it_stands_unless_it_is_needed(bench, conductor):
    clock = bench.join("arm")
    assert stands(clock)[0]
    begun_ns, begun_s = clock.ask_ns(), time.monotonic()
    clock.free(Demand.REAL)
    goes_on(clock)
    clock.free(Demand.NONE)
    passed_s = (clock.ask_ns() - begun_ns) * 1e-9
    assert 0 < passed_s <= time.monotonic() - begun_s + 2 * STEP_NS * 1e-9
    assert stands(clock)[0]
    conductor.close()
    goes_on(clock)


def test_a_go_of_the_conductor_ends_where_something_is_handed_over(bench, conductor):
    device = bench.join("device", hands_over=True)
    begun_ns = device.ask_ns()
    block_ns = 20 * STEP_NS
    conductor.go()
    device.wait_until(begun_ns + block_ns)
    # the device wants the next block already; time waits for the conductor
    device.hold(begun_ns + 2 * block_ns, Demand.FAST)
    assert stands(conductor) == (True, begun_ns + block_ns)
    conductor.go()
    device.wait_told()
    assert device.now_ns() == begun_ns + 2 * block_ns
    assert stands(conductor) == (True, begun_ns + 2 * block_ns)


def test_what_a_conductor_lets_go_does_not_outlast_a_handing_over_that_came_first(bench, conductor):
    """However late the conductor judges a block, it judges each before the next is played."""
    device = bench.join("device", hands_over=True)
    begun_ns, block_ns = device.ask_ns(), 20 * STEP_NS
    conductor.go()
    for n in (1, 2, 3):
        device.hold(begun_ns + n * block_ns, Demand.FAST)
        device.wait_told()
        assert device.now_ns() == begun_ns + n * block_ns
        time.sleep(0.02)
        assert conductor.ask_ns() == begun_ns + n * block_ns
        conductor.go()


def test_one_may_be_told_in_the_place_of_another(bench, conductor):
    hand = bench.join("hand")
    loop = bench.join("loop", told_with="hand")
    begun_ns = loop.ask_ns()
    for n in range(1, 20):
        hand.hold(begun_ns + n * STEP_NS, Demand.FAST)
        while loop.now_ns() < begun_ns + n * STEP_NS:
            loop.wait_told()
        assert loop.now_ns() == begun_ns + n * STEP_NS
    loop.close()
    time.sleep(0.05)
    hand.wait_until(begun_ns + 30 * STEP_NS)  # it is told itself again
    assert hand.now_ns() == begun_ns + 30 * STEP_NS


def test_a_sleeper_is_told_and_holds_nothing(bench, conductor):
    sleeper, loop = bench.join("sleeper"), bench.join("loop")
    begun_ns = loop.ask_ns()
    woken_ns = []
    thread = threading.Thread(
        target=lambda: woken_ns.append(sleeper.sleep_until(begun_ns + 5 * STEP_NS))
    )
    thread.start()
    time.sleep(0.05)
    assert stands(loop)[0], "who only sleeps does not make time pass"
    loop.wait_until(begun_ns + 40 * STEP_NS)
    thread.join(PATIENCE_S)
    assert woken_ns
    assert begun_ns + 5 * STEP_NS <= sleeper.now_ns() <= begun_ns + 40 * STEP_NS


def test_who_is_found_gone_as_it_is_told_keeps_nobody_else_from_being_told():
    bench, told = BenchTime(Reactor(HOST), STEP_NS, simulated=True), []

    def join(name, send):
        serving = bench.serve(SimpleNamespace(send=send))
        next(serving)
        serving.send(b'{"name": "%s"}\n' % name)
        until_ns = START_NS + STEP_NS
        serving.send(MESSAGE.pack(ToBench.HOLD, until_ns, Demand.FAST, -1))
        return serving

    gone = join(b"gone", lambda data: gone.close())  # as a connection that cannot be written to
    loop = join(b"loop", told.append)
    bench._step()
    assert [MESSAGE.unpack(data)[1] for data in told] == [START_NS + STEP_NS]
    loop.close()


def test_a_step_waits_for_packets_that_are_said_to_be_on_their_way(bench, conductor):
    arrived = itertools.count(100)
    newest = [next(arrived)]
    bench.time.packets_arrived = lambda: newest[0]
    clock = bench.join("hand")
    begun_ns = clock.ask_ns()
    clock.hold(begun_ns, Demand.FAST, 0)  # counted from here
    clock.ask_ns()
    clock.hold(begun_ns + STEP_NS, Demand.FAST, 2)
    time.sleep(0.1)
    assert clock.ask_ns() == begun_ns
    newest[0] += 2
    clock.wait_told()
    assert clock.now_ns() == begun_ns + STEP_NS
    # none can come: none is waited for
    newest[0] = None
    clock.hold(begun_ns + 2 * STEP_NS, Demand.FAST, 5)
    clock.wait_told()
    assert clock.now_ns() == begun_ns + 2 * STEP_NS


def test_packets_that_were_lost_are_waited_for_once(bench, conductor, monkeypatch):
    bench.time.packets_arrived = lambda: 100
    clock = bench.join("hand")
    begun_ns = clock.ask_ns()
    clock.hold(begun_ns, Demand.FAST, 0)
    clock.ask_ns()
    monkeypatch.setattr(bench_time, "PACKETS_WITHIN_S", 0.05)
    clock.hold(begun_ns + STEP_NS, Demand.FAST, 1)
    clock.wait_told()
    # from now on a wait would not end
    monkeypatch.setattr(bench_time, "PACKETS_WITHIN_S", math.inf)
    end_s = time.monotonic() + PATIENCE_S

    def give_up():
        assert time.monotonic() < end_s, "it waits for packets again"

    clock.hold(begun_ns + 2 * STEP_NS, Demand.FAST, 2)
    clock.wait_told(give_up)
    assert clock.now_ns() == begun_ns + 2 * STEP_NS


@pytest.mark.parametrize("is_gone", [False, True])
def test_packets_that_are_announced_are_waited_for_until_they_come_or_nobody_is_there_to_send_them(
    bench, conductor, monkeypatch, is_gone
):
    monkeypatch.setattr(bench_time, "PACKETS_WITHIN_S", 0.0)  # of those that were sent
    arrived = [100]
    bench.time.packets_arrived = lambda: arrived[0]
    clock, other = bench.join("hand"), bench.join("other")
    other.free(Demand.FAST)
    clock.hold(0, Demand.NONE, 0)
    begun_ns = clock.ask_ns()
    clock.announce(ENDLESS_NS, Demand.NONE, 1)
    assert stands(clock) == (True, begun_ns)
    if is_gone:
        clock.close()
    else:
        arrived[0] += 1
    goes_on(other)


def test_seeds_reach_who_makes_noise(bench, conductor):
    got = []
    bench.time.seeds.append(got.append)
    conductor.seed(7, 3, 1)
    conductor.ask_ns()
    assert got == [(7, 3, 1)]


def test_what_waits_is_told_that_the_bench_has_ended():
    with Bench() as bench:
        clock, conductor = bench.join("loop"), bench.join("conductor", conducts=True)
        conductor.ask_ns()
        bench.time.stop()
        bench._thread.join()
        bench.reactor.close()
        with pytest.raises(ClockLostError, match="ended|reset"):
            clock.wait_until(ENDLESS_NS)
    with pytest.raises(ClockLostError, match="no simulated time"):
        SimulatedClock(f"{HOST}:1", "nobody")


def test_nonsense_costs_its_sender_the_connection_and_nobody_the_time(bench, conductor):
    import socket

    clock = bench.join("loop")
    unknown_kind = b'{"name": "odd"}\n' + bytes([99]) + bytes(31)
    for text in (b"[]\n", b"{}\n", b"x" * 5000, b"[" * 4000 + b"\n", unknown_kind):
        with socket.create_connection((HOST, bench.port), 5) as odd:
            odd.sendall(text)
            assert odd.recv(10) == b""
    clock.wait_until(clock.ask_ns() + STEP_NS)


@pytest.mark.parametrize("text", ["", "127.0.0.1", "127.0.0.1:", ":1", "127.0.0.1:70000", "a:b"])
def test_an_address_that_is_none_is_refused(text):
    with pytest.raises(ValueError, match="expected HOST:PORT"):
        time_address(text)


def test_on_the_wall_clock_steps_keep_the_pace_and_say_what_was_lost():
    reactor = Reactor(HOST)
    bench = BenchTime(reactor, STEP_NS, simulated=False)
    lost_s = []
    bench.stalled.append(lost_s.append)
    times_s = []

    def step():
        times_s.append(time.monotonic())
        if len(times_s) == 20:
            time.sleep(0.1)
        if len(times_s) == 60:
            bench.stop()

    bench.steps.append(step)
    bench.run()
    reactor.close()
    assert bench.stalls == len(lost_s) >= 1
    # what was lost and what was stepped make up the time that has passed
    passed_s = times_s[-1] - times_s[0]
    assert passed_s == pytest.approx(59 * STEP_NS * 1e-9 + sum(lost_s), abs=0.03)
    assert bench.now_ns == START_NS + 60 * STEP_NS
