# SPDX-License-Identifier: Apache-2.0
"""RTDE server of the simulated controller (port 30004): Real-Time Data Exchange, protocol version 2.

Packets are big-endian: size of the packet with its header (u16), type (u8), payload. Source: Universal Robots,
"Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

from tactile_resonance.simulation.ur5e.controller import POLYSCOPE, UrController
from tactile_resonance.simulation.ur5e.reactor import Connection, Serving
from tactile_resonance.simulation.ur5e.variables import INPUT_TYPES, OUTPUTS, Reader

PROTOCOL_VERSION = 2
HEADER = struct.Struct(">HB")
LONGEST_PAYLOAD = 0xFFFF - HEADER.size

# type -> struct code and count
_LAYOUT = {
    "BOOL": ("?", 1),
    "UINT8": ("B", 1),
    "UINT32": ("I", 1),
    "UINT64": ("Q", 1),
    "INT32": ("i", 1),
    "DOUBLE": ("d", 1),
    "VECTOR3D": ("d", 3),
    "VECTOR6D": ("d", 6),
    "VECTOR6INT32": ("i", 6),
    "VECTOR6UINT32": ("I", 6),
}


class Kind(IntEnum):
    """Types of packets."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    TEXT = ord("M")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


def packet(kind: Kind, payload: bytes) -> bytes:
    """Return a packet with its header; ValueError where it does not fit into one."""
    if len(payload) > LONGEST_PAYLOAD:
        raise ValueError(f"RTDE packet: {len(payload)} bytes, expected at most {LONGEST_PAYLOAD}")
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


class Layout:
    """How the variables of a recipe lie in a data packet.

    Parameters
    ----------
    names, types : sequences of str
        Of the variables; RTDE types.
    """

    def __init__(self, names: Sequence[str], types: Sequence[str]) -> None:
        self.names = tuple(names)
        self._lengths = [_LAYOUT[name][1] for name in types]
        codes = "".join(f"{_LAYOUT[name][1]}{_LAYOUT[name][0]}" for name in types)
        self._struct = struct.Struct(">B" + codes)
        self._packet = struct.Struct(">HBB" + codes)
        if self._struct.size > LONGEST_PAYLOAD:
            raise ValueError(
                f"RTDE recipe: {self._struct.size} bytes, expected at most {LONGEST_PAYLOAD}"
            )

    def pack(self, recipe: int, values: Sequence[Any]) -> bytes:
        """Return a data packet; a vector is a sequence of its length."""
        flat: list[Any] = []
        for value, length in zip(values, self._lengths, strict=True):
            if length == 1:
                flat.append(value)
            else:
                flat += value
        return self._packet.pack(self._packet.size, Kind.DATA, recipe, *flat)

    def unpack(self, payload: bytes) -> list | None:
        """Return the values of a data packet; None where its size is not that of the recipe."""
        if len(payload) != self._struct.size:
            return None
        flat = self._struct.unpack(payload)[1:]
        if len(flat) == len(self._lengths):  # no vectors
            return list(flat)
        values: list = []
        start = 0
        for length in self._lengths:
            values.append(flat[start] if length == 1 else list(flat[start : start + length]))
            start += length
        return values


PORT = 30004
CYCLE_HZ = 500.0


class RtdeServer:
    """All RTDE connections of one controller.

    Attributes
    ----------
    registers_in_use : bool
        A fieldbus or another program claims the input registers: every input recipe is refused.
    packets : int
        Packages of inputs that have come since the start.
    """

    def __init__(self, controller: UrController) -> None:
        self.controller = controller
        self.registers_in_use = False
        self.packets = 0
        self._clients: list[_Client] = []

    def serve(self, connection: Connection) -> Serving:
        """Serve a new connection, and free what it held when it ends."""
        client = _Client(self, connection)
        self._clients.append(client)
        try:
            while True:
                size, kind = HEADER.unpack((yield HEADER.size))
                if size < HEADER.size:
                    raise ValueError(f"RTDE packet: size {size}, expected at least {HEADER.size}")
                client.take(kind, (yield size - HEADER.size))
        finally:
            self._clients.remove(client)

    @property
    def connections(self) -> int:
        """How many clients are connected."""
        return len(self._clients)

    def publish(self, cycle: int) -> None:
        """Send this cycle's outputs to whom they are due."""
        known: dict[tuple[str, ...], bytes] = {}  # what several clients ask for is computed once
        for client in list(self._clients):
            client.publish(cycle, known)

    def repeat(self) -> None:
        """Send what was sent last again: clients take a silent robot for lost."""
        for client in list(self._clients):
            client.repeat()

    def sent_ns(self, port: int) -> int:
        """Time stamp [ns] of the newest outputs that were sent to a client's port; 0: none."""
        return max((c.sent_ns for c in self._clients if c.connection.peer_port == port), default=0)

    def drop(self) -> int:
        """Abort all connections; returns how many there were."""
        clients = list(self._clients)
        for client in clients:
            client.connection.close(reset=True)
        return len(clients)

    def claimed(self, name: str, asking: _Client) -> bool:
        """Whether another connection, or a fieldbus, writes an input."""
        if self.registers_in_use and "register" in name:
            return True
        return any(name in client.inputs for client in self._clients if client is not asking)


class _Client:
    """One RTDE connection: its recipes, and whether it is started."""

    def __init__(self, server: RtdeServer, connection: Connection) -> None:
        self.connection = connection
        self.inputs: set[str] = set()
        self._server = server
        self._recipes: dict[int, Layout] = {}
        self._outputs: Layout | None = None
        self._readers: list[Reader] = []  # of the outputs
        self._period = 1
        self._started = False
        self._newest = b""  # outputs that were sent last
        self.sent_ns = 0

    def take(self, kind: int, payload: bytes) -> None:
        """Answer a request, or take inputs."""
        if kind == Kind.DATA:
            self._take_inputs(payload)
            return
        if kind == Kind.TEXT:
            return
        if kind == Kind.PROTOCOL_VERSION:
            answer = bytes([payload == struct.pack(">H", PROTOCOL_VERSION)])
        elif kind == Kind.CONTROLLER_VERSION:
            answer = struct.pack(">4I", *POLYSCOPE)
        elif kind == Kind.OUTPUTS:
            answer = self._set_up_outputs(payload)
        elif kind == Kind.INPUTS:
            answer = self._set_up_inputs(payload)
        elif kind in (Kind.START, Kind.PAUSE):
            self._started = kind == Kind.START and self._outputs is not None
            self.connection.patient = self._started
            answer = bytes([self._started or kind == Kind.PAUSE])
        else:
            raise ValueError(f"RTDE packet: type {kind}, expected one of 'VvMUOISP'")
        self.connection.send(packet(Kind(kind), answer))

    def publish(self, cycle: int, known: dict[tuple[str, ...], bytes]) -> None:
        """Send the outputs where they are due; a client that does not read misses them.

        `known` holds packets of this cycle by their variables and is added to.
        """
        if not self._started or cycle % self._period:
            return
        recipe, controller = self._outputs, self._server.controller
        assert recipe is not None
        data = known.get(recipe.names)
        if data is None:
            values = [read(controller) for read in self._readers]
            data = known[recipe.names] = recipe.pack(1, values)
        self._newest = data
        if self.connection.send(data, droppable=True):
            self.sent_ns = round((controller.time_s + controller.stood_still_s) * 1e9)

    def repeat(self) -> None:
        """Send the newest outputs again, to whom none were sent yet those of now."""
        if self._started and self._newest:
            self.connection.send(self._newest, droppable=True)
        else:
            self.publish(0, {})

    def _set_up_outputs(self, payload: bytes) -> bytes:
        if len(payload) < 8:
            raise ValueError("RTDE outputs: no frequency")
        (frequency_hz,) = struct.unpack_from(">d", payload)
        if not 1.0 <= frequency_hz <= CYCLE_HZ:
            return b"\x00"
        self._period = round(CYCLE_HZ / frequency_hz)
        names = _names(payload[8:])
        types = [OUTPUTS[name][0] if name in OUTPUTS else "NOT_FOUND" for name in names]
        if "NOT_FOUND" in types:
            return b"\x00" + ",".join(types).encode()
        self._outputs, self._readers = Layout(names, types), [OUTPUTS[name][1] for name in names]
        self._newest = b""
        return b"\x01" + ",".join(types).encode()

    def _set_up_inputs(self, payload: bytes) -> bytes:
        names = _names(payload)
        types = [
            "IN_USE" if self._server.claimed(name, self) else INPUT_TYPES.get(name, "NOT_FOUND")
            for name in names
        ]
        if "IN_USE" in types or "NOT_FOUND" in types:
            return b"\x00" + ",".join(types).encode()
        recipe = len(self._recipes) + 1
        self._recipes[recipe] = Layout(names, types)
        self.inputs.update(names)
        return bytes([recipe]) + ",".join(types).encode()

    def _take_inputs(self, payload: bytes) -> None:
        recipe = self._recipes.get(payload[0]) if payload else None
        if recipe is None:
            return
        self._server.packets += 1
        values = recipe.unpack(payload)
        if values is None:  # a real controller takes no packet of the wrong size either
            return
        self._server.controller.write_inputs(dict(zip(recipe.names, values, strict=True)))


def _names(text: bytes) -> tuple[str, ...]:
    return tuple(name for name in text.decode("ascii", "replace").split(",") if name)
