# SPDX-License-Identifier: Apache-2.0
"""The tip on a tissue through time: the ball held rigidly, or at the end of the beam, which bends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, cos, exp, sin, sqrt
from typing import Protocol

import numpy as np

from tactile_resonance.fields import require
from tactile_resonance.simulation.beam import BeamModes
from tactile_resonance.simulation.indenter import Ball, Indenter
from tactile_resonance.simulation.surfaces import PlantSurface, relative_radius_m
from tactile_resonance.simulation.tissue import Tissue

SUBSTEP_S = 5e-4  # a twentieth of the period of the mode on stiff gelatine


class TipOnTissue(Protocol):
    """A tip on one tissue through time: `RigidTip`, `SprungIndenter`."""

    @property
    def indenter(self) -> Ball:
        """The ball."""
        ...

    def step(self, depth_m: float, dt_s: float, /) -> float:
        """Advance with the depth of what holds the tip [m]; return the force on that [N]."""
        ...


@dataclass(frozen=True)
class RigidTip:
    """A ball that moves as the robot does."""

    indenter: Ball

    def step(self, depth_m: float, dt_s: float, /) -> float:
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
        self._stiffness, self._mass, self._damping = k, m, c
        self._swing_of = 0.0, 0.0  # stiffness and sub-step of the swing that was computed last
        self._swing = 0.0, 0.0
        self.reset()

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

    def reset(self) -> None:
        """Return to undisturbed tissue; the next step begins at rest, with the beam straight."""
        self.indenter.reset()
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
        k, c, m, ball = self._stiffness, self._damping, self._mass, self.indenter
        depth, speed = self.tip_depth_m, self._speed
        count = ceil(dt_s / SUBSTEP_S - 1e-9)
        h, rate = dt_s / count, (base_depth_m - self._base) / dt_s
        half = c / (2 * m)
        fall = exp(-half * h)
        for n in range(count):
            held, tangent = ball.tangent(h)
            whole = k + tangent
            # motion of equilibrium: offset + drift t
            drift = k * rate / whole
            offset = k * (self._base + n * h * rate) + c * (rate - drift) - held + tangent * depth
            offset /= whole
            y, dy = depth - offset, speed - drift
            if (whole, h) != self._swing_of:
                omega = sqrt(whole / m - half * half)
                self._swing_of, self._swing = (whole, h), (cos(omega * h), sin(omega * h) / omega)
            turn, lift = self._swing
            depth = offset + drift * h + fall * (y * turn + (dy + half * y) * lift)
            speed = drift + fall * (dy * turn - (whole / m * y + half * dy) * lift)
            ball.step(depth, h)
        self._base, self.tip_depth_m, self._speed = base_depth_m, depth, speed
        self.force_n = k * (base_depth_m - depth) + c * (rate - speed)
        return self.force_n


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
