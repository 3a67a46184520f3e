# SPDX-License-Identifier: Apache-2.0
"""A cell that shares its bus with others: their frames neither hold it back nor hide its silence."""

import itertools
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.drivers.force_config import read_force_config

can = pytest.importorskip("can", reason="python-can is not installed")

from tactile_resonance.drivers import can_wrench  # noqa: E402
from tactile_resonance.simulation.load_cell import LoadCell  # noqa: E402
from tactile_resonance.simulation.transducer import CellParameters  # noqa: E402

FOREIGN = (
    {"arbitration_id": 0x300, "data": b"12345678", "is_extended_id": False},
    # same numbers as the cell's
    {"arbitration_id": 0x001, "data": b"\x0b2345678", "is_extended_id": True},
    {"arbitration_id": 0x002, "dlc": 8, "is_remote_frame": True, "is_extended_id": False},
)


class BusyBus(can.BusABC):
    """An interface at which a frame always waits: ten of others a millisecond, beside a cell."""

    def __init__(self):
        super().__init__(channel="busy")
        self.cell = LoadCell(CellParameters.from_yaml(None), 1)
        self._start_s = time.time()
        self._waiting, self._foreign = [], itertools.cycle(FOREIGN)

    def send(self, msg, timeout=None):
        self._hand_on(self.cell.receive(msg.arbitration_id, bytes(msg.data)))

    def _hand_on(self, frames):
        for frame in frames:
            self._waiting.append(
                can.Message(
                    arbitration_id=frame.can_id,
                    data=frame.data,
                    is_extended_id=False,
                    timestamp=self._start_s + frame.time_s,
                )
            )

    def _recv_internal(self, timeout):
        time.sleep(1e-4)
        self._hand_on(self.cell.step([0.0] * 6, time.time() - self._start_s))
        if self._waiting:
            return self._waiting.pop(0), True
        return can.Message(timestamp=time.time(), **next(self._foreign)), True


@pytest.fixture
def shared(monkeypatch):
    """The bus, and a driver on it that has not been started."""
    bus = BusyBus()
    monkeypatch.setattr(can_wrench, "open_bus", lambda *_: bus)
    config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
    config = replace(config, limits=replace(config.limits, silent_s=0.3))
    driver = can_wrench.CanWrench(config)
    yield bus, driver
    driver.close()


def read_for(driver, seconds):
    count, end_s = 0, time.monotonic() + seconds
    while time.monotonic() < end_s:
        count += len(driver.read())
        time.sleep(0.01)
    return count


def test_others_frames_are_passed_over(shared):
    _, driver = shared
    driver.start()
    assert read_for(driver, 0.5) > 100
    assert driver.lost == 0


@pytest.mark.parametrize("heard_s", [0.0, 0.1])
def test_silence_is_found_though_the_bus_is_never_quiet(shared, heard_s):
    bus, driver = shared
    driver.start()
    read_for(driver, heard_s)
    bus.cell.faults.inject("silent", 1)
    with pytest.raises(ForceError, match="silent for 3") as error:
        read_for(driver, 5.0)
    assert error.value.fault is ForceFault.SILENT
