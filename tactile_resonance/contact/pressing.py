# SPDX-License-Identifier: Apache-2.0
"""The states in contact, contact found, settle, hold, with the control law; and a touch that was noise.

The law: how fast the tip goes, from what is known of the contact. The estimated model says at which height the
force asked for is reached; the rest of the way, less what the arm will still do of earlier commands, is gone in
a time constant. So the tip slows down early on stiff tissue and late on soft, and the dead time does not make
it oscillate. While the stiffness is uncertain the aim stays below the force by that uncertainty. The speed of
tissue that moves is added to its own.

While the tip holds a force on tissue that moves, its own way says how far and how often.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.contact_filter import ContactFilter, hertz_depth
from tactile_resonance.contact.envelope import Place
from tactile_resonance.contact.geometry import TipPath
from tactile_resonance.contact.goal import Cause, HoldMode, Move, State, failed
from tactile_resonance.contact.observer import Observer
from tactile_resonance.contact.parameters import REACTION_S, ContactParameters
from tactile_resonance.contact.samples import ArmSample

SURE_SHARE = 0.02
"""Uncertainty of the force, as a share of it, for which no caution is needed."""


def force_speed(
    model: ContactFilter,
    height_m: float,
    pending_m: float,
    aim_n: float,
    parameters: ContactParameters,
    *,
    holding: bool,
) -> float:
    """Return the speed along the normal, away from the surface positive [m/s], towards a force.

    Parameters
    ----------
    model : ContactFilter
    height_m : float
        Of the tip now.
    pending_m : float
        Way that the arm will still go of earlier commands [m].
    aim_n : float
    parameters : ContactParameters
    holding : bool
        Whether the force has been reached: then without caution, and slower where the tissue is still.
    """
    depth = model.depth_for(aim_n)
    target = model.surface_m - depth
    if holding:
        time = parameters.time_constant_s if model.moving else parameters.hold_time_constant_s
    else:
        time = parameters.time_constant_s
        slope, std = model.slope_at(depth)
        target += parameters.caution * max(0.0, std - SURE_SHARE * aim_n) / slope
    # relaxation takes the force away: at constant force u goes as C^(-2/3)
    creep = 2 / 3 * model.c_rate_per_s * hertz_depth(aim_n, model.c)
    follow = creep + model.surface_speed_m_s
    # what is under way will be gone by then, and the target will have moved on
    target += follow * (parameters.arm_dead_time_s + parameters.arm_lag_s)
    return (target - height_m - pending_m) / time + follow


def place_speed(
    target_m: float, height_m: float, pending_m: float, parameters: ContactParameters
) -> float:
    """Return the speed along the normal that keeps a height [m/s]."""
    return (target_m - height_m - pending_m) / parameters.hold_time_constant_s


EVERY_NS, NEWEST = 20_000_000, 1000
"""Of the tip's heights one is kept in so long [ns]; so many, the newest."""

ANEW_NS = 500_000_000
"""A motion is described anew after so long [ns]."""

LEAST_S, LEAST_TURNS = 0.4, 2.5
"""A motion is described from so long [s] on; its rate where it has turned so often."""

INNER = (2.5, 97.5)
"""Percentiles of the heights between which a motion goes."""

PADDED = 8
"""By which the spectrum is finer than the heights' own."""


@dataclass(frozen=True)
class TissueMotion:
    """How far and how often tissue moves under the tip that follows it.

    Attributes
    ----------
    half_way_m : float
        Creep taken off where the motion has turned often enough.
    seen_s : float
        For so long.
    rate_hz : float or None
        None where it has not turned often enough.
    """

    half_way_m: float
    seen_s: float
    rate_hz: float | None = None

    def __str__(self) -> str:
        often = f"in {self.seen_s:.1f} s" if self.rate_hz is None else f"at {self.rate_hz:.1f} Hz"
        return f"moving tissue: {1e6 * self.half_way_m:.0f} um {often}"


class HeldMotion:
    """Heights of a tip that holds a force on tissue that moves."""

    def __init__(self) -> None:
        self._times_ns: deque[int] = deque(maxlen=NEWEST)
        self._heights_m: deque[float] = deque(maxlen=NEWEST)
        self._described: tuple[int, TissueMotion | None] = 0, None  # when, and what

    def add(self, time_ns: int, height_m: float) -> None:
        """Take the height of the tip along the normal, with its time."""
        times = self._times_ns
        if not times or time_ns - times[-1] >= EVERY_NS:
            times.append(time_ns)
            self._heights_m.append(height_m)

    def describe(self) -> TissueMotion | None:
        """How it moves; None before it is known."""
        if self._times_ns and self._times_ns[-1] - self._described[0] >= ANEW_NS:
            self._described = self._times_ns[-1], self._motion()
        return self._described[1]

    def _motion(self) -> TissueMotion | None:
        if len(self._times_ns) < LEAST_S * 1e9 / EVERY_NS:
            return None
        t_s = (np.array(self._times_ns) - self._times_ns[0]) * 1e-9  # (n,)
        heights = np.array(self._heights_m)
        crept = heights - np.polyval(np.polyfit(t_s, heights, 1), t_s)
        # on a grid of even steps: a loop that was late leaves gaps
        even = np.arange(0.0, t_s[-1], EVERY_NS * 1e-9)
        power = np.abs(np.fft.rfft(np.interp(even, t_s, crept), PADDED * even.size)) ** 2
        rate_hz = np.argmax(power) / (PADDED * even.size * EVERY_NS * 1e-9)
        if rate_hz * t_s[-1] < LEAST_TURNS:
            return TissueMotion(_half_way_m(heights), float(t_s[-1]))
        return TissueMotion(_half_way_m(crept), float(t_s[-1]), float(rate_hz))


def _half_way_m(heights_m: FloatArray) -> float:
    low, high = np.percentile(heights_m, INNER)
    return 0.5 * float(high - low)


LOST_GRACE_S = 0.02
"""Forces from before the touch do not count for a lost contact, nor those of the first moments."""

STIFFENS = 3.0
"""Force beyond what the model expects, in deviations, at which tissue that is not known stiffens."""

MOST_TAKEN_BACK = 3
"""So often in one contact a touch may turn out to have been noise."""


class Pressing:
    """Brings the force to what is asked for and keeps it; of one contact.

    Parameters
    ----------
    path : TipPath
    observer : Observer
    touch_speed_m_s : float
        With which the tip goes deeper until the force is reached, at most.

    Attributes
    ----------
    touched_ns : int
        When contact was found.
    motion : HeldMotion
        Of the tip while it holds.
    """

    def __init__(self, path: TipPath, observer: Observer, touch_speed_m_s: float) -> None:
        goal, limits = path.goal, observer.limits
        self._touch_speed_m_s = touch_speed_m_s
        self._goal, self._path, self._observer = goal, path, observer
        self._parameters, self._limits = observer.parameters, limits
        self.touched_ns = 0
        self.motion = HeldMotion()
        self._lost_n = limits.lost_below_n(goal.force_n)
        self._sure_ns = 1e9 * (limits.lost_s + LOST_GRACE_S)
        self._within_ns = -1
        self._hold_height_m, self._held_ns = 0.0, 0
        self._unload_from_m: float | None = None
        self._looked_again = False
        self._taken_back = 0

    def begin(self, now_ns: int) -> None:
        """Contact has been found."""
        self.touched_ns, self._looked_again = now_ns, False

    def step(self, now_ns: int, state: State, arm: ArmSample, place: Place) -> Move:
        """Towards the force, or keep it; judges whether what was touched is the tissue."""
        p, model, holding = self._parameters, self._observer.model, state is State.HOLD
        assert model is not None
        gone = self._lost(now_ns, state)
        if gone is not None:
            return gone if self._unload_from_m is None else Move(None, State.RETRACT)
        to: State | None = None
        if not holding:
            sure = now_ns - self.touched_ns > self._sure_ns
            if sure and model.surface_m > p.early_m:
                return self._early(arm, model.surface_m)
            to = self._nearer(now_ns, state, model, place.height_m, sure)
            if to is State.HOLD:
                holding, self._hold_height_m, self._held_ns = True, place.height_m, now_ns
        if holding:
            self.motion.add(now_ns, place.height_m)
            over_s = (now_ns - self._held_ns) * 1e-9 - self._goal.hold_s
            if over_s >= 0 and to is None:
                return self._unload(over_s, arm, place)
        pending = self._observer.arm_model.pending_m
        if holding and self._goal.hold is HoldMode.INDENTATION:
            speed = place_speed(self._hold_height_m, place.height_m, pending, p)
        else:
            speed = force_speed(
                model, place.height_m, pending, self._goal.force_n, p, holding=holding
            )
        most = deepest = p.press_speed_m_s
        if self._touch_speed_m_s < most:
            # what stiffens more than Hertz says is not gone into further
            deepest = (
                0.0 if model.surprise > STIFFENS else most if holding else self._touch_speed_m_s
            )
        if holding and speed < 0:
            # stiff tissue is not followed faster than the arm can be stopped in before it is too much
            slope = model.stiffness_at(model.depth_for(self._goal.force_n))
            deepest = min(deepest, self._limits.abort_force_n / 2 / (slope * REACTION_S))
        twist = self._path.along_normal(arm, min(most, max(-deepest, speed)))
        return Move(twist, to)

    def _unload(self, over_s: float, arm: ArmSample, place: Place) -> Move:
        """After the hold that was asked for: draw back, at an even speed where one is asked for."""
        up_m_s = self._goal.unload_speed_m_s
        if up_m_s == 0.0:
            return Move(None, State.RETRACT)
        if self._unload_from_m is None:
            self._unload_from_m = place.height_m - up_m_s * over_s
        target_m = self._unload_from_m + up_m_s * over_s
        pending = self._observer.arm_model.pending_m
        speed = up_m_s + place_speed(target_m, place.height_m, pending, self._parameters)
        most = self._parameters.retract_speed_m_s
        return Move(self._path.along_normal(arm, min(most, max(0.0, speed))))

    def _nearer(
        self, now_ns: int, state: State, model: ContactFilter, height_m: float, sure: bool
    ) -> State | None:
        """The state that follows while the force comes nearer to what is asked for."""
        p, aim_n = self._parameters, self._goal.force_n
        off = abs(model.force_at(height_m) - aim_n) / aim_n
        if model.moving:  # what is followed so closely is known less well
            off -= max(0.0, model.estimate(height_m).force_std_n / aim_n - SURE_SHARE)
        to: State | None = None
        if state is State.CONTACT:
            if off >= 4 * p.tolerance:
                return None
            to, self._within_ns = State.SETTLE, -1
        if off > p.tolerance:
            self._within_ns = -1
        elif self._within_ns < 0:
            self._within_ns = now_ns
        elif sure and now_ns - self._within_ns >= 1e9 * p.settle_s:
            to = State.HOLD
        return to

    def _early(self, arm: ArmSample, surface_m: float) -> Move:
        """The surface seems to lie higher than accepted: noise, a first guess, or so it is."""
        if self._was_noise(self._lost_n):
            return Move(None, State.APPROACH)
        if not self._looked_again:
            self._looked_again = True
            self._observer.look_again()
            return Move(self._path.along_normal(arm, 0.0))
        text = f"touched {1e3 * surface_m:.2f} mm above the expected surface"
        text += f", accepted are {1e3 * self._parameters.early_m:g} mm"
        return failed(Cause.SURFACE_EARLY, text)

    def _lost(self, now_ns: int, state: State) -> Move | None:
        """What follows where the tissue has gone; a touch that was noise is taken back."""
        observer, limits = self._observer, self._limits
        mean = observer.watch.mean_n
        if mean is None or now_ns - self.touched_ns < self._sure_ns:
            return None
        if state is State.CONTACT:
            noise = self._was_noise(observer.noise_n / 4)
            return Move(None, State.APPROACH) if noise else None
        if mean >= self._lost_n:
            return None
        if state is State.SETTLE and self._was_noise(self._lost_n):
            return Move(None, State.APPROACH)
        text = f"mean force {1e3 * mean:.1f} mN over {1e3 * limits.lost_s:g} ms, "
        text += f"limit {1e3 * self._lost_n:g} mN"
        return failed(Cause.CONTACT_LOST, text)

    def _was_noise(self, least_n: float) -> bool:
        """Whether the detected touch was noise: the force is not there; then the approach goes on."""
        mean = self._observer.watch.mean_n
        if mean is None or mean >= least_n or self._taken_back == MOST_TAKEN_BACK:
            return False
        self._taken_back += 1
        self._observer.seek_touch()
        return True
