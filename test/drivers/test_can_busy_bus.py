# SPDX-License-Identifier: Apache-2.0
"""A cell on a bus of python-can that it shares: frames of others neither hold it back nor hide its silence."""

import itertools
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.drivers.force_config import read_force_config

can = pytest.importorskip("can", reason="python-can is not installed")

from tactile_resonance.drivers import can_bus  # noqa: E402
from tactile_resonance.drivers.can_wrench import CanWrench  # noqa: E402
from tactile_resonance.simulation.cell.transducer import (  # noqa: E402
    CanFrame,
    CellParameters,
    LoadCell,
)

PATIENCE_S = 60.0
FOREIGN = (
    {"arbitration_id": 0x300, "data": b"12345678", "is_extended_id": False},
    # same numbers as the cell's
    {"arbitration_id": 0x001, "data": b"\x0b2345678", "is_extended_id": True},
    {"arbitration_id": 0x002, "dlc": 8, "is_remote_frame": True, "is_extended_id": False},
)


class BusyBus(can.BusABC):
    """An interface at which a frame always waits: ten of others a millisecond of its time, beside a cell."""

    simulated = True

    def __init__(self):
        super().__init__(channel="busy")
        self.cell = LoadCell(CellParameters.from_yaml(None), 1)
        self._time_s = 0.0
        self._waiting, self._foreign = [], itertools.cycle(FOREIGN)

    def now_ns(self):
        """As clock of the driver: time goes on with the frames, however slow this machine is."""
        return round(self._time_s * 1e9)

    def send(self, msg, timeout=None):
        self._hand_on(self.cell.receive(msg.arbitration_id, bytes(msg.data)))

    def _hand_on(self, frames):
        for frame in frames:
            self._waiting.append(
                can.Message(
                    arbitration_id=frame.can_id,
                    data=frame.data,
                    is_extended_id=False,
                    timestamp=frame.time_s,
                )
            )

    def _recv_internal(self, timeout):
        if self._waiting:
            return self._waiting.pop(0), True
        time.sleep(1e-4)
        self._time_s += 1e-4
        self._hand_on(self.cell.step([0.0] * 6, self._time_s))
        return can.Message(timestamp=self._time_s, **next(self._foreign)), True


def driver_on(bus, monkeypatch):
    """A driver on an interface of python-can that has not been started."""
    monkeypatch.setattr(can_bus.can, "Bus", lambda **_: bus)
    config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
    return CanWrench(
        replace(
            config,
            bus={"interface": "busy", "channel": "0"},
            limits=replace(config.limits, silent_s=0.3),
        ),
        clock=bus,
    )


@pytest.fixture
def shared(monkeypatch):
    """The bus, and a driver on it that has not been started."""
    bus = BusyBus()
    driver = driver_on(bus, monkeypatch)
    yield bus, driver
    driver.close()


def read_for(driver, count):
    """Read until so many wrenches have come, or a fault."""
    end_s = time.monotonic() + PATIENCE_S
    while count > 0:
        assert time.monotonic() < end_s
        count -= len(driver.read())
        time.sleep(0.001)


@pytest.mark.parametrize("data", [b"", b"\x0f"])
def test_an_answer_that_is_too_short_to_say_what_was_done_is_passed_over(shared, data):
    bus, driver = shared
    send = bus.send

    def send_beside(message, timeout=None):
        now_s = bus.now_ns() * 1e-9
        # by itself: of the cell's identifiers, with the command's first byte or without any
        bus._hand_on([CanFrame(now_s, 1, data), CanFrame(now_s, 2, b"")])
        send(message)

    bus.send = send_beside
    driver.start()
    read_for(driver, 20)


def test_others_frames_are_passed_over(shared):
    """All wrenches between start and silence arrive: the cell sends one each millisecond."""
    bus, driver = shared
    earliest_ns = bus.now_ns()
    driver.start()
    latest_ns = bus.now_ns()
    read_for(driver, 200)
    assert driver.lost == 0
    before_ns = bus.now_ns()
    bus.cell.faults.inject("silent", 1)
    after_ns = bus.now_ns()
    with pytest.raises(ForceError):
        read_for(driver, 10**6)
    assert (before_ns - latest_ns) * 1e-6 - 2 <= driver.received
    assert driver.received <= (after_ns - earliest_ns) * 1e-6 + 2


@pytest.mark.parametrize("heard", [0, 50])
def test_silence_is_found_though_the_bus_is_never_quiet(shared, heard):
    bus, driver = shared
    driver.start()
    read_for(driver, heard)
    bus.cell.faults.inject("silent", 1)
    with pytest.raises(ForceError, match="silent for 3") as error:
        read_for(driver, 10**6)
    assert error.value.fault is ForceFault.SILENT


class Failing(BusyBus):
    """An interface that raises, or never returns, as soon as it is told to."""

    def __init__(self):
        super().__init__()
        self.hangs, self.broken = threading.Event(), threading.Event()
        self.released = threading.Event()

    def _recv_internal(self, timeout):
        if self.broken.is_set():
            raise can.CanOperationError("the adapter was pulled out")
        if self.hangs.is_set():
            self.released.wait()
        return super()._recv_internal(timeout)


@pytest.mark.parametrize(
    ("fails", "text"), [("broken", "the adapter was pulled out"), ("hangs", "the interface hangs")]
)
def test_an_interface_that_fails_is_a_lost_link(monkeypatch, fails, text):
    bus = Failing()
    driver = driver_on(bus, monkeypatch)
    try:
        driver.start()
        read_for(driver, 20)
        getattr(bus, fails).set()
        with pytest.raises(ForceError, match=text) as error:
            read_for(driver, 10**6)
        assert error.value.fault is ForceFault.LINK_LOST
    finally:
        bus.released.set()
        driver.close()
