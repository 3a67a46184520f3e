# SPDX-License-Identifier: Apache-2.0
"""UrArm in lockstep with simulated time: what a tick sees and does hangs on nothing but its time."""

import contextlib
import os
import signal
import socket
import tempfile
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from arms import (
    ACCELERATION_M_S2,
    CYCLE_NS,
    DOWN,
    PATIENCE_S,
    UP,
    LateSocket,
    connect_again,
    keep_for,
    left_alone,
    nothing,
    tick,
)

from tactile_resonance.clock import PORT, ClockLostError, Demand, SimulatedClock
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import NOTHING, SIZE, SPEED, Exchange, UrCommand
from tactile_resonance.simulation.ur5e.machine import TrackingParameters


def test_each_tick_sees_exactly_the_state_of_its_time(robot, high):
    rng = np.random.default_rng(1)
    high.speed(UP, ACCELERATION_M_S2)
    ahead_ns = None
    for cycles in rng.choice([1, 2, 5, 10], 100):
        before_ns = high.clock.now_ns()
        tick(high, int(cycles))
        sample = high.state()
        assert high.clock.now_ns() == before_ns + cycles * CYCLE_NS
        told = robot.order("state")
        assert (sample.robot_time_s, *sample.position_m) == (told["time_s"], *told["tcp_pose"][:3])
        # one relation of the clocks for all states, the exact one
        assert sample.time_ns == pytest.approx(high.clock.now_ns(), abs=1000)
        robot_ns = round(sample.robot_time_s * 1e9)
        ahead_ns = ahead_ns or high.clock.now_ns() - robot_ns
        assert high.clock.now_ns() - robot_ns == ahead_ns


def test_a_state_that_is_handed_over_late_is_waited_for(high, monkeypatch):
    stream = high._states.stream
    monkeypatch.setattr(stream, "_socket", LateSocket(stream._socket, 0.01))
    high.speed(UP, ACCELERATION_M_S2)
    first = high.state().robot_time_s
    for n in range(1, 30):
        tick(high)
        assert high.state().robot_time_s == pytest.approx(first + n * CYCLE_NS * 1e-9, abs=1e-9)
        assert high.state().time_ns == pytest.approx(high.clock.now_ns(), abs=1000)


def test_a_time_that_is_told_after_its_state_has_come_dates_it(high, monkeypatch):
    """The loop looks at the robot while it waits, and finds a state of a time that it does not know yet."""
    told = high.clock.wait_told

    def late(while_waiting):
        time.sleep(0.01)
        while_waiting()
        told(while_waiting)

    monkeypatch.setattr(high.clock, "wait_told", late)
    for _ in range(30):
        tick(high, 10)
        assert high.state().time_ns == pytest.approx(high.clock.now_ns(), abs=1000)


def test_the_bench_is_told_how_many_packets_are_on_their_way():
    """So it waits for a velocity that was sent before the time was let go on."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    from tactile_resonance.drivers.ur_client import Client
    from tactile_resonance.drivers.ur_session import Session

    held, control = [], SimpleNamespace(speedL=lambda *_: True, kickWatchdog=lambda: True)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with tempfile.TemporaryFile() as page, ours, theirs:
        page.truncate(SIZE)
        client = Client(theirs, Exchange(page.fileno()))
        client._clock = SimpleNamespace(hold=lambda *said: held.append(said))
        client._session = Session(UrArmConfig("127.0.0.1"), None)
        client._session.control = control
        ends_ns = [CYCLE_NS * n for n in range(1, 4)]
        client._obey(UrCommand(SPEED, 1, ends_ns[0], Demand.FAST, tuple(UP), 0.5))
        client._obey(UrCommand(NOTHING, 0, ends_ns[1], Demand.NONE))
        client._obey(UrCommand(SPEED, 2, ends_ns[2], Demand.FAST, tuple(DOWN), 0.5))
    assert held == [
        (ends_ns[0], Demand.FAST, 1), (ends_ns[1], Demand.NONE, 1), (ends_ns[2], Demand.FAST, 2)
    ]  # fmt: skip


def test_the_watchdog_is_set_within_the_time_that_it_allows_however_late_that_is_said():
    """Time that reached its limit before the robot has the command would stand for ever."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    from tactile_resonance.drivers.ur_session import Session

    config, now_ns, said = UrArmConfig("127.0.0.1"), 10**10, []
    limit_ns = now_ns + round(0.75e9 / config.watchdog_hz)
    session = Session(
        config,
        SimpleNamespace(
            hold=lambda *how: said.append(how),
            announce=lambda *how: said.append(("announced", *how)),
            ask_ns=lambda: now_ns,
            sleep_until=lambda time_ns: None,
        ),
    )
    session.control = SimpleNamespace(
        setTcp=lambda tip: True,
        getTCPOffset=lambda: config.tip_in_flange.vector.tolist(),
        setPayload=lambda *_: True,
        setWatchdog=lambda hz: said.append(hz) or True,
        kickWatchdog=lambda: True,
    )
    session._prepare()
    stands = (0, Demand.REAL, 0)  # while the limit is asked for
    assert said == [
        *(stands, ("announced", limit_ns, Demand.REAL, 1), config.watchdog_hz),
        *(stands, ("announced", limit_ns, Demand.REAL, 0)),
    ]


def test_time_stands_between_two_words_of_the_loop(robot, high):
    tick(high)
    first = high.state()
    time.sleep(0.3)
    assert high.state() == first
    assert round(robot.order("state")["time_s"] * 1e9) == round(first.robot_time_s * 1e9)


def test_connected_again_its_states_are_of_the_time_that_is(robot, high):
    """While it connects time goes on, and nobody is told."""
    for stop in ("stop", "drop"):  # the program is started again; all is made anew
        before_ns = high.clock.now_ns()
        if stop == "stop":
            robot.dashboard("stop")
            keep_for(high, 0.02)
        else:
            robot.order("drop")
            with pytest.raises(ArmError):
                keep_for(high, 0.02)
        connect_again(high)
        assert high.clock.now_ns() > before_ns + 2 * CYCLE_NS
        for sample in keep_for(high, 0.1):
            assert sample.moving_allowed
        assert high.state().time_ns == pytest.approx(high.clock.now_ns(), abs=1000)


@pytest.mark.parametrize("speed_m_s", [0.05, -0.1])
def test_a_command_acts_from_its_tick_on(high, speed_m_s):
    """What the arm's way is late by is dead time, lag and the ramp of its speed, and not a cycle more."""
    velocity = np.array([0.0, 0.0, speed_m_s, 0.0, 0.0, 0.0])
    acceleration = 1.0
    keep_for(high, 0.2)
    begin = high.state()
    high.speed(velocity, acceleration)
    samples = keep_for(high, 0.3)
    time_s = 1e-9 * (np.array([s.time_ns for s in samples]) - begin.time_ns)
    way_m = np.array([s.position_m[2] for s in samples]) - begin.position_m[2]
    late_s = (time_s - way_m / speed_m_s)[-50:]
    tracking = TrackingParameters()
    ramp_s = abs(speed_m_s) / acceleration / 2
    expected_s = tracking.dead_time_s + tracking.lag_s + ramp_s
    assert late_s.mean() == pytest.approx(expected_s, abs=0.25e-9 * CYCLE_NS)
    high.stop(2.0)
    keep_for(high, 0.3)


def ride(host, arm, hold_up):
    """States of a ride with noise from known seeds, with `hold_up` called in every tick."""
    connect_again(arm)
    keep_for(arm, 0.1)
    with contextlib.closing(SimulatedClock(f"{host}:{PORT}", "seeds")) as clock:
        clock.seed(7, 3, 1)
        clock.ask_ns()
    begin, seen = arm.state(), []
    for n in range(150):
        hold_up()
        if n % 30 == 0:
            arm.speed((1 + n // 30) * (UP if n % 60 else DOWN), ACCELERATION_M_S2)
        if n == 140:
            arm.stop(2.0)
        hold_up()
        tick(arm, 1 + n % 3)
        state = arm.state()
        seen.append(
            (
                round((state.robot_time_s - begin.robot_time_s) * 1e9),
                state.time_ns - begin.time_ns,
                *state.position_m,
                *state.rotation_rad,
                *state.velocity,
                *state.tool_wrench,
            )
        )
    return np.array(seen)


def test_a_machine_that_holds_things_up_changes_nothing(start_robots, start_arm):
    """Loop, client or robot stand still now and then, for up to 0.2 s: the same states to the bit."""
    quiet, held = start_robots("--simulated-time", count=2)
    rng = np.random.default_rng(2)
    arms = [start_arm(robot.host) for robot in (quiet, held)]
    expected = ride(quiet.host, arms[0], lambda: None)

    def hold_up():
        if rng.random() < 0.9:
            return
        seconds = rng.uniform(0.0, 0.2)
        who = rng.choice(3)
        if who == 0:
            time.sleep(seconds)
            return
        pid = arms[1].client.pid if who == 1 else held.process.pid
        os.kill(pid, signal.SIGSTOP)
        threading.Timer(seconds, os.kill, (pid, signal.SIGCONT)).start()

    found = ride(held.host, arms[1], hold_up)
    time.sleep(0.3)
    assert np.ptp(expected[:, 4]) > 1e-4
    np.testing.assert_array_equal(found[:, 0], expected[:, 0])
    np.testing.assert_allclose(found[:, 1], expected[:, 1], atol=10)
    np.testing.assert_array_equal(found[:, 2:], expected[:, 2:])


@pytest.mark.parametrize(
    ("who", "name"), [("client", "the arm's client process"), ("robot", "the simulated robot")]
)
def test_what_holds_the_time_is_named_and_nothing_is_lost(robot, high, who, name):
    pid = high.client.pid if who == "client" else robot.process.pid
    high.speed(UP, ACCELERATION_M_S2)
    keep_for(high, 0.1)
    assert high.waits_for == ""
    before_ns, named, released = high.clock.now_ns(), [], []
    os.kill(pid, signal.SIGSTOP)

    def while_waiting():
        named.append(high.waits_for)
        if named[-1] and not released:
            os.kill(pid, signal.SIGCONT)
            released.append(True)

    try:
        high.led.while_waiting = while_waiting
        tick(high)
    finally:
        high.led.while_waiting = nothing
        os.kill(pid, signal.SIGCONT)
    assert name in named
    assert set(named) <= {"", name}
    assert high.clock.now_ns() == before_ns + CYCLE_NS
    assert high.state().velocity[2] == pytest.approx(UP[2], rel=0.02)


def test_what_is_raised_while_it_waits_ends_the_wait(robot, high):
    os.kill(robot.process.pid, signal.SIGSTOP)

    def enough():
        raise InterruptedError

    try:
        high.led.while_waiting = enough
        with pytest.raises(InterruptedError):
            tick(high)
    finally:
        high.led.while_waiting = nothing
        os.kill(robot.process.pid, signal.SIGCONT)
    keep_for(high, 0.1)


def test_a_wait_without_need_stands_until_it_is_hurried(robot, high):
    """While somebody conducts, time stands unless it is needed."""
    with contextlib.closing(
        SimulatedClock(f"{robot.host}:{PORT}", "conductor", conducts=True)
    ) as conductor:
        begun_ns = high.clock.now_ns()
        waiting = threading.Thread(
            target=lambda: high.led.wait_until(begun_ns + 10 * CYCLE_NS, Demand.NONE)
        )
        waiting.start()
        time.sleep(0.3)
        assert conductor.ask_ns() == begun_ns
        high.led.hurry()
        waiting.join(PATIENCE_S)
        assert high.clock.now_ns() == begun_ns + 10 * CYCLE_NS


def test_left_to_itself_time_goes_on_and_the_watchdog_is_fed(robot, high):
    before_ns = high.clock.now_ns()
    with left_alone(high, robot):
        end = time.monotonic() + PATIENCE_S
        while high.clock.now_ns() < before_ns + 2e9:  # fifty times the watchdog's
            assert time.monotonic() < end
            time.sleep(0.01)
        assert robot.order("state")["runtime_state"] == "PLAYING"
    tick(high)
    assert high.state().time_ns == pytest.approx(high.clock.now_ns(), abs=1000)
    assert high.state().moving_allowed


def test_a_loop_that_dies_while_it_leads_holds_nothing(robot, start_arm, module_arm):
    module_arm.close()
    arm = start_arm(robot.host)
    connect_again(arm)
    arm.speed(UP, ACCELERATION_M_S2)
    keep_for(arm, 0.1)
    os.kill(arm.client.pid, signal.SIGKILL)
    arm.led.bench.close()
    arm._asked.close()
    robot.until(runtime_state="STOPPED")  # by its watchdog: time goes on


def test_a_wait_in_another_thread_ends_as_the_arm_is_closed(robot, start_arm, module_arm):
    module_arm.close()
    arm, lost = start_arm(robot.host), threading.Event()
    arm.connect()
    clock = arm.clock

    def wait():
        try:
            clock.wait_until(clock.now_ns() + 10**15)
        except ClockLostError:
            lost.set()

    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    time.sleep(0.2)
    assert waiting.is_alive()
    arm.close()
    assert lost.wait(PATIENCE_S)


def test_without_a_bench_the_link_is_lost(start_arm):
    arm = start_arm("127.254.254.1")
    with pytest.raises(ArmError, match="no simulated time at 127.254.254.1:30021") as error:
        arm.connect()
    assert error.value.fault is ArmFault.LINK_LOST
