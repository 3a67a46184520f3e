# SPDX-License-Identifier: Apache-2.0
"""Least squares of a Prony series to one record: starts, steps, and what is known beforehand.

The model is that of `course` over the recorded way of the robot, ramp and all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, nnls

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.mechanics.course import course_of
from tactile_resonance.mechanics.indentation import IndentationRecord, Means

FAST = 1 / 8
"""Time constant of what stands for all faster terms, over the duration of the ramp."""
INSERTED, STARTS, MOST_STEPS = 10, 3, 60
"""Times at which a further term is tried; so many starts are followed, each so far."""
STEP, STEP_M = 1e-5, 1e-8
"""Of the logarithms and of the place of the surface, for derivatives."""


@dataclass(frozen=True)
class SeriesSolution:
    """Logarithms of constants, surface, zero and its drift that fit best."""

    terms: int
    x: FloatArray
    jacobian: FloatArray
    chi_square: float

    @property
    def covariance(self) -> FloatArray:
        """(unknowns, unknowns) from noise alone."""
        scale = np.linalg.norm(self.jacobian, axis=0)
        scale[scale == 0] = 1.0
        inverse = np.linalg.pinv(self.jacobian / scale, rcond=1e-10)
        return inverse @ inverse.T / np.outer(scale, scale)


class SeriesProblem:
    """Least squares of one record.

    Unknowns: ln Einf, ln E_j, ln tau_j, modulus of the fast term over a scale, surface [m], zero [N],
    drift [N/s].

    Attributes
    ----------
    ball : BallTip
    means : Means
        Of the record.
    shows_drift : bool
        Whether it begins and ends in air.
    """

    def __init__(self, test: IndentationRecord, means: Means) -> None:
        self.ball, self.means, self._test = test.ball, means, test
        self._time, self._depth, self._at = _nodes(means)
        c, most, peak = self.ball.factor, self._depth.max(), means.force_n.max()
        if np.isfinite(self.ball.stiffness_n_per_m):
            most = max(0.05 * most, most - peak / self.ball.stiffness_n_per_m)
        self._scale_pa = peak / (c * most**1.5)
        self._small_pa = 1e-2 * self._scale_pa
        self._tried_s = means.ramp_s / 15, 2 * means.hold_s
        free = means.free_time_s
        self._shows_zero = bool((free < means.begin_s).any())
        self.shows_drift = self._shows_zero and bool((free > means.end_s).any())

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

    def shortened(self, longer: SeriesSolution, known: SeriesSolution) -> SeriesSolution:
        """Best of a solution and of those from one with a term more, two made one or one left out."""
        n, x = longer.terms, longer.x
        moduli, times = x[1 : 1 + n], x[1 + n : 1 + 2 * n]
        j, least = int(np.argmin(np.diff(times))), int(np.argmin(moduli))
        both = np.logaddexp(moduli[j], moduli[j + 1])
        share = np.exp(moduli[j] - both)
        merged = np.delete(moduli, j), np.delete(times, j)
        merged[0][j], merged[1][j] = both, share * times[j] + (1 - share) * times[j + 1]
        left = np.delete(moduli, least), np.delete(times, least)
        starts = [np.concatenate([x[:1], *one, x[-4:]]) for one in (merged, left)]
        found = [solution for s in starts if (solution := self._from(n - 1, s)) is not None]
        return min([known, *found], key=lambda solution: solution.chi_square)

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
            priors.append(drift * means.end_s / 1e-9)
        return np.concatenate(
            [
                (means.force_n - zero - drift * at - force) / means.std_n,
                (means.free_force_n - zero - drift * free) / means.free_std_n,
                priors,
            ]
        )

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
