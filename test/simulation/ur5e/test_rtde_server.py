# SPDX-License-Identifier: Apache-2.0
"""While time stands the robot tells its state again and again, also to who comes only then."""

import struct

import pytest

from tactile_resonance.simulation.ur5e.controller import UrController
from tactile_resonance.simulation.ur5e.rtde_server import Kind, PacketReader, RtdeServer, packet


class Connection:
    """Keeps what the server sends."""

    peer_port = 40_000

    def __init__(self):
        self._reader = PacketReader()
        self.packets = []

    def send(self, data, droppable=False):
        self.packets += [(Kind(kind), payload) for kind, payload in self._reader.add(data)]
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
    service = server.serve(connection)
    service.received(packet(Kind.OUTPUTS, struct.pack(">d", 500.0) + names))
    service.received(packet(Kind.START, b""))
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
    server.serve(connection).received(packet(Kind.OUTPUTS, struct.pack(">d", 500.0) + b"timestamp"))
    server.repeat()
    assert connection.stamps_s == []
