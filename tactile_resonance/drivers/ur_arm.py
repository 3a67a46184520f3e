# SPDX-License-Identifier: Apache-2.0
"""`UrArm`: a Universal Robots arm behind the contract of `contact.interfaces.Arm`, over ur_rtde."""

from __future__ import annotations

import select
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from tactile_resonance.clock import Clock, Demand
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
from tactile_resonance.drivers.rtde_stream import RtdeStream
from tactile_resonance.drivers.ur_client_process import ClientProcess
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import (
    FAULTY,
    FRESH,
    NOTHING,
    REVIVED,
    SPEED,
    STOP,
    UrCommand,
)
from tactile_resonance.drivers.ur_motion import REST
from tactile_resonance.drivers.ur_states import PROGRAM_PLAYING, StateReader, stop_fault
from tactile_resonance.drivers.ur_time import ArmTime, LedClock

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
    """

    def __init__(self, config: UrArmConfig, time: str = "") -> None:
        self.config, self.tip_in_tool = config, config.tip_in_flange
        self._time = ArmTime(time)
        self._dated = True  # False: states are dated once the loop knows the time again
        self._pending: UrCommand | None = None  # sent with the next time that the loop waits for
        self._heard_s = 0.0  # when the robot was last heard
        self._client: ClientProcess | None = None
        self._stream: RtdeStream | None = None
        self._states: StateReader | None = None
        self._number = 0
        # number, kind and time [s] of commands without an answer yet
        self._sent: deque[tuple[int, bytes, float]] = deque()
        self._refused = 0
        self._looked_ns = 0
        self._reading = threading.Lock()

    # properties

    @property
    def clock(self) -> Clock:
        """Clock on which its states are dated."""
        return self._time.clock

    @property
    def frames(self) -> int:
        """Frames that the bus of the cell has sent, while a loop leads simulated time; else 0."""
        return 0 if self._time.led is None else self._time.led.frames

    @property
    def waits_for(self) -> str:
        """What has not answered for a second while a loop leads simulated time, for people; empty: nothing."""
        client = self._client
        return "" if client is None else self._time.waits_for(client, self._heard_s)

    @property
    def clock_uncertainty_s(self) -> float:
        """Standard deviation of `ArmSample.time_ns` against `clock` [s]."""
        self._fresh()
        assert self._states is not None
        return self._states.clock_std_s

    @property
    def client_pid(self) -> int | None:
        """Id of the client's process; None while none runs."""
        return None if self._client is None else self._client.pid

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
        if self._client is not None and self._connect_again():
            return
        self._begin()
        client = ClientProcess(self.config, simulated_time=bool(self._time.address))
        names = {"time": self._time.address, "time_name": self._time.client_name}
        self._ask({"name": "connect", "config": self.config.to_dict(), **names}, client)
        if self._time.led is not None:
            self._ask({"name": "lead"}, client)
            self._dated = False  # time has gone on, and the loop has not received it
        self._client = client  # not before: a loop in another thread would send commands to it
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
        assert self._states is not None
        if self._states.fault is not None:
            raise ArmError(*self._states.fault)
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
        if self._client is not None:
            self._client.end()
        self._forget()
        self.follow()
        self._time.close()

    # simulated time, led by a loop

    def led_clock(self, cell: Cell, while_waiting: Callable[[], None]) -> LoopClock | None:
        """Simulated time, led from now on; None on the wall clock. See `contact.interfaces.NodeArm`."""
        if not self._time.address:
            return None
        return LedClock(self, cell, while_waiting)

    def lead(self, bus_port: Callable[[], int] = lambda: 0) -> None:
        """Let simulated time go on only as far as `wait_until` asks for; does nothing on the wall clock.

        Parameters
        ----------
        bus_port : callable
            Local port of the connection to the bus of a load cell, whose frames `frames` counts; 0: none.
        """
        if self._time.address:
            self._time.lead(bus_port)
            self._ask({"name": "lead"})
            self.ask_ns()
            self._dated = False

    def follow(self) -> None:
        """Lead no more: time goes on without this arm."""
        if self._time.led is None:
            return
        pending, self._pending = self._pending, None
        if self._client is not None and pending is not None:
            self._client.send(pending)
        self._time.follow()
        if self._client is not None:
            self._ask({"name": "follow"})

    def wait_until(
        self, time_ns: int, demand: Demand, while_waiting: Callable[[], None] | None = None
    ) -> None:
        """Let simulated time go on up to a time and wait for that, and for the robot's state at it.

        What was commanded before has reached the robot by then.
        """
        led, client = self._time.led, self._client
        assert led is not None
        if client is None:
            self._time.look_again()
            return
        self._time.name_ports(0 if self._stream is None else self._stream.local_port)
        command, self._pending = self._pending or UrCommand(NOTHING), None

        def check() -> None:
            client.look()
            self._read()  # a robot whose time stands repeats its state
            if while_waiting is not None:
                while_waiting()

        try:
            self._time.send(client, command, time_ns, demand)
            while led.now_ns() < time_ns:
                led.wait_told(check)
            if not self._dated:
                led.ask_ns()  # times received while it connected are of the past
            self._looked_ns = 0
            self._catch_up(led.robot_ns)
            if not self._dated and self._states is not None:
                self._states.date_anew()
                self._dated = True
        except ArmError:  # reported by `state`
            self._time.look_again()

    def ask_ns(self) -> int:
        """Simulated time now [ns], also where it has gone on without the loop that leads it."""
        assert self._time.led is not None
        return self._time.led.ask_ns()

    def hurry(self) -> None:
        """Make a wait that does not demand time demand it: something needs it now. From any thread."""
        client = self._client
        if self._time.led is not None and client is not None:
            self._time.hurry(client)

    # helpers

    def _connect_again(self) -> bool:
        """Start the program again over a good connection; False where everything must be reconnected."""
        assert self._client is not None
        try:
            self._fresh()
        except ArmError:
            if self._client is not None:  # else `_fresh` has ended it
                self._client.end()
            self._forget()
            return False
        assert self._states is not None
        if self._states.fault is None:
            self._forget_commands()
            return True
        self._check_stop()
        self._states.guard(False)
        self._ask({"name": "restart"})
        self._guard()
        self._dated = self._time.led is None
        return True

    def _begin(self) -> None:
        """Receive the robot's states, and check that nothing forbids motion."""
        try:
            self._time.begin()
            self._stream = RtdeStream(self.config.host, self.config.rate_hz)
            trip_s = 0.0 if self._time.address else self._stream.round_trip_s
            self._states = StateReader(self._stream, lambda: self.clock.now_ns(), trip_s)
            self._wait_for_first()
            self._check_stop()
        except ConnectionError as error:
            self._forget()
            raise ArmError(ArmFault.LINK_LOST, str(error)) from error
        except ArmError:
            self._forget()
            raise

    def _guard(self) -> None:
        """Wait until the program runs; from now on no other counts as ours."""
        assert self._states is not None
        self._wait_for(
            lambda states: states.newest.runtime_state == PROGRAM_PLAYING,
            "the program ended as soon as it ran",
            ArmFault.PROGRAM_NOT_STARTED,
        )
        self._states.guard(True)
        self._forget_commands()

    def _wait_for_first(self) -> None:
        self._wait_for(lambda states: states.newest is not None, "no state of the robot comes")

    def _wait_for(
        self,
        condition: Callable[[StateReader], bool],
        otherwise: str,
        fault: ArmFault = ArmFault.LINK_LOST,
    ) -> None:
        assert self._stream is not None
        assert self._states is not None
        deadline = time.monotonic() + BEGIN_S
        while not condition(self._states):
            if time.monotonic() > deadline:
                raise ArmError(fault, otherwise)
            select.select([self._stream], [], [], 0.05)
            self._read()

    def _check_stop(self) -> None:
        """Raise where something forbids motion whatever program runs."""
        assert self._states is not None
        newest = self._states.newest
        assert newest is not None
        stop = stop_fault(newest.safety_bits, newest.robot_mode)
        if stop is not None:  # not released yet
            raise ArmError(*stop)

    def _ask(self, request: dict, client: ClientProcess | None = None) -> None:
        client = client or self._client
        assert client is not None
        try:
            client.ask(request, self._read)
        except ArmError as error:
            client.end()
            runs = self._states is not None and self._states.newest is not None
            runs = runs and self._states.newest.runtime_state == PROGRAM_PLAYING
            self._forget()
            if request["name"] == "connect" and "not ready" in str(error) and runs:
                # the library asks it to end in a register that the program may not read, and waits for ever
                text = "another program runs there and does not end; stop it at the robot"
                raise ArmError(
                    ArmFault.PROGRAM_NOT_STARTED, f"{str(error)[len('arm: ') :]}: {text}"
                ) from error
            raise

    def _send(self, kind: bytes, twist: Six, acceleration_m_s2: float) -> None:
        assert self._client is not None
        self._number += 1
        command = UrCommand(kind, self._number, 0, 0, twist, acceleration_m_s2)
        self._sent.append((self._number, kind, time.monotonic()))
        if self._time.led is not None:
            self._pending = command  # with the next word on the time
        else:
            self._client.send(command)

    def _read(self, now_known: bool = False) -> None:
        """Take the states that have come; `now_known`: the loop that leads has received the present time."""
        assert self._states is not None
        try:
            with self._reading:  # a loop may wait for a time while another thread connects
                if self._states.read(now_known or self._time.led is None):
                    self._heard_s = time.monotonic()
        except ConnectionError as error:
            if self._client is not None:
                self._client.end()
            self._forget()
            text = f"the connection to {self.config.host} is lost"
            raise ArmError(ArmFault.LINK_LOST, text) from error

    def _catch_up(self, robot_ns: int) -> None:
        """Wait for the state that the bench has sent."""
        assert self._stream is not None
        assert self._states is not None
        self._read(now_known=True)
        while (newest := self._states.newest) is not None:
            if round(newest.robot_time_s * 1e9) >= robot_ns:
                return
            select.select([self._stream], [], [], 0.1)
            self._read(now_known=True)

    def _fresh(self) -> ArmSample:
        """Return the newest state, and give the client a sign of life."""
        self._looked_ns = 0
        if self._client is None or self._states is None:
            raise ArmError(ArmFault.LINK_LOST, "not connected")
        client, states, config = self._client, self._states, self.config
        self._read()
        sample = states.sample
        assert sample is not None
        age_s = (self.clock.now_ns() - sample.time_ns) * 1e-9
        seen = FRESH if age_s <= config.max_state_age_s else 0
        if states.fault is not None:
            seen |= FAULTY | REVIVED if states.revived else FAULTY
        client.look(seen)
        if age_s > GIVE_UP_S:
            self._client.end()
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
        assert self._client is not None
        assert self._states is not None
        sent, (done, refused) = self._sent, self._client.exchange.answered
        while sent and sent[0][0] <= done:
            number, kind, _ = sent.popleft()
            if number != refused or number <= self._refused:
                continue
            self._refused = number
            if self._states.fault is not None:
                return  # because of a stop, which the state reports
            name = {SPEED: "speed", STOP: "stop"}[kind]
            said = self._client.last_error()
            raise ArmError(ArmFault.COMMAND_REFUSED, f"the robot refused: {name}. {said}")
        if self._time.led is None and sent and time.monotonic() - sent[0][2] > ANSWER_S:
            text = f"no answer to a command after {ANSWER_S:g} s"
            raise ArmError(ArmFault.COMMAND_REFUSED, text)

    def _forget_commands(self) -> None:
        self._sent.clear()
        self._pending = None
        self._refused = self._number
        if self._client is not None:
            self._client.exchange.beat()

    def _forget(self) -> None:
        """Nothing is connected any more."""
        self._client = self._states = None
        if self._stream is not None:
            self._stream.close()
            self._stream = None
