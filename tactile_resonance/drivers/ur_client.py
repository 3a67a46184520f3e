# SPDX-License-Identifier: Apache-2.0
"""Client process of `UrArm`: the only place where ur_rtde runs.

Started as ``python -m tactile_resonance.drivers.ur_client COMMANDS PAGE`` with two open descriptors. It
ends by itself when its owner's end of COMMANDS closes, and before the library's own time-out of 2.5 s,
which may abort the process, can come.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import NoReturn

from tactile_resonance.contact.interfaces import ArmError
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import (
    EXIT_BROKEN,
    EXIT_LINK_LOST,
    EXIT_ORDERLY,
    Exchange,
)
from tactile_resonance.drivers.ur_motion import OvertakenError
from tactile_resonance.drivers.ur_requests import OwnerGoneError, Requests
from tactile_resonance.drivers.ur_session import Session
from tactile_resonance.drivers.ur_states import StateReader

# Without a new state for this long the link is given up; the library would do so after 2.5 s.
GIVE_UP_S = 1.2
REFUSAL_S = 0.008


class Client:
    """Does what the owner asks for, and keeps the robot's watchdog quiet meanwhile."""

    def __init__(self, commands: socket.socket, exchange: Exchange) -> None:
        self._requests = Requests(commands)
        self._exchange = exchange
        self._opened: Session | None = None  # kept where it failed: see `Session.open`
        self._session: Session | None = None
        self._fed_s = 0.0
        # number and deceleration of a stop that the robot has not taken yet
        self._owed: tuple[int, float] | None = None

    def run(self) -> NoReturn:
        """Serve until the owner is gone."""
        try:
            while True:
                session = self._session
                pause_s = 1.0 if session is None else 1.0 / (3 * session.config.watchdog_hz)
                request = self._requests.take(pause_s)
                if request is not None:
                    self._execute(request)
                if self._session is not None:
                    self._keep_alive(self._session)
        except OwnerGoneError:
            self._leave()

    def _execute(self, request: dict) -> None:
        name, number = request["name"], request.get("number", 0)
        if name == "connect":
            self._answer(lambda: self._connect(UrArmConfig.from_dict(request["config"])))
            return
        session = self._session
        assert session is not None
        if name == "restart":
            self._answer(lambda: self._restart(session))
        elif name == "stop":
            (deceleration,) = request["values"]
            # whatever becomes of the stop itself, no velocity is said again
            session.motion.rest(deceleration)
            self._owed = number, deceleration
            self._pay(session)
        else:
            done = self._do(session, name, request["values"])
            if done:
                self._owed = None
            session.states.report(number, done)

    def _answer(self, action: Callable[[], None]) -> None:
        try:
            action()
            answer: dict = {"ok": True}
        except ArmError as error:
            answer = {
                "ok": False,
                "fault": error.fault.value,
                "message": str(error)[len("arm: ") :],
            }
        self._requests.answer(answer)

    def _connect(self, config: UrArmConfig) -> None:
        self._opened = session = Session(config, self._exchange, self._requests.stop_waits)
        session.open()
        self._session = session
        threading.Thread(target=self._publish, args=(session.states,), daemon=True).start()
        session.guard()

    def _restart(self, session: Session) -> None:
        session.restart()
        self._owed = None

    def _do(self, session: Session, name: str, values: list) -> bool:
        try:
            done = session.listening and session.motion.execute(name, values)
        except OvertakenError:
            done = True  # the stop that came will be answered
        except OwnerGoneError:
            raise
        except Exception as error:  # the library raises what it likes; the owner hears of it
            print(f"{name}: {error}", file=sys.stderr)
            done = False
        if not done:
            # a stop that is why shows in the states a cycle or two later than in the refusal
            time.sleep(REFUSAL_S)
        _note_moving(session)
        return done

    def _pay(self, session: Session) -> None:
        """Tell the robot of the stop that it has not taken yet, once it listens."""
        if self._owed is None or not session.states.healthy:
            return
        number, deceleration = self._owed
        if session.listening:
            done = self._do(session, "stop", [deceleration])
            session.states.report(number, done)
            if done:
                self._owed = None
            return
        session.states.report(number, True)  # nothing runs that could be stopped
        if session.states.revived:
            # a program that went on, or began, without us finds the old velocity in its register
            with contextlib.suppress(Exception):
                if session.motion.execute("stop", [deceleration]):
                    self._owed = None

    def _keep_alive(self, session: Session) -> None:
        """Keep the watchdog quiet while nothing moves or the owner lives."""
        config, motion = session.config, session.motion
        _note_moving(session)
        if session.faulty and self._owed is None and motion.commanded:
            # what was under way is not to go on, should the program do so
            motion.rest(config.max_acceleration_m_s2)
            self._owed = 0, config.max_acceleration_m_s2
        self._pay(session)
        fresh = self._exchange.silence_s() < config.owner_timeout_s
        if not fresh and motion.commanded:
            return
        if time.monotonic() - self._fed_s > 1.0 / (3 * config.watchdog_hz):
            session.feed()
            self._fed_s = time.monotonic()

    def _publish(self, states: StateReader) -> NoReturn:
        """Hand out states; end the process where none comes or the owner is gone."""
        try:
            while True:
                states.poll()
                if states.silence_s > GIVE_UP_S or not states.connected:
                    states.lose()
                    os._exit(EXIT_LINK_LOST)
                if states.polls % 100 == 0 and self._requests.owner_gone():
                    # the commands' thread stops the arm, but may itself hang
                    threading.Timer(0.5, os._exit, (EXIT_ORDERLY,)).start()
                time.sleep(0.0005)
        except Exception:
            traceback.print_exc()
            os._exit(EXIT_BROKEN)  # without states nothing may go on

    def _leave(self) -> NoReturn:
        """The owner is gone: stop the arm where that is possible, and end."""
        session = self._session
        if session is not None and session.states.healthy:
            with contextlib.suppress(Exception):
                session.motion.execute("stop", [session.config.max_acceleration_m_s2])
                session.control.stopScript()
        os._exit(EXIT_ORDERLY)  # the library's destructors wait half a second each


def _note_moving(session: Session) -> None:
    """A move whose program has ended is not under way any more."""
    session.states.note_moving(session.motion.moving and not session.faulty)


def main() -> NoReturn:
    """Serve the owner on the descriptors given."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the owner decides when to end
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    commands = socket.socket(fileno=int(sys.argv[1]))
    Client(commands, Exchange(int(sys.argv[2]))).run()


if __name__ == "__main__":
    main()
