# SPDX-License-Identifier: Apache-2.0
"""A load cell on any CAN interface that python-can knows."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from dataclasses import replace

import can
import numpy as np

from tactile_resonance.contact.cell_checks import CellChecks
from tactile_resonance.contact.clocks import STEP_S, ClockTracker
from tactile_resonance.contact.interfaces import ForceError, ForceFault, ForceInfo
from tactile_resonance.contact.samples import CellSample
from tactile_resonance.contact.vectors import six
from tactile_resonance.drivers.can_bus import Flow, one_line, open_bus
from tactile_resonance.drivers.can_frames import CHANNELS, Assembler, Command
from tactile_resonance.drivers.force_config import ForceConfig

ANSWER_WITHIN_S = 0.25
QUIET_S = 0.02
KEPT_SAMPLES = 10000
READER_HUNG_S = 0.25


class CanWrench:
    """Wrenches of a cell on CAN, in its own frame (a `contact.interfaces.Cell`).

    A thread waits for frames, joins them, stamps and checks each wrench. Silence is only declared by a
    thread that found nothing waiting, so that a reader that was held up does not blame the cell.

    Parameters
    ----------
    config : ForceConfig
        Of kind can.

    Attributes
    ----------
    received, lost : int
        Wrenches since `start`.
    """

    def __init__(self, config: ForceConfig) -> None:
        if config.can is None:
            raise ValueError(f"kind: {config.kind!r}, expected can")
        self._config, self._can = config, config.can
        self._checks = CellChecks(config.info, config.range_nm, config.limits)
        self._samples: deque[CellSample] = deque(maxlen=KEPT_SAMPLES)
        self._clock = self._new_clock()
        self._stamp_before_ns = 0
        self._assembler = self._new_assembler()
        self._bus: can.BusABC | None = None
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        self._fault: ForceError | None = None
        self._alive_s = 0.0
        self.received = 0

    @property
    def info(self) -> ForceInfo:
        """What the cell can do, and how well its times are known at present."""
        return replace(self._config.info, clock_uncertainty_s=self._clock_uncertainty_s())

    @property
    def lost(self) -> int:
        """Wrenches of which a frame was missing since `start`."""
        return self._assembler.lost

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
        self._samples.clear()
        self._checks.restart()
        self._clock = self._new_clock()
        self._assembler = self._new_assembler()
        self.received = 0
        self._bus = open_bus(self._can.bus, self._where)
        try:
            self._set_up()
        except ForceError:
            self.close()
            raise
        except (can.CanError, OSError) as error:
            self.close()
            raise ForceError(ForceFault.LINK_LOST, f"{self._where}: {one_line(error)}") from error
        self._ended.clear()
        self._alive_s = time.monotonic()
        self._thread = threading.Thread(target=self._receive, name="can_wrench", daemon=True)
        self._thread.start()

    def read(self) -> list[CellSample]:
        """Wrenches since the last call, oldest first, without waiting.

        Raises
        ------
        ForceError
            From the moment that the fault is found until the next `start`.
        """
        if self._fault is not None:
            raise self._fault
        samples = []
        while self._samples:
            samples.append(self._samples.popleft())
        if samples:
            return samples
        if self._thread is None:
            raise ForceError(ForceFault.LINK_LOST, f"{self._where}: not started")
        if time.monotonic() - self._alive_s > self._config.limits.silent_s + READER_HUNG_S:
            raise ForceError(ForceFault.LINK_LOST, f"{self._where}: the interface hangs")
        return []

    def close(self) -> None:
        """Stop the stream and let the bus go."""
        self._ended.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)
        self._thread = None
        bus, self._bus = self._bus, None
        if bus is None:
            return
        with contextlib.suppress(can.CanError, OSError):
            stop = self._can.description.stop
            if stop is not None and self._fault is None:
                self._send(bus, stop.data)
        with contextlib.suppress(can.CanError, OSError):
            bus.shutdown()

    @property
    def _where(self) -> str:
        bus = self._can.bus
        address = ":".join(str(bus[key]) for key in ("host", "port", "channel") if key in bus)
        return f"{self._config.info.name} on {bus['interface']} {address}"

    def _new_clock(self) -> ClockTracker:
        return ClockTracker(self._can.shortest_delay_s, self._can.delay_std_s)

    def _new_assembler(self) -> Assembler:
        # times of arrival scatter by more than a period: there only the order pairs frames
        adapter = self._can.stamps == "adapter"
        within_s = 0.5 / self._config.info.rate_hz if adapter else math.inf
        return Assembler(self._can.description.frame_ids, within_s)

    def _clock_uncertainty_s(self) -> float:
        if self._can.stamps == "arrival":
            return self._can.delay_std_s
        try:
            return self._clock.relation().uncertainty_s
        except ValueError:
            return float("nan")

    def _send(self, bus: can.BusABC, data: bytes) -> None:
        description = self._can.description
        bus.send(
            can.Message(
                arbitration_id=description.command_id,
                data=data,
                is_extended_id=description.extended_ids,
            )
        )

    def _set_up(self) -> None:
        """Stop the cell, set it, start it."""
        bus, description = self._bus, self._can.description
        assert bus is not None
        if description.stop is not None:
            self._send(bus, description.stop.data)
            deadline_s = time.monotonic() + ANSWER_WITHIN_S
            quiet_s = time.monotonic() + QUIET_S
            while time.monotonic() < quiet_s:
                message = bus.recv(QUIET_S)
                if message is None or not self._is_of_the_cell(message):
                    continue  # the bus may be busy with others
                quiet_s = time.monotonic() + QUIET_S
                if quiet_s > deadline_s:
                    raise ForceError(ForceFault.REFUSED, f"{self._where}: does not stop")
        commands = list(description.setup)
        if description.rates:
            commands.append(description.rates[int(self._config.info.rate_hz)])
        for command in commands:
            self._send(bus, command.data)
            if command.reply:
                self._await_reply(bus, command)
        if description.start is not None:
            self._send(bus, description.start.data)
        if description.request is not None:
            self._send(bus, description.request)
        deadline_s = time.monotonic() + ANSWER_WITHIN_S
        while time.monotonic() < deadline_s:
            message = bus.recv(QUIET_S)
            if message is not None and self._take(message):
                return
        raise ForceError(ForceFault.SILENT, f"{self._where}: sends no wrench")

    def _await_reply(self, bus: can.BusABC, command: Command) -> None:
        reply = self._can.description.reply
        assert reply is not None
        assembler = self._new_assembler()
        deadline_s = time.monotonic() + ANSWER_WITHIN_S
        while time.monotonic() < deadline_s:
            message = bus.recv(QUIET_S)
            if message is None or not self._is_of_the_cell(message):
                continue
            whole = assembler.add(message.arbitration_id, message.data, message.timestamp)
            if whole is None or whole[0] != command.data[0]:
                continue
            if whole[reply.result_byte] == reply.good:
                return
            code = whole[reply.error_byte]
            reason = reply.errors.get(code, f"error {code}")
            raise ForceError(ForceFault.REFUSED, f"{self._where}: {command.name}: {reason}")
        raise ForceError(ForceFault.SILENT, f"{self._where}: no answer to {command.name!r}")

    def _receive(self) -> None:
        """Body of the thread: until closed, or until a fault is found."""
        bus, silent_s = self._bus, self._config.limits.silent_s
        assert bus is not None
        request = self._can.description.request
        period_s = 1 / self._config.info.rate_hz
        longest_s = silent_s if request is None else period_s
        last_s = due_s = time.monotonic()
        stamped, last_stamp_s = self._can.stamps == "adapter", math.inf
        flow = Flow(self._config.info.rate_hz, last_s)
        try:
            while not self._ended.is_set():
                left_s = last_s + silent_s - time.monotonic()
                message = bus.recv(min(longest_s, max(0.0, left_s) + 1e-4))
                now_s = self._alive_s = time.monotonic()
                if request is not None and now_s >= due_s:
                    due_s = max(due_s + period_s, now_s)
                    self._send(bus, request)
                if message is None:
                    if now_s - last_s > silent_s:
                        raise self._silence(bus, now_s - last_s)
                elif message.is_error_frame:
                    raise ForceError(ForceFault.LINK_LOST, f"{self._where}: error frame")
                elif self._take(message):
                    last_s = now_s
                    last_stamp_s = message.timestamp
                elif stamped:
                    # the bus is never empty, but its frames are already those of later
                    last_stamp_s = min(last_stamp_s, message.timestamp)
                    if message.timestamp - last_stamp_s > silent_s:
                        raise self._silence(bus, message.timestamp - last_stamp_s)
                if request is None and flow.short(now_s, self.received + self.lost):
                    text = (
                        f"{self._where}: {flow.rate_hz:.0f} wrenches/s of {1 / period_s:.0f} arrive"
                    )
                    raise ForceError(ForceFault.INCOMPLETE, f"{text}: the interface is too slow")
        except ForceError as error:
            self._fault = error
        except Exception as error:  # each interface has errors of its own
            text = f"{self._where}: {one_line(error)}"
            self._fault = ForceError(ForceFault.LINK_LOST, text)

    def _silence(self, bus: can.BusABC, since_s: float) -> ForceError:
        """Whether the cell or the link is silent: on a dead link two sends fail.

        A socketcand whose server has died gives no frames and raises nothing (python-can 4.6).
        """
        stop = self._can.description.stop
        text = f"{self._where}: silent for {since_s * 1e3:.0f} ms"
        if stop is not None:
            try:
                self._send(bus, stop.data)
                time.sleep(0.001)
                self._send(bus, stop.data)
            except (can.CanError, OSError) as error:
                return ForceError(ForceFault.LINK_LOST, f"{text}: {one_line(error)}")
        return ForceError(ForceFault.SILENT, text)

    def _take(self, message: can.Message) -> bool:
        """Whether this frame completed a wrench. Raises `ForceError`."""
        if not self._is_of_the_cell(message):
            return False
        lost = self._assembler.lost
        whole = self._assembler.add(message.arbitration_id, message.data, message.timestamp)
        if self._assembler.lost > lost:
            self._checks.lost()
        decoded = None if whole is None else self._can.description.decode(whole)
        if decoded is None:
            return False
        counts, full_scale = decoded
        if np.isnan(counts).any():
            name = CHANNELS[int(np.flatnonzero(np.isnan(counts))[0])]
            raise ForceError(ForceFault.INVALID, f"{self._where}: {name} is no number")
        wrench = six(self._can.scale @ counts)
        overload = self._checks.check(wrench, full_scale)
        self._samples.append(CellSample(self._stamp_ns(message), wrench, overload))
        self.received += 1
        return True

    def _is_of_the_cell(self, message: can.Message) -> bool:
        """Identifiers of 11 and of 29 bits are apart, also where their numbers are equal."""
        description = self._can.description
        return (
            message.arbitration_id in description.frame_ids
            and message.is_extended_id == description.extended_ids
            and not message.is_remote_frame
            and not message.is_error_frame
        )

    def _stamp_ns(self, message: can.Message) -> int:
        arrival_ns = time.time_ns()
        if self._can.stamps == "arrival":
            delay_s = self._can.shortest_delay_s + self._config.latency_s
            return arrival_ns - round(delay_s * 1e9)
        self._clock.add(message.timestamp, arrival_ns)
        stamp_ns = self._clock.relation().to_local_ns(message.timestamp)
        # a relation that has become better may be earlier by more than a period, but the order in which
        # the wrenches were taken is certain; a step is none of the relation's, and left to be seen
        if 0 <= self._stamp_before_ns - stamp_ns < STEP_S * 1e9:
            stamp_ns = self._stamp_before_ns + 1
        self._stamp_before_ns = stamp_ns
        return stamp_ns - round(self._config.latency_s * 1e9)
