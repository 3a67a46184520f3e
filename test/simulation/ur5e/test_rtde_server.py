# SPDX-License-Identifier: Apache-2.0
"""While time stands the robot tells its state again and again, also to who comes only then."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_resonance.simulation.ur5e.controller import UrController
from tactile_resonance.simulation.ur5e.reactor import Service
from tactile_resonance.simulation.ur5e.rtde_server import HEADER, Kind, RtdeServer, packet


class Connection:
    """Keeps what the server sends."""

    peer_port = 40_000
    is_open = True

    def __init__(self):
        self.packets = []

    def send(self, data, droppable=False):
        size, kind = HEADER.unpack_from(data)
        assert size == len(data)
        self.packets.append((Kind(kind), data[HEADER.size :]))
        return True

    @property
    def stamps_s(self):
        """Time stamps of the outputs; the recipe's number is before each."""
        return [struct.unpack(">d", p[1:9])[0] for kind, p in self.packets if kind is Kind.DATA]


@pytest.fixture
def server():
    server = RtdeServer(UrController())
    for _ in range(5):
        server.controller.step()
    return server


def client(server, names=b"timestamp"):
    connection = Connection()
    connection.service = Service(connection, server.serve(connection))
    connection.service.received(packet(Kind.OUTPUTS, struct.pack(">d", 500.0) + names))
    connection.service.received(packet(Kind.START, b""))
    return connection


def test_who_comes_while_time_stands_is_told_the_state_of_now(server):
    connection = client(server)
    assert connection.stamps_s == []
    server.repeat()
    server.repeat()
    assert connection.stamps_s == [server.controller.time_s] * 2
    assert server.sent_ns(connection.peer_port) == round(server.controller.time_s * 1e9)


def test_what_was_sent_is_sent_again(server):
    connection = client(server)
    server.publish(1)
    then_s = server.controller.time_s
    server.controller.step()  # nobody was told of it
    server.repeat()
    assert connection.stamps_s == [then_s] * 2


def test_nothing_is_sent_to_a_client_that_has_not_started(server):
    connection = Connection()
    service = Service(connection, server.serve(connection))
    service.received(packet(Kind.OUTPUTS, struct.pack(">d", 500.0) + b"timestamp"))
    server.repeat()
    assert connection.stamps_s == []


@given(
    st.lists(st.just(b"\0\2") | st.binary(max_size=40)),
    st.lists(st.integers(1, 20), min_size=1),
)
def test_packets_come_whole_however_the_stream_is_cut(payloads, cuts):
    connection, k = Connection(), 0
    service = Service(connection, RtdeServer(UrController()).serve(connection))
    stream = b"".join(packet(Kind.PROTOCOL_VERSION, payload) for payload in payloads)
    while stream:
        piece, stream = stream[: cuts[k % len(cuts)]], stream[cuts[k % len(cuts)] :]
        service.received(piece)
        k += 1
    answers = [bytes([payload == b"\0\2"]) for payload in payloads]
    assert connection.packets == [(Kind.PROTOCOL_VERSION, answer) for answer in answers]
