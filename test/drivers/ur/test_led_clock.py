# SPDX-License-Identifier: Apache-2.0
"""Simulated time led by a loop: each period brings what arm and cell have sent in it, all of it and no more."""

import contextlib
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arms import ACCELERATION_M_S2, CYCLE_NS, PATIENCE_S, UP, LateSocket, nothing

from tactile_resonance.clock import PORT, Demand, SimulatedClock
from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.drivers.force_config import RtdeWrench, read_force_config
from tactile_resonance.drivers.ur_time import LedClock

pytest.importorskip("can", reason="python-can is not installed")

from tactile_resonance.drivers.can_wrench import CanWrench


@pytest.fixture
def arm(robot, start_arm):
    """Connected, not led."""
    made = start_arm(robot.host)
    made.connect()
    return made


@pytest.fixture
def cell(robot):
    """The cell under the tissue."""
    config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
    bus = {**config.bus, "host": robot.host}
    made = CanWrench(replace(config, bus=bus))
    yield made
    made.close()


@pytest.fixture
def lead(arm):
    """Make the clock of a cell; it is closed after the test."""
    with contextlib.ExitStack() as stack:

        def make(source, while_waiting=nothing):
            clock = LedClock(arm, source, while_waiting)
            stack.callback(clock.close)
            return clock

        yield make


@pytest.mark.parametrize("held_up", ["nobody", "the loop", "frames"])
def test_each_period_brings_the_state_at_its_end_and_all_its_wrenches(arm, cell, lead, held_up):
    cell.clock = arm.clock  # simulated, and not led yet
    cell.start()
    clock = lead(cell)
    rng = np.random.default_rng(4)
    clock.wait_until(clock.now_ns() + CYCLE_NS)
    cell.read()
    arm.speed(UP, ACCELERATION_M_S2)
    stamps, ends = [], []
    for n in range(60):
        if n == 30:  # by another connection
            cell.start()
            clock.wait_until(clock.now_ns() + CYCLE_NS)
            cell.read()
        if held_up == "frames" and n in (0, 30):
            cell._bus._socket = LateSocket(cell._bus._socket, 0.01)
        cycles = int(rng.choice([1, 1, 2, 5]))
        until_ns, frames = clock.now_ns() + cycles * CYCLE_NS, clock.bench.frames
        clock.wait_until(until_ns)
        assert clock.bench.frames - frames == 4 * cycles  # two a wrench, 1 kHz
        if held_up == "the loop" and rng.random() < 0.1:
            time.sleep(rng.uniform(0, 0.05))
        assert clock.now_ns() == until_ns
        assert arm.state().time_ns == pytest.approx(until_ns, abs=1000)
        samples = cell.read()
        assert len(samples) == 2 * cycles
        stamps += [sample.time_ns for sample in samples]
        ends += [until_ns + 1_000_000 * k for k in range(1 - 2 * cycles, 1)]
    assert cell.lost == 0
    # but for the delay that the configuration takes off
    np.testing.assert_allclose(np.array(stamps) - np.array(ends), -1e5, atol=1e4)


def test_silence_of_the_cell_is_found_at_its_time(robot, arm, cell, lead):
    cell.clock = arm.clock
    cell.start()
    clock = lead(cell)
    for _ in range(50):
        clock.wait_until(clock.now_ns() + CYCLE_NS)
        cell.read()
    robot.order("cell_fault", fault="silent", value=1)
    begun_ns = clock.now_ns()

    def read():
        while clock.now_ns() < begun_ns + 10**9:
            clock.wait_until(clock.now_ns() + CYCLE_NS)
            cell.read()

    try:
        with pytest.raises(ForceError) as error:
            read()
    finally:
        robot.order("cell_fault", fault="silent", value=0)
    assert error.value.fault is ForceFault.SILENT
    # config/force/can_simulated.yaml: 10 ms
    assert 10_000_000 <= clock.now_ns() - begun_ns <= 10_000_000 + 2 * CYCLE_NS


def test_a_cell_that_is_none_of_a_bus_is_led_by_the_arm_alone(arm, lead):
    cell = RtdeWrench(read_force_config(Path("rtde_ur.yaml")), arm)
    clock = lead(cell)
    clock.wait_until(clock.now_ns() + CYCLE_NS)
    cell.start()
    for _ in range(50):
        clock.wait_until(clock.now_ns() + CYCLE_NS)
        (sample,) = cell.read()
        assert sample.time_ns == pytest.approx(clock.now_ns(), abs=1000)


def test_simulated_time_is_ros_time(arm, cell, lead):
    clock = lead(cell)
    assert clock.simulated
    assert clock.ros_ns(123) == clock.own_ns(123) == 123


def test_while_time_stands_it_is_said_and_a_hurry_ends_that(robot, arm, cell, lead):
    """Nothing needs time, and somebody conducts."""
    calls = []
    clock = lead(cell, lambda: calls.append(time.monotonic()))
    with contextlib.closing(
        SimulatedClock(f"{robot.host}:{PORT}", "conductor", conducts=True)
    ) as conductor:
        begun_ns = clock.now_ns()
        waiting = threading.Thread(
            target=lambda: clock.wait_until(begun_ns + 10 * CYCLE_NS, Demand.NONE)
        )
        waiting.start()
        end = time.monotonic() + PATIENCE_S
        while len(calls) < 3:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert conductor.ask_ns() == begun_ns
        clock.hurry()
        waiting.join(PATIENCE_S)
        assert clock.now_ns() == begun_ns + 10 * CYCLE_NS


def test_what_is_raised_while_time_stands_ends_the_wait(robot, arm, cell, lead):
    def enough():
        raise InterruptedError

    clock = lead(cell, enough)
    with contextlib.closing(
        SimulatedClock(f"{robot.host}:{PORT}", "conductor", conducts=True)
    ) as conductor:
        conductor.ask_ns()
        with pytest.raises(InterruptedError):
            clock.wait_until(clock.now_ns() + CYCLE_NS, Demand.NONE)


def test_closed_it_leaves_the_time_to_itself(robot, arm, cell):
    clock = LedClock(arm, cell, nothing)
    clock.wait_until(clock.now_ns() + CYCLE_NS)
    time_s = robot.order("state")["time_s"]
    time.sleep(0.1)
    assert robot.order("state")["time_s"] == time_s
    clock.close()
    end = time.monotonic() + PATIENCE_S
    while robot.order("state")["time_s"] < time_s + 0.2:
        assert time.monotonic() < end
        time.sleep(0.01)
