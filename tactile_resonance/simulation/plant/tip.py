# SPDX-License-Identifier: Apache-2.0
"""The tip on what it touches through time: a ball held rigidly or by the beam, on tissue, bone, what clings."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np

from tactile_resonance.fields import require
from tactile_resonance.simulation.plant.surfaces import PlantSurface, relative_radius_m
from tactile_resonance.simulation.sensor.bimorph import BeamModes
from tactile_resonance.simulation.tissue.hertz import Tissue
from tactile_resonance.simulation.tissue.indenter import Beam, Indenter, Motion, swing

UP_M = 1e-7
"""Over which the slope of a pull is taken [m]."""


class OnSoft(ABC):
    """A ball on soft tissue that something else acts on, too."""

    def __init__(self, soft: Ball) -> None:
        self._soft = soft
        self._beside_n = 0.0  # of what else acts

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
        self._soft.step(depth_m, dt_s)
        self._beside_n = self._act(up_m_s)
        return self.force_n

    def tangent(self, dt_s: float) -> tuple[float, float]:
        """Force after holding for a time [N], and per further depth [N/m]."""
        (force_n, slope), (beside_n, steeper) = self._soft.tangent(dt_s), self._ahead(dt_s)
        return force_n + beside_n, slope + steeper

    @abstractmethod
    def _act(self, up_m_s: float) -> float:
        """Force of what else acts [N], after a step of the tissue in which the ball rose with a speed."""

    @abstractmethod
    def _ahead(self, dt_s: float) -> tuple[float, float]:
        """Its part of `tangent`."""

    def swing(self, beam: Beam, base: Motion, ball: Motion, h_s: float, count: int) -> Motion:
        """See `Indenter.swing`."""
        base_m, rate_m_s = base
        for n in range(count):
            base_now_m = base_m + n * h_s * rate_m_s
            ball = swing(*self.tangent(h_s), *ball, base_now_m, rate_m_s, h_s, *beam)
            self.step(ball[0], h_s)
        return ball

    def stiffness_at(self, depth_m: float) -> float:
        """See `Indenter.stiffness_at`."""
        return self._soft.stiffness_at(depth_m)


Ball = Indenter | OnSoft
"""What presses on the tip."""

BONE_PA, BONE_POISSON_RATIO = 10e6, 0.3


class OnBone(OnSoft):
    """Soft tissue on an elastic half-space: both press on the ball, the lower from its depth on.

    The layer's force is that of a thick one: on bone a thin one is stiffer (Dimitriadis
    et al., Biophys. J. 82 (2002)), so the ball meets the bone faster here, which is the worse case.

    Parameters
    ----------
    soft : Ball
        On the layer.
    layer_m : float
        Its thickness [m].
    radius_m : float
        Of the ball.
    """

    def __init__(
        self,
        soft: Ball,
        *,
        layer_m: float,
        radius_m: float,
    ) -> None:
        require(layer_m >= 0, "layer_m", layer_m, "0 or above")
        super().__init__(soft)
        self._layer_m = layer_m
        self._c = 4 / 3 * BONE_PA / (1 - BONE_POISSON_RATIO**2) * math.sqrt(radius_m)

    def _act(self, up_m_s: float) -> float:
        return self._ahead(0.0)[0]

    def stiffness_at(self, depth_m: float) -> float:
        """Of both."""
        bone = 1.5 * self._c * math.sqrt(max(0.0, depth_m - self._layer_m))
        return super().stiffness_at(depth_m) + bone

    def _ahead(self, dt_s: float) -> tuple[float, float]:
        """Force of the bone and its slope (Hertz)."""
        root = math.sqrt(max(0.0, self._soft.depth_m - self._layer_m))
        return self._c * root**3, 1.5 * self._c * root


class Clinging(OnSoft):
    """Tissue that, once touched, holds the ball back above its surface: a film, a fibre, a hook.

    Parameters
    ----------
    soft : Ball
    pull : callable
        Force [N] from the height of the ball above the surface [m] and its speed upwards [m/s]; None: it lets
        go until the tissue is touched again.
    """

    def __init__(self, soft: Ball, pull: Callable[[float, float], float | None]) -> None:
        super().__init__(soft)
        self.pull = pull
        self._touched = False

    def _act(self, up_m_s: float) -> float:
        self._touched |= self._soft.force_n > 0
        if not self._touched or self._soft.depth_m >= 0:
            return 0.0
        pulled_n = self.pull(-self._soft.depth_m, up_m_s)
        self._touched = pulled_n is not None
        return -(pulled_n or 0.0)

    def _ahead(self, dt_s: float) -> tuple[float, float]:
        height_m = -self._soft.depth_m
        if not self._touched or height_m <= 0:
            return 0.0, 0.0
        pulled_n = self.pull(height_m, 0.0) or 0.0
        further_n = self.pull(height_m + UP_M, UP_M / dt_s) or 0.0
        return -pulled_n, max(0.0, further_n - pulled_n) / UP_M


SUBSTEP_S = 5e-4  # a twentieth of the period of the mode on stiff gelatine
TURN_RAD = 0.2
"""Of a swing in a sub-step, at most, on what is the stiffer the deeper it is."""


@dataclass(frozen=True)
class RigidTip:
    """A ball that moves as the robot does."""

    indenter: Ball

    def step(self, depth_m: float, dt_s: float) -> float:
        """Advance with the depth of the ball [m]; return the force on it [N]."""
        return self.indenter.step(depth_m, dt_s)


class SprungIndenter:
    """An indenter at the end of the beam: static stiffness and first mode between base and tip.

    One mass on a spring, ``m x'' = k (b - x) + c (b' - x') - F(x)``, x the depth of the tip, b that
    which it would have with the beam straight. Each sub-step is the exact motion for the tangent
    of F and a base at constant speed.

    Parameters
    ----------
    indenter : Ball
    stiffness_n_per_m, mass_kg, damping_ns_per_m : float
        k, m, c.

    Attributes
    ----------
    indenter : Ball
    tip_depth_m : float
        x [m].
    force_n : float
        At the base, along the outward normal [N]; the inertia of the beam beyond that of its
        first mode is left out.
    """

    def __init__(
        self,
        indenter: Ball,
        *,
        stiffness_n_per_m: float,
        mass_kg: float,
        damping_ns_per_m: float,
    ) -> None:
        k, m, c = stiffness_n_per_m, mass_kg, damping_ns_per_m
        require(0 < k < np.inf, "stiffness_n_per_m", k, "a number above 0")
        require(0 < m < np.inf, "mass_kg", m, "a number above 0")
        good = 0 <= c < 2 * sqrt(k * m)
        require(good, "damping_ns_per_m", c, "0 to below 2 sqrt(stiffness mass)")
        self.indenter = indenter
        self._beam = k, c, m
        # the first step begins at rest, with the beam straight
        self.force_n = 0.0
        self.tip_depth_m = -np.inf
        self._speed = 0.0
        self._base: float | None = None

    @classmethod
    def on_beam(cls, indenter: Ball, modes: BeamModes) -> SprungIndenter:
        """Return the tip of a bimorph: ``k = 3 EI / L^3``, frequency and damping of mode 1."""
        stiffness, natural = modes.static_stiffness_n_per_m, float(modes.natural_rad_s[0])
        mass = stiffness / natural**2
        return cls(
            indenter,
            stiffness_n_per_m=stiffness,
            mass_kg=mass,
            damping_ns_per_m=2 * modes.damping_ratio * natural * mass,
        )

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


TipOnTissue = RigidTip | SprungIndenter
"""A tip on one tissue through time: `step` takes the depth of what holds it, and returns the force on that."""


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
        From the ball on the tissue to what it meets: `OnBone`, `Clinging`.
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
        return RigidTip(ball) if self.beam is None else SprungIndenter.on_beam(ball, self.beam)
