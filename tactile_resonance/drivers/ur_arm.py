# SPDX-License-Identifier: Apache-2.0
"""`UrArm`: a Universal Robots arm behind the contract of `contact.interfaces.Arm`, over ur_rtde."""

from __future__ import annotations

import contextlib
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from tactile_resonance.clock import Clock, WallClock
from tactile_resonance.contact.interfaces import (
    ArmError,
    ArmFault,
    Cell,
    LoopClock,
    check_acceleration,
    checked_twist,
)
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.vectors import Six
from tactile_resonance.drivers.rtde_stream import (
    PROGRAM_PLAYING,
    RtdeStream,
    StateReader,
    stop_fault,
)
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import (
    FAULTY,
    FRESH,
    REST,
    REVIVED,
    SPEED,
    STOP,
    ClientProcess,
    UrCommand,
)
from tactile_resonance.drivers.ur_time import AskedClock, LedClock, client_name

# An answer to a command takes a few cycles of the robot; longer, and the library hangs.
ANSWER_S = 1.0
# Without a new state for this long the link is given up; the library would do so after 2.5 s.
GIVE_UP_S = 1.2
# The first state must come within this, and so must the program, once the library reports that it runs.
BEGIN_S = 2.0
# A call after `state` in the same period takes the state that was read then.
SAME_PERIOD_NS = 1_000_000


class UrArm:
    """An arm whose states are read here and whose commands are given by ur_rtde, in a process of its own.

    A hang or an abort of the library ends that process and is reported here; the process ends with this
    one. Whether the link is alive is judged by the age of the robot's time stamp.

    While the arm moves, `state` must be called at least every `UrArmConfig.owner_timeout_s`: otherwise the
    robot's watchdog is no longer fed and stops it.

    Parameters
    ----------
    config : UrArmConfig
    time : str
        ``HOST:PORT`` of a simulated bench's time; empty: the arm lives by this machine's clock.

    Attributes
    ----------
    clock : Clock
        On which its states are dated.
    led : LedClock or None
        That of a loop, while it leads simulated time.
    client : ClientProcess or None
        None while none runs.
    heard_s : float
        When the robot was last heard, on this machine's monotonic clock [s].
    """

    def __init__(self, config: UrArmConfig, time: str = "") -> None:
        self.config, self.tip_in_tool = config, config.tip_in_flange
        self.time_server = time
        self.clock: Clock = WallClock()
        self.led: LedClock | None = None
        self.heard_s = 0.0
        self.client: ClientProcess | None = None
        self._asked: AskedClock | None = None
        self._states: StateReader | None = None
        self._number = 0
        # number, kind and time [s] of commands without an answer yet
        self._sent: deque[tuple[int, bytes, float]] = deque()
        self._refused = 0
        self._looked_ns = 0
        self._found_playing = False  # a program, before ours was started
        self._reading = threading.Lock()

    # properties

    @property
    def waits_for(self) -> str:
        """What has not answered for a second while a loop leads simulated time, for people; empty: nothing."""
        return "" if self.led is None else self.led.waits_for

    @property
    def clock_uncertainty_s(self) -> float:
        """Standard deviation of `ArmSample.time_ns` against `clock` [s]."""
        self._fresh()
        return self._reader.clock_std_s

    @property
    def received(self) -> int:
        """States that have come over this connection; `state` gives the newest of them."""
        return self._reader.received

    @property
    def robot_port(self) -> int:
        """Local port of the connection over which the robot sends its states; 0: none."""
        return 0 if self._states is None else self._states.stream.local_port

    # the contract

    def connect(self) -> None:
        """Connect, set TCP and payload, start the control program and its watchdog.

        After a stop that was released at the robot, the program is started again over the same
        connection; after anything else everything is reconnected.

        Raises
        ------
        ArmError
            LINK_LOST, NOT_REMOTE, REGISTERS_IN_USE, PROGRAM_NOT_STARTED, PROTECTIVE_STOP,
            EMERGENCY_STOP, PROGRAM_STOPPED (not powered), COMMAND_REFUSED, CLIENT_DIED.
        """
        if self.client is not None and self._connect_again():
            return
        self._begin()
        client = ClientProcess(self.config, simulated_time=bool(self.time_server))
        self._ask("connect", self.config, self.time_server, client_name(), of=client)
        if self.led is not None:
            self._ask("lead", of=client)
            self.led.dated = False  # time has gone on, and the loop has not received it
        self.client = client  # not before: a loop in another thread would send commands to it
        self._guard()

    def state(self) -> ArmSample:
        """Newest state, without waiting.

        Raises
        ------
        ArmError
            LINK_LOST, STALE, CLIENT_DIED; COMMAND_REFUSED once for each command that the robot
            refused, or where the client does not answer.
        """
        sample = self._fresh()
        if self._sent:
            self._check_commands()
        return sample

    def recent(self) -> ArmSample:
        """As `state`, which it calls where that was not called within the last millisecond."""
        states = self._states
        if states is None or time.monotonic_ns() - self._looked_ns > SAME_PERIOD_NS:
            return self.state()
        assert states.sample is not None
        return states.sample

    def speed(self, twist: Sequence[float], acceleration_m_s2: float) -> None:
        """Move the tip with a twist (6,) in the base [m/s, rad/s] until the next command.

        Raises
        ------
        ArmError
            As `state`; also PROTECTIVE_STOP, EMERGENCY_STOP, PROGRAM_STOPPED where the arm cannot move.
        ValueError
            Where a figure is beyond the limits of the configuration; nothing is sent then.
        """
        values = checked_twist(twist, self.config)
        check_acceleration(acceleration_m_s2, self.config)
        self.recent()
        fault = self._reader.fault
        if fault is not None:
            raise ArmError(*fault)
        self._send(SPEED, values, float(acceleration_m_s2))

    def stop(self, deceleration_m_s2: float) -> None:
        """Stop; works at any time and raises only where the link is dead, or for a wrong figure.

        Where states are stale the client still takes it, and sends it to the robot as soon as it may.
        """
        check_acceleration(deceleration_m_s2, self.config)
        try:
            self._fresh()
        except ArmError as error:
            if error.fault is not ArmFault.STALE:
                raise
        self._send(STOP, REST, float(deceleration_m_s2))

    def close(self) -> None:
        """Stop the arm and its program and end the client; never raises."""
        self._forget()
        if self.led is not None:
            self.led.close()
        if self._asked is not None:
            self._asked.interrupt()  # a wait in another thread ends with `ClockLostError`
            self._asked.close()
            self._asked, self.clock = None, WallClock()

    # simulated time, led by a loop

    def led_clock(self, cell: Cell, while_waiting: Callable[[], None]) -> LoopClock | None:
        """Simulated time, led from now on; None on the wall clock. See `contact.interfaces.NodeArm`."""
        return LedClock(self, cell, while_waiting) if self.time_server else None

    def be_led(self, clock: LedClock | None) -> None:
        """Date states on the clock of a loop that leads simulated time from now on; None: none does."""
        self.led = clock
        if clock is not None:
            self.clock = clock.bench
        else:
            self.clock = self._asked or WallClock()
        if self.client is not None:
            self._ask("follow" if clock is None else "lead")

    def catch_up(self, robot_ns: int) -> None:
        """Wait for the state that the bench has sent, of a time of the robot [ns]."""
        self._looked_ns = 0
        self.receive(now_known=True)
        # another thread may connect anew meanwhile
        while (newest := self._reader.newest) is not None:
            if round(newest.robot_time_s * 1e9) >= robot_ns:
                return
            self._await_state(0.1)
            self.receive(now_known=True)

    def date_anew(self) -> None:
        """Date the newest state, of an unknown time, now."""
        self._reader.date_anew()

    # helpers

    @property
    def _reader(self) -> StateReader:
        """Of the connection; `ArmError` where there is none."""
        if self._states is None:
            raise ArmError(ArmFault.LINK_LOST, "not connected")
        return self._states

    def _connect_again(self) -> bool:
        """Start the program again over a good connection; False where everything must be reconnected."""
        try:
            self._fresh()
        except ArmError:
            self._forget()
            return False
        if self._reader.fault is None:
            self._forget_commands()
            return True
        self._check_stop()
        self._reader.guard(False)
        self._ask("restart")
        self._guard()
        if self.led is not None:
            self.led.dated = False
        return True

    def _begin(self) -> None:
        """Receive the robot's states, and check that nothing forbids motion."""
        try:
            if self.time_server and self._asked is None:
                self.clock = self._asked = AskedClock(self.time_server, f"{client_name()}: owner")
            stream = RtdeStream(self.config.host, self.config.rate_hz)
            trip_s = 0.0 if self.time_server else stream.round_trip_s
            self._states = StateReader(stream, lambda: self.clock.now_ns(), trip_s)
            self._wait_for(lambda states: states.newest is not None, "no state of the robot comes")
            self._found_playing = self._reader.newest.runtime_state == PROGRAM_PLAYING
            self._check_stop()
        except ConnectionError as error:
            self._forget()
            raise ArmError(ArmFault.LINK_LOST, str(error)) from error
        except ArmError:
            self._forget()
            raise

    def _guard(self) -> None:
        """Wait until the program runs; from now on no other counts as ours."""
        self._wait_for(
            lambda states: states.newest.runtime_state == PROGRAM_PLAYING,
            "the program ended as soon as it ran",
            ArmFault.PROGRAM_NOT_STARTED,
        )
        self._reader.guard(True)
        self._forget_commands()

    def _wait_for(
        self,
        condition: Callable[[StateReader], bool],
        otherwise: str,
        fault: ArmFault = ArmFault.LINK_LOST,
    ) -> None:
        states, deadline = self._reader, time.monotonic() + BEGIN_S
        while not condition(states):
            if time.monotonic() > deadline:
                raise ArmError(fault, otherwise)
            self._await_state(0.05)
            self.receive()

    def _await_state(self, seconds: float) -> None:
        """Return when something has come from the robot, after a time at the latest."""
        with contextlib.suppress(OSError, ValueError):  # closed meanwhile, which the next look finds
            select.select([self._reader.stream], [], [], seconds)

    def _check_stop(self) -> None:
        """Raise where something forbids motion whatever program runs."""
        newest = self._reader.newest
        assert newest is not None
        stop = stop_fault(newest.safety_bits, newest.robot_mode)
        if stop is not None:  # not released yet
            raise ArmError(*stop)

    def _ask(self, name: str, *arguments: object, of: ClientProcess | None = None) -> None:
        client = of or self.client
        assert client is not None
        try:
            client.ask((name, *arguments), self.receive)
        except ArmError as error:
            client.end()
            runs = self._found_playing and self._states is not None
            runs = runs and self._states.newest.runtime_state == PROGRAM_PLAYING
            self._forget()
            if name == "connect" and "not ready" in str(error) and runs:
                # the library asks it to end in a register that the program may not read, and waits for ever
                text = "another program runs there and does not end; stop it at the robot"
                raise ArmError(
                    ArmFault.PROGRAM_NOT_STARTED, f"{str(error)[len('arm: ') :]}: {text}"
                ) from error
            raise

    def _send(self, kind: bytes, twist: Six, acceleration_m_s2: float) -> None:
        assert self.client is not None
        self._number += 1
        command = UrCommand(kind, self._number, 0, 0, twist, acceleration_m_s2)
        self._sent.append((self._number, kind, time.monotonic()))
        if self.led is not None:
            self.led.pending = command  # with the next word on the time
        else:
            self.client.send(command)

    def receive(self, now_known: bool = False) -> None:
        """Take the states that have come; `now_known`: the loop that leads has received the present time."""
        states = self._reader
        try:
            with self._reading:  # a loop may wait for a time while another thread connects
                if states.read(now_known or self.led is None):
                    self.heard_s = time.monotonic()
        except OSError as error:
            if states is self._states:  # not where another thread has closed it, and connects anew
                self._forget()
            text = f"the connection to {self.config.host} is lost"
            raise ArmError(ArmFault.LINK_LOST, text) from error

    def _fresh(self) -> ArmSample:
        """Return the newest state, and give the client a sign of life."""
        self._looked_ns = 0
        client, states, config = self.client, self._reader, self.config
        if client is None:
            raise ArmError(ArmFault.LINK_LOST, "not connected")
        self.receive()
        sample = states.sample
        assert sample is not None
        age_s = (self.clock.now_ns() - sample.time_ns) * 1e-9
        seen = FRESH if age_s <= config.max_state_age_s else 0
        if states.fault is not None:
            seen |= FAULTY | REVIVED if states.revived else FAULTY
        client.look(seen)
        if age_s > GIVE_UP_S:
            self._forget()
            raise ArmError(ArmFault.LINK_LOST, f"the connection to {config.host} is lost")
        if age_s > config.max_state_age_s:
            raise ArmError(
                ArmFault.STALE,
                f"the newest state of {config.host} is {age_s * 1e3:.0f} ms old, accepted are "
                f"{config.max_state_age_s * 1e3:.0f} ms",
            )
        self._looked_ns = time.monotonic_ns()
        return sample

    def _check_commands(self) -> None:
        assert self.client is not None
        sent, (done, refused) = self._sent, self.client.exchange.answered
        while sent and sent[0][0] <= done:
            number, kind, _ = sent.popleft()
            if number != refused or number <= self._refused:
                continue
            self._refused = number
            if self._reader.fault is not None:
                return  # because of a stop, which the state reports
            name = {SPEED: "speed", STOP: "stop"}[kind]
            said = self.client.last_error()
            raise ArmError(ArmFault.COMMAND_REFUSED, f"the robot refused: {name}. {said}")
        if self.led is None and sent and time.monotonic() - sent[0][2] > ANSWER_S:
            text = f"no answer to a command after {ANSWER_S:g} s"
            raise ArmError(ArmFault.COMMAND_REFUSED, text)

    def _forget_commands(self) -> None:
        self._sent.clear()
        if self.led is not None:
            self.led.pending = None
        self._refused = self._number
        if self.client is not None:
            self.client.exchange.beat()

    def _forget(self) -> None:
        """End the client; nothing is connected any more."""
        if self.client is not None:
            self.client.end()
        states, self.client, self._states = self._states, None, None
        if states is not None:
            states.stream.close()
