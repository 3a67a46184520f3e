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
the profile of E_j v_j, which determines where the edge goes, is kept, at nodes. A simulated robot
does this two thousand times a second, so it is compiled (numba, which looks at the date of this file
alone: whatever is compiled for it is in here).
"""

from __future__ import annotations

from math import cos, exp, expm1, pi, pow, sin, sqrt

import numpy as np
from numba import float64, from_dtype, int64, njit
from numba.types import UniTuple
from numpy.typing import ArrayLike

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require
from tactile_resonance.simulation.tissue.library import Tissue

NODE_SPACING = 1e-3  # of the profile, in tip radii; the error of unloading goes as its square
MAX_NODES_PER_STEP = 64
NODES = 1024
"""Of the profile, for which there is room at first."""
SUBSTEPS_AT_ONCE = 8
"""Sub-steps of a swing for which there is room at a time."""

STATE = np.dtype(
    [
        *[(name, float) for name in ("radius_m", "scale", "einf_pa", "e0_pa", "pull", "spacing_m")],
        # length of the step, and force per depth and radius in it; of the ball; where its edge is
        *[
            (name, float)
            for name in ("interval_s", "stiffness", "force_n", "depth_m", "time_s", "a_m")
        ],
        # whether it touches; how many nodes there are on either side of the edge
        *[(name, np.int64) for name in ("touching", "inside", "outside")],
    ]
)

MODULI, TIMES, DECAY, GAIN, SUM, COMMON, EDGE, SCRATCH = range(8)
"""Rows of what there is for each term: E_j, tau_j, ``exp(-dt / tau_j)``, E_j times its mean over the step; of
E_j v_j the integral from 0 to the edge, what all touching springs have gone through alike, and the edge's."""

X, SINCE, VALUES = 0, 1, 2
"""Columns of a node: radius, when it was made, and for each term: inside of the edge E_j v_j less what is
common, outside the modal state of the free spring."""


def _decays(
    moduli_pa: FloatArray, times_s: FloatArray, glassy_pa: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Springs of a Prony series without load: ``E0 u = sum E_j z_j``, ``tau_j z_j' = u - z_j``.

    While it touches, a spring bears ``Einf u + sum E_j v_j`` with ``v_j = u - z_j``. The same rank-one change
    of ``diag(1 / tau)`` as in the creep compliance; its eigenvectors make every free spring a sum of decays, so
    none needs to be stepped.

    Returns
    -------
    into : (modes, terms) array
        Modal state of z.
    out : (1 + terms, modes) array
        From the modal state to u [m], and to what the terms would bear if the spring were held there.
    rates : (modes,) array
        Of the modes [1/s], below 0.
    """
    root = np.sqrt(moduli_pa / times_s)
    rates, vectors = np.linalg.eigh(np.diag(1 / times_s) - np.outer(root, root) / glassy_pa)
    weights = np.sqrt(moduli_pa * times_s)
    displacement = vectors.T @ root / glassy_pa  # (modes,)
    loads = moduli_pa[:, None] * (displacement - vectors / weights[:, None])  # (terms, modes)
    into = np.ascontiguousarray(vectors.T * weights)
    return into, np.vstack([displacement, loads]), -rates


@njit
def _set_interval(s, t, dt_s):
    """Keep ``exp(-dt / tau)``, and E_j times its mean over the step, which steady motion sees."""
    s.interval_s, total = dt_s, 0.0
    for j in range(t.shape[1]):
        t[DECAY, j] = exp(-dt_s / t[TIMES, j])
        t[GAIN, j] = -t[MODULI, j] * t[TIMES, j] / dt_s * expm1(-dt_s / t[TIMES, j])
        total += t[GAIN, j]
    s.stiffness = s.einf_pa + total


@njit
def _load(s, x, values):
    """Return ``q (1 - nu^2)`` at x, above that at which the edge lets go."""
    total = 0.0
    for value in values:
        total += value
    return s.einf_pa * (s.depth_m - x * x / s.radius_m) + s.pull * sqrt(x) + total


@njit
def _keep_edge(s, t, inside):
    """Make the present edge a node of the profile, where the last one is far enough inside."""
    if s.a_m - inside[s.inside - 1, X] < s.spacing_m:
        return
    node = inside[s.inside]
    node[X], node[SINCE] = s.a_m, s.time_s
    for j in range(t.shape[1]):
        node[VALUES + j] = t[EDGE, j] - t[COMMON, j]
    s.inside += 1


@njit
def _move_edge(s, t, x):
    """Move the edge to x, at which E_j v_j is in the scratch; it is linear in x^2 on the way."""
    a = s.a_m
    # mean over the way of the share of it, in x^2, that has been gone
    share = (x + 2 * a) / (3 * (x + a)) if x + a > 0 else 0.0
    at_a, at_x = (x - a) * (1 - share), (x - a) * share
    for j in range(t.shape[1]):
        t[SUM, j] = t[SUM, j] + at_a * t[EDGE, j] + at_x * t[SCRATCH, j]
        t[EDGE, j] = t[SCRATCH, j]
    s.a_m = x


@njit
def _free(s, t, node, out, rates):
    """Return u [m] of a free spring; what its terms would bear if it were held there goes into the scratch."""
    elapsed, u = s.time_s - node[SINCE], 0.0
    for j in range(rates.size):
        t[SCRATCH, j] = 0.0
    for k in range(rates.size):
        now = node[VALUES + k] * exp(elapsed * rates[k])
        u += out[0, k] * now
        for j in range(rates.size):
            t[SCRATCH, j] += out[1 + j, k] * now
    return u


@njit
def _let_go(s, t, outside, into):
    """Make the present edge a node of the free surface."""
    u, node = s.depth_m - s.a_m * s.a_m / s.radius_m, outside[s.outside]
    node[X], node[SINCE] = s.a_m, s.time_s
    for k in range(t.shape[1]):
        node[VALUES + k] = 0.0
        for j in range(t.shape[1]):
            node[VALUES + k] += into[k, j] * (u - t[EDGE, j] / t[MODULI, j])
    s.outside += 1


@njit
def _recede(s, t, inside, outside, into, excess):
    """Let go springs at the edge until the load there is no longer below the limit."""
    while s.inside:
        node = inside[s.inside - 1]
        x, elapsed = node[X], node[SINCE] - s.time_s
        for j in range(t.shape[1]):
            t[SCRATCH, j] = t[COMMON, j] + node[VALUES + j] * exp(elapsed / t[TIMES, j])
        load = _load(s, x, t[SCRATCH])
        if not s.outside or outside[s.outside - 1, X] - s.a_m >= s.spacing_m:
            _let_go(s, t, outside, into)
        if load >= 0:
            share = load / (load - excess)
            for j in range(t.shape[1]):
                t[SCRATCH, j] = (1 - share) * t[SCRATCH, j] + share * t[EDGE, j]
            _move_edge(s, t, sqrt(x * x + share * (s.a_m * s.a_m - x * x)))
            return
        _move_edge(s, t, x)
        s.inside, excess = s.inside - 1, load
    _let_go(s, t, outside, into)
    s.touching = 0


@njit
def _undisturbed_edge(s):
    """Return the radius at which undisturbed springs just touch."""
    if s.pull == 0:
        return sqrt(s.radius_m * max(0.0, s.depth_m))
    # depth - x^2/R + pull/E0 sqrt(x): concave, so Newton from the right falls to the root
    pull, radius, depth = s.pull / s.e0_pa, s.radius_m, s.depth_m
    x = 2 * (pow(radius * pull, 2 / 3) + sqrt(radius * abs(depth)))
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


@njit
def _take_undisturbed(s, t, inside, x):
    """Move the edge to x over springs that never touched, all in closed form."""
    a, radius, pull = s.a_m, s.radius_m, s.pull / s.e0_pa
    pressed = s.depth_m * (x - a) - (x * x * x - a * a * a) / (3 * radius)
    pulled = 2 / 3 * pull * (x * sqrt(x) - a * sqrt(a))
    for j in range(t.shape[1]):
        t[SUM, j] = t[SUM, j] + t[GAIN, j] * (pressed + pulled) - t[MODULI, j] * pulled
    _keep_edge(s, t, inside)
    # nodes on the way, where the edge has leapt
    count = min(MAX_NODES_PER_STEP, int((x - a) / s.spacing_m))
    for n in range(1, count + 1):
        s.a_m = a + (x - a) * n / (count + 1)
        jump = -pull * sqrt(s.a_m)
        gone_in = s.depth_m - s.a_m * s.a_m / radius - jump
        for j in range(t.shape[1]):
            t[EDGE, j] = jump * t[MODULI, j] + t[GAIN, j] * gone_in
        _keep_edge(s, t, inside)
    s.a_m = x
    for j in range(t.shape[1]):
        t[EDGE, j] = -pull * sqrt(x) * t[MODULI, j]


@njit
def _advance(s, t, inside, outside, out, rates, excess):
    """Let springs outside the edge touch, those that have recovered first."""
    radius, pull = s.radius_m, s.pull / s.e0_pa
    while s.outside:
        x, a = outside[s.outside - 1, X], s.a_m
        surface = _free(s, t, outside[s.outside - 1], out, rates)
        jump = pull * sqrt(x)
        gone_in = s.depth_m - x * x / radius - surface + jump
        if jump:
            for j in range(t.shape[1]):
                t[SCRATCH, j] -= jump * t[MODULI, j]
        _keep_edge(s, t, inside)
        if gone_in < 0:
            at_edge = excess / s.e0_pa
            share = at_edge / (at_edge - gone_in)
            for j in range(t.shape[1]):
                held = (1 - share) * (t[EDGE, j] - at_edge * t[MODULI, j])
                t[SCRATCH, j] = held + share * t[SCRATCH, j]
            _move_edge(s, t, sqrt(a * a + share * (x * x - a * a)))
            return
        for j in range(t.shape[1]):
            t[SCRATCH, j] = t[SCRATCH, j] + gone_in * t[GAIN, j]
        _move_edge(s, t, x)
        s.outside -= 1
        excess = _load(s, x, t[EDGE])
    x = _undisturbed_edge(s)
    if x > s.a_m:
        _take_undisturbed(s, t, inside, x)


@njit
def _touch(s, t, inside, outside, out, rates, moved, dt_s):
    """Begin a contact if the tip has met the surface, which may still be dented."""
    if s.depth_m <= 0 and s.pull == 0:  # nothing stands out that was never pulled
        return
    surface = 0.0
    for j in range(t.shape[1]):
        t[SCRATCH, j] = t[SUM, j] = t[COMMON, j] = 0.0
    if s.outside:
        surface = _free(s, t, outside[s.outside - 1], out, rates)
    gone_in = s.depth_m - surface
    if gone_in <= 0:
        return
    # the part of the step in contact; the first step ever starts at the surface
    _set_interval(s, t, dt_s * min(1.0, gone_in / moved) if 0 < moved < np.inf else dt_s)
    s.outside, s.touching, s.inside, node = max(0, s.outside - 1), 1, 1, inside[0]
    node[X], node[SINCE] = 0.0, s.time_s
    for j in range(t.shape[1]):
        node[VALUES + j] = t[EDGE, j] = t[SCRATCH, j] + gone_in * t[GAIN, j]
    _advance(s, t, inside, outside, out, rates, _load(s, 0.0, t[EDGE]))


@njit(UniTuple(float64, 2)(from_dtype(STATE)[::1], float64[:, ::1], float64), cache=True)
def _tangent(states, t, dt_s):
    """Return force after holding for a time [N], and per further depth [N/m]."""
    s = states[0]
    if not s.touching:
        return 0.0, 0.0
    if dt_s != s.interval_s:
        _set_interval(s, t, dt_s)
    held, a = 0.0, s.a_m
    for j in range(t.shape[1]):
        held += t[DECAY, j] * t[SUM, j]
    stress = s.einf_pa * a * (s.depth_m - a * a / (3 * s.radius_m)) + held
    return s.scale * stress, s.scale * a * s.stiffness


_MATRIX = float64[:, ::1]


@njit(
    UniTuple(float64, 3)(from_dtype(STATE)[::1], *[_MATRIX] * 5, float64[::1], float64, float64),
    cache=True,
)
def _step(states, t, inside, outside, into, out, rates, depth_m, dt_s):
    """Move the tip; return force and radius, and how many nodes there are."""
    s = states[0]
    moved = depth_m - s.depth_m
    s.depth_m, s.time_s = depth_m, s.time_s + dt_s
    if s.touching:
        if dt_s != s.interval_s:
            _set_interval(s, t, dt_s)
        for j in range(t.shape[1]):
            rise = t[GAIN, j] * moved
            t[SUM, j] = t[DECAY, j] * t[SUM, j] + rise * s.a_m
            t[COMMON, j] = t[DECAY, j] * t[COMMON, j] + rise
            t[EDGE, j] = t[DECAY, j] * t[EDGE, j] + rise
        excess = _load(s, s.a_m, t[EDGE])
        if excess < 0:
            _recede(s, t, inside, outside, into, excess)
        else:
            _advance(s, t, inside, outside, out, rates, excess)
    else:
        _touch(s, t, inside, outside, out, rates, moved, dt_s)
    stress, a, total = 0.0, s.a_m, 0.0
    if s.touching:
        for j in range(t.shape[1]):
            total += t[SUM, j]
        stress = s.einf_pa * a * (s.depth_m - a * a / (3 * s.radius_m)) + total
        if stress < 0 and s.pull == 0:
            stress = 0.0  # rounding of the profile when hardly anything touches
    s.force_n = s.scale * stress
    return s.force_n, s.a_m, float(s.inside + s.outside)


@njit(UniTuple(float64, 2)(*[float64] * 10), cache=True)
def swing(held_n, slope, depth_m, speed_m_s, base_m, rate_m_s, h_s, k, c, m):
    """Return depth and speed of a ball on a beam after a time: the exact motion for the tangent of its force.

    ``m x'' = k (b - x) + c (b' - x') - F(x)``.

    Parameters
    ----------
    held_n, slope : float
        Tangent of F at the end of the time: F where the ball is held [N], and per further depth [N/m].
    depth_m, speed_m_s : float
        x, x' at the beginning.
    base_m, rate_m_s : float
        b then, and b', which is constant.
    h_s : float
        The time.
    k, c, m : float
        Stiffness [N/m], damping [N s/m] and mass [kg] of the beam.
    """
    half, whole = c / (2 * m), k + slope
    fall = exp(-half * h_s)
    # motion of equilibrium: offset + drift t
    drift = k * rate_m_s / whole
    offset = k * base_m + c * (rate_m_s - drift) - held_n + slope * depth_m
    offset /= whole
    y, dy = depth_m - offset, speed_m_s - drift
    omega = sqrt(whole / m - half * half)
    turn, lift = cos(omega * h_s), sin(omega * h_s) / omega
    return (
        offset + drift * h_s + fall * (y * turn + (dy + half * y) * lift),
        drift + fall * (dy * turn - (whole / m * y + half * dy) * lift),
    )


@njit(
    UniTuple(float64, 5)(
        *(from_dtype(STATE)[::1], *[_MATRIX] * 5, float64[::1], UniTuple(float64, 3)),
        *(*[float64] * 5, int64, int64),
    ),
    cache=True,
)
def _swing(
    states, t, inside, outside, into, out, rates, beam, base_m, rate, depth_m, speed, h_s, first, end
):
    """Swing for some of the sub-steps; return depth, speed, force, radius, and how many nodes there are."""
    k, c, m = beam
    s = states[0]
    for n in range(first, end):
        held_n, slope = _tangent(states, t, h_s)
        base_now_m = base_m + n * h_s * rate
        depth_m, speed = swing(held_n, slope, depth_m, speed, base_now_m, rate, h_s, k, c, m)
        _step(states, t, inside, outside, into, out, rates, depth_m, h_s)
    return depth_m, speed, s.force_n, s.a_m, float(s.inside + s.outside)


Beam = tuple[float, float, float]
"""Stiffness [N/m], damping [N s/m], mass [kg]."""
Motion = tuple[float, float]
"""Depth [m] and speed [m/s]: of the ball, or that the ball would have with the beam straight."""


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
        series = tissue.prony
        acting = series.moduli_pa > 0
        moduli, times = series.moduli_pa[acting], series.times_s[acting]
        einf, e0 = series.equilibrium_pa, series.instantaneous_pa
        # edge load / sqrt(x), as q (1 - nu^2)
        plane_modulus = tissue.relaxation_modulus_1s_pa / (1 - poisson_ratio**2)
        pull = (1 - poisson_ratio**2) * sqrt(2 * pi * work * plane_modulus)
        # tissue undisturbed, the tip far above it
        self.force_n, self.contact_radius_m, self.depth_m = 0.0, 0.0, -np.inf
        self._stiffness = 2 * e0 / (1 - poisson_ratio**2) * sqrt(tip_radius_m)
        self._state = np.zeros(1, STATE)
        for name, value in {
            **{"radius_m": tip_radius_m, "spacing_m": NODE_SPACING * tip_radius_m},
            "scale": 2 / (1 - poisson_ratio**2),  # both halves of the row
            **{"einf_pa": einf, "e0_pa": e0, "pull": pull, "depth_m": -np.inf},
        }.items():
            self._state[name] = value
        self._terms = np.zeros((SCRATCH + 1, moduli.size))
        self._terms[MODULI], self._terms[TIMES] = moduli, times
        self._free = _decays(moduli, times, e0)
        # inside, x ascending, and outside, x descending; how many there are on both sides
        self._nodes = tuple(np.zeros((2, NODES, VALUES + moduli.size)))
        self._count = 0.0

    def step(self, depth_m: float, dt_s: float) -> float:
        """Move the tip to a depth at constant speed within `dt_s` and return the force [N]."""
        if not dt_s > 0:
            require(False, "dt_s", dt_s, "a number above 0")
        self._make_room(1)
        self.depth_m = depth_m
        self.force_n, self.contact_radius_m, self._count = _step(
            self._state, self._terms, *self._nodes, *self._free, depth_m, dt_s
        )
        return self.force_n

    def tangent(self, dt_s: float) -> tuple[float, float]:
        """Return (force [N] after holding for `dt_s`, force per further depth [N/m]).

        To first order the force after a step is ``force + stiffness (depth - present depth)``.
        """
        return _tangent(self._state, self._terms, dt_s)

    def stiffness_at(self, depth_m: float) -> float:
        """Return the force per further depth [N/m] at a depth [m] that is reached at once, without adhesion."""
        return self._stiffness * sqrt(max(0.0, depth_m))

    def swing(self, beam: Beam, base: Motion, ball: Motion, h_s: float, count: int) -> Motion:
        """Move at the end of a beam for `count` times `h_s`, as the function `swing`; return its motion."""
        for first in range(0, count, SUBSTEPS_AT_ONCE):
            end = min(first + SUBSTEPS_AT_ONCE, count)
            self._make_room(end - first)
            *ball, self.force_n, self.contact_radius_m, self._count = _swing(
                *(self._state, self._terms, *self._nodes, *self._free),
                *(beam, *base, *ball, h_s, first, end),
            )
        self.depth_m, speed_m_s = ball
        return self.depth_m, speed_m_s

    def _make_room(self, steps: int) -> None:
        """Have room for the nodes of some steps."""
        while self._count + steps * (MAX_NODES_PER_STEP + 2) >= len(self._nodes[0]):
            self._nodes = tuple(np.concatenate([each, np.zeros_like(each)]) for each in self._nodes)


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
