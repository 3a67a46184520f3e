# SPDX-License-Identifier: Apache-2.0
"""The time of a simulated bench: it goes on as far as all participants allow (`tactile_resonance.clock`).

`BenchTime` keeps the list of participants and serves their connections; `run` steps what is simulated, serves
all ports in between and keeps the pace. On the wall clock (`simulated` false) there are no participants: steps
come at the pace of real time, and time for which the machine stood still is lost.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from tactile_resonance.clock import ENDLESS_NS, MESSAGE, Demand, FromBench, ToBench
from tactile_resonance.simulation.ur5e.reactor import Connection, Reactor, Serving, Until

START_NS = 1_000_000_000
"""Time at which a bench begins [ns]; not 0, which in ROS means that no time is known."""
STALL_S = 0.010
"""On the wall clock a step that begins later than this is a stall: what ran meanwhile is not to be trusted."""
REPEAT_S = 0.05
"""While time stands the newest data are sent again after so long, on this machine's clock [s]."""
PACKETS_WITHIN_S = 0.5
"""A packet that was sent is waited for so long, on this machine's clock [s]."""


@dataclass(eq=False)
class Participant:
    """One connection of a participant; see `tactile_resonance.clock.SimulatedClock`."""

    connection: Connection
    name: str
    told_with: str
    hands_over: bool
    conducts: bool
    until_ns: int = ENDLESS_NS
    demand: Demand = Demand.NONE
    told_ns: int = -1  # until_ns that was reported to it
    announces: bool = False  # packets that it has not sent yet
    wake_ns: int = ENDLESS_NS
    robot_port: int = 0
    bus_port: int = 0

    def tell(self, kind: FromBench, now_ns: int, robot_ns: int = 0, frames: int = 0) -> None:
        """Send a time."""
        self.connection.send(MESSAGE.pack(kind, now_ns, robot_ns, frames))


class BenchTime:
    """The participants, how far time may go, and the loop that steps it.

    Parameters
    ----------
    reactor : Reactor
        Serves the ports.
    step_ns : int
        Length of a step [ns].
    simulated : bool
        False: on the wall clock, without participants.

    Attributes
    ----------
    now_ns : int
        Time [ns].
    steps : list of callables
        Called for each step.
    repeats : list of callables
        Called again and again while time stands.
    seeds : list of callables
        Called with three integers, from which noise follows from then on.
    stalled : list of callables
        Called with the time [s] that was lost in a stall.
    robot_sent_ns, frames_sent : callables
        For a local port of a participant: stamp of the newest robot state sent to it [ns], and number of frames
        of the bus sent to it.
    packets_arrived : callable
        Number of packets that the robot has received since the start; None while it is not connected.
    stalls : int
        Steps on the wall clock that began more than 10 ms late.
    longest_delay_s : float
        Of a step on the wall clock [s].
    at_once : callable
        On the wall clock: how many steps may be made together, when the last of them is due, because nobody
        needs each of them at its time.
    to_follow : int
        In a step: how many are made together with it, after it.
    """

    def __init__(self, reactor: Reactor, step_ns: int, *, simulated: bool) -> None:
        self.now_ns = START_NS
        self.steps: list[Callable[[], None]] = []
        self.repeats: list[Callable[[], None]] = []
        self.seeds: list[Callable[[tuple[int, int, int]], None]] = []
        self.stalled: list[Callable[[float], None]] = []
        self.robot_sent_ns: Callable[[int], int] = lambda port: 0
        self.frames_sent: Callable[[int], int] = lambda port: 0
        self.packets_arrived: Callable[[], int | None] = lambda: None
        self.at_once: Callable[[], int] = lambda: 1
        self.to_follow = 0
        self.stalls, self.longest_delay_s = 0, 0.0
        self.simulated = simulated
        self._reactor, self._step_ns = reactor, step_ns
        self._participants: list[Participant] = []
        self._packets_due = self._packets_mark = 0
        self._packets_late_s = 0.0
        self._stopping = False

    @property
    def pace(self) -> str:
        """How well steps on the wall clock kept their pace."""
        return f"{self.stalls} stalls, longest delay {self.longest_delay_s * 1e3:.1f} ms"

    # participants

    def serve(self, connection: Connection) -> Serving:
        """Serve a new connection: a line that says who joins, then messages; who has gone holds up no time."""
        try:
            fields = json.loads((yield Until(b"\n", longest=4096)))
        except RecursionError as error:
            raise ValueError("time: nested too deeply") from error
        if not isinstance(fields, dict) or "name" not in fields:
            raise ValueError("time: no name")
        participant = Participant(
            connection,
            name=str(fields["name"]),
            told_with=str(fields.get("with", "")),
            hands_over=fields.get("hands_over") is True,
            conducts=fields.get("conducts") is True,
        )
        self._participants.append(participant)
        try:
            self.tell_reached()
            while True:
                kind, *integers = MESSAGE.unpack((yield MESSAGE.size))
                self._take(participant, ToBench(kind), *integers)
        finally:
            self._participants.remove(participant)
            if participant.announces:
                self._packets_due = 0

    def _take(self, participant: Participant, kind: ToBench, a: int, b: int, c: int) -> None:
        if kind in (ToBench.HOLD, ToBench.ANNOUNCE):
            participant.until_ns, participant.demand, participant.told_ns = a, Demand(b), -1
            participant.announces = kind is ToBench.ANNOUNCE
            self._expect(c, math.inf if participant.announces else PACKETS_WITHIN_S)
            self.tell_reached()
        elif kind is ToBench.WAKE:
            participant.wake_ns = a
            self.tell_reached()
        elif kind is ToBench.ASK:
            participant.tell(FromBench.TIME, self.now_ns)
        elif kind is ToBench.GO:
            participant.until_ns = ENDLESS_NS
        elif kind is ToBench.SEED:
            for call in self.seeds:
                call((a, b, c))
        else:
            participant.robot_port, participant.bus_port = a, b

    def _expect(self, packets: int, within_s: float) -> None:
        """Make no step before so many packets have come since 0 was stated; below 0 nothing is stated."""
        if packets < 0:
            return
        if packets == 0:
            self._packets_mark, self._packets_due = self.packets_arrived() or 0, 0
        elif self._packets_mark >= 0:
            self._packets_due = self._packets_mark + packets
            self._packets_late_s = time.monotonic() + within_s

    # how far time may go

    def demand(self) -> Demand | None:
        """Largest demand for the next step; None: the step may not come."""
        now_ns = self.now_ns
        wanted, conducted = Demand.NONE, False
        for participant in self._participants:
            if participant.until_ns <= now_ns:
                return None
            wanted = max(wanted, participant.demand)
            conducted = conducted or participant.conducts
        if wanted is Demand.NONE and not conducted:
            return Demand.REAL
        return wanted if wanted is not Demand.NONE else None

    def tell_reached(self) -> None:
        """Report the time to those that wait for it; end a conductor's `go` where a result is handed over."""
        for participant in list(self._participants):  # who is found gone leaves the list
            if participant.wake_ns <= self.now_ns:
                participant.wake_ns = ENDLESS_NS
                participant.tell(FromBench.TOLD, self.now_ns)
            if participant.until_ns > self.now_ns or participant.told_ns == participant.until_ns:
                continue
            participant.told_ns = participant.until_ns
            if participant.conducts:
                continue
            others = [p for p in self._participants if p.told_with == participant.name]
            for other in others or [participant]:
                robot_ns = self.robot_sent_ns(other.robot_port) if other.robot_port else 0
                frames = self.frames_sent(other.bus_port) if other.bus_port else 0
                other.tell(FromBench.TOLD, self.now_ns, robot_ns, frames)
            if participant.hands_over:
                for conductor in self._participants:
                    if conductor.conducts:
                        conductor.until_ns = self.now_ns

    # the loop

    def stop(self) -> None:
        """Let `run` return after its step."""
        self._stopping = True

    def run(self) -> None:
        """Step, serve and keep the pace until stopped; the ports stay open."""
        due_ns = repeat_ns = time.perf_counter_ns()
        steps = 1
        while not self._stopping:
            demand = self.demand()
            if demand is not None and not self._all_packets():
                demand = None
            now_ns = time.perf_counter_ns()
            if demand is None:
                # time stands: wait for messages, and send the newest data again now and then
                self._reactor.serve(min(REPEAT_S, max(0.0, (repeat_ns - now_ns) * 1e-9)))
                due_ns = time.perf_counter_ns()
                if due_ns >= repeat_ns:
                    repeat_ns = due_ns + round(REPEAT_S * 1e9)
                    for call in self.repeats:
                        call()
                continue
            if demand is Demand.REAL and due_ns > now_ns:
                self._reactor.serve((due_ns - now_ns) * 1e-9, patient=self.simulated)
                continue
            self._reactor.serve(0.0)
            if self.demand() is None:
                continue
            due_ns = self._next_due(due_ns, time.perf_counter_ns())
            self.steps_together(steps)
            steps = 1 if self.simulated else self.at_once()
            due_ns += (steps - 1) * self._step_ns
            repeat_ns = time.perf_counter_ns() + round(REPEAT_S * 1e9)

    def _all_packets(self) -> bool:
        """Whether all announced packets have come; what is lost is waited for once, then no more."""
        arrived = self.packets_arrived()
        if arrived is None or self._packets_due <= arrived:
            return True
        if time.monotonic() < self._packets_late_s:
            return False
        self._packets_mark, self._packets_due = -1, 0
        return True

    def steps_together(self, count: int) -> None:
        """Make some steps; what is sent in them goes out together."""
        self._reactor.gathers = count > 1
        for self.to_follow in reversed(range(count)):
            self._step()
        self._reactor.gathers = False

    def _step(self) -> None:
        self.now_ns += self._step_ns
        for call in self.steps:
            call()
        self.tell_reached()

    def _next_due(self, due_ns: int, now_ns: int) -> int:
        """When the step after this one begins at the pace of real time.

        On the wall clock short delays are made up for, so that simulated robot and cell keep to the machine's
        time. A stall is not: steps in quick succession would show clients what no robot does. Those that stamp
        data are called with the time that was lost (`stalled`). In simulated time none is lost.
        """
        late_ns = now_ns - due_ns
        if self.simulated:
            return max(due_ns, now_ns - self._step_ns) + self._step_ns
        self.longest_delay_s = max(self.longest_delay_s, late_ns * 1e-9)
        if late_ns <= STALL_S * 1e9:
            return due_ns + self._step_ns
        self.stalls += 1
        for call in self.stalled:
            call(late_ns * 1e-9)
        return now_ns + self._step_ns
