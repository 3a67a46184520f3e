# SPDX-License-Identifier: Apache-2.0
"""What counts as wrong in which state: the envelope, the forces, the way and the time."""

from __future__ import annotations

from collections.abc import Sequence

from tactile_resonance.contact.envelope import Envelope, Place, inside
from tactile_resonance.contact.free_motion import FreeMotion
from tactile_resonance.contact.goal import ENDED, TARED, TOUCHING, State
from tactile_resonance.contact.interfaces import ArmError, ForceError
from tactile_resonance.contact.observer import Observer
from tactile_resonance.contact.parameters import Workspace
from tactile_resonance.contact.result import Breach, Cause
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import Vector

BESIDE_M = 0.05
"""So far beside the way of a goal the tip may be [m]."""


class Judgement:
    """Judges every cycle of one contact.

    Parameters
    ----------
    envelope : Envelope
    observer : Observer
        Takes the forces.
    free : FreeMotion
        Knows the way of the goal.
    start_ns : int
        When the contact was asked for.
    """

    def __init__(
        self, envelope: Envelope, observer: Observer, free: FreeMotion, start_ns: int
    ) -> None:
        self._envelope, self._observer, self._start_ns = envelope, observer, start_ns
        self._free = free
        self._way: Workspace | None = None  # known with the first state of the arm
        limits, parameters = envelope.limits, observer.parameters
        self._lowest_m = -parameters.search_m - limits.depth_m
        self._longest_s = {
            State.TRAVEL: limits.travel_s,
            State.TARE: 2 * parameters.tare_s + 2.0,
            State.APPROACH: limits.approach_s,
            State.CONTACT: limits.press_s,
            State.SETTLE: limits.press_s,
            State.HOLD: limits.hold_s,
        }

    def breach(
        self,
        state: State,
        since_s: float,
        now_ns: int,
        arm: ArmSample | None,
        place: Place | None,
        wrenches: Sequence[WrenchSample],
        fault: ArmError | ForceError | None,
    ) -> Breach | None:
        """The first thing that is wrong; in retraction and fault only what concerns the arm.

        Parameters
        ----------
        state : State
        since_s : float
            How long it has lasted [s].
        now_ns : int
        arm, place : ArmSample, Place or None
        wrenches : sequence of WrenchSample
            Since the last cycle, oldest first.
        fault : ArmError or ForceError or None
            What a device raised.
        """
        if isinstance(fault, ArmError):
            return Breach(Cause.ARM_LINK, str(fault))
        breach = self._envelope.judge_arm(now_ns, arm)
        if breach is not None or arm is None or place is None:
            return breach
        taken = self._observer.take(wrenches, arm.time_ns, place.height_m)
        if state in ENDED:
            return None
        if isinstance(fault, ForceError):
            return Breach(Cause.FORCE_SOURCE, str(fault))
        breach = taken or self._envelope.judge_motion(arm, place) or self._judge_way(arm)
        if breach is None and state in TOUCHING and place.height_m < self._lowest_m:
            text = (
                f"{-1e3 * place.height_m:.2f} mm below the expected surface, deeper than search_m"
            )
            breach = Breach(Cause.DEPTH, f"{text} and depth_m allow, {-1e3 * self._lowest_m:g} mm")
        if breach is None and state in TARED:
            breach = self._envelope.judge_force(now_ns, self._observer.watch)
        elif breach is None and now_ns - self._start_ns > 1e9 * self._envelope.limits.force_age_s:
            breach = self._envelope.judge_force_age(now_ns, self._observer.watch)
        return breach or self._judge_time(state, since_s)

    def _judge_way(self, arm: ArmSample) -> Breach | None:
        """Whether the tip is near the way of this goal, from where it was first seen."""
        if self._way is None:
            self._way = box_around(self._free.places(arm), BESIDE_M)
        box = self._way
        if inside(arm.position_m, box.low_m, box.high_m):
            return None
        x, y, z = arm.position_m
        text = f"tip at {x:.4f}, {y:.4f}, {z:.4f} m, off the way of its goal: {box.low_m} to "
        return Breach(Cause.WORKSPACE, f"{text}{box.high_m} m")

    def _judge_time(self, state: State, since_s: float) -> Breach | None:
        most = self._longest_s[state]
        if since_s <= most:
            return None
        if state is State.HOLD:
            return Breach(Cause.HOLD_ENDED, f"held for {most:g} s, as long as is allowed")
        return Breach(Cause.TIME, f"{state.value} took longer than {most:g} s")


def box_around(places: Sequence[Vector], beside_m: float) -> Workspace:
    """Return the box around places, so much larger on every side."""
    axes = list(zip(*places, strict=True))
    low_m = tuple(round(min(axis) - beside_m, 4) for axis in axes)
    return Workspace(low_m, tuple(round(max(axis) + beside_m, 4) for axis in axes))
