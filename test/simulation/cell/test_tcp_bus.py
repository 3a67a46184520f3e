# SPDX-License-Identifier: Apache-2.0
"""The buses over TCP, byte by byte and through python-can."""

import contextlib
import re
import resource
import socket
import threading
import time
from types import SimpleNamespace

import pytest

from tactile_resonance.simulation.cell import tcp_bus
from tactile_resonance.simulation.cell.tcp_bus import (
    QUIET_S,
    SlcanServer,
    SocketcandServer,
)
from tactile_resonance.simulation.cell.transducer import CanFrame
from tactile_resonance.simulation.plant.bench_time import STALL_S
from tactile_resonance.simulation.ur5e import reactor as reactor_module
from tactile_resonance.simulation.ur5e.reactor import Reactor, Service, Until

HOST = "127.0.6.3"
FRAME = CanFrame(1.25, 0x001, bytes.fromhex("0B01F4FC18138803"))
ANSWER = CanFrame(2.5, 0x002, b"\x01\x02")
WITHIN_S = 60.0


class Served:
    """A bus, the reactor that serves it, what the cell was sent, and a clock that goes on when told."""

    def __init__(self, kind, monkeypatch):
        self.now_s = 100.0
        clock = SimpleNamespace(monotonic=lambda: self.now_s)
        monkeypatch.setattr(tcp_bus, "time", clock)
        self.frames, self.answer = [], []
        self.reactor = Reactor(HOST)
        self.bus = kind(self.reactor, 0, self._receive)

    def _receive(self, can_id, data):
        self.frames.append((can_id, data))
        return self.answer


@pytest.fixture
def served(monkeypatch):
    made = Served(SocketcandServer, monkeypatch)
    yield made
    made.reactor.close()


@pytest.fixture
def adapter(monkeypatch):
    made = Served(SlcanServer, monkeypatch)
    yield made
    made.reactor.close()


class Talk:
    """A client that is spoken for by the test."""

    # a question that is answered in any state: all that was said before it has been understood then
    LAST = {SocketcandServer: (b"< echo >", b"< echo >"), SlcanServer: (b"V\r", b"V0000\r")}

    def __init__(self, served):
        self._reactor = served.reactor
        self._question, self._answer = self.LAST[type(served.bus)]
        self.socket = socket.create_connection((HOST, served.bus.port))
        self.socket.setblocking(False)
        self.hear()

    def hear(self):
        """All that comes."""
        return self.say(b"")

    def say(self, text):
        """Say something; all that has come until it was understood."""
        self.socket.sendall(text + self._question)
        heard, deadline_s = b"", time.monotonic() + WITHIN_S
        while not heard.endswith(self._answer):
            assert time.monotonic() < deadline_s, heard
            self._reactor.serve(0.01)
            with contextlib.suppress(BlockingIOError):
                heard += self.socket.recv(65536)
        return heard.removesuffix(self._answer)

    def ended(self):
        """Whether the bus closes the connection."""
        deadline_s = time.monotonic() + WITHIN_S
        while time.monotonic() < deadline_s:
            self._reactor.serve(0.01)
            with contextlib.suppress(BlockingIOError, ConnectionResetError):
                if not self.socket.recv(65536):
                    return True
        return False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()


def listening(served, *clients):
    for client in clients:
        client.say(b"< open can0 >< rawmode >")
    served.now_s += QUIET_S


def test_the_greeting_is_exactly_that_of_socketcand(served):
    with socket.create_connection((HOST, served.bus.port), WITHIN_S) as client:
        served.reactor.serve(WITHIN_S)
        assert client.recv(100) == b"< hi >"
    with Talk(served) as client:
        assert client.say(b"< open can0 >") == b"< ok >"
        assert client.say(b"< rawmode >") == b"< ok >"
        served.now_s += QUIET_S
        served.bus.epoch_s = 1000.0
        served.bus.send([FRAME])
        assert client.hear() == b"< frame 001 1001.250000 0B01F4FC18138803 >"


def test_no_frame_is_glued_to_the_last_ok(served):
    with Talk(served) as client:
        assert client.say(b"< open can0 >< rawmode >") == b"< ok >< ok >"
        served.now_s += 0.9 * QUIET_S
        served.bus.send([FRAME])
        assert client.hear() == b""
        # who speaks has read it
        client.say(b"< send 64 1 b >")
        served.bus.send([FRAME])
        assert b"0B01F4" in client.hear()


def test_frames_to_the_bus_may_come_in_pieces(served):
    with Talk(served) as client:
        client.socket.sendall(b"< open can0 >< rawmode >< send 64 2 f 8 >< se")
        served.reactor.serve(WITHIN_S)
        client.say(b"nd 064 1 b >")
        assert served.frames == [(0x64, b"\x0f\x08"), (0x64, b"\x0b")]


def test_every_client_hears_the_bus_and_what_the_cell_answers_to_one(served):
    served.answer = [ANSWER]
    with Talk(served) as first, Talk(served) as second, Talk(served) as deaf:
        listening(served, first, second)
        served.bus.send([FRAME])
        assert b"0B01F4" in first.say(b"< send 64 1 b >")
        heard = second.hear()
        assert b"0B01F4" in heard
        assert b"< frame 002 2.500000 0102 >" in heard
        assert deaf.hear() == b""


def test_frames_are_counted_for_each_client_from_when_it_listens(served):
    with Talk(served) as first, Talk(served) as second:
        ports = [client.socket.getsockname()[1] for client in (first, second)]
        listening(served, first)
        served.bus.send([FRAME] * 3)
        listening(served, second)
        served.bus.send([FRAME] * 4)
        assert [served.bus.frames_sent(port) for port in ports] == [7, 4]
    assert served.bus.frames_sent(1) == 0


def test_stamps_keep_to_the_plant_and_are_never_ahead_of_this_machine(served):
    bus = served.bus
    bus.keep_epoch(1000.0, 1.0)
    assert bus.epoch_s == 999.0
    bus.keep_epoch(1001.0 + 0.9 * STALL_S, 2.0)  # the plant is late by less than a stall
    assert bus.epoch_s == 999.0
    bus.keep_epoch(1002.0 + 1.1 * STALL_S, 3.0)
    assert bus.epoch_s == pytest.approx(999.0 + 1.1 * STALL_S)
    bus.keep_epoch(1003.0, 4.001)
    assert bus.epoch_s + 4.001 <= 1003.0


@pytest.mark.parametrize(
    ("nonsense", "answer"),
    [
        (b"< send 64 3 1 >", b"< error syntax of send >"),
        (b"< send zz 1 1 >", b"< error syntax of send >"),
        (b"< send 64 1 -1 >", b"< error syntax of send >"),
        (b"< send 64 1 1ff >", b"< error syntax of send >"),
        (b"< send >", b"< error syntax of send >"),
        (b"\xff>", b"< error unknown command >"),
    ],
)
def test_who_speaks_nonsense_is_told_so_and_the_others_are_served(served, nonsense, answer):
    with Talk(served) as good, Talk(served) as bad:
        listening(served, good, bad)
        assert bad.say(nonsense) == answer
        assert not served.frames
        served.bus.send([FRAME])
        assert b"0B01F4" in good.hear()


def test_nobody_sends_before_the_bus_is_raw(served):
    with Talk(served) as client:
        assert client.say(b"< send 64 1 b >") == b"< error unknown command >"
        assert not served.frames


def test_a_message_without_end_costs_its_sender_the_link_and_nobody_time(served, monkeypatch):
    """A client that sends faster than it is read must not keep the bus, and what steps it, to itself."""
    pieces = []
    received = Service.received

    def noted(client, data):
        pieces.append(len(data))
        received(client, data)

    monkeypatch.setattr(Service, "received", noted)
    with Talk(served) as good, Talk(served) as bad:
        listening(served, good)
        ended = threading.Event()

        def flood():
            with contextlib.suppress(OSError):
                while not ended.is_set():
                    bad.socket.sendall(b"x" * 65536)

        bad.socket.setblocking(True)
        pieces.clear()
        sender = threading.Thread(target=flood)
        sender.start()
        try:
            while len(served.bus.clients) > 1:
                before = len(pieces)
                served.reactor.serve(0.01)
                assert len(pieces) <= before + 1  # one piece, then the next step has its turn
        finally:
            ended.set()
            sender.join()
        assert max(pieces) <= reactor_module.MOST_AT_ONCE
        longest = Until(b">").longest
        assert longest < sum(pieces) <= longest + reactor_module.MOST_AT_ONCE
        assert good.say(b"< nonsense >") == b"< error unknown command >"


def test_without_a_descriptor_for_a_client_the_others_are_served(served):
    with Talk(served) as good:
        listening(served, good)
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        late = socket.socket()
        late.connect((HOST, served.bus.port))
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))
        try:
            assert good.say(b"< nonsense >") == b"< error unknown command >"
            assert len(served.bus.clients) == 1
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        good.hear()
        assert len(served.bus.clients) == 2
        late.close()


def test_another_bus_is_refused(served):
    with Talk(served) as client:
        assert client.say(b"< open can7 >") == b"< error could not open bus >"


def test_who_never_reads_is_dropped(served):
    with Talk(served) as client:
        listening(served, client)
        for _ in range(400):
            served.bus.send([FRAME] * 500)
        assert not served.bus.clients


def test_clients_that_are_dropped_may_come_back(served):
    with Talk(served) as client:
        served.bus.drop_clients()
        assert client.ended()
    with Talk(served) as client:
        assert client.say(b"< open can0 >") == b"< ok >"


def test_a_client_that_is_dropped_by_what_it_says_is_forgotten_with_the_rest_of_it(served):
    taken = []

    def receive(can_id, data):
        taken.append(data)
        served.bus.drop_clients()
        return [ANSWER]

    served.bus = SocketcandServer(served.reactor, 0, receive)
    with Talk(served) as client:
        listening(served, client)
        client.socket.sendall(b"< send 64 1 b >< send 64 1 c >")
        assert client.ended()
        assert not served.bus.clients
    assert taken == [b"\x0b"]


def test_a_serial_adapter_answers_as_lawicels(adapter):
    with Talk(adapter) as client:
        assert client.say(b"C\rS8\r") == b"\r\r"
        assert client.say(b"t064108\r") == b"\a"  # not open yet
        assert client.say(b"O\r") == b"\r"
        assert client.say(b"S8\r") == b"\a"  # open: the speed stays
        assert client.say(b"t06420F08\r") == b"z\r"
        assert client.say(b"t0643FF\r") == b"\a"
        assert client.say(b"q\r") == b"\a"
        for nonsense in (b"t\r", b"tXYZ1AA\r", b"t064GAA\r", b"t0641G1\r", b"t06\xff1AA\r", b"\r"):
            assert client.say(nonsense) == b"\a"
        assert adapter.frames == [(0x64, b"\x0f\x08")]
        adapter.bus.send([FRAME])
        assert client.hear() == b"t00180B01F4FC18138803\r"
        assert client.say(b"C\r") == b"\r"
        adapter.bus.send([FRAME])
        assert client.hear() == b""


def test_python_can_reads_the_serial_adapter(adapter):
    pytest.importorskip("serial", reason="pyserial is not installed")
    can = pytest.importorskip("can", reason="python-can is not installed")
    # pyserial's sockets connect before the server takes them
    bus = can.Bus(
        interface="slcan",
        channel=f"socket://{HOST}:{adapter.bus.port}",
        bitrate=1_000_000,
        sleep_after_open=0.0,
    )
    try:
        bus.send(can.Message(arbitration_id=0x64, data=b"\x0b", is_extended_id=False))
        deadline_s = time.monotonic() + WITHIN_S
        while not adapter.frames and time.monotonic() < deadline_s:
            adapter.reactor.serve(0.01)
        assert adapter.frames == [(0x64, b"\x0b")]
        adapter.bus.send([FRAME])
        messages = []
        while not messages and time.monotonic() < deadline_s:
            messages += [message for message in [bus.recv(0.05)] if message]
        assert [(m.arbitration_id, bytes(m.data)) for m in messages] == [(1, FRAME.data)]
    finally:
        bus.shutdown()


def test_a_port_in_use_is_said(served):
    said = f"port {served.bus.port} of {HOST}: Address already in use"
    with pytest.raises(ValueError, match=re.escape(said)):
        SocketcandServer(served.reactor, served.bus.port, lambda can_id, data: [])
