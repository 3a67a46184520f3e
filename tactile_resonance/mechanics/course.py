# SPDX-License-Identifier: Apache-2.0
"""A rigid ball pressed once into a viscoelastic half-space, perhaps through a spring, and drawn back.

While the contact grows the force is Lee & Radok's (J. Appl. Mech. 27 (1960) 438),
``F(t) = c integral_0^t E(t - s) d(delta^(3/2))(s)``, ``c = 4 sqrt(R) / (3 (1 - nu^2))``; while it shrinks
Ting's (J. Appl. Mech. 33 (1966) 845): the same integral up to t1, when the contact was as large as it is now,
``integral_t1^t E(t - s) d delta(s) = 0``. With a Prony series both integrals are one number per term, which
is carried from node to node: delta is linear between nodes for Ting's condition, delta^(3/2) for the force.

Robot and ball differ by the bending of what is between them: ``k (z - delta) = F`` is solved with the force
at each node, for beams are soft (15 N/m: 1 cN bends them 0.67 mm) and the ball goes on while the robot
stands.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from tactile_resonance._typing import FloatArray
from tactile_resonance.mechanics.indentation import BallTip

NEWTON_STEPS = 8
"""Of a cubic that is convex where it is solved: from above Newton's method comes down to the root."""


def course_of(
    ball: BallTip,
    time_s: FloatArray,
    depth_m: FloatArray,
    turn: int,
    equilibrium_pa: ArrayLike,
    moduli_pa: ArrayLike,
    times_s: ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """Force and depth that follow from the way of the robot, for P sets of constants at once.

    Parameters
    ----------
    ball : BallTip
    time_s : (N,) array
        Of the nodes, ascending.
    depth_m : (N,) or (P, N) array
        Of the robot past the surface [m]; negative above it.
    turn : int
        Node after which the contact shrinks; N - 1: it never does.
    equilibrium_pa : (P,) array
    moduli_pa, times_s : (P, terms) arrays

    Returns
    -------
    force_n : (P, N) array
    indentation_m : (P, N) array
        Of the ball [m]; 0 before it touches. After it has let go that of the robot.
    """
    einf = np.atleast_1d(_own(equilibrium_pa))
    moduli, times = (np.atleast_2d(_own(v)) for v in (moduli_pa, times_s))
    time = _own(time_s)
    depth = _own(np.broadcast_to(depth_m, (einf.size, time.size)))
    force, delta = np.zeros_like(depth), np.zeros_like(depth)
    k = ball.stiffness_n_per_m
    bending = 1 / k if np.isfinite(k) else 0.0
    _press(ball.factor, bending, time, depth, turn, einf, moduli, times, force, delta)
    return force, delta


def _own(values: ArrayLike) -> FloatArray:
    """A copy: views and arrays that are read-only would each be a kernel more to compile."""
    return np.array(values, float, order="C")


def compiled() -> int:
    """How many kernels were not in the cache and had to be compiled: some five seconds, once."""
    nodes = np.arange(3.0)
    course_of(BallTip(1.0), nodes, nodes, 2, [1.0], [[1.0]], [[1.0]])
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in (_pressed, _press))


@njit(cache=True)
def _pressed(a, held, depth, bending):
    """Depth of the ball behind a spring: ``depth - delta = bending (a delta^(3/2) + held)``, 0 or above."""
    room = depth - bending * held
    if room <= 0.0:
        return 0.0
    stiff = a * bending
    if stiff <= 0.0:
        return room
    # of y = sqrt(delta): stiff y^3 + y^2 = room; from above
    y = min(np.sqrt(room), np.cbrt(room / stiff))
    for _ in range(NEWTON_STEPS):
        y -= (y * y * (stiff * y + 1.0) - room) / (y * (3.0 * stiff * y + 2.0))
    return y * y


@njit(cache=True)
def _press(c, bending, time, depth, turn, einf, moduli, times, force, delta):
    """Force and depth of the ball at each node, in place; see the module's text."""
    count, terms = time.size, times.shape[1]
    # E_j times the integrals of exp(-(t - s) / tau_j) d(delta^(3/2)) and d(delta), at each node
    v, d = np.zeros((turn + 1, terms)), np.zeros((turn + 1, terms))
    decay, gain, d_now = np.zeros(terms), np.zeros(terms), np.zeros(terms)
    for p in range(einf.size):
        # where a record begins in contact, that was a step
        glassy = c * (einf[p] + moduli[p].sum())
        now = _pressed(glassy, 0.0, depth[p, 0], bending)
        x = now**1.5
        delta[p, 0], force[p, 0] = now, glassy * x
        v[0], d[0] = moduli[p] * x, moduli[p] * now
        for n in range(1, count):
            step = time[n] - time[n - 1]
            stiff = einf[p]
            for j in range(terms):
                ratio = step / times[p, j]
                decay[j] = np.exp(-ratio)
                gain[j] = moduli[p, j] * -np.expm1(-ratio) / ratio
                stiff += gain[j]
            before = delta[p, n - 1]
            if n <= turn:
                kept = einf[p] * x
                for j in range(terms):
                    v[n, j] = decay[j] * v[n - 1, j]
                    kept += v[n, j]
                now = _pressed(c * stiff, c * (kept - stiff * x), depth[p, n], bending)
                total = einf[p] * now**1.5
                for j in range(terms):
                    v[n, j] += gain[j] * (now**1.5 - x)
                    d[n, j] = decay[j] * d[n - 1, j] + gain[j] * (now - before)
                    total += v[n, j]
                x = now**1.5
                delta[p, n], force[p, n] = now, c * total
                d_now[:] = d[n]
                continue
            constant = (einf[p] - stiff) * before
            for j in range(terms):
                constant += decay[j] * d_now[j]
            # the latest t1 at which the contact was as large as now; it grew meanwhile
            above_robot = above_ball = above_force = np.nan
            now, force[p, n] = depth[p, n], 0.0  # it has let go
            for m in range(turn, -1, -1):
                then, pressed = einf[p] * delta[p, m], einf[p] * delta[p, m] ** 1.5
                for j in range(terms):
                    left = np.exp((time[m] - time[n]) / times[p, j])
                    then += left * d[m, j]
                    pressed += left * v[m, j]
                # both sides of Ting's condition are linear in the depth of now
                ball_at, force_at = (then - constant) / stiff, c * pressed
                robot_at = ball_at + bending * force_at
                if robot_at <= depth[p, n]:
                    share = 0.0
                    if m < turn and above_robot > robot_at:
                        share = (depth[p, n] - robot_at) / (above_robot - robot_at)
                        now = ball_at + share * (above_ball - ball_at)
                        force[p, n] = force_at + share * (above_force - force_at)
                    else:
                        now, force[p, n] = ball_at, force_at
                    if delta[p, m] <= 0.0 and share == 0.0:
                        now, force[p, n] = depth[p, n], 0.0
                    break
                above_robot, above_ball, above_force = robot_at, ball_at, force_at
            for j in range(terms):
                d_now[j] = decay[j] * d_now[j] + gain[j] * (now - before)
            delta[p, n] = now


def sphere_share(ball: BallTip, depth_m: float) -> float:
    """Force of a sphere over that of Hertz's paraboloid at a depth (Sneddon 1965), 1 for small ones.

    NaN where the sphere is in to its equator.
    """

    def depth_of(x: float) -> float:  # over R, of a contact radius x R
        return x / 2 * np.log((1 + x) / (1 - x))

    wanted = depth_m / ball.radius_m
    if not wanted < 1.0:
        return np.nan
    if wanted < 1e-9:
        return 1.0
    x = brentq(lambda x: depth_of(x) - wanted, 0.0, 1 - 1e-12)
    force = (x * x + 1) / 2 * np.log((1 + x) / (1 - x)) - x
    return float(force / (4 / 3 * wanted**1.5))


def layer_share(ball: BallTip, depth_m: float, thickness_m: float) -> float:
    """Force on a layer bonded to what is rigid over that of a half-space, ``nu`` 0.5.

    Dimitriadis et al., Biophys. J. 82 (2002) 2798, equation 11.
    """
    x = np.sqrt(ball.radius_m * depth_m) / thickness_m
    return float(1 + x * (1.133 + x * (1.283 + x * (0.769 + x * 0.0975))))
