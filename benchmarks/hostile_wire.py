# SPDX-License-Identifier: Apache-2.0
"""What reads bytes from a network: the drivers, the live page, the ports of the simulated bench."""

from __future__ import annotations

import contextlib
import io
import os
import select
import socket
import struct
import threading
from collections.abc import Callable, Iterable
from functools import cached_property

from benchmarks.hostile_targets import Read, Target
from tactile_resonance.clock import MESSAGE, ClockLostError, FromBench, SimulatedClock
from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.can_bus import SocketcandBus
from tactile_resonance.drivers.can_frames import Assembler, read_can_description
from tactile_resonance.drivers.rtde_stream import PORT, RtdeStream
from tactile_resonance.report.live import LiveServer
from tactile_resonance.simulation.cell.tcp_bus import SlcanServer, SocketcandServer
from tactile_resonance.simulation.plant.simulated_robot import (
    SimulatedRobot,
    serve_dashboard,
    serve_orders,
    serve_scripts,
)
from tactile_resonance.simulation.ur5e.controller import UrController
from tactile_resonance.simulation.ur5e.reactor import Service, Serving

GREETINGS = {b"V": b"\1", b"S": b"\1"}
TYPES = b"DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,UINT32,UINT32,INT32"
PROGRAM = b"def a():\n  textmsg(1)\nend\n"


def wire_targets() -> Iterable[Target]:
    """All of them; nothing listens before the first input."""
    yield Target("CAN frames", [bytes(range(18)), b"\x0b" + bytes(15), bytes(36)], _frames(), 0.2)
    frame = b"< frame 123 1.5 0011223344556677 >"
    for name, seeds, read in (
        ("states of a robot", [_state(), 3 * _state()], _Peer(_robot, _read_robot, PORT).read),
        ("socketcand", [frame, 3 * frame], _Peer(_socketcand, _read_socketcand).read),
        ("time of a bench", [_told(5), _told(5) + _told(9)], _Peer(_bench, _read_time).read),
        ("requests to the live page", _requests(), _Page().read),
    ):
        yield Target(name, seeds, read, 0.002)
    plant = _Plant()
    for name, seeds in plant.SEEDS.items():
        yield Target(f"simulated {name}", seeds, plant.reader(name), 0.02)


def _frames() -> Read:
    path = sorted(share_path("config").glob("force/frames/*.yaml"))[0]
    description, assembler = read_can_description(path), Assembler((1, 2), 5e-4)

    def frames(data: bytes) -> None:
        for k in range(0, len(data) - 1, 9):
            joined = assembler.add(data[k] % 3, data[k + 1 : k + 9], 1e-3 * data[k])
            if joined:
                description.decode(joined)
        description.decode(data)

    return frames


def _host(net: int) -> str:
    """An address of 127.0.0.0/8 that nobody else simulates."""
    return f"127.{net}.{os.getpid() % 200 + 20}.{os.getpid() // 200 % 250 + 2}"


class _Peer:
    """Greets a driver as its device does, sends it what it is given, and waits until it has gone."""

    def __init__(
        self,
        greet: Callable[[socket.socket, bytes], None],
        read: Callable[[str, int], None],
        port: int = 0,
    ) -> None:
        self._greet, self._read, self._port, self._data = greet, read, port, b""

    @cached_property
    def _address(self) -> tuple[str, int]:
        listener = socket.create_server((_host(0), self._port))
        threading.Thread(target=self._serve, args=(listener,), daemon=True).start()
        return listener.getsockname()

    def read(self, data: bytes) -> None:
        """Let the driver read it."""
        self._data = data
        self._read(*self._address)

    def _serve(self, listener: socket.socket) -> None:
        while True:
            with listener.accept()[0] as channel, contextlib.suppress(OSError, struct.error):
                self._greet(channel, self._data)


def _robot(channel: socket.socket, data: bytes) -> None:
    while head := channel.recv(3, socket.MSG_WAITALL):
        size, kind = struct.unpack(">Hc", head)
        channel.recv(size - 3, socket.MSG_WAITALL)
        answer = GREETINGS.get(kind, b"\1" + TYPES)
        channel.sendall(struct.pack(">Hc", 3 + len(answer), kind) + answer)
        if kind == b"S":
            channel.sendall(data)


def _read_robot(host: str, _: int) -> None:
    stream = RtdeStream(host, 500.0)
    try:
        for _ in range(2):
            select.select([stream], [], [], 0.01)
            stream.read()
    finally:
        stream.close()


def _state() -> bytes:
    """A data package of the recipe that the driver asks for: all of it zero."""
    payload = bytes(1 + 8 * 19 + 4 * 3)
    return struct.pack(">Hc", 3 + len(payload), b"U") + payload


def _socketcand(channel: socket.socket, data: bytes) -> None:
    channel.sendall(b"< hi >")
    for answer in (b"< ok >", b"< ok >" + data):
        channel.recv(64)
        channel.sendall(answer)
    channel.recv(1)


def _read_socketcand(host: str, port: int) -> None:
    bus = SocketcandBus(host, port, "can0")
    try:
        for _ in range(2):
            bus.wait(0.01)
            bus.read()
    finally:
        bus.close()


def _bench(channel: socket.socket, data: bytes) -> None:
    received = b""
    while received.count(b"\n") < 1 or len(received.split(b"\n", 1)[1]) < MESSAGE.size:
        received += channel.recv(4096)
    channel.sendall(MESSAGE.pack(FromBench.TIME, 1, 0, 0) + data)
    channel.shutdown(socket.SHUT_WR)
    channel.recv(1)


def _read_time(host: str, port: int) -> None:
    clock = SimulatedClock(f"{host}:{port}", "hostile")
    try:
        for _ in range(100):
            clock.wait_until(clock.now_ns() + 1)
    except ClockLostError:  # the bench ends after its last message
        pass
    finally:
        clock.close()


def _told(time_ns: int) -> bytes:
    return MESSAGE.pack(FromBench.TOLD, time_ns, 0, 0)


def _requests() -> list[bytes]:
    head = b" / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    return [b"GET" + head, b"POST" + head, b"GET" + head.replace(b"/ ", b"/events ", 1)]


class _Page:
    """A browser that may send anything; what the server's threads end with is an answer of its own."""

    @cached_property
    def _port(self) -> int:
        server = LiveServer(0, dict)
        server.__enter__()
        return int(server.url.rstrip("/").rpartition(":")[2])

    def read(self, data: bytes) -> None:
        """Send a request and take the beginning of the answer."""
        said, data = io.StringIO(), data.replace(b"localhost", b"localhost:%d" % self._port)
        with contextlib.ExitStack() as stack:
            stack.enter_context(contextlib.redirect_stderr(said))
            address = "127.0.0.1", self._port
            channel = stack.enter_context(socket.create_connection(address, 2.0))
            stack.enter_context(contextlib.suppress(ConnectionError))
            channel.sendall(data)
            channel.shutdown(socket.SHUT_WR)
            while part := channel.recv(1 << 20):
                if b"text/event-stream" in part:  # goes on as long as somebody listens
                    break
        if said.getvalue():
            raise RuntimeError(said.getvalue())


class _Line:
    """A connection whose other end takes everything."""

    port = peer_port = 0
    is_open = patient = True

    def send(self, data: bytes, droppable: bool = False) -> bool:
        """Nobody reads it."""
        return True

    def close(self, reset: bool = False) -> None:
        """Nobody says anything more."""
        self.is_open = False


class _Plant:
    """The ports of a simulated robot and cell, and the cycle that follows what comes there."""

    SEEDS = {
        "RTDE": [
            b"\0\5V\0\2",
            b"\0\5V\0\2\0\x20Oactual_TCP_pose,timestamp\0\0\0",
            b"\0\x1aIinput_double_register_0\0\0",
            b"\0\3S\0\3P",
        ],
        "dashboard": [b"robotmode\n", b"power on\nbrake release\nstop\nquit\n", b"addToLog a\n"],
        "programs": [PROGRAM, b"def a():\nend\n" + PROGRAM],
        "control": [
            b'{"command": "state"}\n',
            b'{"command": "freeze", "seconds": 1.5, "part": "controller"}\n',
            b'{"command": "remote_control", "value": true}\n',
        ],
        "grants of time": [
            b'{"name": "a", "with": "b", "conducts": true}\n' + MESSAGE.pack(1, 5, 1, 0),
            b'{"name": "a", "hands_over": true}\n' + MESSAGE.pack(4, 1, 2, 3),
        ],
        "socketcand": [b"< open can0 >< rawmode >< send 123 2 01 02 >"],
        "slcan": [b"S8\rO\rt12320102\rC\rV\r"],
    }

    @cached_property
    def _robot(self) -> SimulatedRobot:
        return SimulatedRobot(UrController(), _host(1), simulated_time=True)

    @cached_property
    def _buses(self) -> dict[str, SocketcandServer | SlcanServer]:
        reactor = self._robot.reactor
        return {
            "socketcand": SocketcandServer(reactor, 0, lambda can_id, data: ()),
            "slcan": SlcanServer(reactor, 0, lambda can_id, data: ()),
        }

    def reader(self, name: str) -> Read:
        """Of one of its ports."""

        def read(data: bytes) -> None:
            line = _Line()
            service = Service(line, self._serving(name, line))
            try:
                service.received(data)
                self._robot.controller.step()
                for bus in self._buses.values():
                    bus.send(())
            finally:
                service.closed()

        return read

    def _serving(self, name: str, line: _Line) -> Serving:
        robot = self._robot
        if name == "RTDE":
            return robot.rtde.serve(line)
        if name == "dashboard":
            return serve_dashboard(robot.controller, line)
        if name == "programs":
            return serve_scripts(robot.controller, line)
        if name == "control":
            return serve_orders(robot.orders, line)
        if name == "grants of time":
            return robot.time.serve(line)
        return self._buses[name].serve(line)
