# SPDX-License-Identifier: Apache-2.0
"""A rigid ball pressed into viscoelastic tissue through time: loading, unloading, contact again.

The axisymmetric contact of a viscoelastic half-space maps exactly on a row of independent
viscoelastic springs at positions x >= 0 under the profile ``x^2 / R``, whatever the history, while
the contact is one circle: Popov & Hess, *Method of Dimensionality Reduction* (2015), ch. 8;
Argatov & Popov, ZAMM 96 (2016), who show that it is the solution of Lee & Radok (1960) while the
contact grows and that of Ting (1966) while it shrinks. Spring x has the displacement
``u = depth - x^2 / R`` while it touches, the line load
``q = [Einf u + sum E_j v_j] / (1 - nu^2)`` with ``v_j' = u' - v_j / tau_j``, and lets go at q = 0;
from there it recovers free of load. The force is ``2 integral_0^a q dx``.

All springs that touch see the same motion, so sums over them take a few operations per step; only
the profile of E_j v_j, which determines where the edge goes, is kept, at nodes.
"""

from __future__ import annotations

from math import exp, expm1, pi, sqrt
from operator import mul
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require
from tactile_resonance.simulation.tissue.hertz import Tissue

Values = list[float]  # one per Prony term: its share E_j v_j of the line load
Node = tuple[float, float, FloatArray]  # x, time when it was let go, modal state then


class FreeSprings:
    """Springs of a Prony series without load: ``E0 u = sum E_j z_j``, ``tau_j z_j' = u - z_j``.

    While it touches, a spring bears ``Einf u + sum E_j v_j`` with ``v_j = u - z_j``.

    Parameters
    ----------
    moduli_pa, times_s : (terms,) arrays
        E_j above 0 [Pa] and tau_j [s].
    glassy_pa : float
        ``E0 = Einf + sum E_j`` [Pa].

    Notes
    -----
    The same rank-one change of ``diag(1 / tau)`` as in the creep compliance; its eigenvectors
    make every free spring a sum of decays, so none needs to be stepped.
    """

    def __init__(self, moduli_pa: FloatArray, times_s: FloatArray, glassy_pa: float) -> None:
        root = np.sqrt(moduli_pa / times_s)
        rates, vectors = np.linalg.eigh(np.diag(1 / times_s) - np.outer(root, root) / glassy_pa)
        weights = np.sqrt(moduli_pa * times_s)
        self._moduli, self._decay_rates = moduli_pa, (-rates).tolist()
        self._into = vectors.T * weights  # (modes, terms): modal state of z
        displacement = vectors.T @ root / glassy_pa  # (modes,)
        loads = moduli_pa[:, None] * (displacement - vectors / weights[:, None])  # (terms, modes)
        self._out = np.vstack([displacement, loads]).tolist()

    def let_go(self, u: float, values: Values) -> FloatArray:
        """Return the modal state of a spring at displacement u [m] that has just been let go."""
        return (self._into @ (u - np.array(values) / self._moduli)).tolist()

    def at(self, node: Node, time: float) -> tuple[float, Values]:
        """Return u of a free spring [m], and what its terms would bear if it were held there."""
        _, since, state = node
        elapsed = time - since
        now = [y * exp(elapsed * rate) for y, rate in zip(state, self._decay_rates, strict=True)]
        values = [sum(map(mul, row, now)) for row in self._out]
        return values.pop(0), values


NODE_SPACING = 1e-3  # of the profile, in tip radii; the error of unloading goes as its square
MAX_NODES_PER_STEP = 64


class Ball(Protocol):
    """What presses on the tip: an `Indenter`, or one with something else to meet."""

    @property
    def force_n(self) -> float:
        """On the tip along the outward normal [N]."""
        ...

    @property
    def depth_m(self) -> float:
        """Of the lowest point below the undisturbed surface [m]."""
        ...

    @property
    def contact_radius_m(self) -> float:
        """Of the contact on the tissue [m]."""
        ...

    def step(self, depth_m: float, dt_s: float) -> float:
        """Move to a depth within a time; return the force [N]."""
        ...

    def tangent(self, dt_s: float) -> tuple[float, float]:
        """Force after holding for a time [N], and per further depth [N/m]."""
        ...


class Indenter:
    """A spherical rigid tip on a viscoelastic half-space, stepped through time.

    Inertia of the tissue is left out (see `tissue` for the waves of fast vibration), friction too.

    Parameters
    ----------
    tissue : Tissue
    tip_radius_m : float
        Radius R of the ball [m].
    poisson_ratio : float
        Of the tissue.
    adhesion_j_per_m2 : float
        Work of adhesion w [J/m2]; 0: none. The edge lets go at the line load of Johnson, Kendall &
        Roberts (1971), ``-sqrt(2 pi a w E1)``, ``E1 = E(1 s) / (1 - nu^2)``: in the elastic limit
        this is their theory, pull-off at ``-1.5 pi w R``. In tissue the modulus at the edge is
        chosen, not known.

    Attributes
    ----------
    force_n : float
        On the tip along the outward normal [N]; 0 or above without adhesion.
    contact_radius_m : float
        a [m]; 0 out of contact.
    depth_m : float
        Depth of the ball's lowest point below the undisturbed surface [m]; negative above it.
    """

    def __init__(
        self,
        tissue: Tissue,
        *,
        tip_radius_m: float,
        poisson_ratio: float,
        adhesion_j_per_m2: float = 0.0,
    ) -> None:
        require(0 < tip_radius_m < np.inf, "tip_radius_m", tip_radius_m, "a number above 0")
        require(0 <= poisson_ratio <= 0.5, "poisson_ratio", poisson_ratio, "0 to 0.5")
        work = adhesion_j_per_m2
        require(0 <= work < np.inf, "adhesion_j_per_m2", work, "0 or above")
        self._radius = tip_radius_m
        self._scale = 2 / (1 - poisson_ratio**2)  # both halves of the row
        series = tissue.prony
        acting = series.moduli_pa > 0
        moduli, times = series.moduli_pa[acting], series.times_s[acting]
        self._einf, self._e0 = series.equilibrium_pa, series.instantaneous_pa
        self._moduli, self._times = moduli.tolist(), times.tolist()
        # edge load / sqrt(x), as q (1 - nu^2)
        plane_modulus = tissue.relaxation_modulus_1s_pa / (1 - poisson_ratio**2)
        self._pull = (1 - poisson_ratio**2) * sqrt(2 * pi * work * plane_modulus)
        self._free = FreeSprings(moduli, times, self._e0)
        self._spacing = NODE_SPACING * tip_radius_m
        self._interval = 0.0
        self._decay: Values = []
        self._gain: Values = []
        self._stiffness = 0.0
        # tissue undisturbed, the tip far above it
        self.force_n = 0.0
        self.contact_radius_m = 0.0
        self.depth_m = -np.inf
        self._time = 0.0
        self._touching = False
        zero = [0.0] * len(self._times)
        # of E_j v_j, one for each j
        self._sum = zero  # integral_0^a dx
        self._common = zero  # what every touching spring has gone through alike
        self._edge = zero  # at x = a
        self._inside: list[tuple[float, float, Values]] = []  # x, time, less common; x ascending
        self._outside: list[Node] = []  # x descending

    def step(self, depth_m: float, dt_s: float) -> float:
        """Move the tip to a depth at constant speed within `dt_s` and return the force [N]."""
        if not dt_s > 0:
            require(False, "dt_s", dt_s, "a number above 0")
        moved = depth_m - self.depth_m
        self.depth_m = depth_m
        self._time += dt_s
        if self._touching:
            if dt_s != self._interval:
                self._set_interval(dt_s)
            decay, gain, a = self._decay, self._gain, self.contact_radius_m
            rise = [g * moved for g in gain]
            self._sum = [d * v + r * a for d, v, r in zip(decay, self._sum, rise, strict=True)]
            self._common = [d * v + r for d, v, r in zip(decay, self._common, rise, strict=True)]
            self._edge = [d * v + r for d, v, r in zip(decay, self._edge, rise, strict=True)]
            excess = self._load(a, self._edge)
            if excess < 0:
                self._recede(excess)
            else:
                self._advance(excess)
        elif not self._touch(moved, dt_s):
            return 0.0
        return self._update_force()

    def tangent(self, dt_s: float) -> tuple[float, float]:
        """Return (force [N] after holding for `dt_s`, force per further depth [N/m]).

        To first order the force after a step is ``force + stiffness (depth - present depth)``.
        """
        if not self._touching:
            return 0.0, 0.0
        if dt_s != self._interval:
            self._set_interval(dt_s)
        a = self.contact_radius_m
        stress = self._einf * a * (self.depth_m - a * a / (3 * self._radius))
        stress += sum(map(mul, self._decay, self._sum))
        return self._scale * stress, self._scale * a * self._stiffness

    def _set_interval(self, dt_s: float) -> None:
        """Keep ``exp(-dt / tau)``, and E_j times its mean over the step, which steady motion sees."""
        self._interval = dt_s
        terms = zip(self._moduli, self._times, strict=True)
        self._decay = [exp(-dt_s / tau) for tau in self._times]
        self._gain = [-modulus * tau / dt_s * expm1(-dt_s / tau) for modulus, tau in terms]
        self._stiffness = self._einf + sum(self._gain)

    def _load(self, x: float, values: Values) -> float:
        """Return ``q (1 - nu^2)`` at x, above that at which the edge lets go."""
        return (
            self._einf * (self.depth_m - x * x / self._radius) + self._pull * sqrt(x) + sum(values)
        )

    def _touch(self, moved: float, dt_s: float) -> bool:
        """Begin a contact if the tip has met the surface, which may still be dented."""
        if self.depth_m <= 0 and self._pull == 0:  # nothing stands out that was never pulled
            return False
        surface, start = 0.0, [0.0] * len(self._times)
        if self._outside:
            surface, start = self._free.at(self._outside[-1], self._time)
        gone_in = self.depth_m - surface
        if gone_in <= 0:
            return False
        # the part of the step in contact; the first step ever starts at the surface
        self._set_interval(dt_s * min(1.0, gone_in / moved) if 0 < moved < np.inf else dt_s)
        if self._outside:
            self._outside.pop()
        self._edge = [v + gone_in * g for v, g in zip(start, self._gain, strict=True)]
        self._touching = True
        self._sum = self._common = [0.0] * len(self._times)
        self._inside = [(0.0, self._time, self._edge)]
        self._advance(self._load(0.0, self._edge))
        return True

    def _advance(self, excess: float) -> None:
        """Let springs outside the edge touch, those that have recovered first."""
        radius, pull = self._radius, self._pull / self._e0
        while self._outside:
            node = self._outside[-1]
            x, a = node[0], self.contact_radius_m
            surface, start = self._free.at(node, self._time)
            jump = pull * sqrt(x)
            if jump:
                start = [v - jump * modulus for v, modulus in zip(start, self._moduli, strict=True)]
            gone_in = self.depth_m - x * x / radius - surface + jump
            if gone_in >= 0:
                self._outside.pop()
                self._extend(x, [v + gone_in * g for v, g in zip(start, self._gain, strict=True)])
                excess = self._load(x, self._edge)
                continue
            at_edge = excess / self._e0
            share = at_edge / (at_edge - gone_in)
            terms = zip(self._edge, start, self._moduli, strict=True)
            edge = [(1 - share) * (v - at_edge * modulus) + share * w for v, w, modulus in terms]
            self._extend(sqrt(a * a + share * (x * x - a * a)), edge)
            return
        x, a = self._undisturbed_edge(), self.contact_radius_m
        if x > a:
            self._take_undisturbed(a, x)

    def _take_undisturbed(self, a: float, x: float) -> None:
        """Move the edge from a to x over springs that never touched, all in closed form."""
        radius, pull = self._radius, self._pull / self._e0
        pressed = self.depth_m * (x - a) - (x * x * x - a * a * a) / (3 * radius)
        pulled = 2 / 3 * pull * (x * sqrt(x) - a * sqrt(a))
        terms = zip(self._sum, self._gain, self._moduli, strict=True)
        self._sum = [v + gain * (pressed + pulled) - modulus * pulled for v, gain, modulus in terms]
        self._keep_edge()
        # nodes on the way, where the edge has leapt
        count = min(MAX_NODES_PER_STEP, int((x - a) / self._spacing))
        for n in range(1, count + 1):
            at = a + (x - a) * n / (count + 1)
            jump = -pull * sqrt(at)
            gone_in = self.depth_m - at * at / radius - jump
            pairs = zip(self._gain, self._moduli, strict=True)
            self._edge = [jump * modulus + gain * gone_in for gain, modulus in pairs]
            self.contact_radius_m = at
            self._keep_edge()
        self.contact_radius_m = x
        self._edge = [-pull * sqrt(x) * modulus for modulus in self._moduli]

    def _undisturbed_edge(self) -> float:
        """Return the radius at which undisturbed springs just touch."""
        if self._pull == 0:
            return sqrt(self._radius * max(0.0, self.depth_m))
        # depth - x^2/R + pull/E0 sqrt(x): concave, so Newton from the right falls to the root
        pull, radius, depth = self._pull / self._e0, self._radius, self.depth_m
        x = 2 * ((radius * pull) ** (2 / 3) + sqrt(radius * abs(depth)))
        for _ in range(60):
            value = depth - x * x / radius + pull * sqrt(x)
            slope = -2 * x / radius + pull / (2 * sqrt(x))
            if slope >= 0:
                return 0.0
            change = value / slope
            x -= change
            if x <= 0:
                return 0.0
            if abs(change) <= 1e-14 * x:
                break
        return x

    def _extend(self, x: float, edge: Values) -> None:
        """Move the edge outwards to x, v_j linear in x^2 on the way."""
        self._add_segment(self.contact_radius_m, x, self._edge, edge)
        self._keep_edge()
        self.contact_radius_m, self._edge = x, edge

    def _keep_edge(self) -> None:
        """Make the present edge a node of the profile, where the last one is far enough inside."""
        if self.contact_radius_m - self._inside[-1][0] >= self._spacing:
            pairs = zip(self._edge, self._common, strict=True)
            self._inside.append((self.contact_radius_m, self._time, [v - c for v, c in pairs]))

    def _recede(self, excess: float) -> None:
        """Let go springs at the edge until the load there is no longer below the limit."""
        while self._inside:
            x, since, kept = self._inside[-1]
            elapsed = since - self._time
            terms = zip(self._common, self._times, kept, strict=True)
            v = [c + w * exp(elapsed / tau) for c, tau, w in terms]
            load = self._load(x, v)
            a = self.contact_radius_m
            self._let_go(force=not self._outside)
            if load >= 0:
                share = load / (load - excess)
                new = sqrt(x * x + share * (a * a - x * x))
                pairs = zip(v, self._edge, strict=True)
                edge = [(1 - share) * inner + share * outer for inner, outer in pairs]
                self._add_segment(a, new, self._edge, edge)
                self.contact_radius_m, self._edge = new, edge
                return
            self._add_segment(a, x, self._edge, v)
            self.contact_radius_m, self._edge, excess = x, v, load
            self._inside.pop()
        self._let_go(force=True)
        self._touching = False

    def _let_go(self, *, force: bool) -> None:
        """Make the present edge a node of the free surface, where the next is far enough."""
        x = self.contact_radius_m
        if force or self._outside[-1][0] - x >= self._spacing:
            u = self.depth_m - x * x / self._radius
            self._outside.append((x, self._time, self._free.let_go(u, self._edge)))

    def _add_segment(self, x0: float, x1: float, v0: Values, v1: Values) -> None:
        """Add ``integral v dx`` from x0 to x1 to the sums, every v linear in x^2 between its ends."""
        # mean of (x^2 - x0^2) / (x1^2 - x0^2) over the way
        share = (x1 + 2 * x0) / (3 * (x1 + x0)) if x1 + x0 > 0 else 0.0
        at0, at1 = (x1 - x0) * (1 - share), (x1 - x0) * share
        self._sum = [v + at0 * a + at1 * b for v, a, b in zip(self._sum, v0, v1, strict=True)]

    def _update_force(self) -> float:
        stress, a = 0.0, self.contact_radius_m
        if self._touching:
            stress = self._einf * a * (self.depth_m - a * a / (3 * self._radius)) + sum(self._sum)
            if stress < 0 and self._pull == 0:
                stress = 0.0  # rounding of the profile when hardly anything touches
        self.force_n = self._scale * stress
        return self.force_n


AT_ONCE_S = 1e-9  # in which the first depth is reached: glassy, as no Prony term is that fast


def indent(
    tip: Indenter, time_s: ArrayLike, depth_m: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return force [N] and contact radius [m], (T,) each, of a tip moved in, held and drawn out.

    Parameters
    ----------
    tip : Indenter
        Not in contact before the first time, at which the first depth is put on at once.
    time_s : (T,) array
        Strictly ascending times [s].
    depth_m : (T,) array
        Depth of the lowest point below the undisturbed surface [m]; straight in between.

    Raises
    ------
    ValueError
        If times do not ascend, or shapes differ.
    """
    time, depth = np.asarray(time_s, dtype=float), np.asarray(depth_m, dtype=float)
    shapes = time.ndim == 1 and time.size > 0 and depth.shape == time.shape
    require(shapes, "depth_m", depth.shape, f"the shape of time_s, {time.shape}, one axis")
    require(bool(np.all(np.diff(time) > 0)), "time_s", time, "strictly ascending times")
    require(bool(np.all(np.isfinite(depth))), "depth_m", depth, "finite numbers")
    steps = [AT_ONCE_S, *np.diff(time).tolist()]
    moved = zip(depth.tolist(), steps, strict=True)
    force_n, radius_m = np.array([(tip.step(x, dt), tip.contact_radius_m) for x, dt in moved]).T
    return force_n, radius_m
