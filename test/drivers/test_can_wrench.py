# SPDX-License-Identifier: Apache-2.0
"""The driver over the unmodified python-can, on a simulated cell in a process of its own."""

import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.drivers.can_frames import read_can_description
from tactile_resonance.drivers.force_config import read_force_config

can = pytest.importorskip("can", reason="python-can is not installed")

from tactile_resonance.drivers.can_wrench import CanWrench  # noqa: E402

HOST = "127.0.6.2"
PATIENCE_S = 30.0


class CellProcess:
    """``tactile_resonance simulate-cell``."""

    def __init__(self, port=0):
        command = [sys.executable, "-m", "tactile_resonance.cli", "simulate-cell"]
        self._process = subprocess.Popen(
            [*command, "--host", HOST, "--port", str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.port = int(self._process.stdout.readline().rsplit(":", 1)[1])

    def say(self, line):
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def kill(self):
        self._process.kill()
        self._process.wait()

    def end(self):
        self._process.terminate()
        assert self._process.wait(PATIENCE_S) in (0, -9)
        for stream in (self._process.stdin, self._process.stdout):
            stream.close()


@pytest.fixture(scope="module")
def cell():
    process = CellProcess()
    yield process
    process.end()


def config_for(port, **changes):
    """The shipped configuration; slower to call the cell silent, since tests share their machine."""
    config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
    config = replace(config, limits=replace(config.limits, silent_s=1.0))
    bus = {**config.can.bus, "host": HOST, "port": port}
    return replace(config, can=replace(config.can, bus=bus, **changes))


@pytest.fixture
def source(cell):
    driver = CanWrench(config_for(cell.port))
    yield driver
    driver.close()


def read_until(source, count):
    samples = []
    deadline_s = time.monotonic() + PATIENCE_S
    while len(samples) < count and time.monotonic() < deadline_s:
        samples += source.read()
        time.sleep(0.001)
    assert len(samples) >= count
    return samples


def fault_of(source):
    """Read until the driver gives up; the fault and how many samples came before."""
    count = 0
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        try:
            count += len(source.read())
        except ForceError as error:
            return error.fault, count
        time.sleep(0.001)
    pytest.fail("no fault was found")


def test_a_thousand_wrenches_a_second_arrive_without_loss(source):
    source.start()
    samples = read_until(source, 4000)
    assert source.lost == 0
    # the cell's own clock: 1 ms from each to the next, none missing, none twice
    stamps = np.array([sample.time_ns for sample in samples[2500:]])
    np.testing.assert_allclose(np.diff(stamps), 1e6, atol=0.2e6)
    ages_s = (time.time_ns() - stamps[-1]) * 1e-9
    assert -1e-3 < ages_s < PATIENCE_S
    assert 0 < source.info.clock_uncertainty_s < 0.02
    force = np.array([sample.wrench[:3] for sample in samples])
    # config/load_cells/fine.yaml: bias, and 1 mN rms
    np.testing.assert_allclose(force.mean(axis=0), [0.02, -0.01, 0.03], atol=2e-4)
    np.testing.assert_allclose(force.std(axis=0), 1e-3, rtol=0.1)


def test_a_force_on_the_cell_is_read(cell, source):
    cell.say("force 0.0")
    source.start()
    before = np.mean([s.wrench for s in read_until(source, 400)], axis=0)
    cell.say("force 0.01")
    time.sleep(0.1)
    source.read()
    after = np.mean([s.wrench for s in read_until(source, 400)], axis=0)
    cell.say("force 0.0")
    # standard error of either mean: 1 mN / 20
    assert after[2] - before[2] == pytest.approx(0.01, abs=5 * 1e-3 / 20 * 2**0.5)


@pytest.mark.parametrize(
    ("fault", "value", "named"),
    [
        ("silent", 1, ForceFault.SILENT),
        ("stuck", 1, ForceFault.STUCK),
        ("lose_second_every", 1, ForceFault.INCOMPLETE),
        ("lose_second_every", 10, ForceFault.INCOMPLETE),
        ("invalid", 1, ForceFault.INVALID),
        ("saturated", 1, ForceFault.OVERLOAD),
        ("flipped", 1, ForceFault.JUMP),
        ("bias_step_n", 0.025, ForceFault.JUMP),
    ],
)
def test_every_fault_is_named_and_its_end_brings_the_source_back(cell, source, fault, value, named):
    source.start()
    read_until(source, 50)
    try:
        cell.say(f"{fault} {value}")
        assert fault_of(source)[0] is named
        with pytest.raises(ForceError):
            source.read()  # and stays so
    finally:
        cell.say(f"{fault} 0")
        time.sleep(0.05)
    source.start()
    read_until(source, 200)


def test_a_cell_that_is_silent_from_the_start_is_named(cell, source):
    cell.say("silent 1")
    time.sleep(0.05)
    with pytest.raises(ForceError, match="no answer to 'filter off'") as caught:
        source.start()
    assert caught.value.fault is ForceFault.SILENT
    cell.say("silent 0")
    time.sleep(0.05)
    source.start()
    read_until(source, 50)


def test_a_server_that_dies_is_a_lost_link_and_another_in_its_place_is_found():
    first = CellProcess()
    source = CanWrench(config_for(first.port))
    source.start()
    read_until(source, 50)
    first.kill()
    assert fault_of(source)[0] is ForceFault.LINK_LOST
    with pytest.raises(ForceError, match="refused") as caught:
        source.start()
    assert caught.value.fault is ForceFault.LINK_LOST
    first.end()
    second = CellProcess(first.port)
    try:
        source.start()
        read_until(source, 50)
    finally:
        source.close()
        second.end()


def test_a_server_that_says_nothing_does_not_hold_up_the_start():
    with socket.create_server((HOST, 0)) as mute:
        source = CanWrench(config_for(mute.getsockname()[1]))
        with pytest.raises(ForceError, match="not open after") as caught:
            source.start()
        assert caught.value.fault is ForceFault.LINK_LOST


def test_two_readers_share_the_bus(cell):
    config = config_for(cell.port)
    first = CanWrench(config)
    second = can.Bus(
        interface="socketcand", host=HOST, port=cell.port, channel="can0", tcp_tune=True
    )
    try:
        first.start()
        own = read_until(first, 200)[100:]
        heard = set()
        while message := second.recv(0.2):
            if message.arbitration_id == 1 and message.data[0] == 0x0B:
                heard.add(tuple(struct.unpack(">3h", message.data[1:7])))
            if len(heard) > 400:
                break
        own_counts = {tuple(np.rint(np.array(s.wrench[:3]) * 5000).astype(int)) for s in own}
        assert own_counts & heard
    finally:
        first.close()
        second.shutdown()


def test_times_of_arrival_serve_where_an_adapter_stamps_nothing(cell):
    source = CanWrench(config_for(cell.port, stamps="arrival"))
    try:
        source.start()
        samples = read_until(source, 100)
        stamps = [sample.time_ns for sample in samples]
        assert stamps == sorted(stamps)
        assert source.info.clock_uncertainty_s == 1e-4
    finally:
        source.close()


def test_before_its_start_nothing_is_read(cell):
    with pytest.raises(ForceError, match="not started"):
        CanWrench(config_for(cell.port)).read()


def test_a_refused_setting_is_named(cell):
    config = config_for(cell.port)
    description = config.can.description
    odd = replace(description.setup[0], name="filter 7", data=bytes([0x08, 7, 0]))
    config = config_for(cell.port, description=replace(description, setup=(odd,)))
    with pytest.raises(ForceError, match="filter 7: out of range") as caught:
        CanWrench(config).start()
    assert caught.value.fault is ForceFault.REFUSED


def test_another_make_of_cell_is_a_description(tmp_path):
    """Polled, strain gauges in mixed order over two frames, and a calibration matrix, as ATI's NETCANOEM."""
    content = {
        "name": "polled gauges",
        "frame_ids": [0x200, 0x201],
        "layout": ">H6h2x",
        "fields": ["status", "fx", "fz", "ty", "fy", "tx", "tz"],
        "overload": {"field": "status", "mask": 0x8000},
        "commands": {"id": 0x20F, "request": [0]},
    }
    path = tmp_path / "polled.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    rng = np.random.default_rng(8)
    matrix = 1e-3 * (np.eye(6) + 0.1 * rng.standard_normal((6, 6)))
    base = read_force_config(Path("can_simulated.yaml"))
    config = replace(
        base,
        info=replace(base.info, rate_hz=500.0),
        limits=replace(base.limits, silent_s=0.5, stuck_samples=10**6),
        can=replace(
            base.can,
            bus={"interface": "virtual", "channel": "polled"},
            description=read_can_description(path),
            scale=matrix,
            stamps="arrival",
        ),
    )
    gauges = np.array([100, -200, 300, -40, 50, 60])
    ended = threading.Event()
    bus = can.Bus(interface="virtual", channel="polled")

    def play():
        while not ended.is_set():
            request = bus.recv(0.05)
            if request is None or request.arbitration_id != 0x20F:
                continue
            g = gauges.tolist()  # fx fy fz tx ty tz
            first = struct.pack(">Hhhh", 0, g[0], g[2], g[4])
            second = struct.pack(">hhh2x", g[1], g[3], g[5])
            for can_id, data in ((0x200, first), (0x201, second)):
                bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    player = threading.Thread(target=play)
    player.start()
    source = CanWrench(config)
    try:
        source.start()
        for sample in read_until(source, 50):
            np.testing.assert_allclose(sample.wrench, matrix @ gauges)
    finally:
        source.close()
        ended.set()
        player.join()
        bus.shutdown()


def test_wrenches_that_pile_up_are_told_by_their_rate(cell):
    """A cell that sends half of what its configuration says looks to the driver like a slow interface."""
    config = config_for(cell.port)
    description = config.can.description
    slow = replace(description, rates={1000: description.rates[500]})
    source = CanWrench(config_for(cell.port, description=slow))
    try:
        source.start()
        assert fault_of(source)[0] is ForceFault.INCOMPLETE
        with pytest.raises(ForceError, match=r"[45]\d\d wrenches/s of 1000"):
            source.read()
    finally:
        source.close()
