# SPDX-License-Identifier: Apache-2.0
"""The buses over TCP, byte by byte and through python-can."""

import contextlib
import re
import resource
import socket
import threading
import time

import pytest

from tactile_resonance.simulation.load_cell import CanFrame
from tactile_resonance.simulation.slcan import SlcanServer
from tactile_resonance.simulation.socketcand import QUIET_S, SocketcandServer
from tactile_resonance.simulation.tcp_bus import MOST_AT_ONCE

HOST = "127.0.6.3"
FRAME = CanFrame(1.25, 0x001, bytes.fromhex("0B01F4FC18138803"))


@pytest.fixture
def bus():
    server = SocketcandServer(HOST, 0)
    yield server
    server.close()


@pytest.fixture
def slcan():
    server = SlcanServer(HOST, 0)
    yield server
    server.close()


class Talk:
    """A client that is spoken for by the test."""

    def __init__(self, bus):
        self.bus = bus
        self.socket = socket.create_connection((HOST, bus.port))
        self.socket.settimeout(0.02)
        self.frames = []

    def hear(self):
        """All that comes until nothing more does."""
        text = b""
        for _ in range(3):
            self.frames += self.bus.poll()
            try:
                text += self.socket.recv(65536)
            except TimeoutError:
                continue
        return text

    def say(self, text):
        self.socket.sendall(text)
        return self.hear()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()


def test_the_greeting_is_exactly_that_of_socketcand(bus):
    with Talk(bus) as client:
        assert client.hear() == b"< hi >"
        assert client.say(b"< open can0 >") == b"< ok >"
        assert client.say(b"< rawmode >") == b"< ok >"
        time.sleep(QUIET_S)
        bus.epoch_s = 1000.0
        bus.send([FRAME])
        assert client.hear() == b"< frame 001 1001.250000 0B01F4FC18138803 >"


def test_no_frame_is_glued_to_the_last_ok(bus):
    with Talk(bus) as client:
        client.say(b"< open can0 >< rawmode >")
    with Talk(bus) as client:
        client.say(b"< open can0 >")
        client.socket.sendall(b"< rawmode >")
        time.sleep(0.02)
        bus.poll()
        bus.send([FRAME])
        assert client.hear() == b"< ok >"


def test_frames_to_the_bus_may_come_in_pieces(bus):
    with Talk(bus) as client:
        client.say(b"< open can0 >< rawmode >< send 64 2 f 8 >< se")
        client.say(b"nd 064 1 b >")
        assert client.frames == [(0x64, b"\x0f\x08"), (0x64, b"\x0b")]


def test_every_client_hears_the_bus(bus):
    with Talk(bus) as first, Talk(bus) as second:
        for client in (first, second):
            client.say(b"< open can0 >< rawmode >")
        time.sleep(QUIET_S)
        bus.send([FRAME])
        assert b"0B01F4" in first.hear()
        assert b"0B01F4" in second.hear()


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
def test_who_speaks_nonsense_is_told_so_and_the_others_are_served(bus, nonsense, answer):
    with Talk(bus) as good, Talk(bus) as bad:
        good.say(b"< open can0 >< rawmode >")
        bad.say(b"< open can0 >< rawmode >")
        assert bad.say(nonsense) == answer
        assert not bad.frames
        time.sleep(QUIET_S)
        bus.send([FRAME])
        assert b"0B01F4" in good.hear()


def test_nobody_sends_before_the_bus_is_raw(bus):
    with Talk(bus) as client:
        client.hear()
        assert client.say(b"< send 64 1 b >") == b"< error unknown command >"
        assert not client.frames


def test_a_message_without_end_costs_its_sender_the_link_and_nobody_time(bus):
    """A client that sends faster than it is read must not keep the bus, and what steps it, to itself."""
    with Talk(bus) as good, Talk(bus) as bad:
        good.say(b"< open can0 >< rawmode >")
        bad.hear()
        ended = threading.Event()

        def flood():
            with contextlib.suppress(OSError):
                while not ended.is_set():
                    bad.socket.sendall(b"x" * 65536)

        sender = threading.Thread(target=flood)
        sender.start()
        try:
            while len(bus._clients) > 1:
                bus.poll()
                assert all(len(client.received) <= MOST_AT_ONCE for client in bus._clients)
        finally:
            ended.set()
            sender.join()
        assert good.say(b"< echo >") == b"< echo >"


def test_without_a_descriptor_for_a_client_the_others_are_served(bus):
    with Talk(bus) as good:
        good.say(b"< open can0 >< rawmode >")
        late = socket.socket()
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        late.connect((HOST, bus.port))
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))
        try:
            assert bus.poll() == []
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        assert good.say(b"< echo >") == b"< echo >"
        late.close()


def test_another_bus_is_refused(bus):
    with Talk(bus) as client:
        client.hear()
        assert client.say(b"< open can7 >") == b"< error could not open bus >"


def test_who_never_reads_is_dropped(bus):
    with Talk(bus) as client:
        client.say(b"< open can0 >< rawmode >")
        time.sleep(QUIET_S)
        for _ in range(400):
            bus.send([FRAME] * 500)
        assert not bus._clients


def test_clients_that_are_dropped_may_come_back(bus):
    with Talk(bus) as client:
        client.hear()
        bus.drop_clients()
        assert client.socket.recv(10) == b""
    with Talk(bus) as client:
        assert client.hear() == b"< hi >"


def test_a_serial_adapter_answers_as_lawicels(slcan):
    with Talk(slcan) as client:
        assert client.say(b"C\rS8\r") == b"\r\r"
        assert client.say(b"t064108\r") == b"\a"  # not open yet
        assert client.say(b"O\r") == b"\r"
        assert client.say(b"S8\r") == b"\a"  # open: the speed stays
        assert client.say(b"t06420F08\r") == b"z\r"
        assert client.say(b"t0643FF\r") == b"\a"
        assert client.say(b"q\r") == b"\a"
        for nonsense in (b"t\r", b"tXYZ1AA\r", b"t064GAA\r", b"t0641G1\r", b"t06\xff1AA\r", b"\r"):
            assert client.say(nonsense) == b"\a"
        assert client.frames == [(0x64, b"\x0f\x08")]
        slcan.send([FRAME])
        assert client.hear() == b"t00180B01F4FC18138803\r"
        assert client.say(b"C\r") == b"\r"
        slcan.send([FRAME])
        assert client.hear() == b""


def test_python_can_reads_the_serial_adapter(slcan):
    pytest.importorskip("serial", reason="pyserial is not installed")
    can = pytest.importorskip("can", reason="python-can is not installed")
    # pyserial's sockets connect before the server takes them
    bus = can.Bus(
        interface="slcan",
        channel=f"socket://{HOST}:{slcan.port}",
        bitrate=1_000_000,
        sleep_after_open=0.0,
    )
    try:
        bus.send(can.Message(arbitration_id=0x64, data=b"\x0b", is_extended_id=False))
        time.sleep(0.05)
        assert slcan.poll() == [(0x64, b"\x0b")]
        slcan.send([FRAME])
        messages = [message for _ in range(10) if (message := bus.recv(0.05))]
        assert [(m.arbitration_id, bytes(m.data)) for m in messages] == [(1, FRAME.data)]
    finally:
        bus.shutdown()


def test_a_port_in_use_is_said(bus):
    with pytest.raises(OSError, match=re.escape("in use")):
        SocketcandServer(HOST, bus.port)
