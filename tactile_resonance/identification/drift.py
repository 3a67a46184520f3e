# SPDX-License-Identifier: Apache-2.0
"""Poles that change over the periods of a record: a test, and poles with their drift.

A mode ``x' = p(t) x + r u`` whose pole moves by ``d t`` answers a line ``U exp(s t)`` with its own answer,
``r U exp(s t) / (s - p)``, times one and, to second order in d,

    d (t / (s - p) - 1 / (s - p)^2) + d^2 (t^2 / (s - p)^2 - 3 t / (s - p)^3 + 3 / (s - p)^4)

for t exp(s t) through H(s) is ``(t H + dH/ds) exp(s t)``. The powers of t spread each line over the bins
around it, where a constant mode has nothing. Time counts from the middle of the record; the free decay,
at its start, has the pole of that instant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.covariance import f0_damping_covariance, real_covariance
from tactile_resonance.identification.joint import JointPlan
from tactile_resonance.identification.joint_fit import ROUNDED
from tactile_resonance.identification.joint_noise import rough_noise
from tactile_resonance.identification.joint_weights import noise_of, weighted
from tactile_resonance.identification.result import (
    Poles,
    PolesBatch,
    PolesStatus,
    natural_frequency_and_damping_jacobian,
)
from tactile_resonance.identification.single_point import single

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

# How often a constant mode is found to change.
FALSE_ALARM = 2e-5
# Refits of the other coefficients, and the change of the drift, in deviations, that is the last one.
MOST_RETURNS = 12
SAME_DRIFT = 0.02
# Share of the drift itself that is as good as none, for records next to without noise.
SAME_SHARE = 1e-4
GAIN_TOO = (
    "the gain changes over the record as well, as where contact is lost: the drift is no property of "
    "the mode"
)
USABLE = (PolesStatus.OK, PolesStatus.MODEL_ERROR)


@dataclass(frozen=True, eq=False)
class _Step:
    """Drift beside the other coefficients, linearised at a fit.

    Attributes
    ----------
    step : (2 m,) float
        To the drift that fits best.
    inverse : (2 m, 2 m) float
        Of the normal matrix of the drift, without what the coefficients can do.
    coefficients : (n, 2 m) float
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
        """(2 m, 2 m) of the drift."""
        return np.asarray(self.inverse * self.level * self.dof / (self.dof - 1) / 2)

    def chance(self, drift: FloatArray) -> float:
        """Of a drift as large where there is none: an F test."""
        return self._chance(float(drift @ np.linalg.solve(self.inverse, drift)), drift.size)

    @property
    def chance_of_last(self) -> float:
        """As `chance`, of the last one beside all others."""
        return self._chance(float(self.step[-1] ** 2 / self.inverse[-1, -1]), 1)

    def _chance(self, fall: float, count: int) -> float:
        rest = self.level * self.dof
        return float(special.betainc(self.dof, count / 2, rest / (rest + fall)))


@dataclass(frozen=True, eq=False)
class DriftingModes:
    """What drifting poles add to Y on the bins of the band, to second order in the drift.

    Parameters
    ----------
    plan : JointPlan
    fit : PolesBatch
        Of one point, shape ().
    u : (K,) complex
        Input on the bins; lines outside of the band are left out.
    """

    plan: JointPlan
    fit: PolesBatch
    u: ComplexArray

    @cached_property
    def theta(self) -> FloatArray:
        """(n,) coefficients."""
        model = self.fit.fit
        return np.concatenate([model.denominator[:-1], model.numerator, model.transient])

    @cached_property
    def directions(self) -> ComplexArray:
        """(2 m, K) of a drift of 1 rad/s^2 of the real and of the imaginary part of each pole."""
        columns = []
        for pole, residue in self._modes:
            for d in (1.0, 1j):
                about_t = _pair(self._s, pole, d * residue, 2)
                constant = _pair(self._s, pole, -d * residue, 3)
                first = _pair(self._s, pole, d, 1) * self._decay
                columns.append(self._spread(constant, about_t) + first)
        return np.array(columns)

    @cached_property
    def of_gain(self) -> ComplexArray:
        """(1, K) of a gain of the output that grows by 1/s."""
        g = self.fit.fit.response(self._s.imag / (2 * np.pi))
        return np.asarray(self._spread(np.zeros_like(g), g) + self._decay)[None]

    def added(self, drift: FloatArray) -> ComplexArray:
        """(K,) by a drift (2 m,) [rad/s^2], real and imaginary parts in turn."""
        y = np.asarray(drift @ self.directions)
        for (pole, residue), d in zip(self._modes, drift.view(complex), strict=True):
            parts = (
                _pair(self._s, pole, factor * d**2 * residue, power)
                for factor, power in ((3, 5), (-3, 4), (1, 3))
            )
            y = y + self._spread(*parts)
        return y

    @property
    def _modes(self) -> list[tuple[complex, complex]]:
        there = np.isfinite(self.fit.poles_rad_s)
        both = (self.fit.poles_rad_s[there], self.fit.residues[there])
        return list(zip(*(values.tolist() for values in both), strict=True))

    @cached_property
    def _s(self) -> ComplexArray:
        return np.asarray(2j * np.pi * self.plan.frequency_hz(self.plan.bins))

    @cached_property
    def _decay(self) -> ComplexArray:
        """(K,) the free decay times the time from the middle of the record to its start."""
        plan, theta = self.plan, self.theta
        a, b, _ = plan.problem.sizes
        alpha = np.append(theta[:a], 1.0)
        decay = np.zeros(self._s.size, complex)
        for group, where in zip(
            plan.problem.groups, (plan.others_at, plan.excited_at), strict=True
        ):
            free = np.asarray(group.transient) @ theta[a + b :]
            decay[where] = free / (group.denominator @ alpha)
        decay *= -plan.samples_per_period * plan.periods / plan.sample_rate_hz / 2
        return decay

    @cached_property
    def _powers(self) -> tuple[ComplexArray, ComplexArray]:
        """(K, K_e) transforms of t and of t^2 from the middle of the record: of lines, on the bins."""
        plan = self.plan
        size = plan.samples_per_period * plan.periods
        apart = plan.bins[:, None] - plan.bins[plan.excited_at]
        with np.errstate(divide="ignore", invalid="ignore"):
            w = np.expm1(-2j * np.pi * apart / size)
            t = np.where(apart == 0, 0, 1 / w)  # sums of geometric series
            t_2 = np.where(apart == 0, (size**2 - 1) / 12, 1 / w - 2 * (1 + w) / w**2)
        rate_hz = plan.sample_rate_hz
        return np.asarray(t / rate_hz, complex), np.asarray(t_2 / rate_hz**2, complex)

    def _spread(self, *responses: ComplexArray) -> ComplexArray:
        """(K,) Y of responses (K,) that grow with the powers 0, 1, 2 of time."""
        line = self.plan.excited_at
        y = np.zeros(self._s.size, complex)
        y[line] = responses[0][line] * self.u[line]
        for spread, response in zip(self._powers, responses[1:], strict=False):
            y += spread @ (response[line] * self.u[line])
        return y


def _pair(s: ComplexArray, pole: complex, factor: complex, power: int) -> ComplexArray:
    """(K,) ``factor / (s - pole)^power`` and its conjugate partner."""
    partner = np.conj(factor) / (s - np.conj(pole)) ** power
    return np.asarray(factor / (s - pole) ** power + partner)


def _linearised(
    plan: JointPlan,
    fit: PolesBatch,
    u: ComplexArray,
    y: ComplexArray,
    flat: bool,
    with_gain: bool = False,
) -> _Step:
    """The drift that bins u, y (K,) show beside a fit to them, or to y without some drift.

    With weights of flat noise, or of what noise a test finds: this takes a drift for noise. The drift of
    the gain, if asked for, is the last.
    """
    modes = DriftingModes(plan, fit, u)
    directions = modes.directions
    if with_gain:
        directions = np.concatenate([directions, modes.of_gain])
    theta = modes.theta
    u_o, u_e = u[None, plan.others_at], u[None, plan.excited_at]
    one = np.ones((1, 1))
    data = [
        BinData(y[None, plan.others_at], None, one),
        BinData(y[None, plan.excited_at], u_e, one),
    ]
    point = plan.problem.one_point(data)
    value = point.evaluate(theta)
    error = value.error_of(0)
    if flat:
        variance_y, variance_u = rough_noise(error, u_o)
        data = [replace(values, variance_y=variance_y) for values in data]
        data[1] = replace(data[1], variance_u=variance_u)
    else:
        noise = noise_of(plan, error, theta[None], u_o, plan.noise_bands)
        data = weighted(data, noise, plan.noise_bands)
    point = plan.problem.one_point(data)
    value = point.weight(point.evaluate(theta))
    gradient, normals = point.normals(value)
    own = point.jacobian(value)
    where = np.concatenate([plan.others_at, plan.excited_at])
    more = np.ascontiguousarray(-directions[:, where] * value.root).view(float)
    inverse = np.linalg.inv(normals.sum(axis=0))
    crossed = own @ more.T  # (n, 2 m)
    coefficients = inverse @ crossed
    left = np.linalg.inv(more @ more.T - crossed.T @ coefficients)
    score = more @ value.weighted.view(float) - coefficients.T @ gradient
    step = -left @ score
    count = len(step)
    dof = plan.bins.size - (theta.size + count) / 2
    fall = min(float(-score @ step) / value.cost, 1.0)
    level = value.cost * (1 - fall) / dof
    return _Step(step, left, coefficients, level, dof)


def poles_with_drift(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, fit: PolesBatch
) -> tuple[Poles, float] | None:
    """Poles in the middle of a record and their drift, where it shows that they change.

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
    tuple of Poles and float, or None
        With the variance of the noise that is left on a bin of Y. None where nothing changes beyond chance.
        Status MODEL_ERROR where something changes that is no
        steady drift of the poles: the gain too, as where contact is lost, or no fit with drift is found.

    Notes
    -----
    Gauss-Newton steps of the drift, each followed by a fit of all else to the record without it.
    """
    first: _Step | None = None
    constant, drift = fit, np.zeros(0)
    with np.errstate(all="ignore"):
        if not fit.noise_variance[0] > ROUNDED * np.mean(np.abs(y) ** 2):
            return None  # what rounding leaves of exact data says nothing
        for _ in range(MOST_RETURNS):
            if fit.status() not in USABLE or not np.isfinite(fit.poles_rad_s).any():
                break
            rest = y if first is None else y - DriftingModes(plan, fit, u).added(drift)
            try:
                at = _linearised(plan, fit, u, rest, flat=first is None)
            except np.linalg.LinAlgError:
                break
            if first is None:
                if not at.chance(at.step) < FALSE_ALARM:
                    return None
                first, drift = at, np.zeros(at.step.size)
            if drift.size != at.step.size or not np.isfinite(at.step).all():
                break
            drift = drift + at.step
            least = np.maximum(
                SAME_DRIFT * np.sqrt(np.diagonal(at.covariance)), SAME_SHARE * np.abs(drift)
            )
            if np.all(np.abs(at.step) < least):
                if not at.chance(drift) < FALSE_ALARM:
                    break
                rest = y - DriftingModes(plan, fit, u).added(drift)
                gain = _linearised(plan, fit, u, rest, flat=False, with_gain=True)
                poles = _result(plan, fit, at, drift)
                if not gain.chance_of_last > FALSE_ALARM:
                    poles = _changed(poles, GAIN_TOO)
                return poles, float(fit.noise_variance[0])
            fit = plan.from_bins(u, y - DriftingModes(plan, fit, u).added(drift))
    if first is None:
        return None
    reason = "the mode changes over the record, and no fit with its drift is found"
    return _changed(single(constant), reason), float(constant.noise_variance[0])


def _changed(poles: Poles, reason: str) -> Poles:
    """Poles of a record that changes as no model here does."""
    total = poles.covariance if poles.total_covariance is None else poles.total_covariance
    message = "; ".join(filter(None, [poles.message, reason]))
    return replace(poles, status=PolesStatus.MODEL_ERROR, total_covariance=total, message=message)


def _result(plan: JointPlan, fit: PolesBatch, at: _Step, drift: FloatArray) -> Poles:
    """`Poles` of a fit to a record without its drift (2 m,), which is not known better than it is."""
    covariance = at.covariance
    added = at.coefficients @ covariance @ at.coefficients.T
    pole = fit.poles_rad_s
    sensitivity = fit.fit.residues_and_sensitivity(pole)[1]
    more = real_covariance(sensitivity, added)
    in_f0 = f0_damping_covariance(pole, more)
    fit = replace(
        fit,
        coefficient_covariance=fit.coefficient_covariance + added,
        pole_covariance=fit.pole_covariance + more,
        covariance=fit.covariance + in_f0,
        total_covariance=fit.total_covariance + in_f0,
    )
    there = np.flatnonzero(np.isfinite(pole))
    jacobian = natural_frequency_and_damping_jacobian(pole[there])
    rates = (jacobian @ drift.reshape(-1, 2, 1))[..., 0]
    blocks = np.stack([covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(there.size)])
    of_rates = jacobian @ blocks @ np.swapaxes(jacobian, -1, -2)
    real = fit.significant[there]
    middle_s = (plan.samples_per_period * plan.periods - 1) / plan.sample_rate_hz / 2
    poles = single(fit)
    deviations = np.sqrt(np.diagonal(of_rates, axis1=-2, axis2=-1))
    told = [
        f"the mode at {f0:.4g} Hz changes: f0 by {rate[0]:.3g} +- {std[0]:.2g} Hz/s, damping ratio by "
        f"{rate[1]:.2g} +- {std[1]:.2g} 1/s; poles are those {middle_s:.3g} s after the start"
        for f0, rate, std in zip(poles.f0_hz, rates[real], deviations[real], strict=True)
        if np.any(np.abs(rate) > 3 * std)
    ]
    return replace(
        poles,
        f0_drift_hz_per_s=rates[real, 0],
        damping_drift_per_s=rates[real, 1],
        drift_covariance=of_rates[real],
        instant_s=middle_s,
        message="; ".join(filter(None, [poles.message, *told])),
    )
