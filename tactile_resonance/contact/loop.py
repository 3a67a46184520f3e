# SPDX-License-Identifier: Apache-2.0
"""The control loop, period by period: read both devices, let the controller decide, command the arm.

And what a test records of its cycles: force and depth of one contact, from the approach until the tip is back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tactile_resonance.clock import Clock, Demand
from tactile_resonance.contact.free_motion import STILL_M_S, STILL_RAD_S
from tactile_resonance.contact.geometry import TipPath
from tactile_resonance.contact.goal import TOUCHING, Command, ContactGoal, ContactResult, State
from tactile_resonance.contact.interfaces import Arm, ArmError, ArmFault, Cell, ForceError
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.payload import Mount
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import Vector, turn_from_vector
from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Protocol

STOP_AGAIN_NS = 50_000_000
"""A stop that holds is sent again after so long, at least once, and until the arm is seen to rest."""

MOST_STOPS = 20
"""So often a loop that ends sends a stop before it gives up: 1 s."""

GONE = (ArmFault.LINK_LOST, ArmFault.CLIENT_DIED)
"""With these no stop reaches the arm any more."""


class Cycle(NamedTuple):
    """What one cycle saw, for those who record or publish it."""

    time_ns: int
    arm: ArmSample | None
    wrenches: list[WrenchSample]
    state: State
    bias_n: Vector  # of the last tare, not taken off the wrenches
    bias_std_n: float  # its standard deviation along the normal
    fault: ArmError | ForceError | None  # what a device raised in this cycle


class ContactLoop:
    """Runs a controller on an arm, a force sensor and a clock; one thread.

    Parameters
    ----------
    listener : callable, optional
        Called with each `Cycle`; must return at once.

    Attributes
    ----------
    cycles, overruns : int
        Cycles run, and those that began more than one period late.
    fault : ArmError, ForceError or None
        What a device raised in the newest cycle.
    """

    def __init__(
        self,
        arm: Arm,
        force: Cell,
        clock: Clock,
        controller: ContactController,
        listener: Callable[[Cycle], None] | None = None,
    ) -> None:
        self.controller = controller
        self.cycles = self.overruns = 0
        self.fault: ArmError | ForceError | None = None
        self._arm, self._force, self._clock = arm, force, clock
        self._listener = listener
        self._next_ns = clock.now_ns()
        self._seen: ArmSample | None = None  # the arm, in the newest cycle
        self._pose: ArmSample | None = None  # when it was seen last
        self._refused: ArmError | None = None  # what a command raised, reported in the next cycle
        self._stopped_ns: int | None = None
        self._owed: Command | None = None  # a stop of which the arm has not been seen to rest
        self._owed_ns = 0

    def start(self, goal: ContactGoal) -> None:
        """Begin a contact; raises ``ValueError`` where the controller refuses it."""
        self.controller.start(goal, self._clock.now_ns(), self._seen)

    def make(self, goal: ContactGoal) -> ContactResult:
        """Begin a contact and run until it is reached, or has failed and stands still."""
        self.start(goal)
        self.run_while(lambda: self.controller.result is None)
        result = self.controller.result
        assert result is not None
        return result

    def run_while(self, condition: Callable[[], bool], longest_s: float = float("inf")) -> None:
        """Run while a condition holds, at most for some time."""
        end_ns = self._clock.now_ns() + 1e9 * longest_s
        while condition() and self._clock.now_ns() < end_ns:
            self.cycle()

    def retract(self) -> ContactResult | None:
        """Draw the tip back and run until it is, or until the arm fails; return the result."""
        self.controller.retract()
        self.cycle()
        self.run_while(lambda: self.controller.state not in (State.IDLE, State.FAULT))
        return self.controller.result

    def cycle(self) -> None:
        """Wait for the next period and run it."""
        self.wait()
        self.run_period()

    def wait(self) -> None:
        """Wait for the next period; requests may be made meanwhile."""
        # whether what is under way needs simulated time to pass
        waits = self._clock.simulated and self.controller.waits
        self._clock.wait_until(self._next_ns, Demand.NONE if waits else Demand.FAST)

    @property
    def left_s(self) -> float:
        """Until the next period is due [s]; below 0 where it is late."""
        return (self._next_ns - self._clock.now_ns()) * 1e-9

    def hurry(self) -> None:
        """Let the next period be due now, if it is not yet."""
        self._next_ns = min(self._next_ns, self._clock.now_ns())

    def skip(self) -> None:
        """Leave out the period that is due; the next one begins a period from now."""
        self._next_ns = self._clock.now_ns() + self._period_ns()

    def run_period(self) -> None:
        """Read both devices, decide, command."""
        period_ns = self._period_ns()
        now = self._clock.now_ns()
        late_ns = now - self._next_ns
        self.cycles += 1
        if late_ns > period_ns:
            self.overruns += 1
            self._next_ns = now  # periods that are lost are not made up for
        fault: ArmError | ForceError | None = self._refused
        self._refused = None
        arm, wrenches = None, []
        try:
            arm = self._arm.state()
        except ArmError as error:
            fault = fault or error
        try:
            felt = self._force.read()
        except ForceError as error:
            fault = fault or error
        else:
            # without a state of the arm in this cycle, wrenches are referred to its last known pose
            pose = self._pose = arm or self._pose
            if felt and pose is not None:
                goal, mounting = self.controller.goal, self._force.mounting
                if goal is not None and mounting.mount is Mount.TABLE:
                    # so that the weight on it, part of its zero, does not turn with a tip that is put right
                    turn = goal.touch.turn
                else:
                    turn = turn_from_vector(pose.rotation_rad)
                wrenches = mounting.to_tip(felt, pose.position_m, turn)
        self._seen, self.fault = arm, fault
        # the arm keeps a velocity, so a stop is sent until it has worked, whatever state that ends in
        command = self.controller.step(now, arm, wrenches, fault) or self._owed
        try:
            self._tell(command, now)
        except (ArmError, ValueError) as error:  # a driver refuses figures that it may not pass on
            self._refused = (
                error
                if isinstance(error, ArmError)
                else ArmError(ArmFault.COMMAND_REFUSED, str(error))
            )
            self._stopped_ns = None
        else:
            if self._owed is not None and now - self._owed_ns > STOP_AGAIN_NS and _rests(arm):
                self._owed = None
        controller = self.controller
        self._next_ns += period_ns * controller.periods
        if self._listener is not None:
            zero = controller.bias_n, controller.bias_std_n
            cycle = Cycle(now, arm, wrenches, controller.state, *zero, fault)
            self._listener(cycle)

    def bring_to_rest(self) -> str:
        """Stop the arm until it is seen to stand, at most `MOST_STOPS` times; why it was not, else empty.

        For a loop that ends, whatever is wrong with it: nothing is raised.
        """
        reason = ""
        for _ in range(MOST_STOPS):
            reason = "it still moves"
            try:
                self._arm.stop(self.controller.limits.stop_deceleration_m_s2)
            except Exception as error:
                reason = str(error) or repr(error)
                if isinstance(error, ArmError) and error.fault in GONE:
                    break
            try:
                self._clock.wait_until(self._clock.now_ns() + STOP_AGAIN_NS)
                if _rests(self._arm.state()):
                    return ""
            except Exception as error:
                reason = str(error) or repr(error)
        return reason

    def _tell(self, command: Command | None, now: int) -> None:
        """Pass a command on; a stop that goes on is not sent in every period."""
        if command is None or command.twist is not None:
            self._stopped_ns = self._owed = None
        elif self._owed is None:
            self._owed, self._owed_ns = command, now
        if command is None:
            return
        if command.twist is not None:
            self._arm.speed(command.twist, command.acceleration_m_s2)
        elif self._stopped_ns is None or now - self._stopped_ns > STOP_AGAIN_NS:
            self._stopped_ns = now
            self._arm.stop(command.acceleration_m_s2)

    def _period_ns(self) -> int:
        return round(1e9 * self.controller.parameters.period_s)


def _rests(arm: ArmSample | None) -> bool:
    """Whether an arm is seen to stand still, and not to turn; False where a speed is not finite."""
    if arm is None or not math.hypot(*arm.velocity[:3]) < STILL_M_S:
        return False
    return math.hypot(*arm.velocity[3:]) < STILL_RAD_S


RECORDED = (State.APPROACH, *TOUCHING, State.RETRACT)


class IndentationRecorder:
    """Takes the cycles of one contact; one thread adds, another asks once the contact has ended.

    Parameters
    ----------
    goal : ContactGoal
    protocol : Protocol
    ball : BallTip
    source : str
        Of the forces.
    simulated : bool

    Attributes
    ----------
    begun_ns : int or None
        First touch, by the clock of the samples [ns]; None before `record`.
    """

    def __init__(
        self, goal: ContactGoal, protocol: Protocol, ball: BallTip, source: str, *, simulated: bool
    ) -> None:
        self._path, self._protocol, self._ball = TipPath(goal), protocol, ball
        self._source, self._simulated = source, simulated
        self._forces: list[tuple[int, float]] = []
        self._heights: list[tuple[int, float]] = []
        self._zero_std_n = math.nan
        self.begun_ns: int | None = None

    def take(self, cycle: Cycle) -> None:
        """Take a cycle; those before the approach and after the retraction are left out."""
        if cycle.state not in RECORDED:
            return
        self._zero_std_n = cycle.bias_std_n
        if cycle.arm is not None:
            self._heights.append((cycle.arm.time_ns, self._path.height_m(cycle.arm)))
        zero_n = cycle.bias_n[2]
        self._forces.extend((w.time_ns, w.force_n[2] - zero_n) for w in cycle.wrenches)

    def record(self, result: ContactResult | None) -> IndentationRecord:
        """All so far.

        Raises
        ------
        ValueError
            If the tissue was not touched, or too little was recorded.
        """
        if result is None or result.surface_m is None or not self._forces:
            raise ValueError(
                "indentation: the tissue was not touched; accepted is a contact that was reached"
            )
        forces, heights = np.array(self._forces), np.array(self._heights)
        ns = forces[:, 0].astype(np.int64)
        begin_ns = int(ns[0])
        time_s = (ns - begin_ns) * 1e-9
        arm_s = (heights[:, 0] - begin_ns) * 1e-9
        depth_m = result.surface_m - np.interp(time_s, arm_s, heights[:, 1])
        kept = np.concatenate([[True], np.diff(ns) > 0])
        kept &= np.isfinite(forces[:, 1]) & (time_s >= arm_s[0]) & (time_s <= arm_s[-1])
        touched_s = float(time_s[np.argmax(depth_m >= 0)])
        self.begun_ns = begin_ns + round(1e9 * touched_s)
        return IndentationRecord(
            self._protocol,
            time_s[kept] - touched_s,
            forces[kept, 1],
            depth_m[kept],
            self._ball,
            force_std_n=self._zero_std_n,
            source=self._source,
            simulated=self._simulated,
        )
