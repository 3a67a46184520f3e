# SPDX-License-Identifier: Apache-2.0
"""What waits on a connection of a simulated port: for the network, or for the end of a step."""

import socket

import pytest

from tactile_resonance.simulation.ur5e.reactor import Reactor

HOST, LIMIT = "127.0.0.1", 10_000


@pytest.fixture
def ends():
    """A reactor, its end of a connection of few unread bytes, and the client's."""
    reactor, served = Reactor(HOST), []

    def serve(connection):
        served.append(connection)
        while True:
            yield None

    port = reactor.listen(0, serve, most_unsent=LIMIT)
    with socket.create_connection((HOST, port)) as client:
        while not served:
            reactor.serve(0.01)
        yield reactor, served[0], client
    reactor.close()


def test_what_is_gathered_in_a_step_is_sent_whole_however_much_it_is(ends):
    reactor, connection, client = ends
    reactor.gathers = True
    assert all(connection.send(b"x" * 3000) for _ in range(20))
    reactor.gathers = False
    client.settimeout(5.0)
    read = 0
    while read < 60_000:
        read += len(client.recv(65536))
    assert connection.is_open


def test_who_does_not_read_is_disconnected(ends):
    _, connection, _ = ends
    sent = 0
    while connection.send(b"x" * 3000):
        sent += 3000
        assert sent < 2**26, "more than any network takes"
    assert not connection.is_open
