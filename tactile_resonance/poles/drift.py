# SPDX-License-Identifier: Apache-2.0
"""A mode that changes over the periods of a record: a test, and its mean poles with their drift.

A mode ``x' = (p + d(t)) x + r u`` answers with ``x0 + x1 + x2 ...``: x0 is what the constant pole p makes of
u, and each next term what it makes of d times the one before. The change d is a sum of Legendre polynomials
over the record, as many as the record asks for, since creep slows down. Their transforms, spherical Bessel
functions, spread each line over the bins around it, where a constant mode has nothing. They have no mean: p,
the mean pole over the record, is as well known as a constant one, where the pole of an instant is known the
less, the more polynomials there are. What decays from the start of the record has the pole of that instant,
and its slope there.

A mode that jumps, as where the tip slips, is found as well, and its mean is right; but it has that at no
instant. So one jump is tried in place of the polynomials, and is a model error where it explains more.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import scipy.fft
from numpy.polynomial import legendre
from scipy import special

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.data import BinData, follows_input, rough_noise, with_noise
from tactile_resonance.poles.fit import Linearised
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.joint_fit import noise_of_moving_modes
from tactile_resonance.poles.knocks import linearised_at, orthonormal
from tactile_resonance.poles.likelihood import moments
from tactile_resonance.poles.model import propagated
from tactile_resonance.poles.noise_level import ROUNDED
from tactile_resonance.poles.result import (
    Poles,
    PolesBatch,
    PolesStatus,
    natural_frequency_and_damping,
    natural_frequency_and_damping_jacobian,
    single,
)

# How often a constant mode is found to change.
FALSE_ALARM = 2e-5
# Of one that changes: how often one polynomial more is found than there are, and how many at most.
ONE_MORE = 1e-3
MOST_DEGREES = 6
# Terms x1, x2 ...
TERMS = 4
# Refits of the other coefficients, and the change of the drift, in deviations, that is the last one.
MOST_RETURNS = 12
SAME_DRIFT = 0.02
# Share of the drift itself that is as good as none, for records next to without noise.
SAME_SHARE = 1e-4
# Of the drift, what the changes of all else in the response move it by: .8 to 1.3 % on the simulated bench.
SHARE_OF_OTHERS = 0.01
# A contact, or a spring under a constant force, changes the residue by as much of itself as the pole; chance
# would pass a limit of 1.
MOST_OF_GAIN = 2.0
GAIN_TOO = (
    "the gain changes over the record as well, as where contact is lost or clocks differ: the drift is no "
    "property of the mode"
)
# Of what is not modelled of decays from the start of the record, in deviations of the noise: means were off by
# up to 1.6 of their deviations where less is left out, by 2 to 27 where more is.
MOST_LEFT_OUT = 8.0
TOO_NARROW = (
    "what decays from the start of the record changes faster than it decays: the mode is too narrow for such a "
    "drift, and its poles may be off by more than they state"
)
# Of the record until a jump, from which one is fitted; evaluations at most, and the last relative change.
SHARES = np.linspace(0.01, 0.99, 99)
MOST_EVALUATIONS = 300
LAST_CHANGE = 1e-4
# Logarithm of the likelihood by which one jump must explain more than the polynomials. Of 127 jumps the least
# was 16; of 1800 modes that creep or tremble one had more than this.
MORE_LIKELY = 10.0
# Of the record, from -1 to 1, among which that is found where the change is nearest to its mean.
TIMES = np.linspace(-1, 1, 2001)
USABLE = (PolesStatus.OK, PolesStatus.MODEL_ERROR)


@dataclass(frozen=True, eq=False)
class _Step:
    """Drift beside the other coefficients, linearised at a fit.

    Attributes
    ----------
    step : (c,) float
        To the drift that fits best.
    inverse : (c, c) float
        Of the normal matrix of the drift, without what the coefficients can do.
    coefficients : (n, c) float
        What the coefficients change by with the drift, with a minus.
    level, dof : float
        Of the noise, in units of the variances weighted with, and its complex degrees of freedom.
    """

    step: FloatArray
    inverse: FloatArray
    coefficients: FloatArray
    level: float
    dof: float

    @property
    def covariance(self) -> FloatArray:
        """(c, c) of the drift."""
        return np.asarray(self.inverse * self.level * self.dof / (self.dof - 1) / 2)

    def chance(self, drift: FloatArray, of: slice = slice(None)) -> float:
        """Probability that chance makes these values of the drift as large, beside all others: an F test."""
        values = drift.ravel()[of]
        fall = float(values @ np.linalg.solve(self.inverse[of, of], values))
        rest = self.level * self.dof
        return float(special.betainc(self.dof, values.size / 2, rest / (rest + fall)))


@dataclass(frozen=True, eq=False)
class Drifted:
    """Poles of a record that changes.

    Attributes
    ----------
    poles : Poles
    fit : PolesBatch
        To what is left of the record without its drift, shape ().
    rest : (K,) complex
        Bins of Y without it.
    """

    poles: Poles
    fit: PolesBatch
    rest: ComplexArray


@dataclass(frozen=True, eq=False)
class DriftingModes:
    """What modes whose poles change add to Y on the bins of the band.

    A drift has rows of a complex number for each mode: what the residue grows by of itself, steadily, then
    what the pole changes by [rad/s], with the polynomials of first, second ... degree. Each goes from -1 to 1
    over the record.

    Parameters
    ----------
    plan : JointPlan
    fit : PolesBatch
        Of one point, shape (), with m modes.
    u : (K,) complex
        Input on the bins; lines outside of the band are left out.
    """

    plan: JointPlan
    fit: PolesBatch
    u: ComplexArray

    @property
    def there(self) -> IntArray:
        """(m,) places of modes."""
        return np.flatnonzero(np.isfinite(self.fit.poles_rad_s))

    @cached_property
    def theta(self) -> FloatArray:
        """(n,) coefficients."""
        model = self.fit.fit
        return np.concatenate([model.denominator[:-1], model.numerator, model.transient])

    def directions(self, row: int) -> ComplexArray:
        """(2 m, K) of 1 in the real and in the imaginary part of one row of the drift of each mode."""
        columns = []
        times, start = self._times(max(row, 1)), (-1) ** row * self._decay
        for mode in self._modes:
            p, r = (np.array([[z], [z.conjugate()]]) for z in mode)
            driven = r * self._lines  # (2, K), of the pole above the real axis and the one below
            moved = self._spread(times, driven / (self._s - p) if row else driven)
            above, below = (moved + start * (row > 0)) / (self._s - p)
            columns += [above + below, 1j * (above - below)]
        return np.array(columns)

    def added(self, drift: FloatArray) -> ComplexArray:
        """(K,) by a drift (rows, m, 2), real and imaginary parts last."""
        changes = drift.view(complex)[..., 0]  # (rows, m)
        times = np.array([self._times(degree) for degree in range(1, len(changes))])
        y = np.zeros(self._s.size, complex)
        for (pole, residue), change in zip(self._modes, changes.T, strict=True):
            for p, r, d in (
                (pole, residue, change),
                (np.conj(pole), np.conj(residue), np.conj(change)),
            ):
                more = self._spread(d[0] * times[0], r * self._lines) / (self._s - p)
                x = r * self._lines / (self._s - p) + more
                moved, per_s = self._at_start(d)
                away = self._s - p - moved
                y += more + self._decay * (moved / away + (self._s - p) * per_s / away**3)
                for _ in range(TERMS):
                    x = self._spread(d[1:] @ times, x) / (self._s - p)
                    y += x
        return y

    def jumping(self, share: float, before: ComplexArray, after: ComplexArray) -> ComplexArray:
        """(K,) by poles `before` (m, 1) up to a share of the record, and `after` (m, 1) from there on.

        However far apart: each answers to the lines in its part, and the mode goes on from where it is.
        """
        s, per_s = self._s, self.plan.resolution_hz
        apart = np.append(np.arange(1, s.size), np.arange(1 - s.size, 0))
        turn, samples = -2j * np.pi * apart, self.plan.sample_rate_hz / per_s
        later = np.zeros(scipy.fft.next_fast_len(2 * s.size - 1), complex)
        later[0] = 1 - share
        later[apart] = np.expm1(share * turn) / -np.expm1(turn / samples) / samples
        pole, residue = np.array(self._modes).T[..., None]
        early, late = (residue * self._lines / (s - p) for p in (before, after))
        y = early - residue * self._lines / (s - pole)
        y += self._spread(scipy.fft.fft(later), late - early)
        beside = np.sum((early - late) * np.exp(s * share / per_s), axis=-1, keepdims=True)
        end = np.exp(after * (1 - share) / per_s)
        y += beside * per_s * (np.exp(-s * share / per_s) - end) / (s - after)
        y += self._decay * (before - pole) / (s - before)
        return np.asarray(y.sum(axis=0))

    def left_out(self, drift: FloatArray) -> float:
        """What `added` leaves out of the decays from the start, in deviations of the noise: their next term."""
        changes = drift.view(complex)[..., 0]  # (rows, m)
        y = np.zeros(self._s.size, complex)
        for (pole, _), change in zip(self._modes, changes.T, strict=True):
            moved, per_s = self._at_start(change)
            y += 3 * per_s**2 * self._decay * (self._s - pole) / (self._s - pole - moved) ** 5
        return float(np.linalg.norm(y) / np.sqrt(self.fit.noise_variance[0]))

    def _at_start(self, change: ComplexArray) -> tuple[complex, complex]:
        """What a pole is off its mean by at the start of the record [rad/s], and changes by there [rad/s^2]."""
        degrees = np.arange(1, len(change))
        sign = (-1.0) ** degrees
        slope = -sign * degrees * (degrees + 1) * self.plan.resolution_hz
        return complex(change[1:] @ sign), complex(change[1:] @ slope)

    @property
    def _modes(self) -> list[tuple[complex, complex]]:
        both = (self.fit.poles_rad_s[self.there], self.fit.residues[self.there])
        return list(zip(*(values.tolist() for values in both), strict=True))

    @cached_property
    def _s(self) -> ComplexArray:
        return np.asarray(2j * np.pi * self.plan.frequency_hz)

    @cached_property
    def _lines(self) -> ComplexArray:
        """(K,) the input without what is between its lines."""
        line = self.plan.excited_at
        lines = np.zeros(self._s.size, complex)
        lines[line] = self.u[line]
        return lines

    @cached_property
    def _decay(self) -> ComplexArray:
        """(K,) the free decay from the start of the record."""
        plan, theta, terms = self.plan, self.theta, self.plan.structure.transient_terms
        a, b, _ = plan.problem.sizes
        alpha = np.append(theta[:a], 1.0)
        decay = np.zeros(self._s.size, complex)
        problem = plan.problem
        numerator = problem.transient[:, :terms] @ theta[a + b : a + b + terms]
        decay[plan.order] = numerator / (problem.denominator @ alpha)
        return decay

    def _times(self, degree: int) -> ComplexArray:
        return _transform_of(degree, self.plan.samples_per_period * self.plan.periods, self.u.size)

    @staticmethod
    def _spread(times: ComplexArray, x: ComplexArray) -> ComplexArray:
        """(..., K) bins of signals with bins x (..., K) times a function of time."""
        return np.asarray(scipy.fft.ifft(times * scipy.fft.fft(x, times.size))[..., : x.shape[-1]])


@lru_cache(maxsize=64)
def _transform_of(degree: int, samples: int, bins: int) -> ComplexArray:
    """(L,) what `DriftingModes._spread` takes to multiply by a polynomial in time."""
    apart = np.arange(1 - bins, bins)
    # the sum over the samples is the integral to the square of apart / samples
    turn = (-1.0) ** apart * np.exp(1j * np.pi * apart / samples)
    transform = np.zeros(scipy.fft.next_fast_len(apart.size), complex)
    transform[apart] = turn * (-1j) ** degree * special.spherical_jn(degree, np.pi * apart)
    return np.asarray(scipy.fft.fft(transform))


def _linearised(
    modes: DriftingModes, y: ComplexArray, rows: Iterable[int], flat: bool = False
) -> _Step | None:
    """The drift that bins y (K,) show beside a fit to them, or to y without some drift.

    With weights of flat noise, or of what noise a test finds: this takes a drift for noise. None where the
    rows asked for cannot be distinguished.
    """
    plan, u, theta = modes.plan, modes.u, modes.theta
    directions = np.concatenate([modes.directions(row) for row in rows])
    others = plan.others_at.size
    data = BinData.of(y[None, None], u[None, None], plan.order, others)
    at, between = Linearised.of(plan.problem, data, theta), data.u[0][:, data.order[:others]]
    model = modes.fit.fit
    g = plan.numerator_on_bins @ model.numerator / (plan.denominator_basis.values @ model.denominator)
    if not flat or follows_input(at.error[:, :others], between, g[None, plan.others_at]).any():
        known, *_ = with_noise(plan, data, theta[None, None])
        # unless it is noise on both channels, what the input explains leaves its own noise, with the shape of
        # the mode as a drift
        flat &= known.covariance_yu.size > 0 or known.y is data.y
        if not flat:
            data = known  # what came through the input is no drift
            at = Linearised.of(plan.problem, data, theta)
    if flat:
        variance_y, variance_u = rough_noise(at.error[:, :others], between)
        data = data.weighted(rest=variance_y, variance_y=variance_y, variance_u=variance_u)
    costs, gradients, normals = moments(plan.problem.tables, data, theta[None, None])
    cost, gradient = float(costs.sum()), gradients[0, 0]
    variance = data.variance[0]
    variance[others:] = data.residual_variance(g[None, plan.excited_at])[0]
    root = 1 / np.sqrt(variance)
    own = np.ascontiguousarray(-(at.slope[0] * root[:, None]).T).view(float)  # (n, 2 K)
    residual = np.ascontiguousarray(at.error[0] * root).view(float)
    more = np.ascontiguousarray(-directions[:, plan.order] * root).view(float)
    crossed = own @ more.T  # (n, c)
    try:
        coefficients = np.linalg.inv(normals[0, 0].sum(axis=0)) @ crossed
        left = np.linalg.inv(more @ more.T - crossed.T @ coefficients)
    except np.linalg.LinAlgError:
        return None
    score = more @ residual - coefficients.T @ gradient
    step = -left @ score
    count = len(step)
    dof = plan.bins.size - (theta.size + count) / 2
    fall = min(float(-score @ step) / cost, 1.0)
    level = cost * (1 - fall) / dof
    return _Step(step, left, coefficients, level, dof)


def _converged(
    modes: DriftingModes, y: ComplexArray, drift: FloatArray
) -> tuple[DriftingModes, FloatArray, _Step] | None:
    """Modes fitted to a record without its drift (rows, m, 2), the drift, its last step; None: no end.

    Gauss-Newton steps of the drift, each followed by a fit of all else.
    """
    plan, u = modes.plan, modes.u
    for _ in range(MOST_RETURNS):
        at = _linearised(modes, y - modes.added(drift), range(len(drift)), flat=not drift.any())
        if at is None or not np.isfinite(at.step).all():
            return None
        drift = drift + at.step.reshape(drift.shape)
        least = np.maximum(
            SAME_DRIFT * np.sqrt(np.diagonal(at.covariance)), SAME_SHARE * np.abs(drift.ravel())
        )
        if np.all(np.abs(at.step) < least):
            return modes, drift, at
        modes = DriftingModes(plan, plan.from_bins(u, y - modes.added(drift)), u)
        if modes.fit.status() not in USABLE or modes.there.size != drift.shape[1]:
            return None
    return None


@np.errstate(all="ignore")
def _jump(modes: DriftingModes, y: ComplexArray, drift: FloatArray) -> tuple[str, ComplexArray]:
    """What jumps in bins y (K,), empty where the drift (rows, m, 2) explains more, and what that adds to them.

    Both beside all that the coefficients can do, and with the noise that is left with the drift.
    """
    plan, polynomials = modes.plan, modes.added(drift)
    at = linearised_at(plan, modes.u, y - polynomials, modes.fit)
    root = 1 / np.sqrt(at.variance)
    own = orthonormal((at.slope[0] * root[:, None]).T).view(float)
    mean = modes.fit.poles_rad_s[modes.there][:, None]

    def left(added: ComplexArray) -> FloatArray:
        error = ((at.error[0] + (polynomials - added)[plan.order]) * root).view(float)
        return np.asarray(error - (own @ error) @ own)

    def residual(values: FloatArray) -> FloatArray:
        return left(modes.jumping(values[0], *(mean + values[1:].view(complex).reshape(2, -1, 1))))

    change = np.cumsum(legendre.legval(TIMES, np.concatenate([0 * drift[:1], drift[1:]])), axis=-1)
    at_ends = change[..., np.round(SHARES * TIMES.size).astype(int)] / TIMES.size  # (m, 2, shares)
    parts = np.stack([at_ends / SHARES, -at_ends / (1 - SHARES)]).reshape(-1, SHARES.size)
    starts = np.ascontiguousarray(np.vstack([SHARES, parts]).T)
    start = min(starts, key=lambda values: float(np.sum(residual(values) ** 2)))
    most = {"xtol": LAST_CHANGE, "ftol": LAST_CHANGE, "max_nfev": MOST_EVALUATIONS}
    best = scipy.optimize.least_squares(residual, start, method="lm", x_scale="jac", **most)
    gain = plan.bins.size * np.log(np.sum(left(polynomials) ** 2) / (2 * best.cost))
    share, parts = best.x[0], mean + best.x[1:].view(complex).reshape(2, -1, 1)
    if not (gain > MORE_LIKELY and 0 < share < 1):
        return "", polynomials
    f0_hz, damping = (np.diff(values, axis=0)[0, :, 0] for values in natural_frequency_and_damping(parts))
    k, instant_s = int(np.argmax(np.abs(np.diff(parts, axis=0)))), share / plan.resolution_hz
    told = (
        f"the mode at {np.abs(mean[k, 0]) / (2 * np.pi):.4g} Hz jumps about {instant_s:.2g} s after the start "
        f"of the record, f0 by about {f0_hz[k]:.2g} Hz and the damping ratio by {damping[k]:.1g}: this is no "
        "drift, and poles are means of before and after"
    )
    return told, modes.jumping(share, *parts)


def poles_with_drift(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, fit: PolesBatch
) -> Drifted | None:
    """Mean poles over a record and their drift, where it shows that they change.

    Parameters
    ----------
    plan : JointPlan
        Of several periods.
    u, y : (K,) complex
        Bins of the record.
    fit : PolesBatch
        What the plan makes of them, shape ().

    Returns
    -------
    Drifted or None
        None where nothing changes beyond chance. Status MODEL_ERROR where something changes that is no drift of
        the poles: they jump, the gain changes too, as where contact is lost, or no fit with drift is found;
        then `rest` is y.
    """
    modes, found = DriftingModes(plan, fit, u), None
    with np.errstate(all="ignore"):
        if not fit.noise_variance[0] > ROUNDED * np.mean(np.abs(y) ** 2):
            return None  # what rounding leaves of exact data says nothing
        if fit.status() not in USABLE or not modes.there.size:
            return None
        at = _linearised(modes, y, [1], flat=True)
        if at is None or not at.chance(at.step) < FALSE_ALARM:
            return None
        none = np.zeros((1, modes.there.size, 2))
        drift = none
        while len(drift) <= MOST_DEGREES:
            more = _converged(modes, y, np.concatenate([drift, none]))
            if more is None:
                break
            found = modes, drift, _ = more
            rest = y - modes.added(drift)
            at = _linearised(modes, rest, range(len(drift) + 1))
            if at is None or not at.chance(at.step, slice(drift.size, None)) < ONE_MORE:
                break
    if found is not None:
        pole_rad_s = modes.fit.poles_rad_s[modes.there]
        gain, change = np.abs(drift.view(complex)[:2, :, 0])
        alone = np.any(gain > MOST_OF_GAIN * change / np.abs(pole_rad_s))
        alone &= found[2].chance(drift, slice(none.size)) < FALSE_ALARM
        if alone or found[2].chance(drift) < ONE_MORE:
            poles = _result(*found, y)
            jump, added = ("", modes.added(drift)) if alone else _jump(modes, y, drift)
            if alone:
                poles = _changed(poles, GAIN_TOO)
            elif jump:
                return Drifted(_changed(poles, jump), plan.from_bins(u, y - added), y - added)
            elif modes.left_out(drift) > MOST_LEFT_OUT:
                poles = _changed(poles, TOO_NARROW)
            return Drifted(poles, modes.fit, y - added)
    reason = "the mode changes over the record, or is disturbed in it, and no fit with a drift is found"
    return Drifted(_changed(single(fit), reason), fit, y)


def _changed(poles: Poles, reason: str) -> Poles:
    """Poles of a record that changes as no model here does."""
    total = poles.covariance if poles.total_covariance is None else poles.total_covariance
    changed = replace(poles, status=PolesStatus.MODEL_ERROR, total_covariance=total)
    return changed.noting(reason)


def _result(modes: DriftingModes, drift: FloatArray, at: _Step, y: ComplexArray) -> Poles:
    """`Poles` of a fit to a record y (K,) without its drift (rows, m, 2), which is not known better than it is.

    What the polynomials do not describe is noise at the mode, in all that is stated.
    """
    plan, fit, there = modes.plan, modes.fit, modes.there
    factor = noise_of_moving_modes(plan, modes.u, y - modes.added(drift), modes.theta)
    covariance = factor * at.covariance
    added = at.coefficients @ covariance @ at.coefficients.T
    pole = fit.poles_rad_s
    sensitivity = fit.fit.residues_and_sensitivity(pole)[1]
    more, in_f0 = (of[0] for of in propagated(pole[None], sensitivity[None], added[None]))
    fit = replace(
        fit,
        coefficient_covariance=factor * fit.coefficient_covariance + added,
        pole_covariance=factor * fit.pole_covariance + more,
        covariance=factor * fit.covariance + in_f0,
        total_covariance=fit.total_covariance + (factor - 1) * fit.covariance + in_f0,
    )
    samples = plan.samples_per_period * plan.periods
    # the first polynomial is the straight line nearest to the change
    jacobian = 2 * plan.resolution_hz * natural_frequency_and_damping_jacobian(pole[there])
    rates = (jacobian @ drift[1, :, :, None])[..., 0]
    first = 2 * (there.size + np.arange(there.size))
    blocks = np.stack([covariance[k : k + 2, k : k + 2] for k in first])
    blocks += SHARE_OF_OTHERS**2 * np.sum(drift[1] ** 2, axis=-1)[:, None, None] * np.eye(2)
    of_rates = jacobian @ blocks @ np.swapaxes(jacobian, -1, -2)
    real = fit.significant[there]
    change = legendre.legval(TIMES, np.concatenate([0 * drift[:1], drift[1:]]))  # (m, 2, times)
    nearest = TIMES[np.argmin(np.sum(change**2, axis=(0, 1)))]
    instant_s = float(((1 + nearest) * samples - 1) / plan.sample_rate_hz / 2)
    poles = single(fit)
    deviations = np.sqrt(np.diagonal(of_rates, axis1=-2, axis2=-1))
    told = [
        f"the mode at {f0:.4g} Hz changes: f0 by {rate[0]:.3g} +- {std[0]:.2g} Hz/s, damping ratio by "
        f"{rate[1]:.2g} +- {std[1]:.2g} 1/s; poles are means over the record, as about {instant_s:.3g} s "
        "after its start"
        for f0, rate, std in zip(poles.f0_hz, rates[real], deviations[real], strict=True)
        if np.any(np.abs(rate) > 3 * std)
    ]
    drifting = replace(
        poles,
        f0_drift_hz_per_s=rates[real, 0],
        damping_drift_per_s=rates[real, 1],
        drift_covariance=of_rates[real],
        instant_s=instant_s,
    )
    return drifting.noting(*told)
