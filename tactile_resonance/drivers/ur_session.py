# SPDX-License-Identifier: Apache-2.0
"""A robot made ready: connected over ur_rtde, its program started, TCP, payload and watchdog set.

Only the client process of `UrArm` imports this: the library may hang, and may abort the process.
"""

from __future__ import annotations

import contextlib
import signal
import socket
import time
from collections.abc import Callable, Iterator

import dashboard_client
import rtde_control
import rtde_receive

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import Exchange
from tactile_resonance.drivers.ur_motion import Motion
from tactile_resonance.drivers.ur_safety import motion_fault, stop_fault
from tactile_resonance.drivers.ur_states import VARIABLES, StateReader
from tactile_resonance.processes import take_priority

RTDE_PORT = 30004
# A constructor of the library may hang with Python's lock held; the kernel then ends this process.
HANG_S = 20
# From clearing the command register to sending a program that reads it, by another connection.
CLEARING_S = 0.05


class Session:
    """Connections to one robot; nothing is connected before `open`.

    Parameters
    ----------
    config : UrArmConfig
    exchange : Exchange
        Where states go.
    overtaken : callable
        Whether a stop has come in the meantime.

    Attributes
    ----------
    config : UrArmConfig
    states : StateReader
    control : rtde_control.RTDEControlInterface
    motion : Motion
    """

    states: StateReader
    control: rtde_control.RTDEControlInterface
    motion: Motion

    def __init__(
        self, config: UrArmConfig, exchange: Exchange, overtaken: Callable[[], bool]
    ) -> None:
        self.config = config
        self._exchange, self._overtaken = exchange, overtaken

    def open(self) -> None:
        """Connect, start the program, prepare it. Raises `ArmError`, see `UrArm.connect`.

        What was opened before it failed stays: the library's destructors wait, and may hang.
        """
        config = self.config
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
        self.states = StateReader(receive, self._exchange, round_trip_s)
        self.states.wait_for_first()
        self._check_modes()
        with _bounded():
            try:
                self.control = rtde_control.RTDEControlInterface(config.host, config.rate_hz)
            except Exception as error:
                raise _named(config.host, error) from error
        self.states.watch(self.control)
        self.motion = Motion(self.control, self._overtaken)
        self._prepare()

    @property
    def faulty(self) -> bool:
        """Whether the newest state forbids motion."""
        state = self.states.state()
        return motion_fault(state.safety_bits, state.robot_mode, state.runtime_state) is not None

    @property
    def listening(self) -> bool:
        """Whether the program would take a command: the library waits for one that does not."""
        return self.states.healthy and not self.faulty

    def restart(self) -> None:
        """Upload the program again, after a stop has been released. Raises `ArmError`."""
        self._check_modes()
        self.states.unguard()
        # the velocity of the moment when the program ended still stands in the command register, and a
        # new program would follow it; what the library does not send to a stopped program clears it
        self.control.kickWatchdog()
        time.sleep(CLEARING_S)
        if not self.control.reuploadScript():
            raise ArmError(ArmFault.PROGRAM_NOT_STARTED, "the program could not be sent")
        deadline = time.monotonic() + 2.0
        while not self.control.isProgramRunning():
            if time.monotonic() > deadline:
                raise ArmError(
                    ArmFault.PROGRAM_NOT_STARTED, "the program was sent again and does not run"
                )
            time.sleep(0.01)
        self.motion = Motion(self.control, self._overtaken)
        self._prepare()
        self.guard()

    def guard(self) -> None:
        """From now on no program but the one that runs counts as ours. Raises `ArmError`."""
        if not self.states.guard():
            raise ArmError(ArmFault.PROGRAM_NOT_STARTED, "the program ended as soon as it ran")
        # its watchdog counts since it was set, and no state told until now that it listens
        self.feed()

    def feed(self) -> None:
        """Keep the robot's watchdog quiet, where it listens."""
        if self.listening:  # never a command on a dead link
            self.motion.feed()

    def _prepare(self) -> None:
        """Set TCP, payload and watchdog, and see that they were taken."""
        config, control = self.config, self.control
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

    def _check_modes(self) -> None:
        state = self.states.state()
        problem = stop_fault(state.safety_bits, state.robot_mode)
        if problem is not None:
            raise ArmError(*problem)
        config = self.config
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


def _round_trip_s(host: str) -> float:
    """Least time of three TCP connections [s]."""
    times = []
    for _ in range(3):
        start = time.perf_counter()
        try:
            socket.create_connection((host, RTDE_PORT), timeout=2.0).close()
        except (OSError, ValueError) as error:  # ValueError: what no name or address can be
            reason = getattr(error, "strerror", None) or error
            raise ArmError(
                ArmFault.LINK_LOST, f"no robot answers at {host}, port {RTDE_PORT}: {reason}"
            ) from error
        times.append(time.perf_counter() - start)
    return min(times)


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
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
