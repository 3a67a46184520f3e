# SPDX-License-Identifier: Apache-2.0
"""The life of a contact, one cycle at a time: travel, tare, approach, contact, settle, hold, retract.

Pure: data in, a command out. What talks to devices is in `loop`; what each state does is in
`free_motion` and `pressing`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from tactile_resonance.contact.contact_filter import ContactEstimate
from tactile_resonance.contact.envelope import Envelope, Place, is_finite
from tactile_resonance.contact.free_motion import FreeMotion, Withdrawal
from tactile_resonance.contact.geometry import TipGeometry, TipPath
from tactile_resonance.contact.goal import (
    ENDED,
    REST,
    TARED,
    TOUCHING,
    Breach,
    Cause,
    Command,
    ContactGoal,
    ContactResult,
    HoldMode,
    Move,
    NotIdleError,
    State,
)
from tactile_resonance.contact.interfaces import ArmError, ForceError
from tactile_resonance.contact.observer import Observer
from tactile_resonance.contact.outcome import Memory, Outcome
from tactile_resonance.contact.parameters import ContactParameters, Limits, check_goal
from tactile_resonance.contact.pressing import Pressing, TissueMotion
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import Vector, dot

RELIEVING = (*TOUCHING, State.RETRACT)
"""States in which force is taken off as fast as it may be."""

RETRACT_AFTER_S = 0.1
"""A fault's stop lasts so long before the tip is drawn back [s]; where too much force is why, none."""

PRESSING_CAUSES = frozenset({Cause.FORCE_ABORT, Cause.FORCE_HARD, Cause.FORCE_RATE})
"""After these the tip is drawn back at once: while it slows down it goes deeper."""

ARM_CAUSES = frozenset({Cause.ARM_LINK, Cause.ARM_STALE, Cause.ARM_STOPPED, Cause.ARM_INVALID})
"""After these the tip is not drawn back: the arm moves again only on request."""

STAYING_CAUSES = ARM_CAUSES | {Cause.HELD}
"""After these the tip stays where it is until it is asked to retract."""

LINGER_NS = 1_000_000_000
"""So long a tip waits at a goal's own standoff for the next goal before it rises to the usual one [ns]."""

IDLE_PERIODS = 10
"""While no contact is under way one of so many periods is run, where nothing else is stated: 20 ms, half of
what a robot's watchdog of 25 Hz allows, since in simulated time it is fed once per period."""

CALM = 2.5
"""Deviations by which the force of a held contact that is calm is off at most, as a mean of some forces."""

FRESH_PERIODS = 3
"""A contact is not calm where the newest force or state of the arm is as many periods old: it may be silent."""

WISH_NS = 1_000_000_000
"""For so long a retraction that is asked for waits for an arm that cannot move [ns]."""


class ContactController:
    """State machine, law and envelope of one tip.

    All times are of one monotonic clock, that of the samples, or of a simulation's.

    Parameters
    ----------
    parameters : ContactParameters
    limits : Limits
    tip : TipGeometry, optional
        For its housing, which is not watched without it.
    under_sample : bool
        Whether the cell is under the sample.
    calm_periods : int
        While a contact is held on tissue that is still and brings no surprise, one of so many periods is run;
        of a cell that moves with the tip each one is.
    idle_periods : int
        The same while no contact is under way.

    Attributes
    ----------
    state : State
    parameters : ContactParameters
    limits : Limits
    goal : ContactGoal or None
    """

    def __init__(
        self,
        parameters: ContactParameters,
        limits: Limits,
        tip: TipGeometry | None = None,
        *,
        under_sample: bool = False,
        calm_periods: int = 1,
        idle_periods: int = IDLE_PERIODS,
    ) -> None:
        limits.check(parameters)
        self._tip, self._under_sample = tip, under_sample
        self._calm_periods = calm_periods if under_sample else 1
        self._idle_periods = idle_periods
        self.parameters, self.limits = parameters, limits
        self.state = State.IDLE
        self.goal: ContactGoal | None = None
        self._envelope = Envelope(limits)
        self._observer = Observer(parameters, limits)
        self._outcome = Outcome(self._observer, 0)
        self._memory = Memory()
        self._pressed_n = 0.0
        self._height_m = 0.0
        self._state_ns = 0
        self._wish_retract = self._rising = False
        self._stride = 1
        self._wish_ns: int | None = None  # since when it waits for an arm that cannot move

    @property
    def result(self) -> ContactResult | None:
        """Of the last goal, once it was reached or failed; while held its force is the mean so far."""
        return self._outcome.result(self.state is State.HOLD)

    @property
    def motion(self) -> TissueMotion | None:
        """How tissue that moves does so under the held tip; None where none is seen."""
        model, goal = self._observer.model, self.goal
        if model is None or not model.moving or goal is None or goal.hold is not HoldMode.FORCE:
            return None  # a tip that keeps its place says nothing of the tissue's
        return self._pressing.motion.describe()

    @property
    def estimate(self) -> ContactEstimate | None:
        """What is known of the contact; None where there is none."""
        model = self._observer.model
        return None if model is None else model.estimate(self._height_m)

    @property
    def waits(self) -> bool:
        """Whether the contact goes on as it is until somebody asks for something else."""
        held = self.state is State.HOLD and self.goal is not None and math.isinf(self.goal.hold_s)
        return held or self.settled

    @property
    def settled(self) -> bool:
        """Whether nothing more happens without a request: idle, or in a fault after which the tip stays."""
        stays = self.state is State.IDLE or (self.state is State.FAULT and self._stays)
        return stays and not self._wish_retract

    @property
    def bias_n(self) -> Vector:
        """Force of the last tare [N], of the frame `tip`; zeros before it."""
        return self._observer.watch.bias_n

    @property
    def bias_std_n(self) -> float:
        """Standard deviation of that along the normal [N]; 0 before it."""
        return self._observer.bias_std_n

    # requests

    def configure(self, parameters: ContactParameters, limits: Limits) -> None:
        """Exchange parameters and limits; only while idle.

        Raises
        ------
        NotIdleError
            If a contact is under way; nothing is changed then.
        ValueError
            If parameters ask for more than the limits allow; nothing is changed then.
        """
        if not self._free_for_goals:
            raise NotIdleError(f"parameters: refused in state {self.state.value}; accepted in idle")
        limits.check(parameters)
        if parameters.beam_stiffness_n_per_m != self.parameters.beam_stiffness_n_per_m:
            self._memory.clear()  # what was safe with one tip need not be with another
        self.parameters, self.limits = parameters, limits
        self._envelope = Envelope(limits)

    def start(self, goal: ContactGoal, now_ns: int, arm: ArmSample | None = None) -> None:
        """Begin a contact, from where the arm is; None: its way is judged in the first cycle that sees it.

        Raises
        ------
        NotIdleError
            If another is under way.
        ValueError
            If the goal lies beyond the limits.
        """
        if not self._free_for_goals:
            raise NotIdleError(f"goal: refused in state {self.state.value}; accepted in idle")
        p = self.parameters.lowered(goal.standoff_m, goal.press_speed_m_s)
        if self._under_sample:  # what the robot carries is not on the cell
            p = replace(p, carried_kg=0.0)
        limits = self.limits
        limits.check(p)
        check_goal(goal, p, limits)
        if self._tip is not None:
            self._tip.check_clear(limits)
        observer = Observer(p, limits)
        path = TipPath(goal, self._tip)
        known = self._memory.knows(goal, p.known_radius_m)
        speed = math.inf if known else p.first_speed_m_s(limits.abort_force_n)
        # a zero is followed where a moving tip may show it
        follows = self._under_sample and p.zero_std_n > 0
        zero = self._memory.zero_for(goal) if follows else None
        free = FreeMotion(path, observer, speed, under_sample=self._under_sample, zero=zero)
        if arm is not None and is_finite(arm):
            free.begin(arm)
        self.goal, self._observer, self._free = goal, observer, free
        self._outcome = Outcome(observer, now_ns)
        self._pressing = Pressing(path, observer, speed)
        self._withdrawal = Withdrawal(free, observer)
        self._start_ns, self._longest_s = now_ns, _longest_s(p, limits)
        self._lowest_m = -p.search_m - limits.depth_m
        self._stays = self._pressed_too_hard = self._rising = False
        self._pressed_n, self._memory.zero, self._usual_m = 0.0, None, self.parameters.standoff_m
        self._enter(State.TRAVEL, now_ns)

    def retract(self) -> None:
        """Draw the tip back along the normal, at the next cycle; also out of a fault."""
        if self.state is not State.IDLE or self._is_low:
            self._wish_retract, self._wish_ns = True, None

    def tell_touch(self) -> bool:
        """Another sensor has detected the first contact: the rest of the approach is slow.

        What counts as contact for the law and its limits is still the force. Returns whether it is new
        and of use: only in an approach.
        """
        if self.state is not State.APPROACH or self._free.told_m is not None:
            return False
        self._free.told_m = self._height_m
        return True

    # one cycle

    def step(
        self,
        now_ns: int,
        arm: ArmSample | None,
        wrenches: Sequence[WrenchSample],
        fault: ArmError | ForceError | None = None,
    ) -> Command | None:
        """Take what came since the last cycle and return the command to the arm; None: none.

        Parameters
        ----------
        now_ns : int
        arm : ArmSample or None
            Newest state; None where none could be had.
        wrenches : sequence of WrenchSample
            Since the last cycle, oldest first.
        fault : ArmError or ForceError, optional
            What a device raised in this cycle.
        """
        goal = self.goal
        if self.state is State.IDLE and self._is_low:
            self._rise(now_ns, arm, fault)
        if self.state is State.IDLE or goal is None:
            return None
        self._stride = 1
        place = None
        # of an arm whose place is not finite nothing else is known
        if arm is not None and is_finite(arm):
            if self.state is State.TRAVEL and not self._free.begun:
                self._begin_way(now_ns, arm)
            place = self._place(goal, arm)
        breach = self._breach(now_ns, arm, place, wrenches, fault)
        if breach is not None and self.state is State.FAULT:
            self._stays = True  # nothing else counts in this state
        elif breach is not None:
            self._fail(breach, now_ns)
        if self._wish_retract:
            self._heed_wish(now_ns, breach)
        if arm is None or place is None:
            return self._stop()
        move = self._act(goal, now_ns, arm, place)
        self._follow(goal, move, now_ns)
        if move.twist is None:
            return self._stop()
        twist = self._envelope.bound(move.twist, arm.position_m, place)
        speed, arm_model = dot(place.normal, twist[:3]), self._observer.arm_model
        limit = self.parameters.acceleration_m_s2
        if self.state in RELIEVING and speed > arm_model.set_speed_m_s:
            limit = max(limit, self.parameters.relief_acceleration_m_s2)
        if self._calm_periods > 1 and wrenches and self._is_calm():
            # where a device may be silent each period looks for it
            age_s = (now_ns - min(arm.time_ns, wrenches[-1].time_ns)) * 1e-9
            if age_s < FRESH_PERIODS * self.parameters.period_s:
                self._stride = self._calm_periods
        for _ in range(self._stride):
            arm_model.step(speed, limit)
        return Command(twist, limit)

    def _stop(self) -> Command:
        limit = self.limits.stop_deceleration_m_s2
        self._observer.arm_model.step(0.0, limit)
        return Command(None, limit)

    @property
    def periods(self) -> int:
        """After so many periods the next cycle is due."""
        return self._idle_periods if self.state is State.IDLE else self._stride

    def _is_calm(self) -> bool:
        """Whether a contact is held on tissue that is still, and brings no surprise."""
        model = self._observer.model
        if model is None or model.moving or self.state is not State.HOLD:
            return False
        return abs(model.surprise) < CALM and not self._wish_retract

    @property
    def _free_for_goals(self) -> bool:
        return self.state is State.IDLE or (self.state is State.RETRACT and self._rising)

    @property
    def _is_low(self) -> bool:
        """Whether the tip was drawn back to a goal's own standoff, below the usual one."""
        return self.goal is not None and self._free.rest_m < self._usual_m

    def _rise(
        self, now_ns: int, arm: ArmSample | None, fault: ArmError | ForceError | None
    ) -> None:
        """Go on to the usual standoff where that is asked for, or no goal came for a while.

        After a fault of the arm, and where it is where it may not be, only where it is asked for.
        """
        wished, self._wish_retract = self._wish_retract, False
        waited = now_ns - self._state_ns > LINGER_NS
        if isinstance(fault, ArmError) or self._envelope.judge_arm(now_ns, arm) is not None:
            self._stays = True
        elif wished or (waited and not self._stays):
            self._free.rest_m, self._rising = self._usual_m, True
            self._enter(State.RETRACT, now_ns)

    def _begin_way(self, now_ns: int, arm: ArmSample) -> None:
        """Find the way to the standoff of a contact that was begun while no arm was seen."""
        try:
            self._free.begin(arm)
        except ValueError as error:
            self._fail(Breach(Cause.HOUSING, str(error)), now_ns)

    def _breach(
        self,
        now_ns: int,
        arm: ArmSample | None,
        place: Place | None,
        wrenches: Sequence[WrenchSample],
        fault: ArmError | ForceError | None,
    ) -> Breach | None:
        """The first thing that is wrong; in retraction and fault only what concerns the arm."""
        if isinstance(fault, ArmError):
            return Breach(Cause.ARM_LINK, str(fault))
        state, envelope, observer = self.state, self._envelope, self._observer
        breach = envelope.judge_arm(now_ns, arm)
        if breach is not None or arm is None or place is None:
            return breach
        taken = observer.take(wrenches, arm.time_ns, place.height_m)
        if state in ENDED:
            return None
        if isinstance(fault, ForceError):
            return Breach(Cause.FORCE_SOURCE, str(fault))
        breach = taken or envelope.judge_motion(arm, place) or self._free.judge_way(arm)
        if breach is None and state in TOUCHING and place.height_m < self._lowest_m:
            text = (
                f"{-1e3 * place.height_m:.2f} mm below the expected surface, deeper than search_m"
            )
            breach = Breach(Cause.DEPTH, f"{text} and depth_m allow, {-1e3 * self._lowest_m:g} mm")
        if breach is None and state in TARED:
            breach = envelope.judge_force(now_ns, observer.watch)
        elif breach is None and now_ns - self._start_ns > 1e9 * envelope.limits.force_age_s:
            breach = envelope.judge_force_age(now_ns, observer.watch)
        return breach or self._judge_time(self._since_s(now_ns))

    def _judge_time(self, since_s: float) -> Breach | None:
        most_s = self._longest_s[self.state]
        if since_s <= most_s:
            return None
        if self.state is State.HOLD:
            return Breach(Cause.HOLD_ENDED, f"held for {most_s:g} s, as long as is allowed")
        name = "pressing" if self.state in TOUCHING else self.state.value
        return Breach(Cause.TIME, f"{name} took longer than {most_s:g} s")

    def _heed_wish(self, now_ns: int, breach: Breach | None) -> None:
        """Draw back as asked for; a wish that the arm cannot follow soon is forgotten."""
        if self.state is State.RETRACT:
            return
        if breach is None:
            self._end(Breach(Cause.CANCELLED, "drawn back as asked for"), now_ns)
            self._enter(State.RETRACT, now_ns)
        elif self._wish_ns is None:
            self._wish_ns = now_ns
        elif now_ns - self._wish_ns > WISH_NS:
            self._wish_retract, self._wish_ns = False, None

    def _act(self, goal: ContactGoal, now_ns: int, arm: ArmSample, place: Place) -> Move:
        """What the present state wishes."""
        if self.state is State.APPROACH:
            move = self._free.approach(arm, place)
            if move.to is not State.CONTACT:
                return move
            self._pressing.begin(now_ns)
            self._enter(State.CONTACT, now_ns)
            place = self._place(goal, arm)
        if self.state in TOUCHING:
            return self._pressing.step(now_ns, self.state, arm, place)
        if self.state is State.TRAVEL:
            return self._free.travel(now_ns, arm, place)
        if self.state is State.TARE:
            return self._free.tare(now_ns, arm)
        since_s = self._since_s(now_ns)
        if self.state is State.RETRACT:
            return self._withdrawal.step(now_ns, since_s, arm, place)
        # in a fault it stands still, and is then drawn back, unless the arm itself was the fault
        after_s = 0.0 if self._pressed_too_hard else RETRACT_AFTER_S
        return REST if self._stays or since_s < after_s else Move(None, State.RETRACT)

    def _follow(self, goal: ContactGoal, move: Move, now_ns: int) -> None:
        """Go over to the state that follows."""
        if move.breach is not None:
            self._fail(move.breach, now_ns)
        elif move.to is not None:
            if move.to is State.RETRACT and self.state is State.HOLD:
                self._end(Breach(Cause.HOLD_ENDED, f"held for {goal.hold_s:g} s as asked"), now_ns)
            estimate = self.estimate
            if move.to is State.HOLD and estimate is not None:
                told_m = self._free.told_m
                self._outcome.reached(now_ns, self._pressing.touched_ns, estimate, told_m)
            if move.to is State.IDLE and not self._rising:
                self._outcome.drawn_back(self._withdrawal.zero_n)
                self._memory.keep(goal, self.result, self._observer.zero)
            self._enter(move.to, now_ns)
            self._rising = self._rising and move.to is not State.IDLE

    # pieces

    def _since_s(self, now_ns: int) -> float:
        """How long the state has lasted [s]."""
        return (now_ns - self._state_ns) * 1e-9

    def _place(self, goal: ContactGoal, arm: ArmSample) -> Place:
        path, model, depth = self._free.path, self._observer.model, None
        self._height_m = above = path.height_m(arm)
        if model is not None and self.state in TOUCHING:
            depth = model.surface_m - above
            self._pressed_n = min(goal.force_n, model.force_at(above))
            above = -depth
        # the plane of the goal says nothing of what lies lower beside it
        lifted = self.state is State.TRAVEL and self._free.lifts(arm)
        housing_m = None if lifted else path.housing_m(arm, above)
        return Place(path.normal, self._height_m, depth, path.off_rad(arm), housing_m)

    def _enter(self, state: State, now_ns: int) -> None:
        if state is State.RETRACT:
            result = self.result
            cause = Cause.NONE if result is None else result.cause
            self._withdrawal.begin(cause, self._pressed_n)
            if self.state is not State.HOLD:
                self._free.rest_m = self._usual_m
        self.state = state
        if state is not State.SETTLE:  # part of pressing, whose time is limited from the touch on
            self._state_ns = now_ns
        if state in (State.TRAVEL, State.RETRACT, State.IDLE):
            self._wish_retract, self._wish_ns = False, None

    def _fail(self, breach: Breach, now_ns: int) -> None:
        """Note why, and stop."""
        self._stays, self._rising = breach.cause in STAYING_CAUSES, False
        self._pressed_too_hard = breach.cause in PRESSING_CAUSES
        if self._pressed_too_hard and self.goal is not None:
            self._memory.forget(self.goal, self.parameters.known_radius_m)
        self._end(breach, now_ns)
        self._enter(State.FAULT, now_ns)

    def _end(self, breach: Breach, now_ns: int) -> None:
        """Note why the contact was not reached, or ended."""
        holding = self.state is State.HOLD
        if holding and self.motion:
            breach = replace(breach, message=f"{breach.message}; {self.motion}")
        self._outcome.ended(breach, now_ns, self._free.told_m, holding)


def _longest_s(parameters: ContactParameters, limits: Limits) -> dict[State, float]:
    """How long each state may last before the tip is drawn back [s]."""
    return {
        State.TRAVEL: limits.travel_s,
        State.TARE: 2 * parameters.tare_s + 2.0,
        State.APPROACH: limits.approach_s,
        State.CONTACT: limits.press_s,
        State.SETTLE: limits.press_s,
        State.HOLD: limits.hold_s,
    }
