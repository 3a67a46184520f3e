# SPDX-License-Identifier: Apache-2.0
"""Client process of `UrArm`: the only place where ur_rtde runs.

Started as ``python -m tactile_resonance.drivers.ur_client COMMANDS PAGE`` with two open descriptors. It
ends by itself when its owner's end of COMMANDS closes, and before the library's own time-out of 2.5 s,
which may abort the process, can come.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from typing import Any, NoReturn

import dashboard_client
import rtde_control
import rtde_receive

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import (
    EXIT_BROKEN,
    EXIT_LINK_LOST,
    EXIT_ORDERLY,
    Exchange,
)
from tactile_resonance.drivers.ur_motion import Motion, OvertakenError
from tactile_resonance.drivers.ur_safety import motion_fault, stop_fault
from tactile_resonance.drivers.ur_states import VARIABLES, StateReader
from tactile_resonance.processes import take_priority

RTDE_PORT = 30004
# Without a new state for this long the link is given up; the library would do so after 2.5 s.
GIVE_UP_S = 1.2
# A constructor of the library may hang with Python's lock held; the kernel then ends this process.
HANG_S = 20
LONGEST_MESSAGE = 8192
REFUSAL_S = 0.008
# From clearing the command register to sending a program that reads it, by another connection.
CLEARING_S = 0.05


class Client:
    """Connects, hands out states, executes commands."""

    def __init__(self, commands: socket.socket, exchange: Exchange) -> None:
        self._commands = commands
        self._exchange = exchange
        self._config: UrArmConfig | None = None
        self._states: StateReader | None = None
        self._control: Any = None
        self._motion: Motion | None = None
        self._kicked_s = 0.0
        self._requests: list[dict] = []
        # number and deceleration of a stop that the robot has not taken yet
        self._owed: tuple[int, float] | None = None

    def run(self) -> NoReturn:
        """Serve until the owner is gone."""
        while True:
            if not self._requests:
                pause_s = 1.0 if self._motion is None else 1.0 / (3 * self._require().watchdog_hz)
                select.select([self._commands], [], [], pause_s)
            self._receive()
            if self._requests:
                self._execute(self._requests.pop(0))
            self._keep_alive()

    def _receive(self) -> None:
        """Take what the owner has sent meanwhile."""
        while True:
            try:
                data = self._commands.recv(LONGEST_MESSAGE, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self._leave()
            self._requests.append(json.loads(data))
        self._requests = _newest(self._requests)

    def _stop_waits(self) -> bool:
        self._receive()
        return any(request["name"] == "stop" for request in self._requests)

    def _execute(self, request: dict) -> None:
        name, number = request["name"], request.get("number", 0)
        if name == "connect":
            self._answer(lambda: self._connect(UrArmConfig.from_dict(request["config"])))
        elif name == "restart":
            self._answer(self._restart)
        elif name == "stop":
            assert self._motion is not None
            (deceleration,) = request["values"]
            # whatever becomes of the stop itself, no velocity is said again
            self._motion.rest(deceleration)
            self._owed = number, deceleration
            self._pay()
        else:
            assert self._states is not None
            done = self._do(name, request["values"])
            if done:
                self._owed = None
            self._states.report(number, done)

    def _do(self, name: str, values: list) -> bool:
        assert self._motion is not None
        assert self._states is not None
        try:
            done = self._listening() and self._motion.execute(name, values)
        except OvertakenError:
            done = True  # the stop that came will be answered
        except Exception as error:  # the library raises what it likes; the owner hears of it
            print(f"{name}: {error}", file=sys.stderr)
            done = False
        if not done:
            # a stop that is why shows in the states a cycle or two later than in the refusal
            time.sleep(REFUSAL_S)
        self._note_moving()
        return done

    def _listening(self) -> bool:
        """Whether the program would take a command: the library waits for one that does not."""
        assert self._states is not None
        return self._states.healthy and not self._faulty()

    def _pay(self) -> None:
        """Tell the robot of the stop that it has not taken yet, once it listens."""
        assert self._motion is not None
        assert self._states is not None
        if self._owed is None or not self._states.healthy:
            return
        number, deceleration = self._owed
        if self._listening():
            done = self._do("stop", [deceleration])
            self._states.report(number, done)
            if done:
                self._owed = None
            return
        self._states.report(number, True)  # nothing runs that could be stopped
        if self._states.revived:
            # a program that went on, or began, without us finds the old velocity in its register
            with contextlib.suppress(Exception):
                if self._motion.execute("stop", [deceleration]):
                    self._owed = None

    def _answer(self, action: Any) -> None:
        try:
            action()
            answer = {"ok": True}
        except ArmError as error:
            answer = {
                "ok": False,
                "fault": error.fault.value,
                "message": str(error)[len("arm: ") :],
            }
        self._commands.send(json.dumps(answer).encode())

    def _connect(self, config: UrArmConfig) -> None:
        self._config = config
        if config.realtime_priority:
            try:
                take_priority(config.realtime_priority)
            except ValueError as error:
                raise ArmError(ArmFault.COMMAND_REFUSED, f"realtime_{error}") from error
        round_trip_s = _round_trip_s(config.host)
        with _bounded():
            try:
                receive = rtde_receive.RTDEReceiveInterface(config.host, config.rate_hz, VARIABLES)
            except Exception as error:
                raise ArmError(ArmFault.LINK_LOST, f"{config.host}: {error}") from error
        self._states = StateReader(receive, self._exchange, round_trip_s)
        self._states.wait_for_first()
        self._check_modes(config)
        with _bounded():
            try:
                self._control = rtde_control.RTDEControlInterface(config.host, config.rate_hz)
            except Exception as error:
                raise _named(config.host, error) from error
        self._states.watch(self._control)
        self._motion = Motion(self._control, self._stop_waits)
        self._prepare(config)
        threading.Thread(target=self._publish, daemon=True).start()
        self._guard()

    def _restart(self) -> None:
        """Upload the program again, after a stop has been released."""
        config = self._require()
        assert self._states is not None
        self._check_modes(config)
        self._states.unguard()
        # the velocity of the moment when the program ended still stands in the command register, and a
        # new program would follow it; what the library does not send to a stopped program clears it
        self._control.kickWatchdog()
        time.sleep(CLEARING_S)
        if not self._control.reuploadScript():
            raise ArmError(ArmFault.PROGRAM_NOT_STARTED, "the program could not be sent")
        deadline = time.monotonic() + 2.0
        while not self._control.isProgramRunning():
            if time.monotonic() > deadline:
                raise ArmError(
                    ArmFault.PROGRAM_NOT_STARTED, "the program was sent again and does not run"
                )
            time.sleep(0.01)
        self._motion, self._owed = Motion(self._control, self._stop_waits), None
        self._prepare(config)
        self._guard()

    def _guard(self) -> None:
        assert self._states is not None
        if not self._states.guard():
            raise ArmError(ArmFault.PROGRAM_NOT_STARTED, "the program ended as soon as it ran")

    def _prepare(self, config: UrArmConfig) -> None:
        """Set TCP, payload and watchdog, and see that they were taken."""
        control = self._control
        tip = config.tip_in_flange.vector.tolist()
        if not control.setTcp(tip):
            raise ArmError(ArmFault.COMMAND_REFUSED, f"setTcp {tip} was refused")
        offset = control.getTCPOffset()
        if max(abs(a - b) for a, b in zip(offset, tip, strict=True)) > 1e-6:
            raise ArmError(
                ArmFault.COMMAND_REFUSED, f"the robot's TCP is {offset} after it was set to {tip}"
            )
        if config.payload_kg is not None and not control.setPayload(
            config.payload_kg, list(config.payload_cog_m)
        ):
            raise ArmError(ArmFault.COMMAND_REFUSED, f"setPayload {config.payload_kg} was refused")
        if not control.setWatchdog(config.watchdog_hz):
            raise ArmError(ArmFault.COMMAND_REFUSED, "setWatchdog was refused")
        self._kick()

    def _check_modes(self, config: UrArmConfig) -> None:
        assert self._states is not None
        state = self._states.state()
        problem = stop_fault(state.safety_bits, state.robot_mode)
        if problem is not None:
            raise ArmError(*problem)
        if not config.check_dashboard:
            return
        dashboard = dashboard_client.DashboardClient(config.host)
        try:
            dashboard.connect()
            remote = dashboard.isInRemoteControl()
        except Exception as error:
            raise ArmError(
                ArmFault.LINK_LOST, f"dashboard of {config.host} does not answer: {error}"
            ) from error
        finally:
            with contextlib.suppress(Exception):
                dashboard.disconnect()
        if not remote:
            raise ArmError(
                ArmFault.NOT_REMOTE,
                f"{config.host} is not in remote control: switch it on the pendant",
            )

    def _publish(self) -> NoReturn:
        """Hand out states; end the process where none comes or the owner is gone."""
        assert self._states is not None
        states = self._states
        try:
            while True:
                states.poll()
                if states.silence_s > GIVE_UP_S or not states.connected:
                    states.lose()
                    os._exit(EXIT_LINK_LOST)
                if states.polls % 100 == 0 and _closed(self._commands):
                    # the commands' thread stops the arm, but may itself hang
                    threading.Timer(0.5, os._exit, (EXIT_ORDERLY,)).start()
                time.sleep(0.0005)
        except Exception:
            traceback.print_exc()
            os._exit(EXIT_BROKEN)  # without states nothing may go on

    def _keep_alive(self) -> None:
        """Keep the watchdog quiet while nothing moves or the owner lives."""
        if self._motion is None or self._states is None:
            return
        config = self._require()
        self._note_moving()
        if self._faulty() and self._owed is None and self._motion.commanded:
            # what was under way is not to go on, should the program do so
            self._motion.rest(config.max_acceleration_m_s2)
            self._owed = 0, config.max_acceleration_m_s2
        self._pay()
        fresh = self._exchange.silence_s() < config.owner_timeout_s
        if not fresh and self._motion.commanded:
            return
        if time.monotonic() - self._kicked_s > 1.0 / (3 * config.watchdog_hz):
            self._kick()

    def _kick(self) -> None:
        assert self._motion is not None
        if self._listening():  # never a command on a dead link
            self._motion.feed()
        self._kicked_s = time.monotonic()

    def _faulty(self) -> bool:
        assert self._states is not None
        state = self._states.state()
        return motion_fault(state.safety_bits, state.robot_mode, state.runtime_state) is not None

    def _note_moving(self) -> None:
        """A move whose program has ended is not under way any more."""
        assert self._motion is not None
        assert self._states is not None
        self._states.note_moving(self._motion.moving and not self._faulty())

    def _leave(self) -> NoReturn:
        """The owner is gone: stop the arm where that is possible, and end."""
        if self._motion is not None and self._states is not None and self._states.healthy:
            with contextlib.suppress(Exception):
                self._motion.execute("stop", [self._require().max_acceleration_m_s2])
                self._control.stopScript()
        os._exit(EXIT_ORDERLY)  # the library's destructors wait half a second each

    def _require(self) -> UrArmConfig:
        assert self._config is not None
        return self._config


def _newest(requests: list[dict]) -> list[dict]:
    """Leave out speeds that a later command has overtaken, and all motion before a stop."""
    kept: list[dict] = []
    for request in requests:
        if request["name"] == "stop":
            kept = [r for r in kept if r["name"] not in ("speed", "move")]
        elif request["name"] == "speed" and kept and kept[-1]["name"] == "speed":
            kept.pop()
        kept.append(request)
    return kept


def _closed(commands: socket.socket) -> bool:
    try:
        return commands.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


def _round_trip_s(host: str) -> float:
    """Least time of three TCP connections [s]."""
    times = []
    for _ in range(3):
        start = time.perf_counter()
        try:
            socket.create_connection((host, RTDE_PORT), timeout=2.0).close()
        except OSError as error:
            raise ArmError(
                ArmFault.LINK_LOST,
                f"no robot answers at {host}, port {RTDE_PORT}: {error.strerror or error}",
            ) from error
        times.append(time.perf_counter() - start)
    return min(times)


@contextlib.contextmanager
def _bounded():
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)


def _named(host: str, error: Exception) -> ArmError:
    """Give the library's exception a fault; it has texts only."""
    text = " ".join(str(error).split())
    for part, fault in (
        ("remote control", ArmFault.NOT_REMOTE),
        ("already in use", ArmFault.REGISTERS_IN_USE),
        ("start control script", ArmFault.PROGRAM_NOT_STARTED),
    ):
        if part in text:
            return ArmError(fault, f"{host}: {text}")
    return ArmError(ArmFault.LINK_LOST, f"{host}: {text}")


def main() -> NoReturn:
    """Serve the owner on the descriptors given."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the owner decides when to end
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    commands = socket.socket(fileno=int(sys.argv[1]))
    Client(commands, Exchange(int(sys.argv[2]))).run()


if __name__ == "__main__":
    main()
