# SPDX-License-Identifier: Apache-2.0
"""The reader of RTDE outputs on byte streams that are written out here, as the protocol's guide has them.

Universal Robots, "Real-Time Data Exchange (RTDE) Guide": a packet is its length (u16, itself included), a type
(one character) and a payload, big-endian.
"""

import contextlib
import os
import struct
import time

import numpy as np
import pytest
from one_client import PATIENCE_S, one_client, wait_until_arrived

from tactile_resonance.drivers import rtde_stream
from tactile_resonance.drivers.rtde_stream import PORT, RobotState, RtdeStream

HOST = f"127.{1 + os.getpid() % 250}.{1 + os.getpid() // 250 % 250}.231"
VERSION = b"\x00\x05V\x00\x02"
NAMES = (
    b"timestamp,actual_TCP_pose,actual_TCP_speed,actual_TCP_force,safety_status_bits,runtime_state,"
    b"robot_mode"
)
TYPES = b"DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,UINT32,UINT32,INT32"


def packet(kind, payload=b""):
    return struct.pack(">H", 3 + len(payload)) + kind + payload


REQUESTS = (VERSION, packet(b"O", struct.pack(">d", 125.0) + NAMES), packet(b"S"))
GOOD = (packet(b"V", b"\x01"), packet(b"O", b"\x01" + TYPES), packet(b"S", b"\x01"))


@pytest.fixture
def serve():
    """Make a robot that answers in some way; it is gone after the test."""
    with contextlib.ExitStack() as stack:

        def make(answers=GOOD):
            dialogue = list(zip(REQUESTS, answers, strict=False))
            # two connections before it only show how long connecting takes
            return stack.enter_context(one_client((HOST, PORT), dialogue, probes=2, piece=7))

        yield make


@pytest.fixture
def connected(serve):
    robot = serve()
    stream = RtdeStream(HOST, 125.0)
    robot.join()
    yield robot, stream
    stream.close()


def state(number):
    """A state of which every figure tells where it belongs."""
    vectors = 1e-3 * (number + np.arange(18.0)).reshape(3, 6)
    return RobotState(0.002 * number, *map(tuple, vectors.tolist()), 1 << 11 | 1, 2, -1)


def data(it):
    """A data package of recipe 1, field by field."""
    payload = b"\x01" + struct.pack(">d", it.robot_time_s)
    for vector in (it.pose, it.speed, it.force):
        payload += struct.pack(">6d", *vector)
    return packet(b"U", payload + struct.pack(">IIi", it.safety_bits, it.runtime_state, it.robot_mode))


def read(stream, count):
    """So many states as they come; no more may come."""
    states, end_s = [], time.monotonic() + PATIENCE_S
    while len(states) < count:
        assert time.monotonic() < end_s, f"{len(states)} of {count}"
        states += stream.read()
        time.sleep(0.0005)
    assert stream.read() == []
    return states


def test_it_asks_for_version_2_and_its_variables_at_its_rate(connected):
    robot, stream = connected
    assert tuple(robot.heard) == REQUESTS
    assert stream.local_port == robot.channel.getpeername()[1]
    assert 0 < stream.round_trip_s < PATIENCE_S


# texts of the robot, answers to others, data of another recipe, short and long; one looks like a state inside
OTHERS = (
    packet(b"M", b"\x05hello\x03robot\x01"),
    packet(b"U", b"\x02" + bytes(10)),
    packet(b"M", data(state(77)) + b"x"),
    packet(b"S", b"\x01"),
    packet(b"P"),
    packet(b"M", bytes(3000)),
)


@pytest.mark.parametrize("seed", range(4))
def test_states_come_whole_and_in_order_however_the_stream_is_cut(connected, seed):
    robot, stream = connected
    rng = np.random.default_rng(seed)
    states = [state(n) for n in range(100)]
    text = b""
    for n, one in enumerate(states):
        if n % 3 == 0:
            text += OTHERS[n // 3 % len(OTHERS)]
        text += data(one)
    got, at = [], 0
    while at < len(text):
        size = int(rng.choice([1, 3, 50, len(data(states[0])), 500, 4000]))
        robot.channel.sendall(text[at : at + size])
        at += size
        if rng.random() < 0.7:
            got += stream.read()
    got += read(stream, len(states) - len(got))
    assert got == states


def test_a_state_is_there_as_soon_as_its_last_byte_is(connected):
    robot, stream = connected
    text = data(state(1))
    robot.channel.sendall(text[:-1])
    assert stream.read() == []
    robot.channel.sendall(text[-1:])
    assert read(stream, 1) == [state(1)]


@pytest.mark.parametrize("at_once", [100, len(data(state(0))), 5 * len(data(state(0))), 1 << 16])
def test_one_look_brings_all_that_has_come(connected, monkeypatch, at_once):
    """However long nobody has looked: the newest state is among them."""
    robot, stream = connected
    monkeypatch.setattr(rtde_stream, "_AT_ONCE", at_once)
    states = [state(n) for n in range(50)]
    text = b"".join(map(data, states))
    robot.channel.sendall(text)
    wait_until_arrived(stream.fileno(), len(text))
    assert stream.read() == states


def test_nothing_to_read_is_nothing_and_a_closed_connection_an_error(connected):
    robot, stream = connected
    assert stream.read() == []
    robot.channel.sendall(data(state(1)))
    robot.channel.close()
    wait_until_arrived(stream.fileno(), len(data(state(1))))
    assert stream.read() == [state(1)]
    with pytest.raises(ConnectionError, match="the robot has closed the connection"):
        read(stream, 1)


def test_a_length_that_is_none_ends_it(connected):
    robot, stream = connected
    robot.channel.sendall(data(state(1)) + b"\x00\x02U" + bytes(300))
    with pytest.raises(ConnectionError, match="a packet of 2 bytes"):
        read(stream, 2)


def test_what_comes_between_question_and_answer_is_passed_over(serve):
    serve((OTHERS[0] + GOOD[0], OTHERS[5] + GOOD[1], OTHERS[2] + GOOD[2] + data(state(5))))
    stream = RtdeStream(HOST, 125.0)
    assert read(stream, 1) == [state(5)]
    stream.close()


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ((packet(b"V", b"\x00"),), "does not take version 2"),
        ((GOOD[0], packet(b"O", b"\x00" + TYPES.replace(b"UINT32", b"NOT_FOUND"))), "NOT_FOUND"),
        ((GOOD[0], packet(b"O", b"\x01" + TYPES[:-6])), "does not send timestamp,.* but"),
        ((*GOOD[:2], packet(b"S", b"\x00")), "does not start to send"),
        ((b"\x00\x00V",), "a packet of 0 bytes"),
        ((), "timed out"),
    ],
)
def test_a_robot_that_does_not_agree_is_refused_by_name(serve, answers, message):
    robot = serve(answers)
    with pytest.raises(ConnectionError, match=f"{HOST}, port 30004: .*{message}"):
        RtdeStream(HOST, 125.0, timeout_s=0.5)
    robot.join()


def test_nobody_there_is_said():
    with pytest.raises(ConnectionError, match="no robot answers at .*, port 30004: .*refused"):
        RtdeStream(HOST, 500.0)
