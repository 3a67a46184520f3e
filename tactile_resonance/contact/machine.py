# SPDX-License-Identifier: Apache-2.0
"""The life of a contact, one cycle at a time: travel, tare, approach, contact, settle, hold, retract.

Pure: data in, a command out. What talks to devices is in `loop`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.admission import check_goal
from tactile_resonance.contact.envelope import Envelope, Place
from tactile_resonance.contact.estimator import ContactEstimate
from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import Command, ContactGoal, State
from tactile_resonance.contact.interfaces import ArmError, ForceError
from tactile_resonance.contact.law import HoldMode, force_speed, place_speed
from tactile_resonance.contact.observer import Observer
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.result import Breach, Cause, ContactResult
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.tip_path import ARRIVED_M, TipPath

FloatArray = NDArray[np.float64]

STILL_M_S, STILL_NS = 5e-4, 50_000_000
"""Below this speed for so long the arm is at rest [m/s], [ns]."""

TOUCH_IN_TRAVEL_N = 0.01
"""Change of the untared force while coming down to the standoff that is a touch [N]."""

LOST_GRACE_S = 0.02
"""Forces from before the touch do not count for a lost contact, nor those of the first moments."""

MOST_TAKEN_BACK = 3
"""So often in one contact a touch may turn out to have been noise."""

RETRACT_AFTER_S = 0.1
"""A fault's stop lasts so long before the tip is drawn back [s]; where too much force is why, none."""

PRESSING_CAUSES = frozenset({Cause.FORCE_ABORT, Cause.FORCE_HARD, Cause.FORCE_RATE})
"""After these the tip is drawn back at once: while it slows down it goes deeper."""

ARM_CAUSES = frozenset({Cause.ARM_LINK, Cause.ARM_STALE, Cause.ARM_STOPPED, Cause.ARM_INVALID})
"""After these the tip is not drawn back by itself: the arm moves again only when told to."""


TOUCHING = (State.CONTACT, State.SETTLE, State.HOLD)
TARED = (State.APPROACH, *TOUCHING)


class ContactController:
    """State machine, law and envelope of one tip.

    Parameters
    ----------
    parameters : ContactParameters
    limits : Limits
    tip : TipGeometry, optional
        For its housing, which is not watched without it.

    Attributes
    ----------
    state : State
    parameters : ContactParameters
    limits : Limits
    goal : ContactGoal or None
    """

    def __init__(
        self, parameters: ContactParameters, limits: Limits, tip: TipGeometry | None = None
    ) -> None:
        limits.check(parameters)
        self._tip = tip
        self.parameters, self.limits = parameters, limits
        self.state = State.IDLE
        self.goal: ContactGoal | None = None
        self._envelope = Envelope(limits)
        self._clear()

    def _clear(self) -> None:
        """Forget the last contact."""
        self._result: ContactResult | None = None
        self._observer = Observer(self.parameters, self.limits.stuck_samples)
        self._start_ns = self._state_ns = self._contact_ns = self._tare_ns = 0
        self._still_ns = self._within_ns = -1
        self._travel_force: FloatArray | None = None
        self._hold_height_m = 0.0
        self._told_m: float | None = None
        self._looked_again = False
        self._taken_back = 0
        self._wish_retract = self._arm_was_bad = self._pressed_too_hard = False

    @property
    def result(self) -> ContactResult | None:
        """Of the last goal, once it was reached or failed; while held its force is the mean so far."""
        result, mean = self._result, self._observer.mean_force()
        if result is not None and self.state is State.HOLD and mean is not None:
            return replace(result, force_n=mean[0], force_std_n=mean[1])
        return result

    @property
    def estimate(self) -> ContactEstimate | None:
        """What is known of the contact; None where there is none."""
        model = self._observer.model
        return None if model is None else model.estimate(self._height_m)

    @property
    def bias_n(self) -> FloatArray:
        """Force (3,) of the last tare [N], of the frame `tip`; zeros before it."""
        return self._observer.watch.bias_n

    # requests

    def configure(self, parameters: ContactParameters, limits: Limits) -> None:
        """Exchange parameters and limits; only while idle.

        Raises
        ------
        ValueError
            If a contact is under way, or parameters ask for more than the limits allow; nothing is
            changed then.
        """
        if self.state is not State.IDLE:
            raise ValueError(f"parameters: refused in state {self.state.value}; accepted in idle")
        limits.check(parameters)
        self.parameters, self.limits = parameters, limits
        self._envelope = Envelope(limits)

    def start(self, goal: ContactGoal, now_ns: int) -> None:
        """Begin a contact.

        Raises
        ------
        ValueError
            If another is under way, or the goal lies beyond the limits.
        """
        if self.state is not State.IDLE:
            raise ValueError(f"goal: refused in state {self.state.value}; accepted in idle")
        check_goal(goal, self.parameters, self.limits, self._tip)
        self._clear()
        self.goal = goal
        self._path = TipPath(goal, self._tip)
        self._start_ns = now_ns
        self._enter(State.TRAVEL, now_ns)

    def retract(self) -> None:
        """Draw the tip back along the normal, at the next cycle; also out of a fault."""
        if self.state is not State.IDLE:
            self._wish_retract = True

    def tell_touch(self) -> bool:
        """Another sensor tells the first contact: the rest of the approach is slow.

        What counts as contact for the law and its limits is still the force. Returns whether it is new
        and of use: only in an approach.
        """
        if self.state is not State.APPROACH or self._told_m is not None:
            return False
        self._told_m = self._height_m
        return True

    # one cycle

    def step(
        self,
        now_ns: int,
        arm: ArmSample | None,
        wrenches: Sequence[WrenchSample],
        fault: ArmError | ForceError | None = None,
    ) -> Command | None:
        """Take what came since the last cycle and return what the arm is told; None: nothing.

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
        if self.state is State.IDLE or self.goal is None:
            return None
        place = None if arm is None else self._place(arm)
        breach = self._judge(now_ns, arm, place, wrenches, fault)
        if breach is not None and self.state is State.FAULT:
            self._arm_was_bad = True  # nothing else counts in this state
        elif breach is not None:
            self._fail(breach, now_ns)
        if breach is None and self._wish_retract and self.state is not State.RETRACT:
            text = "drawn back as asked for"
            self._end(Breach(Cause.CANCELLED, text), now_ns)
            self._enter(State.RETRACT, now_ns)
        if arm is None or place is None:
            return self._stop()
        twist = self._act(now_ns, arm, place)
        if twist is None:
            return self._stop()
        twist = self._envelope.bound(twist, arm.tip.position_m, place)
        speed, arm_model = float(self._path.normal @ twist[:3]), self._observer.arm_model
        limit = self.parameters.acceleration_m_s2
        if self.state in (*TOUCHING, State.RETRACT) and speed > arm_model.set_speed_m_s:
            limit = max(limit, self.parameters.relief_acceleration_m_s2)
        arm_model.step(speed, limit)
        return Command(twist, limit)

    def _stop(self) -> Command:
        limit = self.limits.stop_deceleration_m_s2
        self._observer.arm_model.step(0.0, limit)
        return Command(None, limit)

    def _judge(
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
        breach = self._envelope.judge_arm(now_ns, arm)
        if breach is not None or arm is None or place is None:
            return breach
        taken = self._observer.take(wrenches, arm.time_ns, place.height_m)
        if self.state in (State.RETRACT, State.FAULT):
            return None
        if isinstance(fault, ForceError):
            return Breach(Cause.FORCE_SOURCE, str(fault))
        breach = taken or self._envelope.judge_motion(arm, place)
        if breach is None and self.state in TARED:
            breach = self._envelope.judge_force(now_ns, self._observer.watch)
        elif breach is None and now_ns - self._start_ns > 1e9 * self.limits.force_age_s:
            breach = self._envelope.judge_force_age(now_ns, self._observer.watch)
        return breach or self._judge_time(now_ns)

    def _judge_time(self, now_ns: int) -> Breach | None:
        limits, tare = self.limits, 2 * self.parameters.tare_s + 2.0
        most = {
            State.TRAVEL: limits.travel_s,
            State.TARE: tare,
            State.APPROACH: limits.approach_s,
            State.CONTACT: limits.press_s,
            State.SETTLE: limits.press_s,
            State.HOLD: limits.hold_s,
        }[self.state]
        if (now_ns - self._state_ns) * 1e-9 <= most:
            return None
        if self.state is State.HOLD:
            return Breach(Cause.HOLD_ENDED, f"held for {most:g} s, as long as is allowed")
        return Breach(Cause.TIME, f"{self.state.value} took longer than {most:g} s")

    # what each state does: the wished twist, None to stop

    def _act(self, now_ns: int, arm: ArmSample, place: Place) -> FloatArray | None:
        if self.state is State.TRAVEL:
            return self._travel(now_ns, arm, place)
        if self.state is State.TARE:
            return self._taring(now_ns, arm)
        if self.state is State.APPROACH:
            return self._approach(now_ns, arm, place)
        if self.state in TOUCHING:
            return self._press(now_ns, arm, place)
        if self.state is State.RETRACT:
            return self._draw_back(now_ns, arm, place)
        self._after_fault(now_ns)
        return None

    def _travel(self, now_ns: int, arm: ArmSample, place: Place) -> FloatArray | None:
        p = self.parameters
        near = place.height_m < self.limits.near_m
        if self._path.must_lift(arm, p.standoff_m):
            # it may still press, where something ended while it did: up before it goes along
            return self._path.lift(arm, p)
        if near and math.isfinite(self._observer.watch.age_s(now_ns)):
            # not tared yet, so only a change counts
            if self._travel_force is None:
                self._travel_force = self._observer.watch.force_n.copy()
            change = float(np.linalg.norm(self._observer.watch.force_n - self._travel_force))
            if change > TOUCH_IN_TRAVEL_N:
                text = f"force changed by {1e3 * change:.1f} mN on the way to the standoff"
                self._fail(Breach(Cause.SURFACE_EARLY, text), now_ns)
                return None
        if self._path.arrived(arm, p.standoff_m):
            self._enter(State.TARE, now_ns)
            return None
        return self._path.travel(arm, p, self.limits)

    def _taring(self, now_ns: int, arm: ArmSample) -> FloatArray | None:
        speed = float(np.linalg.norm(arm.tip_velocity[:3]))
        observer = self._observer
        if not observer.taring:
            if speed > STILL_M_S:
                self._still_ns = -1
            elif self._still_ns < 0:
                self._still_ns = now_ns
            elif now_ns - self._still_ns > STILL_NS:
                observer.begin_tare()
                self._tare_ns = now_ns
        elif now_ns - self._tare_ns >= 1e9 * self.parameters.tare_s:
            breach = observer.end_tare()
            if breach is None:
                self._enter(State.APPROACH, now_ns)
            else:
                self._fail(breach, now_ns)
        return None

    def _approach(self, now_ns: int, arm: ArmSample, place: Place) -> FloatArray | None:
        p = self.parameters
        model = self._observer.model
        if model is not None:
            self._contact_ns, self._looked_again = now_ns, False
            self._enter(State.CONTACT, now_ns)
            return self._press(now_ns, arm, self._place(arm))
        if place.height_m < -p.search_m:
            text = f"no touch down to {1e3 * p.search_m:g} mm below the expected surface"
            self._fail(Breach(Cause.SURFACE_MISSING, text), now_ns)
            return None
        told = self._told_m is not None
        speed = min(p.approach_speed_m_s, p.told_speed_m_s) if told else p.approach_speed_m_s
        return self._path.along_normal(arm, -speed)

    def _press(self, now_ns: int, arm: ArmSample, place: Place) -> FloatArray | None:
        p, goal, model = self.parameters, self.goal, self._observer.model
        assert goal is not None
        assert model is not None
        if self._lost(now_ns):
            return None
        estimate = model.estimate(place.height_m)
        sure = now_ns - self._contact_ns > 1e9 * (self.limits.lost_s + LOST_GRACE_S)
        early = self.state is not State.HOLD and sure and estimate.surface_m > p.early_m
        if early and self._was_noise(self.limits.lost_force_n, now_ns):
            return None
        if early and not self._looked_again:
            self._looked_again = True
            self._observer.look_again()
            return self._path.along_normal(arm, 0.0)
        if early:
            text = f"touched {1e3 * estimate.surface_m:.2f} mm above the expected surface"
            text += f", accepted are {1e3 * p.early_m:g} mm"
            self._fail(Breach(Cause.SURFACE_EARLY, text), now_ns)
            return None
        off = abs(estimate.force_n - goal.aim.force_n) / goal.aim.force_n
        if self.state is State.CONTACT and off < 4 * p.tolerance:
            self._enter(State.SETTLE, now_ns)
        if self.state is State.SETTLE:
            if off > p.tolerance:
                self._within_ns = -1
            elif self._within_ns < 0:
                self._within_ns = now_ns
            elif sure and now_ns - self._within_ns >= 1e9 * p.settle_s:
                self._hold_height_m = place.height_m
                self._observer.begin_mean()
                self._result = self._new_result(Breach(Cause.NONE, ""), now_ns, estimate)
                self._enter(State.HOLD, now_ns)
        pending = self._observer.arm_model.pending_m
        if self.state is State.HOLD and goal.aim.hold is HoldMode.INDENTATION:
            speed = place_speed(self._hold_height_m, place.height_m, pending, p)
        else:
            speed = force_speed(
                model,
                place.height_m,
                pending,
                goal.aim.force_n,
                p,
                holding=self.state is State.HOLD,
            )
        most = p.press_speed_m_s
        return self._path.along_normal(arm, min(most, max(-most, speed)))

    def _lost(self, now_ns: int) -> bool:
        """Whether the tissue has gone; a touch that was noise is taken back."""
        observer, limits = self._observer, self.limits
        mean = observer.watch.mean_n(limits.lost_s)
        if mean is None or now_ns - self._contact_ns < 1e9 * (limits.lost_s + LOST_GRACE_S):
            return False
        if self.state is State.CONTACT and self._was_noise(observer.noise_n / 4, now_ns):
            return True
        if self.state is State.SETTLE and self._was_noise(limits.lost_force_n, now_ns):
            return True
        if self.state in (State.SETTLE, State.HOLD) and mean < limits.lost_force_n:
            text = f"mean force {1e3 * mean:.1f} mN over {1e3 * limits.lost_s:g} ms"
            self._fail(Breach(Cause.CONTACT_LOST, text), now_ns)
            return True
        return False

    def _was_noise(self, least_n: float, now_ns: int) -> bool:
        """Whether what told the touch was noise: no such force is there; then it is sought anew."""
        mean = self._observer.watch.mean_n(self.limits.lost_s)
        if mean is None or mean >= least_n or self._taken_back == MOST_TAKEN_BACK:
            return False
        self._taken_back += 1
        self._observer.seek_touch()
        self._enter(State.APPROACH, now_ns)
        return True

    def _draw_back(self, now_ns: int, arm: ArmSample, place: Place) -> FloatArray | None:
        if now_ns - self._state_ns > 1e9 * self.limits.retract_s:
            self._fail(Breach(Cause.TIME, "retraction took too long"), now_ns)
            return None
        if self.parameters.standoff_m - place.height_m < ARRIVED_M:
            if self._result is not None:
                self._result = replace(self._result, retracted=True)
            self._enter(State.IDLE, now_ns)
            return None
        return self._path.lift(arm, self.parameters)

    def _after_fault(self, now_ns: int) -> None:
        """Stand still; then draw back, unless the arm itself was the fault."""
        after_s = 0.0 if self._pressed_too_hard else RETRACT_AFTER_S
        if not self._arm_was_bad and now_ns - self._state_ns >= 1e9 * after_s:
            self._enter(State.RETRACT, now_ns)

    # pieces

    def _place(self, arm: ArmSample) -> Place:
        path, depth = self._path, None
        self._height_m = above = path.height_m(arm)
        if self._observer.model is not None and self.state in TOUCHING:
            depth = self._observer.model.estimate(above).depth_m
            above = -depth
        return Place(
            path.normal,
            self._height_m,
            depth,
            float(np.linalg.norm(path.turn(arm))),
            path.housing_m(arm, above),
        )

    def _enter(self, state: State, now_ns: int) -> None:
        self.state, self._state_ns = state, now_ns
        self._within_ns = self._still_ns = -1
        if state in (State.RETRACT, State.IDLE):
            self._wish_retract = False

    def _fail(self, breach: Breach, now_ns: int) -> None:
        """Note why, and stop."""
        self._arm_was_bad = breach.cause in ARM_CAUSES
        self._pressed_too_hard = breach.cause in PRESSING_CAUSES
        self._end(breach, now_ns)
        self._enter(State.FAULT, now_ns)

    def _end(self, breach: Breach, now_ns: int) -> None:
        """Note why the contact was not reached, or ended; the first cause stays."""
        result = self.result
        if result is None:
            self._result = self._new_result(breach, now_ns, None)
        elif result.cause is Cause.NONE:
            peak = self._observer.watch.peak_n
            self._result = replace(
                result, cause=breach.cause, message=breach.message, peak_force_n=peak
            )

    def _new_result(
        self, breach: Breach, now_ns: int, estimate: ContactEstimate | None
    ) -> ContactResult:
        return ContactResult(
            reached=estimate is not None,
            cause=breach.cause,
            message=breach.message,
            force_n=estimate.force_n if estimate is not None else None,
            force_std_n=(
                math.hypot(estimate.force_std_n, self._observer.bias_std_n)
                if estimate is not None
                else None
            ),
            depth_m=estimate.depth_m if estimate is not None else None,
            stiffness_n_per_m=estimate.stiffness_n_per_m if estimate is not None else None,
            surface_m=estimate.surface_m if estimate is not None else None,
            told_m=self._told_m,
            surface_std_m=estimate.depth_std_m if estimate is not None else None,
            contact_s=(now_ns - self._contact_ns) * 1e-9 if estimate is not None else None,
            total_s=(now_ns - self._start_ns) * 1e-9,
            peak_force_n=self._observer.watch.peak_n,
            retracted=False,
        )
