# SPDX-License-Identifier: Apache-2.0
"""The driver on a simulated cell in simulated time; what a real adapter does, on the wall clock."""

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

sys.path.insert(0, str(Path(__file__).parent))
from cell_bench import HOST, STEP_NS, CellBench, cell_config  # noqa: E402

from tactile_resonance.drivers import can_wrench  # noqa: E402
from tactile_resonance.drivers.can_bus import open_bus  # noqa: E402
from tactile_resonance.drivers.can_wrench import CanWrench  # noqa: E402
from tactile_resonance.simulation.cell.tcp_bus import QUIET_S  # noqa: E402

PATIENCE_S = 60.0
SHORTEST_DELAY_S = 1e-4  # of config/force/can_simulated.yaml: taken off every stamp


@pytest.fixture
def bench():
    made = CellBench()
    yield made
    made.close()


@pytest.fixture
def make_source(bench):
    """Make drivers of the bench's cell; all are closed after the test."""
    made = []

    def make(**changes):
        made.append(CanWrench(bench.config(**changes), bench.clock))
        return made[-1]

    yield make
    for source in made:
        source.close()


def fault_of(bench, source, limit=5000):
    """Let time go on until the driver gives up; the error, and after how many wrenches of the cell."""
    for ticks in range(1, limit):
        try:
            bench.go(source, 1)
        except ForceError as error:
            return error, ticks
    pytest.fail("no fault was found")


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_a_thousand_wrenches_a_second_arrive_without_loss(bench, make_source, steps):
    source = make_source()
    source.start()
    begun_ns = bench.clock.now_ns()
    samples = bench.go(source, 4000 // steps, steps)
    count = 4000 // steps * steps
    assert len(samples) == source.received == count
    assert source.lost == 0
    # one a millisecond, none missing, none twice; those of one look were not taken when it was
    taken = begun_ns + STEP_NS * np.arange(1, count + 1)
    stamps = np.array([sample.time_ns for sample in samples])
    later = slice(2500, None)  # by then the clocks' relation is known
    assert np.all(np.diff(stamps) > 0)
    late_ns = stamps[later] - taken[later]
    # what a look is late by is least for the last wrench that it finds
    np.testing.assert_allclose(late_ns, -SHORTEST_DELAY_S * 1e9, atol=2e3)
    assert 0 < source.clock_uncertainty_s < 2e-3 * steps
    force = np.array([sample.wrench[:3] for sample in samples])
    # config/load_cells/fine.yaml: bias, 1 mN rms and steps of 0.2 mN
    rms_n = np.hypot(1e-3, 2e-4 / 12**0.5)
    np.testing.assert_allclose(
        force.mean(axis=0), [0.02, -0.01, 0.03], atol=5 * rms_n / count**0.5 + 2e-5
    )
    np.testing.assert_allclose(force.std(axis=0), rms_n, rtol=5 / (2 * count) ** 0.5)


def test_a_force_on_the_cell_is_read_from_the_wrench_on_in_which_it_acts(bench, make_source):
    source = make_source()
    source.start()
    before = np.array([s.wrench for s in bench.go(source, 400)])
    bench.wrench = (0.0, 0.0, 0.01, 0.0, 0.0, 0.0)
    after = np.array([s.wrench for s in bench.go(source, 400)])
    assert len(before) == len(after) == 400
    # standard error of either mean: 1 mN / 20
    step_n = after.mean(axis=0)[2] - before.mean(axis=0)[2]
    assert step_n == pytest.approx(0.01, abs=5 * 1e-3 / 20 * 2**0.5)
    assert after[0, 2] - before[:, 2].mean() > 0.005


@pytest.mark.parametrize(
    ("fault", "value", "named", "within"),
    [
        ("silent", 1, ForceFault.SILENT, 11),  # limits.silent_s is 10 ms
        ("stuck", 1, ForceFault.STUCK, 30),
        ("lose_second_every", 1, ForceFault.INCOMPLETE, 5),  # 3 of the last hundred are tolerated
        ("lose_second_every", 10, ForceFault.INCOMPLETE, 41),
        ("invalid", 1, ForceFault.INVALID, 1),
        ("saturated", 1, ForceFault.OVERLOAD, 3),  # limits.overload_samples
        ("flipped", 1, ForceFault.JUMP, 1),
        ("bias_step_n", 0.025, ForceFault.JUMP, 1),
    ],
)
def test_every_fault_is_named_in_time_and_its_end_brings_the_source_back(
    bench, make_source, fault, value, named, within
):
    source = make_source()
    source.start()
    bench.go(source, 50)
    bench.cell.faults.inject(fault, value)
    error, ticks = fault_of(bench, source)
    assert error.fault is named
    assert ticks <= within
    with pytest.raises(ForceError):
        source.read()  # and stays so
    bench.cell.faults.inject(fault, 0)
    source.start()
    assert len(bench.go(source, 200)) == 200


def test_a_reader_that_was_held_up_waits_once_more_for_a_cell_that_sends_nothing(
    bench, make_source
):
    source = make_source()
    source.start()
    bench.go(source, 50)
    bench.cell.faults.inject("silent", 1)
    bench.go(source, 1, steps=30)  # ms; perhaps what brings the frames was held up with it
    bench.cell.faults.inject("silent", 0)
    assert len(bench.go(source, 50)) == 50
    bench.cell.faults.inject("silent", 1)
    bench.go(source, 1, steps=30)
    error, ticks = fault_of(bench, source)
    assert error.fault is ForceFault.SILENT
    assert ticks in (10, 11)  # limits.silent_s is 10 ms


def test_a_reader_that_looks_seldom_names_a_silent_cell_at_the_second_look(bench, make_source):
    source = make_source()
    source.start()
    bench.go(source, 50)
    bench.cell.faults.inject("silent", 1)
    bench.go(source, 1, steps=20)  # ms
    with pytest.raises(ForceError, match="silent for 20 ms"):
        bench.go(source, 1, steps=20)


def test_a_cell_that_is_silent_from_the_start_is_named(bench, make_source, monkeypatch):
    source = make_source()
    bench.cell.faults.inject("silent", 1)
    with monkeypatch.context() as quick:
        quick.setattr(can_wrench, "SIMULATED_WITHIN_S", 0.1)
        with pytest.raises(ForceError, match="no answer to 'filter off'") as caught:
            source.start()
    assert caught.value.fault is ForceFault.SILENT
    bench.cell.faults.inject("silent", 0)
    source.start()
    assert len(bench.go(source, 50)) == 50


def test_a_link_that_is_cut_is_lost_and_found_again(bench, make_source):
    source = make_source()
    source.start()
    bench.go(source, 50)
    bench.bus.drop_clients()
    error, ticks = fault_of(bench, source)
    assert error.fault is ForceFault.LINK_LOST
    assert ticks <= 2
    source.start()
    assert len(bench.go(source, 50)) == 50


def test_two_readers_share_the_bus(bench, make_source):
    """The other is python-can's own client of socketcand."""
    first = make_source()
    second = can.Bus(
        interface="socketcand", host=HOST, port=bench.port, channel="can0", tcp_tune=True
    )
    try:
        first.start()
        time.sleep(QUIET_S)  # python-can reads its last `ok` alone: frames come after a while
        wrenches = np.array([sample.wrench[:3] for sample in bench.go(first, 100)])
        own = [tuple(counts) for counts in np.rint(wrenches * 5000).astype(int).tolist()]
        heard = []
        while len(heard) < len(own):
            message = second.recv(PATIENCE_S)
            assert message is not None, f"{len(heard)} wrenches of {len(own)}"
            if message.arbitration_id == 1 and message.data[0] == 0x0B:
                heard.append(struct.unpack(">3h", message.data[1:7]))
        assert heard == own
    finally:
        second.shutdown()


def test_times_of_arrival_serve_where_an_adapter_stamps_nothing(bench, make_source):
    source = make_source(stamps="arrival")
    source.start()
    begun_ns = bench.clock.now_ns()
    stamps = np.array([sample.time_ns for sample in bench.go(source, 50, steps=2)])
    assert len(stamps) == 100
    looked = begun_ns + 2 * STEP_NS * np.arange(1, 51)
    # those that were found together came one after the other
    np.testing.assert_array_equal(stamps[::2], looked - round(SHORTEST_DELAY_S * 1e9))
    np.testing.assert_array_equal(stamps[1::2], stamps[::2] + 1)
    assert source.clock_uncertainty_s == 1e-4


def test_before_its_start_nothing_is_read(make_source):
    with pytest.raises(ForceError, match="not started"):
        make_source().read()


def test_a_refused_setting_is_named(bench, make_source):
    description = bench.config().description
    commands = description.commands
    odd = replace(commands.setup[0], name="filter 7", data=bytes([0x08, 7, 0]))
    source = make_source(description=replace(description, commands=replace(commands, setup=(odd,))))
    with pytest.raises(ForceError, match="filter 7: out of range") as caught:
        source.start()
    assert caught.value.fault is ForceFault.REFUSED


def test_wrenches_that_pile_up_are_told_by_their_rate(bench, make_source):
    """A cell that sends half of what its configuration says looks to the driver like a slow interface."""
    description = bench.config().description
    slow = replace(description.commands, rates={1000: description.commands.rates[500]})
    source = make_source(description=replace(description, commands=slow))
    source.start()
    error, ticks = fault_of(bench, source)
    assert error.fault is ForceFault.INCOMPLETE
    assert ticks == pytest.approx(1000, abs=4)  # two windows of half a second
    with pytest.raises(ForceError, match=r"(499|500|501) wrenches/s of 1000 .* rate_hz"):
        source.read()


class StandingClock:
    """Simulated time that stands: nothing is ever late."""

    simulated = True

    def now_ns(self):
        return 1_000_000_000


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
        rate_hz=500.0,
        limits=replace(base.limits, stuck_samples=10**6),
        bus={"interface": "virtual", "channel": "polled"},
        description=read_can_description(path),
        **{"counts_per_n": None, "counts_per_nm": None, "matrix": matrix, "resolution_n": 1e-3},
        stamps="arrival",
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
    source = CanWrench(config, StandingClock())
    try:
        source.start()
        for sample in read_until(source, 50):
            np.testing.assert_allclose(sample.wrench, matrix @ gauges)
    finally:
        source.close()
        ended.set()
        player.join()
        bus.shutdown()


# On the wall clock, for a real adapter's connection is made, lost and judged in this machine's time.


def read_until(source, count):
    samples = []
    deadline_s = time.monotonic() + PATIENCE_S
    while len(samples) < count:
        assert time.monotonic() < deadline_s
        samples += source.read()
        time.sleep(0.001)
    return samples


def patient(config):
    """Slower to call the cell silent, since tests share their machine."""
    return replace(config, limits=replace(config.limits, silent_s=1.0))


class CellProcess:
    """``tactile_resonance simulate-cell``."""

    def __init__(self, port=0):
        command = [sys.executable, "-m", "tactile_resonance.cli", "simulate-cell"]
        self._process = subprocess.Popen(
            [*command, "--host", HOST, "--port", str(port)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.port = int(self._process.stdout.readline().rsplit(":", 1)[1])

    def kill(self):
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()


def test_a_server_that_dies_is_a_lost_link_and_another_in_its_place_is_found(monkeypatch):
    monkeypatch.setattr(can_wrench, "ANSWER_WITHIN_S", PATIENCE_S)
    first = CellProcess()
    source = CanWrench(patient(cell_config(HOST, first.port)))
    begun_ns = time.monotonic_ns()
    source.start()
    for sample in read_until(source, 50):  # dated on this machine's clock
        assert begun_ns - 1e9 < sample.time_ns < time.monotonic_ns()
    first.kill()
    with pytest.raises(ForceError) as caught:
        read_until(source, 10**6)
    assert caught.value.fault is ForceFault.LINK_LOST
    with pytest.raises(ForceError, match="refused") as caught:
        source.start()
    assert caught.value.fault is ForceFault.LINK_LOST
    second = CellProcess(first.port)
    try:
        source.start()
        read_until(source, 50)
    finally:
        source.close()
        second.kill()


def test_a_time_limit_of_the_interface_itself_keeps_its_words(monkeypatch):
    def no_answer(**settings):
        raise TimeoutError("adapter did not acknowledge")

    monkeypatch.setattr(can, "Bus", no_answer)
    with pytest.raises(ForceError, match="cell: adapter did not acknowledge"):
        open_bus({"interface": "slcan", "channel": "x"}, "cell", None, 0.1)


def test_a_server_that_says_nothing_does_not_hold_up_the_start():
    with socket.create_server((HOST, 0)) as mute:
        source = CanWrench(cell_config(HOST, mute.getsockname()[1]))
        with pytest.raises(ForceError, match="not open after") as caught:
            source.start()
        assert caught.value.fault is ForceFault.LINK_LOST
