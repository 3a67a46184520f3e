# SPDX-License-Identifier: Apache-2.0
"""The states out of contact: travel to the standoff, tare, approach; and drawing the tip back.

Whether it comes free is judged by force, where force can be believed. What clings to the tip pulls harder the
further it goes (a fibre, tissue that sticks) or the faster it goes (a film); a zero that has moved does
neither. So the tip leaves the surface slowly, goes slower the more it is pulled, and where the pull is beyond
what is accepted it moves a little further: if the pull grows, the tip is held; if not, the zero has moved. A
force that is left at the standoff is distinguished in the same way: tissue that presses is left behind, a zero
is not.
"""

from __future__ import annotations

import math
from statistics import mean, stdev

from tactile_resonance.contact.envelope import Place, inside
from tactile_resonance.contact.geometry import ARRIVED_M, TipPath, TurningWay
from tactile_resonance.contact.goal import REST, Breach, Cause, Move, State, failed
from tactile_resonance.contact.observer import Observer, Zero
from tactile_resonance.contact.parameters import REACTION_S, Workspace
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.vectors import Vector, added, difference, dot, scaled, vector

STILL_M_S, STILL_RAD_S, STILL_NS = 5e-4, 1e-2, 50_000_000
"""Below these speeds for so long the arm is at rest [m/s], [rad/s], [ns]."""

BESIDE_M = 0.05
"""So far beside the way of a goal the tip may be [m]."""

TOUCH_IN_TRAVEL_N, NOISES_IN_TRAVEL = 0.01, 8.0
"""Change of the untared force, near the surface, that is a touch [N]; more where so much is noise."""


class FreeMotion:
    """Leads the tip to where the tissue should begin; of one contact.

    Parameters
    ----------
    path : TipPath
    observer : Observer
    touch_speed_m_s : float
        At which the tissue may be met, at most.
    under_sample : bool
        Whether the cell is under the sample: then its force counts on all of the way.
    zero : Zero or None
        Of the force, where it is known for a tip that is turned as the goal is.

    Attributes
    ----------
    begun : bool
        Whether its way is known.
    rest_m : float
        Height to which it is drawn back [m]: the standoff.
    told_m : float or None
        Height at which another sensor detected the touch [m].
    """

    def __init__(
        self,
        path: TipPath,
        observer: Observer,
        touch_speed_m_s: float,
        *,
        under_sample: bool,
        zero: Zero | None,
    ) -> None:
        self._under_sample, self._zero = under_sample, zero
        self._path, self._observer, self._touch_speed_m_s = path, observer, touch_speed_m_s
        self._parameters, self._limits = observer.parameters, observer.limits
        self.begun = False
        self.rest_m = observer.parameters.standoff_m
        self._turning: TurningWay | None = None
        self._box: Workspace | None = None  # around its way: known with the first state of the arm
        self._travel_force_n: Vector | None = None
        self._still_ns = -1
        self._tare_ns = 0
        self.told_m: float | None = None

    @property
    def path(self) -> TipPath:
        """With respect to the surface that counts: the goal's, or that which the tip is leaving to turn."""
        turning = self._turning
        return self._path if turning is None or not turning.leaving else turning.departure

    @property
    def clear_m(self) -> float:
        """Height above `path` at which the tip is free of what it may have stood on."""
        away = self.path is not self._path
        return self.rest_m + self._limits.depth_m if away else self.rest_m

    def begin(self, arm: ArmSample) -> None:
        """Find the way from where the tip is; ``ValueError`` where there is none."""
        if self._path.off_rad(arm) > self._limits.misalignment_rad / 2:
            self._turning = TurningWay(self._path, arm, self._parameters, self._limits)
        self.begun = True

    def lifts(self, arm: ArmSample) -> bool:
        """Whether it goes straight up to the standoff: it stands lower, beside the surface or on it."""
        return self._turning is None and self._path.must_lift(arm, self._parameters.standoff_m)

    def judge_way(self, arm: ArmSample) -> Breach | None:
        """Whether the tip is near the way of this goal, from where it was first seen."""
        if self._box is None:
            axes = list(zip(*self._places(arm), strict=True))
            low_m = tuple(round(min(axis) - BESIDE_M, 4) for axis in axes)
            self._box = Workspace(low_m, tuple(round(max(axis) + BESIDE_M, 4) for axis in axes))
        box = self._box
        if inside(arm.position_m, box.low_m, box.high_m):
            return None
        x, y, z = arm.position_m
        text = f"tip at {x:.4f}, {y:.4f}, {z:.4f} m, off the way of its goal: {box.low_m} to "
        return Breach(Cause.WORKSPACE, f"{text}{box.high_m} m")

    def _places(self, arm: ArmSample) -> list[Vector]:
        """Corners of its way, from where the tip is to the deepest place that the limits allow."""
        p, path = self._parameters, self._path
        lift_m = max(0.0, p.standoff_m - path.height_m(arm))
        lifted_m = added(arm.position_m, scaled(lift_m, path.normal))
        poses = () if self._turning is None else self._turning.poses
        turns_m = [vector(pose.position_m) for pose in poses]
        deepest_m = path.place_at(-p.search_m - self._limits.depth_m)
        return [arm.position_m, lifted_m, *turns_m, path.place_at(p.standoff_m), deepest_m]

    def travel(self, now_ns: int, arm: ArmSample, place: Place) -> Move:
        """To the standoff; up first where much is to be turned, or the tip may still press on something."""
        p = self._parameters
        if self._turning is not None:
            twist = self._turning.twist(arm)
            if twist is not None:
                return Move(twist)
            self._turning = None
        # a cell under the sample feels the tip wherever it is, one on the tool how it is moved
        near = place.height_m < self._limits.near_m or self._under_sample
        if self.lifts(arm):
            # it may still press, where something ended while it did: up before it goes along
            return Move(self._path.lift(arm, p))
        if near and math.isfinite(self._observer.watch.age_s(now_ns)):
            touched = self._touched("on the way to the standoff")
            if touched is not None:
                return touched
        if self._path.arrived(arm, p.standoff_m):
            self._still_ns = -1
            looked = self._observer.taring
            if looked and self._observer.end_tare(now_ns, self._zero) is None:
                return Move(None, State.APPROACH)
            return Move(None, State.TARE)
        if self._zero is not None and not self._observer.taring:
            self._observer.begin_tare()  # in air, and a cell under the sample does not feel the arm
        return Move(self._path.travel(arm, p, self._limits.near_m))

    def tare(self, now_ns: int, arm: ArmSample) -> Move:
        """At rest for the zero of the force."""
        observer = self._observer
        if not observer.taring:
            if math.hypot(*arm.velocity[:3]) > STILL_M_S:
                self._still_ns = -1
            elif self._still_ns < 0:
                self._still_ns = now_ns
            elif now_ns - self._still_ns > STILL_NS:
                observer.begin_tare()
                self._travel_force_n = None
                self._tare_ns = now_ns
            return REST
        # not before: a tool on the cell has to come to rest
        touched = self._touched("at the standoff, before its zero was known")
        if touched is not None or now_ns - self._tare_ns < 1e9 * self._parameters.tare_s:
            return touched or REST
        breach = observer.end_tare(now_ns)
        return Move(None, State.APPROACH if breach is None else State.FAULT, breach)

    def _touched(self, where: str) -> Move | None:
        """Result where something pushes: without a zero only a change of the force shows that."""
        force_n, p = self._observer.watch.force_n, self._parameters
        if self._travel_force_n is None:
            self._travel_force_n = force_n
        x, y, z = difference(force_n, self._travel_force_n)
        # along the normal inertia is taken off; across it a tool on the cell shows how it is moved
        across = max(0.0, math.hypot(x, y) - p.carried_kg * p.acceleration_m_s2)
        change = math.hypot(across, z)
        if change <= max(TOUCH_IN_TRAVEL_N, NOISES_IN_TRAVEL * p.cell_noise_n):
            return None
        return failed(Cause.SURFACE_EARLY, f"force changed by {1e3 * change:.1f} mN {where}")

    def approach(self, arm: ArmSample, place: Place) -> Move:
        """Down along the normal until the force shows a touch."""
        p = self._parameters
        if self._observer.model is not None:
            return Move(None, State.CONTACT)
        if place.height_m < -p.search_m:
            text = f"no touch down to {1e3 * p.search_m:g} mm below the expected surface"
            return failed(Cause.SURFACE_MISSING, text)
        speed = min(p.approach_speed_m_s, self._touch_speed_m_s)
        if self.told_m is not None:
            speed = min(speed, p.told_speed_m_s)
        return Move(self._path.along_normal(arm, -speed))


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
        self._left_m = math.inf  # height of the tip when that was looked into
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
            self._n_per_m = model.stiffness_at(model.depth_for(touched_n))
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
        text = f"{text} grow while it is drawn back, or the force source is not steady"
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
            self._left_m, self._felt_s = height_m, 0.0
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
        if height_m - self._left_m > BEYOND_M:
            if not tared:  # a source that is not steady enough for a zero says no more
                return Move(None, State.IDLE)
            text = f"the force still changes {1e3 * height_m:.0f} mm above the surface"
            return failed(Cause.HELD, f"{text}: free the tip, then ask it to retract")
        return Move(self._free.path.along_normal(arm, BEYOND_M_S))
