# SPDX-License-Identifier: Apache-2.0
"""Client process of `UrArm`: the only place where ur_rtde runs.

Started as ``python -m tactile_resonance.drivers.ur_client COMMANDS PAGE`` with two open descriptors. It does
what its owner asks for and keeps the robot's watchdog fed; the owner reads the robot's states. It ends
when the owner's end of COMMANDS closes.

It takes part in a simulated bench's time: while the owner leads, time goes on up to the time sent with each
command; else from one feeding of the watchdog to the next.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable
from itertools import zip_longest
from typing import Any, NoReturn

from tactile_resonance.clock import Demand, SimulatedClock
from tactile_resonance.contact.interfaces import ArmError
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import (
    EXIT_BROKEN,
    EXIT_ORDERLY,
    FAULTY,
    FRESH,
    REVIVED,
    SPEED,
    STOP,
    Exchange,
    UrCommand,
)
from tactile_resonance.drivers.ur_session import Session

LONGEST_MESSAGE = 8192
# Characters of an error of the library that are sent to the owner.
MOST_TOLD = 1000
# No command is given to a robot of which the owner has seen nothing for so long.
HEALTHY_S = 0.1
REFUSAL_S = 0.008
# An orderly end that the library holds up is given up.
LEAVE_WITHIN_S = 0.5


class OwnerGoneError(Exception):
    """The owner has closed its end."""


class Client:
    """Does what the owner asks for, and keeps the robot's watchdog quiet meanwhile."""

    def __init__(self, commands: socket.socket, exchange: Exchange) -> None:
        self._commands, self._exchange = commands, exchange
        self._told = select.poll()
        self._told.register(commands, select.POLLIN)
        self._opened: Session | None = None  # kept where it failed: see `Session.open`
        self._session: Session | None = None
        self._clock: SimulatedClock | None = None
        self._led = False  # the owner states how far simulated time may go
        self._fed_ns = 0  # when the watchdog was fed, by a velocity too, in simulated time or this machine's
        self._until_ns = 0  # up to when simulated time may go on
        # number and deceleration of a stop that the robot has not taken yet
        self._owed: tuple[int, float] | None = None

    def run(self) -> NoReturn:
        """Serve until the owner is gone."""
        try:
            while True:
                for message in self._wait():
                    if message[:1] == pickle.PROTO:
                        self._request(*pickle.loads(message))
                    else:
                        self._obey(UrCommand.unpack(message))
                if self._session is not None:
                    self._keep_alive(self._session)
        except OwnerGoneError:
            self._leave()

    # messages of the owner

    def _wait(self) -> list[bytes]:
        """Wait a while for messages of the owner; without velocities that a later command has overtaken."""
        pause_ms = None
        if self._session is not None:
            if self._clock is None:
                pause_ms = 1e3 / (3 * self._session.config.watchdog_hz)
            elif not self._led:  # by the bench's time
                select.select([self._commands, self._clock], [], [])
                pause_ms = 0
        messages: list[bytes] = []
        ready = self._told.poll(pause_ms)
        while ready:
            try:
                data = self._commands.recv(LONGEST_MESSAGE)
            except OSError:
                data = b""
            if not data:
                raise OwnerGoneError
            messages.append(data)
            ready = self._told.poll(0)
        if len(messages) < 2:
            return messages
        return [
            message
            for message, later in zip_longest(messages, messages[1:], fillvalue=b"")
            if message[:1] != SPEED or later[:1] not in (SPEED, STOP)
        ]

    def _obey(self, command: UrCommand) -> None:
        session = self._session
        assert session is not None
        if command.kind == STOP:
            # whether the stop succeeds or not, no velocity is sent again
            session.rest(command.acceleration)
            self._owed = command.number, command.acceleration
            self._pay(session)
        elif command.kind == SPEED:
            done = self._do(session.speed, command.twist, command.acceleration)
            if done:
                self._owed = None
                if self._clock is None:
                    self._fed_ns = time.monotonic_ns()
            self._exchange.report(command.number, done)
        if command.until_ns and self._clock is not None:
            # the owner sends this when the time that it sent last is reached
            if command.kind == SPEED:
                self._fed_ns = self._until_ns
            elif command.until_ns - self._fed_ns > 0.5e9 / session.config.watchdog_hz:
                self._feed(session)
                self._fed_ns = self._until_ns
            self._until_ns = command.until_ns
            self._clock.hold(command.until_ns, Demand(command.demand), session.packets)
            self._exchange.hear(command.until_ns)

    def _request(self, name: str, *arguments: Any) -> None:
        """Do what the owner asks for, and answer with what was wrong; simulated time stands afterwards."""
        answer = None
        try:
            if name == "connect":
                self._connect(*arguments)
            elif name == "restart":
                self._restart()
            else:
                self._led = name == "lead"
        except ArmError as error:
            answer = error.fault, str(error)[len("arm: ") :][:MOST_TOLD]
        self._stand()
        self._commands.send(pickle.dumps(answer))

    def _connect(self, config: UrArmConfig, time_server: str, time_name: str) -> None:
        if time_server:
            self._clock = SimulatedClock(time_server, time_name)
            self._clock.free(Demand.REAL)
        self._opened = session = Session(config, self._clock)
        session.open()
        self._session = session

    def _restart(self) -> None:
        assert self._session is not None
        if self._clock is not None:
            self._clock.free(Demand.REAL)
        self._session.restart()
        self._owed = None

    def _stand(self) -> None:
        """Let simulated time stand until the owner sends how far it may go."""
        if self._clock is None or self._session is None:
            return
        self._session.packets = 0
        self._until_ns = self._clock.ask_ns()
        self._clock.hold(self._until_ns, Demand.NONE, 0)
        self._clock.ask_ns()  # answered after the hold was received

    # what is sent to the robot

    @property
    def _healthy(self) -> bool:
        """Whether the owner lives and sees a robot that may be given commands."""
        return bool(self._exchange.seen & FRESH) and self._exchange.silence_s() < HEALTHY_S

    @property
    def _faulty(self) -> bool:
        """Whether the owner sees that the robot's state forbids motion."""
        return bool(self._exchange.seen & FAULTY) and self._healthy

    def _do(self, action: Callable[..., bool], *arguments: Any) -> bool:
        try:
            done = action(*arguments)
        except Exception as error:  # the library documents no exceptions; the owner reads the text
            print(f"{action.__name__}: {error}", file=sys.stderr)
            done = False
        if not done:
            # a stop that is why shows in the states a cycle or two later than in the refusal
            time.sleep(REFUSAL_S)
        return done

    def _pay(self, session: Session) -> None:
        """Send the stop that the robot has not taken yet, once it listens."""
        if self._owed is None or not self._healthy:
            return
        (number, deceleration), seen = self._owed, self._exchange.seen
        if not seen & FAULTY:
            done = self._do(session.stop, deceleration)
            self._exchange.report(number, done)
            if done:
                self._owed = None
            return
        self._exchange.report(number, True)  # nothing runs that could be stopped
        if seen & REVIVED and self._do(session.stop, deceleration):
            # a program that went on, or began, without us finds the old velocity in its register
            self._owed = None

    def _keep_alive(self, session: Session) -> None:
        """Keep the watchdog quiet while nothing moves or the owner lives."""
        config = session.config
        if self._owed is None and session.commanded and self._faulty:
            # what was under way is not to go on, should the program do so
            session.rest(config.max_acceleration_m_s2)
            self._owed = 0, config.max_acceleration_m_s2
        self._pay(session)
        if self._clock is not None:
            if not self._led:
                self._follow_time(session)
            return
        now_ns = time.monotonic_ns()
        if now_ns - self._fed_ns <= 1e9 / (3 * config.watchdog_hz):
            return
        if not session.commanded or self._exchange.silence_s() <= config.owner_timeout_s:
            self._feed(session)
            self._fed_ns = now_ns

    def _feed(self, session: Session) -> None:
        """Keep the watchdog quiet, where the program runs that has one."""
        if not self._faulty and session.listening:
            with contextlib.suppress(Exception):
                session.feed()

    def _follow_time(self, session: Session) -> None:
        """Let simulated time go on from one feeding to the next."""
        assert self._clock is not None
        self._clock.refresh()
        now_ns = self._clock.now_ns()
        if now_ns >= self._until_ns:
            self._feed(session)
            self._fed_ns = now_ns
            self._until_ns = now_ns + round(1e9 / (3 * session.config.watchdog_hz))
            self._clock.hold(self._until_ns, Demand.NONE, session.packets)

    def _leave(self) -> NoReturn:
        """The owner is gone: stop the arm where that is possible, and end."""
        threading.Timer(LEAVE_WITHIN_S, os._exit, (EXIT_ORDERLY,)).start()
        session = self._session
        with contextlib.suppress(Exception):
            if self._clock is not None:
                self._clock.free(Demand.REAL)
            if session is not None and session.listening:
                session.stop(session.config.max_acceleration_m_s2)
                session.control.stopScript()
        os._exit(EXIT_ORDERLY)  # the library's destructors wait half a second each


def main() -> NoReturn:
    """Serve the owner on the descriptors given."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the owner decides when to end
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    commands = socket.socket(fileno=int(sys.argv[1]))
    try:
        Client(commands, Exchange(int(sys.argv[2]))).run()
    except Exception:
        traceback.print_exc()
        os._exit(EXIT_BROKEN)


if __name__ == "__main__":
    main()
