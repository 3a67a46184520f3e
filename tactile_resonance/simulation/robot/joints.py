# SPDX-License-Identifier: Apache-2.0
"""How the joints follow their targets, and how the tip trembles beside them."""

from __future__ import annotations

from tactile_resonance.contact.vectors import Vector
from tactile_resonance.simulation.noise import Seed
from tactile_resonance.simulation.robot.kinematics import Posture
from tactile_resonance.simulation.robot.poses import ORIGIN, ZERO, Six
from tactile_resonance.simulation.robot.target import CYCLE_S, rate
from tactile_resonance.simulation.tracking import Jitter, Lag, TrackingParameters


class Joints:
    """Actual angles and speeds of the joints: dead time and lag behind the target.

    Attributes
    ----------
    posture : Posture
        At the angles that the encoders say [rad]; the same object while they do not change.
    qd : 6 floats
        Speeds [rad/s].
    tremble_m : Vector
        Vibration of the tool in the base, which the encoders do not see.
    """

    def __init__(self, q: Six, tracking: TrackingParameters, seed: Seed) -> None:
        self._tracking = tracking
        self._jitter = Jitter(tracking, CYCLE_S, seed) if tracking.jitter_rms_m > 0 else None
        self.posture = Posture(q)
        self.tremble_m: Vector = ORIGIN
        self.hold()

    @property
    def q(self) -> Six:
        """Angles [rad]."""
        return self.posture.q

    @property
    def qdd(self) -> Six:
        """Accelerations [rad/s^2]."""
        return rate(self._slower, self.qd)

    def reseed(self, seed: Seed) -> None:
        """Let vibration follow from a seed, from the next step on."""
        if self._jitter is not None:
            self._jitter.reseed(seed)

    def step(self, target_q: Six, powered: bool) -> None:
        """Follow for one cycle; without power the brakes hold the joints where they are."""
        if not powered:
            self._slower = self.qd = ZERO
            return
        before, self._slower = self.posture.q, self.qd
        q = self._lag.step(target_q)
        if q != before:
            self.posture = Posture(q)
        self.qd = ZERO if q == before else rate(before, q)
        if self._jitter is not None:
            self.tremble_m = self._jitter.step()

    def hold(self) -> Six:
        """Forget what is pending and return the angles at which the brakes caught the joints."""
        self._lag = Lag(self._tracking, self.q, CYCLE_S)
        self._slower = self.qd = ZERO
        return self.q
