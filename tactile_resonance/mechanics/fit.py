# SPDX-License-Identifier: Apache-2.0
"""Prony series of tissue from a test with a ball: estimates, their covariance, and what the record determines.

The model is that of `course` over the recorded way of the robot, ramp and all; unknown are Einf, E_j and
tau_j, the place of the surface and the zero of the force with its drift. It is fitted to the forces by
weighted least squares in the logarithms of the constants, for one term (the standard linear solid), two
terms and so on; the number of terms is the least on which more do not improve by an F test.

A term acts on the record only between the duration of the ramp and that of the hold: of faster ones the
ramp shows one number, of slower ones the hold shows a part. All faster terms together are fitted as one of
an eighth of the ramp, and slower ones as they come, for the others would be biased without them; they are
declared `not determined`. What is left to chance in the number of terms is in the deviations: the step of
each constant to the series with one term more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls
from scipy.special import fdtrc

from tactile_resonance.fields import require
from tactile_resonance.mechanics.course import course_of, layer_share, sphere_share
from tactile_resonance.mechanics.indentation import IndentationRecord, Means, means_of
from tactile_resonance.mechanics.prony import Prony

FloatArray = NDArray[np.float64]

MOST_TERMS = 4
FAST = 1 / 8
"""Time constant of what stands for all faster terms, over the duration of the ramp."""
SHOWN, SURE = 2.5, 2.0
"""A hold shows a term where it lasts so many of its time constants: with less, one term passes for two. By so
many deviations."""
LARGEST_STD = 0.3
"""Relative deviation beyond which a constant is not determined."""
SIGNIFICANT = 0.05
"""Of the F test by which a term more counts."""
INSERTED, STARTS, MOST_STEPS = 10, 3, 60
"""Times at which a further term is tried; so many starts are followed, each so far."""
STEP, STEP_M = 1e-5, 1e-8
"""Of the logarithms and of the place of the surface, for derivatives."""
HERTZ_OFF, LAYER_OFF = 0.05, 0.1
"""Of a sphere, and of a layer: share by which the force differs from Hertz's before the status says so."""


class Known(str, Enum):
    """Whether a record determines a constant, or why not."""

    DETERMINED = "determined"
    FASTER = "not determined: faster than the ramp"
    SLOWER = "not determined: slower than the hold"
    UNCERTAIN = "not determined: too uncertain"


@dataclass(frozen=True)
class Term:
    """One term of the series.

    Attributes
    ----------
    modulus_pa, time_s : float
    modulus_std, time_std : float
        Relative standard deviations, of the logarithms.
    known : Known
        Of both.
    """

    modulus_pa: float
    time_s: float
    modulus_std: float
    time_std: float
    known: Known


@dataclass(frozen=True, eq=False)
class Fit:
    """What a test says of the tissue.

    Attributes
    ----------
    terms : tuple of Term
        By time.
    equilibrium_pa, equilibrium_std : float
        Einf and its relative deviation.
    equilibrium_known : Known
    surface_m, surface_std_m : float
        Depth of the robot at which the ball touches.
    zero_n, zero_drift_n_per_s : float
        Of the force.
    covariance : (2 n + 1, 2 n + 1) array
        From noise alone, of the logarithms of Einf, E_1.., tau_1..; in the order of `terms`.
    beyond : Prony or None
        The series with one term more; None where it was not found.
    chi_square, dof : float, int
        Of the means, by the noise of the forces: expected chi_square / dof is 1. Where it is more the
        covariance is larger by that.
    bic : tuple of float
        Of one term, two and so on, for comparison: the number of terms is that of an F test, at 5 %.
    begin_s, ramp_s, hold_s : float
        First touch, and durations.
    peak_force_n, relaxed_share : float
        Largest force, and the share of it that is gone at the end of the hold, by the model without noise.
    time_s, force_n, indentation_m : (N,) arrays
        The model at the means: force less its zero, and depth of the ball.
    measured_n, measured_std_n : (N,) arrays
        The means, less the zero.
    contact_ratio : float
        Largest contact radius over that of the ball.
    sphere_share, layer_share : float
        What Hertz's force leaves out, as in `course`: a sphere's over a paraboloid's, a layer's over a
        half-space's (NaN: thickness unknown).
    status : tuple of str
        What limits the result, for people; empty: nothing.
    """

    terms: tuple[Term, ...]
    equilibrium_pa: float
    equilibrium_std: float
    equilibrium_known: Known
    surface_m: float
    surface_std_m: float
    zero_n: float
    zero_drift_n_per_s: float
    covariance: FloatArray
    beyond: Prony | None
    chi_square: float
    dof: int
    bic: tuple[float, ...]
    begin_s: float
    ramp_s: float
    hold_s: float
    peak_force_n: float
    relaxed_share: float
    time_s: FloatArray
    force_n: FloatArray
    indentation_m: FloatArray
    measured_n: FloatArray
    measured_std_n: FloatArray
    contact_ratio: float
    sphere_share: float
    layer_share: float
    status: tuple[str, ...]

    @property
    def prony(self) -> Prony:
        """The series, terms that are not determined included: for interpolation within the record."""
        moduli, times = zip(*((t.modulus_pa, t.time_s) for t in self.terms), strict=True)
        return Prony(self.equilibrium_pa, np.array(moduli), np.array(times))

    def modulus(self, time_s: float) -> tuple[float, float]:
        """E(t) [Pa] at one time after a step and its relative deviation; NaN outside of ramp and hold."""
        if not self.ramp_s <= time_s <= self.hold_s:
            return np.nan, np.nan
        series = self.prony
        value = float(series.relaxation_modulus(time_s))
        decays = np.exp(-time_s / series.times_s)
        slope = np.concatenate(
            [
                [series.equilibrium_pa],
                series.moduli_pa * decays,
                series.moduli_pa * decays * time_s / series.times_s,
            ]
        )
        std = float(np.sqrt(slope @ self.covariance @ slope)) / value
        moved = 0.0
        if self.beyond is not None:
            moved = float(np.log(self.beyond.relaxation_modulus(time_s) / value))
        return value, math.hypot(std, moved)


def fit_indentation(
    test: IndentationRecord, *, most_terms: int = MOST_TERMS, thickness_m: float = np.nan
) -> Fit:
    """Fit a Prony series to a test.

    Parameters
    ----------
    test : IndentationRecord
    most_terms : int
        1 (the standard linear solid) to 6.
    thickness_m : float
        Of the tissue on what is rigid, for the status; NaN: unknown.

    Raises
    ------
    ValueError
        If the record has no contact, or goes back before its end, or no series fits.
    """
    check_options(most_terms, thickness_m)
    means = means_of(test)
    problem = _Problem(test, means)
    solved: list[_Solution] = []
    for terms in range(1, most_terms + 2):  # one more: how far the constants move then
        found = problem.solve(terms, solved[-1] if solved else None)
        if found is None:
            break
        solved.append(found)
        if len(solved) > 2 and _enough(solved[-3:], means.time_s.size) == 0:
            break
    require(bool(solved), "test", test.label, "a record that a Prony series fits")
    for n in reversed(range(len(solved) - 1)):  # a series may show the way to a shorter one
        solved[n] = problem.shortened(solved[n + 1], solved[n])
    chosen = _enough(solved[:most_terms], means.time_s.size)
    further = solved[chosen + 1] if chosen + 1 < len(solved) else None
    return problem.result(solved[chosen], further, solved[:most_terms], thickness_m)


def check_options(most_terms: int, thickness_m: float) -> None:
    """Raise ``ValueError`` where `fit_indentation` does not take these."""
    require(most_terms in range(1, 7), "most_terms", most_terms, "1 to 6")
    good = math.isnan(thickness_m) or 0 < thickness_m < math.inf
    require(good, "thickness_m", thickness_m, "a number above 0")


def _enough(solved: list[_Solution], count: int) -> int:
    """The fewest terms on which no more terms improve significantly, by an F test."""
    for i, fewer in enumerate(solved):
        tests = [
            ((fewer.chi_square - more.chi_square) / (2 * (j - i)), more.chi_square, j)
            for j, more in enumerate(solved[i + 1 :], i + 1)
        ]
        left = [(gain, chi / (count - solved[j].x.size), 2 * (j - i)) for gain, chi, j in tests]
        if all(fdtrc(k, count, max(gain, 0.0) / rest) > SIGNIFICANT for gain, rest, k in left):
            return i
    raise AssertionError("the last one has none after it")


@dataclass(frozen=True)
class _Solution:
    """Logarithms of constants, surface, zero and its drift that fit best."""

    terms: int
    x: FloatArray
    jacobian: FloatArray
    chi_square: float

    @property
    def covariance(self) -> FloatArray:
        scale = np.linalg.norm(self.jacobian, axis=0)
        scale[scale == 0] = 1.0
        inverse = np.linalg.pinv(self.jacobian / scale, rcond=1e-10)
        return inverse @ inverse.T / np.outer(scale, scale)


class _Problem:
    """Least squares of one record.

    Unknowns: ln Einf, ln E_j, ln tau_j, modulus of the fast term over a scale, surface [m], zero [N],
    drift [N/s].
    """

    def __init__(self, test: IndentationRecord, means: Means) -> None:
        self._ball, self._means, self._test = test.ball, means, test
        self._nodes = _nodes(means)
        time, depth, at, turn = self._nodes
        self._at = at
        self._dense = time, depth, turn
        self._from_s = means.begin_s
        c, most = self._ball.factor, depth.max()
        peak = means.force_n.max()
        if np.isfinite(self._ball.stiffness_n_per_m):
            most = max(0.05 * most, most - peak / self._ball.stiffness_n_per_m)
        self._scale_pa = peak / (c * most**1.5)
        self._small_pa = 1e-2 * self._scale_pa
        self._tried_s = means.ramp_s / 15, 2 * means.hold_s
        free = means.free_time_s
        self._shows_drift = bool((free < means.begin_s).any() and (free > means.end_s).any())

    def solve(self, terms: int, fewer: _Solution | None) -> _Solution | None:
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

    def shortened(self, longer: _Solution, known: _Solution) -> _Solution:
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

    def _starts_after(self, fewer: _Solution) -> list[FloatArray]:
        """The solution with one term less, and a small term beside it, or one of its own cut in two."""
        n, x = fewer.terms, fewer.x
        moduli, times = x[1 : 1 + n], x[1 + n : 1 + 2 * n]
        made = [
            (np.append(moduli, np.log(self._small_pa)), np.append(times, time))
            for time in np.log(np.geomspace(*self._tried_s, INSERTED))
        ]
        for j in range(n):
            halves = np.insert(moduli - np.log(2) * (np.arange(n) == j), j, moduli[j] - np.log(2))
            made.append(
                (
                    halves,
                    np.insert(times + np.log(2) * (np.arange(n) == j), j, times[j] - np.log(2)),
                )
            )
        made.sort(key=lambda one: self._linear(np.exp(one[1]), x[-3])[1])
        return [np.concatenate([x[:1], *one, x[-4:]]) for one in made[:STARTS]]

    def _from(self, terms: int, x: FloatArray) -> _Solution | None:
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
        return _Solution(terms, done.x[place], done.jac[:, place], 2 * done.cost)

    def _linear(self, times_s: FloatArray, surface_m: float) -> tuple[FloatArray, float]:
        """Einf, E_j and that of the fast term, 0 or above, for given times, and their cost.

        The depth of the ball is that which follows from the measured force: they are a start.
        """
        means, kept = self._means, slice(0, self._means.turn + 1)
        ball_m = means.depth_m[kept] - surface_m
        if np.isfinite(self._ball.stiffness_n_per_m):
            ball_m = ball_m - means.force_n[kept] / self._ball.stiffness_n_per_m
            ball_m = np.maximum.accumulate(np.maximum(0.0, ball_m))
        rigid = replace(self._ball, stiffness_n_per_m=np.inf)
        times = np.append(times_s, FAST * means.ramp_s)
        each = np.eye(times.size + 1)  # one modulus at a time
        sets = each[:, 0], each[:, 1:], np.tile(times, (times.size + 1, 1))
        unit = course_of(rigid, means.time_s[kept], ball_m, means.turn, *sets).force_n
        weight = means.std_n[kept]
        return nnls((unit / weight).T, means.force_n[kept] / weight)

    def course(self, sets: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(P, N) forces and depths of the ball, at the means, of (P, unknowns)."""
        terms = (sets.shape[1] - 5) // 2
        time, depth, turn = self._dense
        values = np.exp(sets[:, : 2 * terms + 1])
        fast = np.full((len(sets), 1), FAST * self._means.ramp_s)
        found = course_of(
            self._ball,
            time,
            depth - sets[:, -3, None],
            turn,
            values[:, 0],
            np.hstack([values[:, 1 : terms + 1], self._scale_pa * sets[:, -4, None]]),
            np.hstack([values[:, terms + 1 :], fast]),
        )
        return found.force_n[:, self._at], found.indentation_m[:, self._at]

    def residuals(self, x: FloatArray) -> FloatArray:
        """Of contact, free time, and what is known of surface and zero beforehand."""
        return self._weighted(x, self.course(x[None])[0][0])

    def _weighted(self, x: FloatArray, force: FloatArray) -> FloatArray:
        means, test = self._means, self._test
        surface, zero, drift = x[-3:]
        at = means.time_s - self._from_s
        free = means.free_time_s - self._from_s
        priors = []
        if not np.isnan(test.depth_std_m):
            priors.append(surface / max(test.depth_std_m, 1e-9))
        shown = means.free_time_s
        before = bool((shown < means.begin_s).any())
        if not before:
            priors.append(zero / (max(test.force_std_n, 1e-9) if test.force_std_n >= 0 else 1e-9))
        if not self._shows_drift:
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

    def result(
        self,
        best: _Solution,
        further: _Solution | None,
        tried: list[_Solution],
        thickness_m: float,
    ) -> Fit:
        """Fit of the solution chosen; `further` has one term more."""
        means, n = self._means, best.terms
        count = means.time_s.size
        dof = max(1, count - best.x.size)
        more = max(1.0, best.chi_square / dof)
        covariance = more * best.covariance
        std = np.sqrt(np.diag(covariance))
        beyond = None
        if further is not None:
            std = np.hypot(std, _moved(best, further))
            beyond = _series(further)
        values = np.exp(best.x[: 2 * n + 1])
        hold_s = max(means.hold_s, means.ramp_s)
        terms = []
        for j in range(n):
            modulus, time = values[1 + j], values[1 + n + j]
            stds = std[1 + j], std[1 + n + j]
            known = _known(time, *stds, means.ramp_s, hold_s)
            terms.append(Term(float(modulus), float(time), float(stds[0]), float(stds[1]), known))
        slow = any(
            t.known is Known.SLOWER or (t.known is Known.UNCERTAIN and t.time_s > hold_s / 4)
            for t in terms
        )
        equilibrium = Known.DETERMINED
        if slow:
            equilibrium = Known.SLOWER
        elif std[0] > LARGEST_STD:
            equilibrium = Known.UNCERTAIN
        force, ball_m = self.course(best.x[None])
        surface, zero, drift = best.x[-3:]
        measured = means.force_n - zero - drift * (means.time_s - self._from_s)
        deepest = float(ball_m[0, : means.turn + 1].max())
        peak, held = float(force[0].max()), float(force[0, means.turn])
        ball = self._ball
        sphere = sphere_share(ball, deepest)
        layer = np.nan if np.isnan(thickness_m) else layer_share(ball, deepest, thickness_m)
        ratio = float(np.sqrt(deepest / ball.radius_m))
        return Fit(
            tuple(terms),
            float(values[0]),
            float(std[0]),
            equilibrium,
            float(surface),
            float(std[-3]),
            float(zero),
            float(drift),
            covariance[: 2 * n + 1, : 2 * n + 1],
            beyond,
            best.chi_square,
            dof,
            tuple(
                count * np.log(s.chi_square / count) + 2 * s.terms * np.log(count) for s in tried
            ),
            means.begin_s,
            means.ramp_s,
            means.hold_s,
            peak,
            1 - held / peak,
            means.time_s - self._from_s,
            force[0],
            ball_m[0],
            measured,
            means.std_n,
            ratio,
            sphere,
            layer,
            _status(best.chi_square / dof, ratio, sphere, layer, self._shows_drift),
        )


def _known(
    time_s: float, modulus_std: float, time_std: float, ramp_s: float, hold_s: float
) -> Known:
    middle_s = np.sqrt(ramp_s * hold_s)
    if time_s < middle_s and time_s * np.exp(-SURE * time_std) < ramp_s:
        return Known.FASTER
    if time_s >= middle_s and time_s * np.exp(SURE * time_std) > hold_s / SHOWN:
        return Known.SLOWER
    return Known.UNCERTAIN if max(modulus_std, time_std) > LARGEST_STD else Known.DETERMINED


def _series(solution: _Solution) -> Prony:
    values = np.exp(solution.x[: 2 * solution.terms + 1])
    return Prony(float(values[0]), *np.split(values[1:], 2))


def _moved(best: _Solution, further: _Solution) -> FloatArray:
    """By how much each unknown moves where one term more is fitted: to the nearest term, by time."""
    n, m = best.terms, further.terms
    moved = np.zeros(best.x.size)
    moved[0] = further.x[0] - best.x[0]
    moved[-4:] = further.x[-4:] - best.x[-4:]
    for j in range(n):
        at = int(np.argmin(np.abs(further.x[1 + m : 1 + 2 * m] - best.x[1 + n + j])))
        moved[1 + j] = further.x[1 + at] - best.x[1 + j]
        moved[1 + n + j] = further.x[1 + m + at] - best.x[1 + n + j]
    return moved


def _status(
    reduced: float, ratio: float, sphere: float, layer: float, shows_drift: bool
) -> tuple[str, ...]:
    said = []
    if not shows_drift:
        said.append(
            "the record does not begin and end in air: its force is taken not to drift, and deviations leave "
            "a drift out"
        )
    if reduced > 2:
        said.append(f"the series leaves {np.sqrt(reduced):.1f} times the noise of the forces")
    if np.isnan(sphere):
        said.append(f"a/R {ratio:.2f}: deeper than the ball's radius, where no model here holds")
    elif not abs(sphere - 1) < HERTZ_OFF:
        said.append(f"a/R {ratio:.2f}: a sphere's force is {sphere:.2f} times that of Hertz")
    if not np.isnan(layer) and layer - 1 > LAYER_OFF:
        said.append(f"thin: a layer's force is {layer:.2f} times that of Hertz")
    return tuple(said)


def _nodes(means: Means) -> tuple[FloatArray, FloatArray, NDArray[np.int64], int]:
    """Times and depths of the nodes, dense where the robot moves, the place of each mean, and the turn."""
    time, depth = means.time_s, means.depth_m
    most = depth.max() / 40
    parts = np.maximum(1, np.ceil(np.abs(np.diff(depth)) / most)).astype(int)
    at = np.concatenate([[0], np.cumsum(parts)])
    dense = np.interp(np.arange(at[-1] + 1), at, time)
    return dense, np.interp(dense, time, depth), at, int(at[means.turn])
