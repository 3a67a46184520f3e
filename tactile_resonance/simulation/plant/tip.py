# SPDX-License-Identifier: Apache-2.0
"""The tip on what it touches through time: a ball held rigidly or by the beam, on tissue, bone, what clings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np

from tactile_resonance.fields import require
from tactile_resonance.simulation.plant.surfaces import PlantSurface, relative_radius_m
from tactile_resonance.simulation.sensor.bimorph import BeamModes
from tactile_resonance.simulation.tissue.indenter import Beam, Indenter, Motion, swing
from tactile_resonance.simulation.tissue.library import Tissue

UP_M = 1e-9
"""Over which slopes are taken [m]."""

Beside = Callable[[float, float], float | None]
"""Force of something else than soft tissue on a ball along the outward normal [N], from its depth below the
undisturbed surface [m] and its speed upwards [m/s]; None: it lets go until the tissue is touched again."""


class OnSoft:
    """A ball on soft tissue, beside which something else acts on it from the first touch on.

    Parameters
    ----------
    soft : Ball
    beside : callable
        What else acts: `bone`, `clinging`.
    """

    def __init__(self, soft: Ball, beside: Beside) -> None:
        self.beside = beside
        self._soft, self._touched = soft, False
        self._beside_n = 0.0

    @property
    def force_n(self) -> float:
        """On the ball along the outward normal [N]."""
        return self._soft.force_n + self._beside_n

    @property
    def depth_m(self) -> float:
        """Of the ball's lowest point below the undisturbed surface [m]."""
        return self._soft.depth_m

    @property
    def contact_radius_m(self) -> float:
        """On the soft tissue [m]."""
        return self._soft.contact_radius_m

    def step(self, depth_m: float, dt_s: float) -> float:
        """Move the ball to a depth within a time; return the force [N]."""
        up_m_s = (self._soft.depth_m - depth_m) / dt_s
        self._touched |= self._soft.step(depth_m, dt_s) > 0
        acting_n = self.beside(depth_m, up_m_s) if self._touched else None
        self._touched, self._beside_n = acting_n is not None, acting_n or 0.0
        return self.force_n

    def tangent(self, dt_s: float) -> tuple[float, float]:
        """Force after holding for a time [N], and per further depth [N/m]."""
        force_n, slope = self._soft.tangent(dt_s)
        if not self._touched:
            return force_n, slope
        depth_m = self._soft.depth_m
        held_n = self.beside(depth_m, 0.0) or 0.0
        higher_n = self.beside(depth_m - UP_M, UP_M / dt_s) or 0.0
        return force_n + held_n, slope + max(0.0, held_n - higher_n) / UP_M

    def swing(self, beam: Beam, base: Motion, ball: Motion, h_s: float, count: int) -> Motion:
        """See `Indenter.swing`."""
        base_m, rate_m_s = base
        for n in range(count):
            base_now_m = base_m + n * h_s * rate_m_s
            ball = swing(*self.tangent(h_s), *ball, base_now_m, rate_m_s, h_s, *beam)
            self.step(ball[0], h_s)
        return ball

    def stiffness_at(self, depth_m: float) -> float:
        """See `Indenter.stiffness_at`; of all that acts."""
        soft = self._soft.stiffness_at(depth_m)
        if depth_m <= 0:
            return soft
        higher_n = self.beside(depth_m - UP_M, 0.0) or 0.0
        return soft + ((self.beside(depth_m, 0.0) or 0.0) - higher_n) / UP_M


Ball = Indenter | OnSoft
"""What presses on the tip."""

BONE_PA, BONE_POISSON_RATIO = 10e6, 0.3


def bone(layer_m: float, radius_m: float) -> Beside:
    """Elastic half-space under a layer: both press on the ball, the lower from its depth on.

    The layer's force is that of a thick one: on bone a thin one is stiffer (Dimitriadis
    et al., Biophys. J. 82 (2002)), so the ball meets the bone faster here, which is the worse case.

    Parameters
    ----------
    layer_m : float
        Its thickness [m].
    radius_m : float
        Of the ball.
    """
    require(layer_m >= 0, "layer_m", layer_m, "0 or above")
    c = 4 / 3 * BONE_PA / (1 - BONE_POISSON_RATIO**2) * sqrt(radius_m)
    return lambda depth_m, _: c * max(0.0, depth_m - layer_m) ** 1.5


def clinging(pull: Callable[[float, float], float | None]) -> Beside:
    """Tissue that holds the ball back above its surface: a film, a fibre, a hook.

    Parameters
    ----------
    pull : callable
        Force [N] from the height of the ball above the surface [m] and its speed upwards [m/s]; None: it lets
        go until the tissue is touched again.
    """

    def beside(depth_m: float, up_m_s: float) -> float | None:
        pulled_n = 0.0 if depth_m >= 0 else pull(-depth_m, up_m_s)
        return None if pulled_n is None else -pulled_n

    return beside


SUBSTEP_S = 5e-4  # a twentieth of the period of the mode on stiff gelatine
TURN_RAD = 0.2
"""Of a swing in a sub-step, at most, on what is the stiffer the deeper it is."""


class SprungIndenter:
    """An indenter at the end of the beam: static stiffness and first mode between base and tip.

    One mass on a spring, ``m x'' = k (b - x) + c (b' - x') - F(x)``, x the depth of the tip, b that
    which it would have with the beam straight. Each sub-step is the exact motion for the tangent
    of F and a base at constant speed.

    Parameters
    ----------
    indenter : Ball
    beam : Beam
        k, c, m, which swings: ``c < 2 sqrt(k m)``.

    Attributes
    ----------
    indenter : Ball
    tip_depth_m : float
        x [m].
    force_n : float
        At the base, along the outward normal [N]; the inertia of the beam beyond that of its
        first mode is left out.
    """

    def __init__(self, indenter: Ball, beam: Beam) -> None:
        self.indenter, self._beam = indenter, beam
        # the first step begins at rest, with the beam straight
        self.force_n = 0.0
        self.tip_depth_m = -np.inf
        self._speed = 0.0
        self._base: float | None = None

    def step(self, base_depth_m: float, dt_s: float) -> float:
        """Move the base to a depth at constant speed within `dt_s`; return the force there [N]."""
        if not dt_s > 0:
            require(False, "dt_s", dt_s, "a number above 0")
        if self._base is None:
            self._base = self.tip_depth_m = base_depth_m
        k, c, m = self._beam
        push_n = k * (max(self._base, base_depth_m) - self.tip_depth_m) - self.indenter.force_n
        fastest_m_s = abs(self._speed) + max(0.0, push_n) / m * dt_s
        stiffest = self.indenter.stiffness_at(self.tip_depth_m + fastest_m_s * dt_s)
        count = ceil(max(dt_s / SUBSTEP_S, dt_s * sqrt(stiffest / m) / TURN_RAD) - 1e-9)
        rate = (base_depth_m - self._base) / dt_s
        depth, speed = self.indenter.swing(
            self._beam, (self._base, rate), (self.tip_depth_m, self._speed), dt_s / count, count
        )
        self._base, self.tip_depth_m, self._speed = base_depth_m, depth, speed
        self.force_n = k * (base_depth_m - depth) + c * (rate - speed)
        return self.force_n


TipOnTissue = tuple[Ball, Ball | SprungIndenter]
"""The ball on one tissue, and what is moved: itself, or its beam. `step` of that takes its depth, and returns
the force on it."""


@dataclass(frozen=True)
class Tip:
    """The ball, and the beam that holds it where there is one.

    Attributes
    ----------
    radius_m : float
    beam : BeamModes or None
        None: held rigidly.
    poisson_ratio : float
        Of the tissue.
    adhesion_j_per_m2 : float
        See `Indenter`.
    meets : callable, optional
        From the ball on the tissue to what it meets: `OnSoft`.
    """

    radius_m: float = 2.5e-3
    beam: BeamModes | None = None
    poisson_ratio: float = 0.49
    adhesion_j_per_m2: float = 0.0
    meets: Callable[[Indenter], Ball] | None = None

    def on(self, tissue: Tissue, surface: PlantSurface) -> TipOnTissue:
        """Return the tip at rest over a tissue with that surface."""
        radius_m = relative_radius_m(self.radius_m, surface)
        soft = Indenter(
            tissue,
            tip_radius_m=radius_m,
            poisson_ratio=self.poisson_ratio,
            adhesion_j_per_m2=self.adhesion_j_per_m2,
        )
        ball: Ball = soft if self.meets is None else self.meets(soft)
        return ball, ball if self.beam is None else SprungIndenter(ball, self.beam.spring)
