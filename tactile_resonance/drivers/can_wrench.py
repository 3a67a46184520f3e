# SPDX-License-Identifier: Apache-2.0
"""A load cell on any CAN interface that python-can knows."""

from __future__ import annotations

import contextlib
import math
import time
from operator import mul

import can

from tactile_resonance.clock import Clock, WallClock
from tactile_resonance.contact.cell_checks import CellChecks
from tactile_resonance.contact.clocks import STEP_S, ClockTracker
from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.contact.payload import Mounting
from tactile_resonance.contact.samples import CellSample
from tactile_resonance.drivers.can_bus import (
    ERROR,
    EXTENDED,
    Bus,
    Flow,
    Frame,
    SocketcandBus,
    open_bus,
)
from tactile_resonance.drivers.can_frames import CHANNELS, Assembler, CellCommand
from tactile_resonance.drivers.force_config import CanForce
from tactile_resonance.fields import one_line

ANSWER_WITHIN_S = 0.25
"""Of a cell, on this machine's clock; of a simulated one on a machine that may be slow:"""
SIMULATED_WITHIN_S = 10.0
QUIET_S = 0.02


class CanWrench:
    """Wrenches of a cell on CAN, in its own frame (a `contact.interfaces.Cell`).

    `read` takes the frames that have come, joins them, stamps and checks each wrench. Silence is only
    declared where nothing waited. If the call itself comes late, the machine may have stood still, and the
    process that brings the frames with it: then the time of silence starts again, once.

    Parameters
    ----------
    config : CanForce
    clock : Clock or None
        On which wrenches are dated; this machine's where it is not given.

    Attributes
    ----------
    mounting : Mounting
    received : int
        Wrenches since `start`.
    """

    def __init__(self, config: CanForce, clock: Clock | None = None) -> None:
        self.mounting: Mounting = config
        self._config = self.info = config
        self.clock: Clock = WallClock() if clock is None else clock
        self._checks = CellChecks(config, config.range_nm, config.limits)
        self._bus: Bus | None = None
        self._fault: ForceError | None = None
        self._stamped, self._latency_ns = config.stamps == "adapter", round(config.latency_s * 1e9)
        self._scale = [tuple(map(float, row)) for row in config.scale]
        diagonal = [row[k] for k, row in enumerate(self._scale)]
        crosstalk = sum(map(abs, sum(self._scale, ()))) > sum(map(abs, diagonal))
        self._diagonal = None if crosstalk else diagonal
        description = config.description
        # of 11 and of 29 bits they are apart, also where their numbers are equal
        flag = EXTENDED if description.extended_ids else 0
        self._decode = description.decode
        self._ids = tuple([can_id | flag for can_id in description.frame_ids])
        self._begin()

    @property
    def clock_uncertainty_s(self) -> float:
        """Standard deviation of the times of its wrenches against this machine's clock, at present [s]."""
        return self._tracker.uncertainty_s if self._stamped else self._config.delay_std_s

    @property
    def lost(self) -> int:
        """Wrenches of which a frame was missing since `start`."""
        return self._assembler.lost

    @property
    def local_port(self) -> int:
        """Local port of the connection to a bus over TCP; 0 for other buses."""
        return self._bus.local_port if isinstance(self._bus, SocketcandBus) else 0

    def start(self) -> None:
        """Open the bus, set the cell up and let it stream; also after a fault has ended.

        Raises
        ------
        ForceError
            `LINK_LOST` where the bus cannot be opened, `REFUSED` where the cell declines a setting,
            `SILENT` where it does not answer or sends no wrench.
        """
        self.close()
        self._fault = None
        try:
            self._open()
        except ForceError as error:
            self.close()
            self._fault = error
            raise

    def _open(self) -> None:
        self._checks.restart()
        self._begin()
        info, description = self._config, self._config.description
        request, commands = None, description.commands
        if commands.request is not None:
            request = (commands.id, commands.request, description.extended_ids, 1 / info.rate_hz)
        look_s = self._config.limits.silent_s / 2
        self._bus = open_bus(self._config.bus, self._where, request, look_s)
        try:
            self._set_up(self._bus)
        except (can.CanError, OSError) as error:
            raise ForceError(ForceFault.LINK_LOST, f"{self._where}: {one_line(error)}") from error
        now_s = self.clock.now_ns() * 1e-9
        self._last_s = self._looked_s = now_s
        self._excused = False
        self._flow = Flow(info.rate_hz, now_s)

    def read(self) -> list[CellSample]:
        """Wrenches since the last call, oldest first, without waiting.

        Raises
        ------
        ForceError
            From the moment that the fault is found until the next `start`.
        """
        if self._fault is not None:
            raise self._fault
        if self._bus is None:
            raise ForceError(ForceFault.LINK_LOST, f"{self._where}: not started")
        try:
            return self._read(self._bus)
        except ForceError as error:
            self._fault = error
            raise
        except Exception as error:  # each interface has errors of its own
            text = f"{self._where}: {one_line(error)}"
            self._fault = ForceError(ForceFault.LINK_LOST, text)
            raise self._fault from error

    def catch_up(self, frames: int) -> None:
        """In simulated time: wait for the frames that a simulated bus has sent until now."""
        bus = self._bus
        if not isinstance(bus, SocketcandBus) or self._fault is not None:
            return
        with contextlib.suppress(OSError):  # found again by `read`
            while bus.frames < frames:
                bus.wait(0.1)
                self._ahead += bus.read()

    def close(self) -> None:
        """Stop the stream and let the bus go."""
        bus, self._bus = self._bus, None
        if bus is None:
            return
        with contextlib.suppress(can.CanError, OSError):
            stop = self._config.description.commands.stop
            if stop is not None and self._fault is None:
                self._send(bus, stop)
        with contextlib.suppress(can.CanError, OSError):
            bus.close()

    # parts of these

    @property
    def _where(self) -> str:
        bus = self._config.bus
        address = ":".join(str(bus[key]) for key in ("host", "port", "channel") if key in bus)
        return f"{self._config.name} on {bus['interface']} {address}"

    def _begin(self) -> None:
        """Nothing has come yet."""
        self._tracker = ClockTracker(self._config.shortest_delay_s, self._config.delay_std_s)
        self._stamp_before_ns = 0
        self._assembler = self._new_assembler()
        self._ahead: list[Frame] = []  # taken from the bus, not yet looked at
        self._last_stamp_s = math.inf
        self.received = 0

    def _new_assembler(self) -> Assembler:
        # times of arrival scatter by more than a period: there only the order pairs frames
        within_s = 0.5 / self._config.rate_hz if self._stamped else math.inf
        return Assembler(self._ids, within_s)

    def _send(self, bus: Bus, data: bytes) -> None:
        description = self._config.description
        bus.send(description.commands.id, data, description.extended_ids)

    def _set_up(self, bus: Bus) -> None:
        """Stop the cell, set it, start it."""
        commands, simulated = self._config.description.commands, self.clock.simulated
        within_s = SIMULATED_WITHIN_S if simulated else ANSWER_WITHIN_S
        if commands.stop is not None:
            self._send(bus, commands.stop)
            deadline_s = time.monotonic() + within_s
            quiet_s = time.monotonic() + QUIET_S
            while time.monotonic() < quiet_s:
                if any(map(self._is_of_the_cell, _frames(bus))):  # the bus may be busy with others
                    quiet_s = time.monotonic() + QUIET_S
                    if quiet_s > deadline_s:
                        raise ForceError(ForceFault.REFUSED, f"{self._where}: does not stop")
        setup = list(commands.setup)
        if commands.rates:
            rate_hz = int(self._config.rate_hz)
            setup.append(CellCommand(commands.rates[rate_hz], f"rate {rate_hz} Hz"))
        for command in setup:
            self._send(bus, command.data)
            if command.reply:
                self._await_reply(bus, command, within_s)
        if commands.start is not None:
            self._send(bus, commands.start)
        deadline_s = time.monotonic() + ANSWER_WITHIN_S
        while not simulated and not self._ahead:  # simulated time may stand still for now
            frames = _frames(bus)
            if any(map(self._is_of_the_cell, frames)):
                self._ahead = frames
            if time.monotonic() > deadline_s:
                raise ForceError(ForceFault.SILENT, f"{self._where}: sends no wrench")

    def _await_reply(self, bus: Bus, command: CellCommand, within_s: float) -> None:
        reply = self._config.description.commands.reply
        assert reply is not None
        assembler, last = self._new_assembler(), max(reply.result_byte, reply.error_byte)
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            for frame in filter(self._is_of_the_cell, _frames(bus)):
                whole = assembler.add(frame.can_id, frame.data, frame.stamp_s) or b""
                if len(whole) <= last or whole[0] != command.data[0]:
                    continue
                if whole[reply.result_byte] == reply.good:
                    return
                code = whole[reply.error_byte]
                reason = reply.errors.get(code, f"error {code}")
                raise ForceError(ForceFault.REFUSED, f"{self._where}: {command.name}: {reason}")
        raise ForceError(ForceFault.SILENT, f"{self._where}: no answer to {command.name!r}")

    def _read(self, bus: Bus) -> list[CellSample]:
        frames = self._ahead + bus.read()
        self._ahead = []
        samples: list[CellSample] = []
        silent_s, ids, assembler = self._config.limits.silent_s, self._ids, self._assembler
        lost = assembler.lost
        for can_id, data, stamp_s, arrival_ns in frames:
            whole = assembler.add(can_id, data, stamp_s)
            if whole is not None:
                sample = self._wrench(whole, stamp_s, arrival_ns)
                if sample is not None:
                    samples.append(sample)
                    self._last_stamp_s = stamp_s
            elif can_id in ids:
                while assembler.lost > lost:
                    lost += 1
                    self._checks.lost()
            elif can_id & ERROR:
                raise ForceError(ForceFault.LINK_LOST, f"{self._where}: error frame")
            elif self._stamped:
                # the bus is never empty, but the frames of others are already those of later
                self._last_stamp_s = min(self._last_stamp_s, stamp_s)
                if stamp_s - self._last_stamp_s > silent_s:
                    raise self._silence(bus, stamp_s - self._last_stamp_s)
        now_s = self.clock.now_ns() * 1e-9
        held_up = now_s - self._looked_s > silent_s / 2
        self._looked_s = now_s
        if samples:
            self._last_s, self._excused = now_s, False
        elif bus.drained and now_s - self._last_s > silent_s:
            if not held_up or self._excused:
                raise self._silence(bus, now_s - self._last_s)
            self._last_s, self._excused = now_s, True
        streams = self._config.description.commands.request is None
        short_hz = self._flow.short(now_s, self.received + self.lost) if streams else None
        if short_hz is not None:
            text = f"{short_hz:.0f} wrenches/s of {self._config.rate_hz:.0f} arrive"
            why = "the interface is too slow, or rate_hz is not the cell's"
            raise ForceError(ForceFault.INCOMPLETE, f"{self._where}: {text}: {why}")
        return samples

    def _silence(self, bus: Bus, since_s: float) -> ForceError:
        """Whether the cell or the link is silent: on a dead link two sends fail."""
        stop = self._config.description.commands.stop
        text = f"{self._where}: silent for {since_s * 1e3:.0f} ms"
        if stop is not None:
            try:
                self._send(bus, stop)
                time.sleep(0.001)
                self._send(bus, stop)
            except (can.CanError, OSError) as error:
                return ForceError(ForceFault.LINK_LOST, f"{text}: {one_line(error)}")
        return ForceError(ForceFault.SILENT, text)

    def _wrench(self, whole: bytes, stamp_s: float, arrival_ns: int) -> CellSample | None:
        """The wrench of these joined bytes, None where they are another answer. Raises `ForceError`."""
        decoded = self._decode(whole)
        if decoded is None:
            return None
        counts, full_scale = decoded
        if math.isnan(sum(counts)):
            name = next(n for n, c in zip(CHANNELS, counts, strict=True) if math.isnan(c))
            raise ForceError(ForceFault.INVALID, f"{self._where}: {name} is not finite")
        if self._diagonal is not None:
            wrench = tuple(map(mul, self._diagonal, counts))
        else:
            wrench = tuple([sum(map(mul, row, counts)) for row in self._scale])
        overload = self._checks.check(wrench, full_scale)
        self.received += 1
        return CellSample(self._stamp_ns(stamp_s, arrival_ns), wrench, overload)

    def _is_of_the_cell(self, frame: Frame) -> bool:
        return frame.can_id in self._ids

    def _stamp_ns(self, stamp_s: float, arrival_ns: int) -> int:
        clock = self.clock
        if clock.simulated:
            arrival_ns = clock.now_ns()
        if not self._stamped:
            delay_s = self._config.shortest_delay_s + self._config.latency_s
            # those that were taken together came one after the other
            stamp_ns = max(arrival_ns - round(delay_s * 1e9), self._stamp_before_ns + 1)
            self._stamp_before_ns = stamp_ns
            return stamp_ns
        self._tracker.add(stamp_s, arrival_ns)
        stamp_ns = self._tracker.to_local_ns(stamp_s)
        # a relation that has become better may be earlier by more than a period, but the order in which
        # the wrenches were taken is certain; a step is none of the relation's, and left to be seen
        if 0 <= self._stamp_before_ns - stamp_ns < STEP_S * 1e9:
            stamp_ns = self._stamp_before_ns + 1
        self._stamp_before_ns = stamp_ns
        return stamp_ns - self._latency_ns


def _frames(bus: Bus) -> list[Frame]:
    """What comes within a moment."""
    bus.wait(QUIET_S)
    return bus.read()
