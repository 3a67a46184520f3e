# SPDX-License-Identifier: Apache-2.0
"""Frames of a socketcand server, however TCP cuts or joins its text; what it may answer and how it may end.

Texts are those of linux-can/socketcand, doc/protocol.md.
"""

import contextlib
import threading
import time

import numpy as np
import pytest
from one_client import PATIENCE_S, one_client, wait_until_arrived

from tactile_resonance.contact.interfaces import ForceError, ForceFault

pytest.importorskip("can", reason="python-can is not installed")

from tactile_resonance.drivers import can_bus
from tactile_resonance.drivers.can_bus import ERROR, EXTENDED, SocketcandBus, open_bus

HOST = "127.0.6.5"
GOOD = ((b"", b"< hi >"), (b"< open can0 >", b"< ok >"), (b"< rawmode >", b"< ok >"))


@pytest.fixture
def serve():
    """Make servers; all are closed after the test."""
    with contextlib.ExitStack() as stack:
        yield lambda dialogue=GOOD: stack.enter_context(one_client((HOST, 0), dialogue))


@pytest.fixture
def opened(serve):
    server = serve()
    bus = SocketcandBus(HOST, server.port, "can0")
    server.join()
    assert server.heard == [request for request, _ in GOOD]
    yield server, bus
    bus.close()


def read(bus, count):
    """So many frames as they come; no more may come."""
    frames, end_s = [], time.monotonic() + PATIENCE_S
    while len(frames) < count:
        assert time.monotonic() < end_s, f"{len(frames)} of {count}"
        bus.wait(1.0)
        frames += bus.read()
    assert bus.read() == []
    return frames


def content(frames):
    return [(f.can_id, f.data, f.stamp_s) for f in frames]


TEXTS = (
    (b"< frame 001 1700000000.250000 0B01F4FC18138803 >",
     (1, bytes.fromhex("0B01F4FC18138803"), 1700000000.25)),
    (b"< frame 7FF 12.000001 >", (0x7FF, b"", 12.000001)),
    (b"< frame 064 0.5 0B 0c >", (0x64, b"\x0b\x0c", 0.5)),
    (b"< frame 00000001 3.5 FF >", (1 | EXTENDED, b"\xff", 3.5)),
    (b"< error 20000008 4.25 >", (8 | ERROR | EXTENDED, b"", 4.25)),
)  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_frames_come_whole_and_in_order_however_the_text_is_cut(opened, seed):
    server, bus = opened
    rng = np.random.default_rng(seed)
    chosen = [TEXTS[k] for k in rng.integers(0, len(TEXTS), 200)]
    # an answer that is no frame is passed over
    text = b"".join(words + b"< echo >" * (k % 7 == 0) for k, (words, _) in enumerate(chosen))
    got, at, begun_ns = [], 0, time.monotonic_ns()
    while at < len(text):
        size = int(rng.choice([1, 2, 7, 40, 100, 3000]))
        server.channel.sendall(text[at : at + size])
        at += size
        if rng.random() < 0.7:
            got += bus.read()
    got += read(bus, len(chosen) - len(got))
    assert content(got) == [frame for _, frame in chosen]
    assert bus.frames == len(chosen)
    arrivals = [frame.arrival_ns for frame in got]
    assert arrivals == sorted(arrivals)
    assert begun_ns <= arrivals[0]
    assert arrivals[-1] <= time.monotonic_ns()


def test_frames_that_follow_the_last_answer_at_once_are_not_lost(serve):
    server = serve((*GOOD[:2], (b"< rawmode >", b"< ok >" + TEXTS[0][0] + TEXTS[1][0][:9])))
    bus = SocketcandBus(HOST, server.port, "can0")
    server.join()
    server.channel.sendall(TEXTS[1][0][9:])
    assert content(read(bus, 2)) == [TEXTS[0][1], TEXTS[1][1]]
    bus.close()


def test_it_is_drained_once_nothing_more_waits(opened, monkeypatch):
    server, bus = opened
    monkeypatch.setattr(can_bus, "_AT_ONCE", 10 * len(TEXTS[0][0]))
    assert bus.read() == []
    assert bus.drained
    server.channel.sendall(TEXTS[0][0] * 25)
    wait_until_arrived(bus._socket.fileno(), 25 * len(TEXTS[0][0]))
    seen = []
    while bus.frames < 25:
        bus.wait(PATIENCE_S)
        seen.append((len(bus.read()), bus.drained))
    assert seen == [(10, False), (10, False), (5, True)]


@pytest.mark.parametrize(
    ("extended", "text"), [(False, b"< send 064 2 0F 08 >"), (True, b"< send 00000064 2 0F 08 >")]
)
def test_frames_are_sent_as_the_protocol_has_it(opened, extended, text):
    server, bus = opened
    bus.send(0x64, b"\x0f\x08", extended)
    server.channel.settimeout(PATIENCE_S)
    assert server.channel.recv(100) == text


@pytest.mark.parametrize("said", [b"", b"< frame 001 1.0 0B >"])
def test_a_server_that_closes_is_found_after_its_last_frame(opened, said):
    server, bus = opened
    server.channel.sendall(said)
    server.channel.close()
    if said:
        bus.wait(PATIENCE_S)
        assert len(bus.read()) == 1
    with pytest.raises(ConnectionError, match="closed the connection"):
        read(bus, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"< frame 001 1.0 0B0 >", "sends .*0B0"),
        (b"< frame 0x 1.0 0B >", "sends"),
        (b"< frame 001 soon 0B >", "soon"),
        (b"x" * 5000, "without end"),
    ],
)
def test_what_is_no_frame_is_an_error_that_quotes_it(opened, text, message):
    server, bus = opened
    server.channel.sendall(text)
    with pytest.raises(ConnectionError, match=message):
        read(bus, 1)


SETTINGS = {"interface": "socketcand", "host": HOST, "channel": "can0"}


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ((GOOD[0], (b"< open can0 >", b"< error could not open bus >")), "could not open bus"),
        ((), "not open after"),
    ],
)
def test_a_bus_that_is_not_opened_says_why(serve, monkeypatch, answers, message):
    monkeypatch.setattr(can_bus, "OPEN_WITHIN_S", 0.5)
    server = serve(answers)
    with pytest.raises(ForceError, match=f"the cell: .*{message}") as caught:
        open_bus({**SETTINGS, "port": server.port}, "the cell", None, 0.1)
    assert caught.value.fault is ForceFault.LINK_LOST


def test_a_server_that_closes_at_once_is_a_lost_link(serve):
    server = serve(((b"", b"< hi >"),))
    closer = threading.Thread(target=lambda: (server.join(), server.channel.close()))
    closer.start()
    with pytest.raises(ForceError, match="the cell: .*(closed|reset|pipe)"):
        open_bus({**SETTINGS, "port": server.port}, "the cell", None, 0.1)
    closer.join()


def test_it_is_read_in_batches_unless_it_has_to_be_asked_for_each_wrench(serve):
    server = serve()
    bus = open_bus({**SETTINGS, "port": server.port}, "the cell", None, 0.1)
    assert isinstance(bus, SocketcandBus)
    bus.close()
