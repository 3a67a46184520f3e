# SPDX-License-Identifier: Apache-2.0
"""Ports of the simulated robot byte by byte, without ur_rtde: the protocol as its guide tells it."""

import contextlib
import signal
import socket
import struct
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_resonance.simulation.ur5e.rtde_server import HEADER, Kind, Layout, packet

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
VALUES = {
    "DOUBLE": NUMBERS,
    "INT32": st.integers(-(2**31), 2**31 - 1),
    "UINT32": st.integers(0, 2**32 - 1),
    "UINT64": st.integers(0, 2**64 - 1),
    "UINT8": st.integers(0, 255),
    "VECTOR3D": st.lists(NUMBERS, min_size=3, max_size=3),
    "VECTOR6D": st.lists(NUMBERS, min_size=6, max_size=6),
    "VECTOR6INT32": st.lists(st.integers(-(2**31), 2**31 - 1), min_size=6, max_size=6),
}


@given(
    st.lists(st.sampled_from(sorted(VALUES)).flatmap(lambda t: st.tuples(st.just(t), VALUES[t])))
)
def test_data_packets_carry_what_was_packed(fields):
    layout = Layout([f"v{k}" for k in range(len(fields))], [kind for kind, _ in fields])
    data = layout.pack(7, [value for _, value in fields])
    payload = data[HEADER.size :]
    assert HEADER.unpack_from(data) == (len(data), Kind.DATA)
    assert payload[0] == 7
    assert layout.unpack(payload) == [value for _, value in fields]
    assert layout.unpack(payload + b"\0") is None


class Rtde:
    """A client of bytes."""

    def __init__(self, host):
        self.socket = socket.create_connection((host, 30004), 5)

    def send(self, kind, payload=b""):
        self.socket.sendall(packet(kind, payload))

    def next(self, kind):
        """Payload of the next packet of a kind."""
        while True:
            size, found = HEADER.unpack(self._read(HEADER.size))
            payload = self._read(size - HEADER.size)
            if found == kind:
                return payload

    def _read(self, size):
        data = b""
        while len(data) < size:
            part = self.socket.recv(size - len(data))
            if not part:
                raise ConnectionError("closed")
            data += part
        return data

    def ask(self, kind, payload=b""):
        self.send(kind, payload)
        return self.next(kind)


@pytest.fixture
def connect(robot):
    clients = []

    def make():
        clients.append(Rtde(robot.host))
        return clients[-1]

    yield make
    for client in clients:
        client.socket.close()


def test_versions(connect):
    client = connect()
    assert client.ask(Kind.PROTOCOL_VERSION, struct.pack(">H", 1)) == b"\0"
    assert client.ask(Kind.PROTOCOL_VERSION, struct.pack(">H", 2)) == b"\1"
    assert struct.unpack(">4I", client.ask(Kind.CONTROLLER_VERSION))[0] == 5


@pytest.mark.parametrize(("rate_hz", "period_s"), [(500.0, 0.002), (125.0, 0.008), (100.0, 0.01)])
def test_outputs_come_at_the_rate_asked_for(connect, rate_hz, period_s):
    client = connect()
    answer = client.ask(Kind.OUTPUTS, struct.pack(">d", rate_hz) + b"timestamp,runtime_state,")
    assert answer == b"\x01DOUBLE,UINT32"
    assert client.ask(Kind.START) == b"\1"
    stamps = [struct.unpack(">BdI", client.next(Kind.DATA))[1] for _ in range(20)]
    gaps = [b - a for a, b in zip(stamps, stamps[1:], strict=False)]
    assert gaps == pytest.approx([period_s] * 19, abs=1e-9)
    assert client.ask(Kind.PAUSE) == b"\1"


def test_unknown_variables_are_not_found_and_nothing_starts(connect):
    client = connect()
    answer = client.ask(Kind.OUTPUTS, struct.pack(">d", 500.0) + b"timestamp,no_such_thing,")
    assert answer == b"\0DOUBLE,NOT_FOUND"
    assert client.ask(Kind.START) == b"\0"
    assert client.ask(Kind.INPUTS, b"no_such_input,") == b"\0NOT_FOUND"
    assert client.ask(Kind.OUTPUTS, struct.pack(">d", 0.0) + b"timestamp,")[0] == 0


def test_inputs_belong_to_one_client_until_it_leaves(robot, connect):
    first, second = connect(), connect()
    names = b"input_int_register_20,input_double_register_20,"
    assert first.ask(Kind.INPUTS, names) == b"\x01INT32,DOUBLE"
    assert second.ask(Kind.INPUTS, names) == b"\0IN_USE,IN_USE"
    first.socket.close()
    robot.until(rtde_connections=1)
    assert second.ask(Kind.INPUTS, names) == b"\x01INT32,DOUBLE"
    robot.order("registers_in_use", value=True)
    assert connect().ask(Kind.INPUTS, b"input_int_register_3,") == b"\0IN_USE"
    robot.order("registers_in_use", value=False)


def test_a_packet_of_the_wrong_size_writes_nothing(robot, connect):
    writer, reader = connect(), connect()
    assert writer.ask(Kind.INPUTS, b"standard_digital_output_mask,standard_digital_output,")[0] == 1
    reader.ask(Kind.OUTPUTS, struct.pack(">d", 500.0) + b"actual_digital_output_bits,")
    reader.ask(Kind.START)

    def bits():
        reader.socket.settimeout(60)
        return [struct.unpack(">BQ", reader.next(Kind.DATA))[1] for _ in range(30)][-1]

    writer.send(Kind.DATA, bytes([1, 1, 1, 1]))  # one byte too many
    writer.send(Kind.DATA, bytes([9, 1, 1]))  # no such recipe
    assert bits() & 1 == 0
    writer.send(Kind.DATA, bytes([1, 1, 1]))
    assert bits() & 1 == 1
    writer.send(Kind.DATA, bytes([1, 1, 0]))
    assert bits() & 1 == 0


def test_nonsense_ends_the_connection_and_nothing_else(robot, connect):
    client = connect()
    client.socket.sendall(b"\0\0\0\0")
    assert client.socket.recv(10) == b""
    with socket.create_connection((robot.host, 29999), 5) as dashboard:
        dashboard.sendall(b"x" * 5000)
        while dashboard.recv(4096):
            pass
    assert robot.order("state")["runtime_state"] in ("STOPPED", "PLAYING")


def test_dashboard(robot):
    assert robot.dashboard("robotmode") == "Robotmode: RUNNING"
    assert robot.dashboard("load nothing.urp") == "File not found: nothing.urp"
    assert robot.dashboard("sing") == "could not understand: 'sing'"
    robot.order("remote_control", value=False)
    assert robot.dashboard("is in remote control") == "false"
    assert "not in remote control" in robot.dashboard("power off")
    robot.order("remote_control", value=True)
    assert robot.order("state")["robot_mode"] == "RUNNING"
    assert robot.dashboard("power off") == "Powering off"
    robot.power_up()


def test_programs_that_are_not_the_clients_are_logged_and_not_run(robot):
    robot.dashboard("stop")
    with socket.create_connection((robot.host, 30003), 5) as script:
        script.sendall(b"def other():\n  movej([0,0,0,0,0,0])\nend\n")
    robot.until(runtime_state="STOPPED")
    assert any("rtde_control" in line for line in robot.order("log")["log"])
    with socket.create_connection((robot.host, 30003), 5) as script:
        script.sendall(b"movej([0,0,0,0,0,0])\n")  # a robot does a single line, the model does not
    end = time.monotonic() + 5
    while "no line 'end'" not in robot.order("log")["log"][-1]:
        assert time.monotonic() < end


def test_second_robot_on_an_address_says_why_it_ends(robot, capsys):
    from tactile_resonance.cli import main

    assert main(["simulate-ur", "--host", robot.host]) == 1
    error = capsys.readouterr().err
    assert "port 30004" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ends_in_order(start_robots, number):
    (robot,) = start_robots()
    robot.process.send_signal(number)
    output, _ = robot.process.communicate(timeout=60)
    assert robot.process.returncode == 0
    assert "robot time" in output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--host", "192.168.0.1"], "accepted is an address 127"),
        (["--tissue", "granite"], "tissue"),
        (["--priority", "100"], "priority: got 100"),
        (["--tissue", "gel12", "--can-port", "99999"], "can-port: got 99999"),
        (["--tissue", "gel12", "--table", *"00000", "nan"], "table: "),
        (["--tilt", "nan"], "tilt: serves only with --tissue"),
        (["--can-port", "29537"], "can-port: serves only with --tissue or --scene"),
        (["--tissue", "gel12", "--table", *"000000"], "table: serves only with --scene"),
    ],
)
def test_wrong_options_are_one_line(options, message, capsys):
    from tactile_resonance.cli import main

    assert main(["simulate-ur", "--host", "127.200.1.1", *options]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_requests_that_no_packet_can_answer_close_their_connection_only(robot, connect):
    """Types of so many variables, or their values, are longer than a packet can be."""
    for names in ("x," * 20000, "target_q," * 3000):
        client = connect()
        client.ask(Kind.PROTOCOL_VERSION, struct.pack(">H", 2))
        client.send(Kind.OUTPUTS, struct.pack(">d", 500.0) + names.encode())
        with pytest.raises(ConnectionError):
            client.next(Kind.OUTPUTS)
    assert robot.order("state")["robot_mode"] == "RUNNING"


def test_a_crowd_leaves_the_other_ports_and_the_robot_alone(robot, connect):
    """More clients than a port serves, and some that vanish while they speak."""
    crowd = [socket.create_connection((robot.host, 30004), 5) for _ in range(150)]
    try:
        assert robot.order("state")["rtde_connections"] <= 100
        assert robot.dashboard("robotmode") == "Robotmode: RUNNING"
    finally:
        for k, client in enumerate(crowd):
            with contextlib.suppress(OSError):
                client.sendall(b"\0\x05V"[: 1 + k % 3])
            client.close()
    robot.until(rtde_connections=0)
    assert connect().ask(Kind.PROTOCOL_VERSION, struct.pack(">H", 2)) == b"\1"
