# SPDX-License-Identifier: Apache-2.0
"""Poles and transient together, from all bins of the band of a whole record.

The DFT of P periods from any initial state is exactly ``Y = (B U + C) / A`` on every bin, excited
or not: the transient is a numerator C over the denominator of the system. Estimating C costs two
parameters a mode where removing the transient beforehand costs a quarter of the information
(Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
sections 6.3.2 and 9.12). The bins between harmonics bring the level of the noise on both channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy import special

from tactile_resonance.frf.band_bins import BandBins
from tactile_resonance.identification.basis import PolynomialBasis
from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.covariance import invert_normal, modes_in_band
from tactile_resonance.identification.dense import refit_failed
from tactile_resonance.identification.joint_noise import (
    BINS_PER_BAND,
    NoiseBands,
    noise_between_harmonics,
)
from tactile_resonance.identification.joint_transient import (
    default_transient_terms,
    transient_basis,
)
from tactile_resonance.identification.judgement import (
    MODEL_ERROR_PROBABILITY,
    Evidence,
    assemble,
    difference_of_halves,
    single,
)
from tactile_resonance.identification.lines_fit import LinesFit
from tactile_resonance.identification.model import RationalModel, Variable
from tactile_resonance.identification.noise_level import f_quantile
from tactile_resonance.identification.result import Poles, PolesBatch
from tactile_resonance.identification.solver import Problem, minimise
from tactile_resonance.identification.structure import ModelStructure

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class JointPlan:
    """Everything of the joint estimator that does not depend on the samples.

    Parameters
    ----------
    sample_rate_hz : float
    samples_per_period : int
        N.
    periods : int
        P.
    harmonics : (F,) int or None
        Excited multiples of ``sample_rate_hz / samples_per_period``; those outside the band are
        ignored. None for an input that is not periodic: then all bins count as excited, and the
        input as free of noise.
    band_hz : (low, high)
    structure : ModelStructure, optional
        One mode and six residual terms when absent.
    transient_terms : int, optional
        Coefficients of the transient's numerator. When absent those of the model's own modes and of
        as many residual terms as suit the structure: the transients of modes outside the band are
        smooth over it, as their responses are.
    input_noise_ratio : float, optional
        Variance of the noise on a bin of U over that on a bin of Y. Needed for one period only:
        with several it is estimated.

    Attributes
    ----------
    excited_bins, other_bins : (K_e,), (K_o,) int
        Of the DFT of the whole record.
    bins : (K,) int
        All of the band, ascending.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.

    Examples
    --------
    >>> plan = JointPlan(50e3, 20000, 8, np.arange(4, 4001), (200.0, 300.0))
    >>> poles = plan(u, y)  # u, y: (..., 8, 20000)
    """

    sample_rate_hz: float
    samples_per_period: int
    periods: int
    harmonics: IntArray | None
    band_hz: tuple[float, float]
    structure: ModelStructure = field(default_factory=ModelStructure)
    transient_terms: int | None = None
    input_noise_ratio: float | None = None
    bins: IntArray = field(init=False)
    excited_bins: IntArray = field(init=False)
    other_bins: IntArray = field(init=False)
    problem: Problem = field(init=False)
    variable: Variable = field(init=False)
    denominator_basis: PolynomialBasis = field(init=False)
    numerator_basis: PolynomialBasis = field(init=False)
    numerator_on_others: ComplexArray = field(init=False, repr=False)
    noise_bands: NoiseBands = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._check()
        samples = self.samples_per_period * self.periods
        resolution = self.sample_rate_hz / samples
        first = max(1, int(np.ceil(self.band_hz[0] / resolution - 1e-9)))
        last = min((samples - 1) // 2, int(np.floor(self.band_hz[1] / resolution + 1e-9)))
        bins = np.arange(first, last + 1)
        excited = np.ones(bins.size, bool)
        if self.harmonics is not None:
            excited = np.isin(bins, np.asarray(self.harmonics) * self.periods)
        parameters = self.structure.parameters
        if excited.sum() <= self.structure.fewest_lines:
            raise ValueError(
                f"band_hz: {self.band_hz} holds {excited.sum()} excited lines, "
                f"{parameters} parameters need more than {self.structure.fewest_lines}"
            )
        if self.structure.delay:
            raise ValueError("structure: the joint estimator takes no delay")
        frequency_hz = np.asarray(bins * resolution, float)
        variable = Variable.for_lines(frequency_hz, self.structure)
        x = variable.of_frequency(frequency_hz)
        denominator = PolynomialBasis.on_lines(x, self.structure.order)
        numerator = PolynomialBasis.on_lines(x[excited], self.structure.numerator_order)
        terms = self.transient_terms
        if terms is None:
            terms = default_transient_terms(self.structure)
        transient = transient_basis(
            frequency_hz, terms, self.sample_rate_hz, self.band_hz, self.structure
        )
        groups = [BinGroup(denominator.values[excited], numerator.values, transient[excited])]
        if not excited.all():
            groups.insert(0, BinGroup(denominator.values[~excited], None, transient[~excited]))
        fields = {
            "transient_terms": terms,
            "bins": bins,
            "excited_bins": bins[excited],
            "other_bins": bins[~excited],
            "problem": Problem(tuple(groups)),
            "variable": variable,
            "denominator_basis": denominator,
            "numerator_basis": numerator,
            "numerator_on_others": numerator.at(x[~excited])[0],
            "noise_bands": NoiseBands.of(bins, excited),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def _check(self) -> None:
        for name in ("sample_rate_hz", "samples_per_period", "periods"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)}, expected above 0")
        low, high = self.band_hz
        if not 0 <= low < high:
            raise ValueError(f"band_hz: {self.band_hz}, expected 0 <= low < high")
        ratio = self.input_noise_ratio
        if ratio is not None and not ratio >= 0:
            raise ValueError(f"input_noise_ratio: {ratio}, expected 0 or above")
        if self.transient_terms is not None and self.transient_terms < 1:
            raise ValueError(f"transient_terms: {self.transient_terms}, expected at least 1")

    def __call__(self, u: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> PolesBatch:
        """Poles of records.

        Parameters
        ----------
        u, y : (..., P, N) float
            Actuator and sensor: P consecutive periods of N samples.

        Returns
        -------
        PolesBatch
            With the leading axes of the records.

        Raises
        ------
        ValueError
            If the shapes do not fit the plan.
        """
        return self.from_bins(*(self.transform(x, name) for x, name in ((u, "u"), (y, "y"))))

    def transform(self, samples: npt.NDArray[np.floating], name: str = "samples") -> ComplexArray:
        """(..., K) bins of the band of records (..., P, N), scaled by 1 / (P N)."""
        samples = np.asarray(samples)
        shape = (self.periods, self.samples_per_period)
        if samples.shape[-2:] != shape:
            raise ValueError(
                f"{name}: shape {samples.shape}, expected (..., {shape[0]}, {shape[1]})"
            )
        record = samples.reshape(*samples.shape[:-2], shape[0] * shape[1])
        spectrum = scipy.fft.rfft(record, axis=-1)[..., self.bins[0] : self.bins[-1] + 1]
        return np.asarray(spectrum / record.shape[-1], dtype=complex)

    def from_bins(self, u: ComplexArray, y: ComplexArray) -> PolesBatch:
        """Poles from the bins of the band of the DFT of whole records.

        Parameters
        ----------
        u, y : (..., K) complex
            At ``bins``.
        """
        for name, values in (("u", u), ("y", y)):
            if values.shape[-1:] != self.bins.shape:
                raise ValueError(
                    f"{name}: shape {values.shape}, expected (..., {self.bins.size}) bins"
                )
        shape = np.broadcast_shapes(u.shape[:-1], y.shape[:-1])
        flat_u, flat_y = (
            np.broadcast_to(v, (*shape, self.bins.size)).reshape(-1, self.bins.size) for v in (u, y)
        )
        chunk = self.problem.chunk
        parts = [
            self._chunk(flat_u[k : k + chunk], flat_y[k : k + chunk])
            for k in range(0, flat_u.shape[0], chunk)
        ]
        joined = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
        return self._result(joined, shape)

    def _with_noise(
        self, data: list[BinData], u_o: ComplexArray, rough: FloatArray
    ) -> tuple[list[BinData], FloatArray, npt.NDArray]:
        """Data with the noise that the bins between harmonics show, its variances, its kind."""
        problem, others = self.problem, data[0]
        inverse_a, _, model, _ = problem.model(problem.groups[0], others, rough)
        g = problem.split(rough)[1] @ self.numerator_on_others.T * inverse_a
        noise = noise_between_harmonics(
            others.y - model, u_o, g, self.noise_bands, problem.sizes[2]
        )
        excited = BinData(
            data[1].y,
            data[1].u,
            noise.on(self.noise_bands.of_excited, noise.variance_y),
            noise.on(self.noise_bands.of_excited, noise.variance_u),
            noise.covariance_yu,
        )
        y_o = others.y if noise.through_input is None else others.y - noise.through_input
        other = BinData(y_o, None, noise.on(self.noise_bands.of_others, noise.variance_rest))
        return [other, excited], noise.mean_variances, noise.kind

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def _chunk(self, u: ComplexArray, y: ComplexArray) -> dict[str, npt.NDArray]:
        """Fit of a few points: coefficients and what the statistics need, by name."""
        batch = u.shape[0]
        usable = np.asarray(np.isfinite(u).all(axis=-1) & np.isfinite(y).all(axis=-1))
        if not usable.all():
            u, y = (np.where(usable[:, None], v, 0) for v in (u, y))
        where = self.excited_bins - self.bins[0]
        u_e, y_e = np.take(u, where, axis=1), np.take(y, where, axis=1)
        one = np.ones((batch, 1))
        kind = np.full(batch, "flat", "U8")
        problem = self.problem
        if self.other_bins.size == 0:
            ratio = self.input_noise_ratio or 0.0
            data = [BinData(y_e, u_e, one, ratio * one if ratio else None, None)]
            solution = minimise(problem, data)
            solution = refit_failed(problem, solution, data)
            inverse, condition = invert_normal(solution.normal.sum(axis=1))
            level_dof = np.full(batch, where.size - sum(problem.sizes) / 2)
            level = solution.cost / level_dof
            scale = level
            cost = expected = np.full(batch, np.nan)
            suspect = np.zeros(batch, bool)
            noise = np.stack([level, ratio * level], axis=-1)
        else:
            others = self.other_bins - self.bins[0]
            u_o, y_o = np.take(u, others, axis=1), np.take(y, others, axis=1)
            data = [BinData(y_o, None, one), BinData(y_e, u_e, one)]
            rough = problem.rough(data)
            data, noise, kind = self._with_noise(data, u_o, rough)
            solution = minimise(problem, data, rough)
            solution = refit_failed(problem, solution, data)
            n = solution.theta.shape[-1]
            inverse, condition = invert_normal(solution.normal.sum(axis=1))
            used = np.einsum("bij,bji->b", inverse, solution.normal[:, 0])  # leverage of the others
            dof_o = others.size - used / 2
            dof_e = where.size - (n - used) / 2
            level = solution.group_cost[:, 0] / dof_o
            cost = solution.group_cost[:, 1] / level
            expected = dof_e * dof_o / (dof_o - 1)
            limit = dof_e * f_quantile(1 - MODEL_ERROR_PROBABILITY, 2 * dof_e, 2 * dof_o)
            pieces = kind == "per line"
            if pieces.any():
                # weights from few bins: moments of F(2, 2 nu), as in `VarianceModel.cost_quantile`
                mean = BINS_PER_BAND / (BINS_PER_BAND - 1)
                std = mean * np.sqrt(BINS_PER_BAND / (BINS_PER_BAND - 2))
                quantile = special.ndtri(1 - MODEL_ERROR_PROBABILITY)
                expected = np.where(pieces, expected * mean, expected)
                limit = np.where(pieces, dof_e * mean + np.sqrt(dof_e) * std * quantile, limit)
            suspect = cost > limit
            pooled = solution.group_cost.sum(axis=-1) / (dof_e + dof_o)
            scale = np.where(suspect, level, pooled)
            noise = noise * level[:, None]
        places = self.structure.order // 2
        halves = np.zeros((batch, places, 2, 2))
        if suspect.any():
            halves[suspect] = self._difference_of_halves(data, solution.theta, suspect)
        return {
            "halves": halves,
            "theta": solution.theta,
            "inverse": inverse,
            "condition": condition,
            "converged": solution.converged,
            "scale": scale,
            "cost": cost,
            "expected": expected,
            "suspect": suspect,
            "usable": usable,
            "noise": noise,
            "kind": kind,
            "residual": self._residual(data[-1], solution.theta) / np.sqrt(scale)[:, None],
        }

    def _difference_of_halves(
        self, data: list[BinData], theta: FloatArray, rows: npt.NDArray[np.bool_]
    ) -> FloatArray:
        """(rows, places, 2, 2) as `judgement.difference_of_halves`, of the excited bins."""
        other, excited = (values.rows(rows) for values in data)
        poles = []
        for parity in (0, 1):
            left_out = np.arange(excited.y.shape[1]) % 2 == parity
            half = replace(excited, variance_y=np.where(left_out, np.inf, excited.variance_y))
            found = minimise(self.problem, [other, half], theta[rows]).theta
            roots = self.denominator_basis.roots(self.problem.split(found)[0])
            poles.append(modes_in_band(self.variable.to_s(roots)[0], self.band_hz))
        return difference_of_halves(*poles)

    def _residual(self, excited: BinData, theta: FloatArray) -> ComplexArray:
        """(batch, K_e) weighted residuals on the excited bins."""
        with np.errstate(all="ignore"):
            _, _, y, g = self.problem.model(self.problem.groups[-1], excited, theta)
            return (excited.y - y) / np.sqrt(excited.residual_variance(g))

    def _result(self, parts: dict[str, npt.NDArray], shape: tuple[int, ...]) -> PolesBatch:
        a, b, _ = self.problem.sizes
        theta = parts["theta"]
        batch = theta.shape[0]
        model = RationalModel(
            denominator=np.concatenate([theta[:, :a], np.ones((batch, 1))], axis=1),
            numerator=theta[:, a : a + b],
            transient=theta[:, a + b :],
            variable=self.variable,
            denominator_basis=self.denominator_basis,
            numerator_basis=self.numerator_basis,
        )
        # real and imaginary part of a circular complex error have half its variance each
        covariance = 0.5 * parts["inverse"] * parts["scale"][:, None, None]
        fit = LinesFit(
            model, parts["cost"], covariance, parts["condition"], parts["converged"],
            parts["residual"],
        )  # fmt: skip
        known = self.other_bins.size > 0 or self.input_noise_ratio is not None
        unknown = np.full_like(covariance, np.nan)
        evidence = Evidence(
            fit,
            np.where(parts["usable"], self.excited_bins.size, 0),
            parts["usable"],
            parts["cost"],
            parts["expected"],
            parts["suspect"],
            covariance if known else unknown,
            unknown if known else covariance,
            parts["kind"],
            known,
            parts["noise"],
        )
        if evidence.suspect.any():
            evidence = evidence.with_model_error(covariance)
        method = "joint maximum likelihood of poles and transient"
        result = assemble(evidence, self.structure, self.band_hz, shape, method)
        if evidence.suspect.any():
            total = result.total_covariance
            total += parts["halves"].reshape(total.shape)
        return result


def identify_poles_from_records(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    *,
    sample_rate_hz: float,
    harmonics: IntArray | None,
    band_hz: tuple[float, float],
    structure: ModelStructure | None = None,
    input_noise_ratio: float | None = None,
) -> Poles:
    """Poles from the samples of one record; many want a `JointPlan`, which this makes every time.

    Parameters
    ----------
    u, y : (P, N) float
        Actuator and sensor: P consecutive periods of N samples, from any initial state.
    sample_rate_hz, harmonics, band_hz, structure, input_noise_ratio
        See `JointPlan`.

    Returns
    -------
    Poles
        Always with a status; raised is only what `JointPlan` raises.
    """
    if np.ndim(u) != 2:
        raise ValueError(f"u: shape {np.shape(u)}, expected (P, N)")
    plan = JointPlan(
        sample_rate_hz,
        np.shape(u)[1],
        np.shape(u)[0],
        harmonics,
        band_hz,
        structure or ModelStructure(),
        input_noise_ratio=input_noise_ratio,
    )
    return single(plan(u, y))


def identify_poles_from_bins(
    bins: BandBins,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
    *,
    input_noise_ratio: float | None = None,
    notes: Sequence[str] = (),
) -> Poles:
    """Poles from the bins that a stream of periods keeps; plans of the latest kinds are kept.

    Parameters
    ----------
    bins : BandBins
    band_hz : (low, high), optional
        Within that of the bins, which is taken when absent.
    structure, input_noise_ratio
        See `JointPlan`.
    notes : sequence of str
        Added to the message.

    Raises
    ------
    ValueError
        If the bins do not cover the band, or as `JointPlan`.
    """
    if band_hz is None:
        band_hz = bins.band_hz
    plan = _plan(
        bins.sample_rate_hz,
        bins.samples_per_period,
        bins.periods,
        np.ascontiguousarray(bins.harmonics, np.int64).tobytes(),
        (float(band_hz[0]), float(band_hz[1])),
        structure or ModelStructure(),
        input_noise_ratio,
    )
    first = plan.bins[0] - bins.first_bin
    if first < 0 or first + plan.bins.size > bins.u.size:
        raise ValueError(
            f"band_hz: {band_hz}, the bins cover {bins.band_hz[0]:g} to {bins.band_hz[1]:g} Hz"
        )
    here = slice(first, first + plan.bins.size)
    return single(plan.from_bins(bins.u[here], bins.y[here]), notes=notes)


@lru_cache(maxsize=32)
def _plan(
    sample_rate_hz: float,
    samples_per_period: int,
    periods: int,
    harmonics: bytes,
    band_hz: tuple[float, float],
    structure: ModelStructure,
    input_noise_ratio: float | None,
) -> JointPlan:
    return JointPlan(
        sample_rate_hz,
        samples_per_period,
        periods,
        np.frombuffer(harmonics, np.int64),
        band_hz,
        structure,
        input_noise_ratio=input_noise_ratio,
    )
