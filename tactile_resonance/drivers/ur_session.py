# SPDX-License-Identifier: Apache-2.0
"""A robot made ready: ur_rtde connected, its program started, TCP, payload and watchdog set; its velocities.

Only the client process of `UrArm` imports this: the library may hang, and may abort the process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator

import dashboard_client
import numpy as np
import rtde_control

from tactile_resonance.clock import Demand, SimulatedClock
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.samples import Pose
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import REST
from tactile_resonance.processes import loose_timers, take_priority, thread_ids

# The library watches the robot in a thread that wakes for every state; commands need no more than this, and at
# 500 Hz it takes a sixth of a processor core. After each state it looks twenty times more, 0.1 ms apart: the
# slack of its timer, which a thread without real-time priority has, makes that two or three times.
CONTROL_HZ = 100.0
SLACK_NS = 4_000_000
# A constructor of the library may hang with Python's lock held; the kernel then ends this process.
HANG_S = 20
# From clearing the command register to sending a program that reads it, by another connection.
CLEARING_S = 0.05
# speedL hands the newest velocity to the arm once a cycle of an e-series; it is no dead-man's switch.
CYCLE_S = 0.002


class Session:
    """The library's connection to one robot; nothing is connected before `open`.

    A velocity is not acknowledged: it stands in the command register until the robot's program looks, once a
    cycle. The library's ``kickWatchdog`` writes zero into that register, and where both arrive within one cycle
    (the robot's own, or a network that held packets back) the velocity is lost, be it the zero of a stop. So
    once a velocity was sent the watchdog is fed by sending the newest velocity again. A stop is a velocity of
    zero: the library's own ``speedStop`` waits for longer than the watchdog allows.

    Parameters
    ----------
    config : UrArmConfig
    clock : SimulatedClock or None
        In simulated time: it goes on while the library waits for the robot.

    Attributes
    ----------
    config : UrArmConfig
    control : rtde_control.RTDEControlInterface
    packets : int
        Velocities, or signs of life, that were sent to the robot.
    """

    control: rtde_control.RTDEControlInterface

    def __init__(self, config: UrArmConfig, clock: SimulatedClock | None) -> None:
        self.config, self._clock = config, clock
        self._twist: tuple[float, ...] = REST
        self._acceleration_m_s2: float | None = None  # None: the program has got no velocity yet
        self.packets = 0

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
        self._check_remote()
        threads = thread_ids()
        with _bounded(), loose_timers(SLACK_NS), _faults_of(config.host):
            self.control = rtde_control.RTDEControlInterface(
                config.host, CONTROL_HZ, rt_priority=-1
            )
        self._threads = thread_ids() - threads
        with self._library_hurries(), _faults_of(config.host):
            self._prepare()

    def restart(self) -> None:
        """Upload the program again, after a stop has been released. Raises `ArmError`."""
        self._check_remote()
        with _faults_of(self.config.host):
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
            with self._library_hurries():
                self._prepare()

    @property
    def listening(self) -> bool:
        """Whether the program would take a command, as far as the library knows."""
        control = self.control
        return control.isConnected() and control.isProgramRunning()

    # velocities: whether the program took them

    @property
    def commanded(self) -> bool:
        """Whether the arm moves, or would without end, by a command of ours."""
        return any(self._twist)

    def speed(self, twist: tuple[float, ...], acceleration: float) -> bool:
        """Follow a twist until the next call."""
        self._twist, self._acceleration_m_s2 = twist, acceleration
        return self.feed()

    def rest(self, deceleration: float) -> None:
        """Want no velocity any more: from now on the watchdog is fed with zero."""
        self._twist, self._acceleration_m_s2 = REST, deceleration

    def stop(self, deceleration: float) -> bool:
        """Brake and stand."""
        return self.speed(REST, deceleration)

    def feed(self) -> bool:
        """Keep the robot's watchdog quiet without changing what the arm does."""
        self.packets += 1
        if self._acceleration_m_s2 is None:
            return self.control.kickWatchdog()
        return self.control.speedL(self._twist, self._acceleration_m_s2, CYCLE_S)

    @contextlib.contextmanager
    def _library_hurries(self) -> Iterator[None]:
        """Give the library's thread the priority of this one while answers are awaited and a watchdog counts.

        Afterwards nothing waits for it, and it has none.
        """
        urgent = os.sched_getscheduler(0), os.sched_getparam(0)
        for thread in self._threads:
            os.sched_setscheduler(thread, *urgent)
        try:
            yield
        finally:
            for thread in self._threads:
                with contextlib.suppress(OSError):  # it has ended
                    os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))

    def _prepare(self) -> None:
        """Set TCP, payload and watchdog, and see that they were taken."""
        config, control = self.config, self.control
        tip = config.tip_in_flange.vector.tolist()
        if not control.setTcp(tip):
            raise ArmError(ArmFault.COMMAND_REFUSED, f"setTcp {tip} was refused")
        offset = control.getTCPOffset()
        # one rotation has several vectors: of half a turn either direction of the axis is right
        off = Pose.from_vector(np.array(offset)).seen_from(config.tip_in_flange).vector
        if not np.all(np.abs(off) <= 1e-6):
            raise ArmError(
                ArmFault.COMMAND_REFUSED, f"the robot's TCP is {offset} after it was set to {tip}"
            )
        if config.payload_kg is not None and not control.setPayload(
            config.payload_kg, list(config.payload_cog_m)
        ):
            raise ArmError(ArmFault.COMMAND_REFUSED, f"setPayload {config.payload_kg} was refused")
        self._settle()
        self._limit_time(announced=1)
        if not control.setWatchdog(config.watchdog_hz):
            raise ArmError(ArmFault.COMMAND_REFUSED, "setWatchdog was refused")
        self._limit_time()
        self._twist, self._acceleration_m_s2 = REST, None
        self.feed()

    def _settle(self) -> None:
        """In simulated time: let the library see that the program is ready for the next command."""
        if self._clock is not None:
            # this reports to the session itself, also while the loop receives the times it waits for
            self._clock.sleep_until(self._clock.ask_ns() + round(2e9 / CONTROL_HZ))

    def _limit_time(self, announced: int = 0) -> None:
        """A watchdog counts as soon as it is set: simulated time waits for the library before it expires.

        Time stands until so many packets have arrived, so the robot executes the command within the limit
        however late this process sends it. A process that never does is ended by its owner; then time goes on.
        """
        if self._clock is not None:
            self._clock.hold(0, Demand.REAL, 0)
            limit_ns = self._clock.ask_ns() + round(0.75e9 / self.config.watchdog_hz)
            self._clock.announce(limit_ns, Demand.REAL, announced)

    def _check_remote(self) -> None:
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


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)


@contextlib.contextmanager
def _faults_of(host: str) -> Iterator[None]:
    """Give the library's exceptions a fault; they have texts only."""
    try:
        yield
    except ArmError:
        raise
    except Exception as error:
        text = " ".join(str(error).split())
        for part, fault in (
            ("remote control", ArmFault.NOT_REMOTE),
            ("already in use", ArmFault.REGISTERS_IN_USE),
            ("start control script", ArmFault.PROGRAM_NOT_STARTED),
        ):
            if part in text:
                raise ArmError(fault, f"{host}: {text}") from error
        raise ArmError(ArmFault.LINK_LOST, f"{host}: {text}") from error
