# SPDX-License-Identifier: Apache-2.0
"""Drawing the tip back: whether it comes free is judged by force, where force can be believed.

What clings to the tip pulls harder the further it goes (a fibre, tissue that sticks) or the faster it goes (a
film); a zero that has moved does neither. So the tip leaves the surface slowly, goes slower the more it is
pulled, and where the pull is beyond what is accepted it moves a little further: if the pull grows, the tip is
held; if not, the zero has moved. A force that is left at the standoff is distinguished in the same way:
tissue that presses is left behind, a zero is not.
"""

from __future__ import annotations

import math
from statistics import mean, stdev

from tactile_resonance.contact.envelope import Place
from tactile_resonance.contact.free_motion import STILL_M_S, FreeMotion
from tactile_resonance.contact.goal import Move, State, failed
from tactile_resonance.contact.observer import Observer
from tactile_resonance.contact.parameters import REACTION_S
from tactile_resonance.contact.result import Cause
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.tip_path import ARRIVED_M
from tactile_resonance.contact.vectors import dot

BLIND_CAUSES = frozenset({Cause.FORCE_STALE, Cause.FORCE_SOURCE})
"""After these, and after a bad force, the source is not believed: the tip is drawn back by position alone."""

SMOOTH_S = 0.008
"""Forces are averaged over about so long [s]."""

LEAVE_M_S, LEAVE_M, LEAVE_M_S2, PRESSED = 3.5e-3, 2e-4, 0.08, 1.5
"""Speed with which the surface is left until so far above it, and its growth from there on [m/s2]; faster
only while more than this multiple of the force is pressed with."""

EASE_M_S, EASE_S = 1.2e-2, 2 * REACTION_S
"""While the tip still presses it goes faster, up to the first: in the second what presses would be gone."""

CLINGS, SLOW_M_S, SLOW_N = 0.3, 6e-3, 3e-3
"""A pull beyond this share of the last limits the speed, from the second at no pull to none at the last."""

FEEL_M_S, FEEL_NOT_S, FEEL_M, GROWS_N = 1e-3, 0.08, 1e-3, 2.5e-3
"""Speed of a tip that is pulled too hard, until its mean force has come to what it is, the way after that, and
growth of the pull on it that is no zero."""

LEFT_N, NOISES = 2e-3, 5.0
"""Force at the standoff that is looked into [N], or so many deviations of the mean of 50 ms."""

BEYOND_M_S, STEP_S, BEYOND_M = 5e-3, 0.2, 0.02
"""Beyond the standoff: speed, length of the means that are compared, and how far."""


class Withdrawal:
    """Draws the tip back along the normal to the standoff, or until nothing presses; of one contact.

    Parameters
    ----------
    free : FreeMotion
        Knows which surface is left.
    observer : Observer

    Attributes
    ----------
    zero_n : float or None
        What the force source shows at its end, less the zero of the tare [N]; None where it is not
        believed, or no zero was taken.
    """

    def __init__(self, free: FreeMotion, observer: Observer) -> None:
        self._free, self._observer = free, observer
        self._parameters, self._limits = observer.parameters, observer.limits
        self.zero_n: float | None = None
        self._least_n: float | None = None  # force along the normal that is accepted
        self._surface_m = -math.inf  # where the tissue was touched
        self._smooth_n = self._pressed_n = math.nan
        self._n_per_m = math.inf  # of what is pressed on
        self._believed = self._must_leave = False
        self._speed_m_s = LEAVE_M_S
        self._felt_s = 0.0  # with the slowest speed
        self._felt_from: tuple[float, float] | None = None  # height and force
        self._step: tuple[float, list[float]] | None = None  # where it begins, and its forces
        self._left_n = math.nan  # at the standoff
        self._zero_moved = False  # once in a contact
        self._before_n = math.nan  # mean of the last step

    def begin(self, cause: Cause, touched_n: float) -> None:
        """Begin, after a cause; with the force that was pressed with, 0 where nothing was touched."""
        self._believed = cause not in BLIND_CAUSES
        self._must_leave = cause in (Cause.SURFACE_EARLY, Cause.TARE)
        self._pressed_n = PRESSED * touched_n
        watch = self._observer.watch
        self._smooth_n = now_n = watch.force_n[2]
        self._step, self._felt_from, self._felt_s = None, None, 0.0
        if self._least_n is not None and watch.mean_n is not None:
            # asked for again: the tip stands, and its force is steady
            self._smooth_n, self._felt_s = watch.mean_n, FEEL_NOT_S
        model, touched_m = self._observer.model, self._observer.touched_m
        if model is not None and touched_n > 0:
            self._n_per_m, _ = model.slope_at(model.depth_for(touched_n))
        if self._least_n is None and self._observer.zero is not None:
            if model is not None and touched_m is not None:
                self._surface_m = max(model.surface_m, touched_m)
            # the force goes down by what is pressed with, wherever the zero is now
            self._least_n = min(0.0, now_n - max(touched_n, now_n)) - self._limits.pull_force_n

    def step(self, now_ns: int, since_s: float, arm: ArmSample, place: Place) -> Move:
        """One cycle; `since_s` has gone by in this state."""
        if since_s > self._limits.retract_s:
            return failed(Cause.HELD, f"not free within retract_s = {self._limits.retract_s:g} s")
        watch, p = self._observer.watch, self._parameters
        believed = self._believed and self._observer.sound
        believed = believed and watch.age_s(now_ns) <= self._limits.force_age_s
        force_n = watch.force_n[2]
        self._smooth_n += (force_n - self._smooth_n) * -math.expm1(-p.period_s / SMOOTH_S)
        clear_m = self._free.clear_m
        coasts = dot(self._free.path.normal, arm.velocity[:3]) > STILL_M_S
        if self._step is None and (clear_m - place.height_m >= ARRIVED_M or coasts):
            most_m_s = self._speed(place.height_m) if believed else p.retract_speed_m_s
            if most_m_s is None:
                return self._held(place.height_m)
            return Move(self._free.path.lift(arm, p, clear_m, most_m_s))
        if not believed:
            return Move(None, State.IDLE)
        return self._leave(arm, place.height_m, force_n)

    def _speed(self, height_m: float) -> float | None:
        """Largest speed with which the tip goes up [m/s]; None where it is held."""
        if self._least_n is None:
            return self._parameters.retract_speed_m_s
        p, pull_n = self._parameters, self._limits.pull_force_n
        fastest = p.retract_speed_m_s
        # a beam bends by so much more before what clings to the ball is felt
        leave_m = LEAVE_M + SLOW_N / p.beam_n_per_m
        room_n = self._smooth_n - self._least_n
        pulled = (pull_n - room_n) / SLOW_N
        if self._smooth_n > self._pressed_n:
            self._speed_m_s = fastest
        elif height_m < self._surface_m + leave_m:
            eased_m_s = min(EASE_M_S, self._smooth_n / (self._n_per_m * EASE_S))
            self._speed_m_s = max(LEAVE_M_S, eased_m_s)
        else:
            self._speed_m_s += LEAVE_M_S2 * p.period_s
        if pulled > CLINGS:  # it may pull the harder the faster the tip goes
            self._speed_m_s = min(self._speed_m_s, SLOW_M_S * (1.0 - pulled))
        self._speed_m_s = min(max(FEEL_M_S, self._speed_m_s), fastest)
        slowest = self._speed_m_s == FEEL_M_S
        self._felt_s = self._felt_s + p.period_s if slowest else 0.0
        # below the surface what it still presses with goes, too
        early = room_n > 0 or self._felt_s <= FEEL_NOT_S or height_m < self._surface_m
        if early or self._felt_from is None:
            self._felt_from = height_m, self._smooth_n
            return self._speed_m_s
        begun_m, begun_n = self._felt_from
        if self._smooth_n < begun_n - self._grown_n():
            return None
        if height_m - begun_m > FEEL_M:  # the zero has moved
            if self._zero_moved:  # it does not do so again and again
                return None
            self._zero_moved = True
            self._least_n = self._smooth_n - self._limits.pull_force_n
        return FEEL_M_S

    def _held(self, height_m: float) -> Move:
        text = f"{-1e3 * self._smooth_n:.1f} mN pull on the tip {1e3 * height_m:.2f} mm above the surface and"
        least_mn = -1e3 * (self._least_n or 0.0)
        text = f"{text} grow while it is drawn back, accepted are {least_mn:.1f} mN"
        return failed(Cause.HELD, f"{text}: free it, then ask it to retract")

    def _grown_n(self) -> float:
        """Growth of a pull that is no noise of the smoothed force."""
        noise_n = self._observer.noise_n * math.sqrt(self._parameters.period_s / SMOOTH_S / 2)
        return max(GROWS_N, NOISES * noise_n)

    def _leave(self, arm: ArmSample, height_m: float, force_n: float) -> Move:
        """At the standoff: idle where nothing presses or pulls, else on until it no longer changes."""
        observer = self._observer
        tared = observer.zero is not None
        if self._step is None:
            mean_n = observer.watch.mean_n
            samples = max(1.0, self._limits.lost_s / self._parameters.period_s)
            left_n = max(LEFT_N, NOISES * observer.noise_n / math.sqrt(samples))
            small = tared and mean_n is not None and abs(mean_n) <= left_n
            if small or not (tared or self._must_leave):
                self.zero_n = mean_n if tared else None
                return Move(None, State.IDLE)
            self._step, self._before_n = (height_m, []), math.nan
            self._felt_s = 0.0
        self._felt_s += self._parameters.period_s
        if self._felt_s <= FEEL_NOT_S:
            self._left_n = self._smooth_n
        # what still presses goes as the tip rises
        if tared and self._smooth_n < min(self._left_n, 0.0) - self._grown_n():
            return self._held(height_m)
        begun_m, forces_n = self._step
        forces_n.append(force_n)
        if len(forces_n) * self._parameters.period_s >= STEP_S and len(forces_n) > 1:
            now_n, std_n = mean(forces_n), stdev(forces_n)
            change_n = abs(now_n - self._before_n)
            if height_m - begun_m < BEYOND_M_S * STEP_S / 4:
                return failed(
                    Cause.HELD, f"{1e3 * now_n:.1f} mN at the standoff, and no room above it"
                )
            if change_n < max(LEFT_N / 2, NOISES * std_n * math.sqrt(2 / len(forces_n))):
                self.zero_n = now_n if tared else None
                return Move(None, State.IDLE)
            self._step, self._before_n = (height_m, []), now_n
        if height_m - self._free.clear_m > BEYOND_M:
            if not tared:  # a source that is not steady enough for a zero says no more
                return Move(None, State.IDLE)
            text = f"the force still changes {1e3 * height_m:.0f} mm above the surface"
            return failed(Cause.HELD, f"{text}: free the tip, then ask it to retract")
        return Move(self._free.path.along_normal(arm, BEYOND_M_S))
