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

`SeriesProblem` is the least squares of a series to one record over its recorded way of the robot, ramp and all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.optimize import brentq, least_squares, nnls

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Means

NEWTON_STEPS = 8
"""Of a cubic that is convex where it is solved: from above Newton's method comes down to the root."""
FAST = 1 / 8
"""Time constant of what stands for all faster terms, over the duration of the ramp."""
INSERTED, STARTS, MOST_STEPS = 10, 3, 60
"""Times at which a further term is tried; so many starts are followed, each so far."""
WALKS, SHOWN_WALK = 121, 9.0
"""Sizes of a random walk that are tried; twice the logarithm of the likelihood ratio that shows one: by chance
one of 700."""
STEP, STEP_M = 1e-5, 1e-8
"""Of the logarithms and of the place of the surface, for derivatives."""


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
    bending = 1 / ball.stiffness_n_per_m  # 0 of a ball that is held rigidly
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


@dataclass(frozen=True)
class SeriesSolution:
    """Logarithms of constants, surface, zero and its drift that fit best."""

    terms: int
    x: FloatArray
    jacobian: FloatArray
    chi_square: float

    @property
    def inverse(self) -> FloatArray:
        """(unknowns, residuals) how the unknowns follow the residuals."""
        scale = np.linalg.norm(self.jacobian, axis=0)
        scale[scale == 0] = 1.0
        return np.linalg.pinv(self.jacobian / scale, rcond=1e-10) / scale[:, None]


class SeriesProblem:
    """Least squares of one record.

    Unknowns: ln Einf, ln E_j, ln tau_j, modulus of the fast term over a scale, surface [m], zero [N],
    drift [N/s].

    Attributes
    ----------
    ball : BallTip
    means : Means
        Of the record.
    knows_zero : bool
        Whether it begins or ends in air, or the deviation of its zero is stated.
    shows_drift : bool
        Whether it begins and ends in air.
    """

    def __init__(self, test: IndentationRecord, means: Means) -> None:
        self.ball, self.means, self._test = test.ball, means, test
        self._time, self._depth, self._at = _nodes(means)
        c, most, peak = self.ball.factor, self._depth.max(), means.force_n.max()
        most = max(0.05 * most, most - peak / self.ball.stiffness_n_per_m)
        self._scale_pa = peak / (c * most**1.5)
        self._small_pa = 1e-2 * self._scale_pa
        self._tried_s = means.ramp_s / 15, 2 * means.hold_s
        free = means.free_time_s
        self._shows_zero = free.size > 0
        self.knows_zero = self._shows_zero or not np.isnan(test.force_std_n)
        self.shows_drift = bool((free < means.begin_s).any() and (free > means.end_s).any())

    def solve(self, terms: int, fewer: SeriesSolution | None) -> SeriesSolution | None:
        """Best of several starts; None where none converges."""
        spread = np.geomspace(*self._tried_s, terms + 2)[1:-1]
        moduli, _ = self._linear(spread, 0.0 if fewer is None else fewer.x[-3])
        others = np.zeros(4) if fewer is None else fewer.x[-4:]
        starts = [
            np.concatenate(
                [np.log(np.maximum(moduli[:-1], self._small_pa)), np.log(spread), others]
            )
        ]
        if fewer is not None:
            starts += self._starts_after(fewer)
        found = [solution for x in starts if (solution := self._from(terms, x)) is not None]
        return min(found, key=lambda solution: solution.chi_square, default=None)

    def _starts_after(self, fewer: SeriesSolution) -> list[FloatArray]:
        """The solution with one term less, and a small term beside it, or one of its own cut in two."""
        n, x = fewer.terms, fewer.x
        moduli, times = x[1 : 1 + n], x[1 + n : 1 + 2 * n]
        made = [
            (np.append(moduli, np.log(self._small_pa)), np.append(times, time))
            for time in np.log(np.geomspace(*self._tried_s, INSERTED))
        ]
        for j in range(n):
            twice = np.log(2) * (np.arange(n) == j)
            first, later = moduli[j] - np.log(2), times[j] - np.log(2)
            made.append((np.insert(moduli - twice, j, first), np.insert(times + twice, j, later)))
        made.sort(key=lambda one: self._linear(np.exp(one[1]), x[-3])[1])
        return [np.concatenate([x[:1], *one, x[-4:]]) for one in made[:STARTS]]

    def _from(self, terms: int, x: FloatArray) -> SeriesSolution | None:
        """Where least squares come to from a start."""
        low, high = np.full(x.size, -np.inf), np.full(x.size, np.inf)
        low[: terms + 1], high[: terms + 1] = np.log(np.array([1e-5, 1e5]) * self._scale_pa)
        low_s, high_s = self._tried_s
        low[terms + 1 : -4], high[terms + 1 : -4] = np.log([low_s / 3, 5 * high_s])
        low[-4] = 0.0
        inside = np.clip(x, low + 1e-3, high - 1e-3)
        try:
            done = least_squares(
                self.residuals,
                inside,
                self.jacobian,
                bounds=(low, high),
                x_scale="jac",
                ftol=1e-6,
                xtol=1e-6,
                gtol=1e-6,
                max_nfev=MOST_STEPS,
            )
        except (ValueError, np.linalg.LinAlgError):  # a series whose forces are not finite
            return None
        order = np.argsort(done.x[terms + 1 : -4])
        place = np.concatenate([[0], 1 + order, 1 + terms + order, x.size - np.arange(4, 0, -1)])
        return SeriesSolution(terms, done.x[place], done.jac[:, place], 2 * done.cost)

    def _linear(self, times_s: FloatArray, surface_m: float) -> tuple[FloatArray, float]:
        """Einf, E_j and that of the fast term, 0 or above, for given times, and their cost.

        The depth of the ball is that which follows from the measured force: they are a start.
        """
        means, kept = self.means, slice(0, self.means.turn + 1)
        ball_m = means.depth_m[kept] - surface_m
        if np.isfinite(self.ball.stiffness_n_per_m):
            ball_m = ball_m - means.force_n[kept] / self.ball.stiffness_n_per_m
            ball_m = np.maximum.accumulate(np.maximum(0.0, ball_m))
        rigid = replace(self.ball, stiffness_n_per_m=np.inf)
        times = np.append(times_s, FAST * means.ramp_s)
        each = np.eye(times.size + 1)  # one modulus at a time
        sets = each[:, 0], each[:, 1:], np.tile(times, (times.size + 1, 1))
        unit, _ = course_of(rigid, means.time_s[kept], ball_m, means.turn, *sets)
        weight = means.std_n[kept]
        return nnls((unit / weight).T, means.force_n[kept] / weight)

    def course(self, sets: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(P, N) forces and depths of the ball, at the means, of (P, unknowns)."""
        terms = (sets.shape[1] - 5) // 2
        values = np.exp(sets[:, : 2 * terms + 1])
        fast = np.full((len(sets), 1), FAST * self.means.ramp_s)
        force_n, ball_m = course_of(
            self.ball,
            self._time,
            self._depth - sets[:, -3, None],
            int(self._at[self.means.turn]),
            values[:, 0],
            np.hstack([values[:, 1 : terms + 1], self._scale_pa * sets[:, -4, None]]),
            np.hstack([values[:, terms + 1 :], fast]),
        )
        return force_n[:, self._at], ball_m[:, self._at]

    def residuals(self, x: FloatArray) -> FloatArray:
        """Of contact, free time, and what is known of surface and zero beforehand."""
        return self._weighted(x, self.course(x[None])[0][0])

    def _weighted(self, x: FloatArray, force: FloatArray) -> FloatArray:
        means, test = self.means, self._test
        surface, zero, drift = x[-3:]
        at, free = means.time_s - means.begin_s, means.free_time_s - means.begin_s
        priors = []
        if not np.isnan(test.depth_std_m):
            priors.append(surface / max(test.depth_std_m, 1e-9))
        if not self._shows_zero:
            priors.append(zero / (max(test.force_std_n, 1e-9) if test.force_std_n >= 0 else 1e-9))
        if not self.shows_drift:
            priors.append(drift * (means.end_s - means.begin_s) / 1e-9)
        return np.concatenate(
            [
                (means.force_n - zero - drift * at - force) / means.std_n,
                (means.free_force_n - zero - drift * free) / means.free_std_n,
                priors,
            ]
        )

    def covariance(self, solution: SeriesSolution) -> tuple[FloatArray, float]:
        """(unknowns, unknowns) from noise, and the random walk that the residuals show [N/sqrt(s)].

        Noise is as large as what the solution leaves, not less than that of the means. What is alike in
        neighbouring means is taken for a walk, by restricted maximum likelihood (Patterson and Thompson,
        Biometrika 58, 1971), where a likelihood ratio shows one: then parts of a long hold average it no more.
        """
        means, j = self.means, solution.jacobian
        count, unknowns = j.shape
        time_s = np.concatenate([means.time_s, means.free_time_s])
        std_n = np.concatenate([means.std_n, means.free_std_n])
        since_s = time_s - time_s.min()
        walk = np.zeros((count, count))  # of one N/sqrt(s), in variances of the means
        known = slice(0, time_s.size)
        walk[known, known] = np.minimum.outer(since_s, since_s) / np.outer(std_n, std_n)
        free = np.linalg.qr(j, mode="complete")[0][:, unknowns:]
        each, turned = np.linalg.eigh(free.T @ walk @ free)
        squares = (turned.T @ (free.T @ self.residuals(solution.x))) ** 2
        dof = max(1, squares.size)

        def cost(square: float) -> tuple[float, float]:
            of = 1 + square * np.maximum(each, 0.0)
            level = max(1.0, float((squares / of).sum()) / dof)
            return float(np.log(level * of).sum() + (squares / of).sum() / level), level

        inverse, (still, _) = solution.inverse, cost(0.0)
        tried = np.geomspace(1e-6, 1e6, WALKS) / max(float(each.max(initial=0.0)), 1e-300)
        square = min(tried, key=lambda square: cost(square)[0])
        least, level = cost(square)
        if still - least < SHOWN_WALK:
            level = max(1.0, solution.chi_square / max(1, means.time_s.size - unknowns))
            return level * inverse @ inverse.T, 0.0
        noise = level * (np.eye(count) + square * walk)
        return inverse @ noise @ inverse.T, float(np.sqrt(level * square))

    def moved_by_slower(self, solution: SeriesSolution, time_s: float) -> float:
        """By how much a term more, of that time constant, may move ln Einf: as it fits, and its deviation."""
        n, x, added = solution.terms, solution.x, 1e-3 * self._scale_pa
        more = np.insert(x, [1 + n, 1 + 2 * n], np.log([added, time_s]))
        base, inverse = self.residuals(x), solution.inverse
        by_modulus = (self.residuals(more) - base) / added
        own = by_modulus - solution.jacobian @ (inverse @ by_modulus)
        square = float(own @ own)
        level = max(1.0, solution.chi_square / max(1, self.means.time_s.size - x.size))
        modulus = np.hypot(own @ base / square, np.sqrt(level / square))
        return float(modulus * (inverse @ by_modulus)[0])

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(residuals, unknowns), by differences of one batch."""
        steps = np.full(x.size, STEP)
        steps[-3] = STEP_M
        sets = np.concatenate([x[None], x + np.diag(steps)[:-2]])
        forces = self.course(sets)[0]
        base = self._weighted(x, forces[0])
        columns = [
            (self._weighted(one, force) - base) / step
            for one, force, step in zip(sets[1:], forces[1:], steps[:-2], strict=True)
        ]
        for which in (-2, -1):  # in these the residuals are linear
            moved = x.copy()
            moved[which] += 1.0
            columns.append(self._weighted(moved, forces[0]) - base)
        return np.stack(columns, axis=1)


def _nodes(means: Means) -> tuple[FloatArray, FloatArray, IntArray]:
    """Times and depths of the nodes, dense where the robot moves, and the place of each mean."""
    time, depth = means.time_s, means.depth_m
    most = depth.max() / 40
    parts = np.maximum(1, np.ceil(np.abs(np.diff(depth)) / most)).astype(int)
    at = np.concatenate([[0], np.cumsum(parts)])
    dense = np.interp(np.arange(at[-1] + 1), at, time)
    return dense, np.interp(dense, time, depth), at
