# SPDX-License-Identifier: Apache-2.0
"""The states before contact: travel to the standoff, tare, approach."""

from __future__ import annotations

import math

from tactile_resonance.contact.envelope import Place, inside
from tactile_resonance.contact.goal import REST, Move, State, failed
from tactile_resonance.contact.observer import Observer, Zero
from tactile_resonance.contact.parameters import Workspace
from tactile_resonance.contact.result import Breach, Cause
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.tip_path import ARRIVED_RAD, TipPath, TurningWay
from tactile_resonance.contact.vectors import Vector, added, scaled, vector

STILL_M_S, STILL_NS = 5e-4, 50_000_000
"""Below this speed for so long the arm is at rest [m/s], [ns]."""

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
        if self._path.must_lift(arm, p.standoff_m):
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
        if self._zero is not None and self._path.off_rad(arm) < ARRIVED_RAD:
            if (
                not self._observer.taring
            ):  # in air, and a cell under the sample does not feel the arm
                self._observer.begin_tare()
        elif self._observer.taring:
            self._zero, self._observer.taring = None, False
        return Move(self._path.travel(arm, p, self._limits.near_m))

    def tare(self, now_ns: int, arm: ArmSample) -> Move:
        """At rest for the zero of the force."""
        speed = math.hypot(*arm.velocity[:3])
        observer = self._observer
        if observer.taring:
            # not before: a tool on the cell has to come to rest
            touched = self._touched("at the standoff, before its zero was known")
            if touched is not None:
                return touched
        if not observer.taring:
            if speed > STILL_M_S:
                self._still_ns = -1
            elif self._still_ns < 0:
                self._still_ns = now_ns
            elif now_ns - self._still_ns > STILL_NS:
                observer.begin_tare()
                self._travel_force_n = None
                self._tare_ns = now_ns
        elif now_ns - self._tare_ns >= 1e9 * self._parameters.tare_s:
            breach = observer.end_tare(now_ns)
            if breach is None:
                return Move(None, State.APPROACH)
            return Move(None, State.FAULT, breach)
        return REST

    def _touched(self, where: str) -> Move | None:
        """Result where something pushes: without a zero only a change of the force shows that."""
        force_n = self._observer.watch.force_n
        if self._travel_force_n is None:
            self._travel_force_n = force_n
        change = math.dist(force_n, self._travel_force_n)
        if change <= max(TOUCH_IN_TRAVEL_N, NOISES_IN_TRAVEL * self._parameters.cell_noise_n):
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
