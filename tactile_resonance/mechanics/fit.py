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
each constant to the series with one term more, and of Einf what a term so slow that the hold does not show it
may hide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.special import fdtrc

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require
from tactile_resonance.mechanics.course import (
    SeriesProblem,
    SeriesSolution,
    layer_share,
    sphere_share,
)
from tactile_resonance.mechanics.indentation import IndentationRecord, Prony, means_of

MOST_TERMS = 4
SHOWN, SURE = 2.5, 2.0
"""A hold of `SHOWN` time constants of a term shows it, by `SURE` deviations: in less, one term passes for two.
A term with a time constant of `SHOWN` holds may hide in Einf."""
LARGEST_STD = 0.3
"""Relative deviation beyond which a constant is not determined."""
SIGNIFICANT = 0.05
"""Of the F test by which a term more counts."""
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
    covariance : (2 n + 1, 2 n + 1) array
        From noise alone, of the logarithms of Einf, E_1.., tau_1..; in the order of `terms`.
    beyond : Prony or None
        The series with one term more; None where it was not found.
    chi_square, dof : float, int
        Of the means, by the noise of the forces: expected chi_square / dof is 1. Where it is more the
        covariance is larger by that, or by a walk of the force (`SeriesProblem.covariance`).
    bic : tuple of float
        Of one term, two and so on, for comparison: the number of terms is that of an F test, at 5 %.
    ramp_s, hold_s : float
    peak_force_n, relaxed_share : float
        Largest force, and the share of it that is gone at the end of the hold, by the model without noise.
    time_s, force_n, indentation_m : (N,) arrays
        The model at the means: time from the touch, force less its zero, and depth of the ball.
    measured_n : (N,) array
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
    covariance: FloatArray
    beyond: Prony | None
    chi_square: float
    dof: int
    bic: tuple[float, ...]
    ramp_s: float
    hold_s: float
    peak_force_n: float
    relaxed_share: float
    time_s: FloatArray
    force_n: FloatArray
    indentation_m: FloatArray
    measured_n: FloatArray
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
        If the record has no contact, or goes back before its end, or no series fits, or best without a contact.
    """
    check_options(most_terms, thickness_m)
    means = means_of(test)
    problem = SeriesProblem(test, means)
    solved: list[SeriesSolution] = []
    for terms in range(1, most_terms + 2):  # one more: how far the constants move then
        found = problem.solve(terms, solved[-1] if solved else None)
        if found is None:
            break
        solved.append(found)
        if len(solved) > 2 and _enough(solved[-3:], means.time_s.size) == 0:
            break
    require(bool(solved), "test", test.label, "a record that a Prony series fits")
    chosen = _enough(solved[:most_terms], means.time_s.size)
    further = solved[chosen + 1] if chosen + 1 < len(solved) else None
    return _result(problem, solved[chosen], further, solved[:most_terms], thickness_m)


def check_options(most_terms: int, thickness_m: float) -> None:
    """Raise ``ValueError`` where `fit_indentation` does not take these."""
    require(most_terms in range(1, 7), "most_terms", most_terms, "1 to 6")
    good = math.isnan(thickness_m) or 0 < thickness_m < math.inf
    require(good, "thickness_m", thickness_m, "a number above 0")


def _enough(solved: list[SeriesSolution], count: int) -> int:
    """The fewest terms on which no more terms improve significantly, by an F test."""

    def chance(fewer: SeriesSolution, more: SeriesSolution) -> float:
        added, free = 2 * (more.terms - fewer.terms), count - more.x.size
        gain = max((fewer.chi_square - more.chi_square) / added, 0.0)
        return float(fdtrc(added, free, gain * free / more.chi_square))

    return next(
        i
        for i, fewer in enumerate(solved)
        if all(chance(fewer, more) > SIGNIFICANT for more in solved[i + 1 :])
    )


def _result(
    problem: SeriesProblem,
    best: SeriesSolution,
    further: SeriesSolution | None,
    tried: list[SeriesSolution],
    thickness_m: float,
) -> Fit:
    """Fit of the solution chosen; `further` has one term more."""
    means, ball, n = problem.means, problem.ball, best.terms
    force, ball_m = problem.course(best.x[None])
    peak, held = float(force[0].max()), float(force[0, means.turn])
    require(peak > 0, "force_n", "forces that fit best without a contact", "those of tissue that stays")
    count = means.time_s.size
    dof = max(1, count - best.x.size)
    covariance, walk_n_per_sqrt_s = problem.covariance(best)
    std = np.sqrt(np.diag(covariance))
    beyond = None
    if further is not None:
        std = np.hypot(std, _moved(best, further))
        einf, *rest = np.exp(further.x[: 2 * further.terms + 1])
        beyond = Prony(float(einf), *np.split(np.array(rest), 2))
    values = np.exp(best.x[: 2 * n + 1])
    hold_s = max(means.hold_s, means.ramp_s)
    std[0] = np.hypot(std[0], problem.moved_by_slower(best, SHOWN * hold_s))
    terms = []
    for j in range(n):
        modulus, time = values[1 + j], values[1 + n + j]
        stds = std[1 + j], std[1 + n + j]
        known = _known(time, *stds, means.ramp_s, hold_s)
        terms.append(Term(float(modulus), float(time), float(stds[0]), float(stds[1]), known))
    equilibrium = Known.DETERMINED if std[0] <= LARGEST_STD else Known.UNCERTAIN
    if any(
        t.known is Known.SLOWER or (t.known is Known.UNCERTAIN and t.time_s > hold_s / 4)
        for t in terms
    ):
        equilibrium = Known.SLOWER
    surface, zero, drift = best.x[-3:]
    measured = means.force_n - zero - drift * (means.time_s - means.begin_s)
    deepest = float(ball_m[0, : means.turn + 1].max())
    sphere = sphere_share(ball, deepest)
    layer = np.nan if np.isnan(thickness_m) else layer_share(ball, deepest, thickness_m)
    ratio = float(np.sqrt(deepest / ball.radius_m))
    return Fit(
        terms=tuple(terms),
        equilibrium_pa=float(values[0]),
        equilibrium_std=float(std[0]),
        equilibrium_known=equilibrium,
        surface_m=float(surface),
        surface_std_m=float(std[-3]),
        covariance=covariance[: 2 * n + 1, : 2 * n + 1],
        beyond=beyond,
        chi_square=best.chi_square,
        dof=dof,
        bic=tuple(
            count * np.log(s.chi_square / count) + 2 * s.terms * np.log(count) for s in tried
        ),
        ramp_s=means.ramp_s,
        hold_s=means.hold_s,
        peak_force_n=peak,
        relaxed_share=1 - held / peak,
        time_s=means.time_s - means.begin_s,
        force_n=force[0],
        indentation_m=ball_m[0],
        measured_n=measured,
        contact_ratio=ratio,
        sphere_share=sphere,
        layer_share=layer,
        status=_status(
            best.chi_square / dof, walk_n_per_sqrt_s * math.sqrt(hold_s), ratio, sphere, layer, problem
        ),
    )


def _known(
    time_s: float, modulus_std: float, time_std: float, ramp_s: float, hold_s: float
) -> Known:
    middle_s = np.sqrt(ramp_s * hold_s)
    if time_s < middle_s and time_s * np.exp(-SURE * time_std) < ramp_s:
        return Known.FASTER
    if time_s >= middle_s and SURE * time_std > np.log(hold_s / SHOWN / time_s):
        return Known.SLOWER
    return Known.UNCERTAIN if max(modulus_std, time_std) > LARGEST_STD else Known.DETERMINED


def _moved(best: SeriesSolution, further: SeriesSolution) -> FloatArray:
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
    reduced: float,
    walked_n: float,
    ratio: float,
    sphere: float,
    layer: float,
    problem: SeriesProblem,
) -> tuple[str, ...]:
    said = []
    if not problem.knows_zero:
        said.append("no force in air: its zero is taken as exact, and deviations leave it out")
    if not problem.shows_drift:
        said.append(
            "the record does not begin and end in air: its force is taken not to drift, and deviations leave "
            "a drift out"
        )
    if reduced > 2:
        said.append(f"the series leaves {np.sqrt(reduced):.1f} times the noise of the forces")
    if walked_n > 0:
        said.append(
            f"neighbouring means are off alike, as if the zero walked by {1e3 * walked_n:.2g} mN in the hold: "
            "deviations hold that"
        )
    if np.isnan(sphere):
        said.append(f"a/R {ratio:.2f}: deeper than the ball's radius, where no model here holds")
    elif not abs(sphere - 1) < HERTZ_OFF:
        said.append(f"a/R {ratio:.2f}: a sphere's force is {sphere:.2f} times that of Hertz")
    if not np.isnan(layer) and layer - 1 > LAYER_OFF:
        said.append(f"thin: a layer's force is {layer:.2f} times that of Hertz")
    return tuple(said)
