# SPDX-License-Identifier: Apache-2.0
"""What the joint estimator of poles and transient makes of a band before any sample is there."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from numbers import Integral, Real

import numpy as np
import numpy.typing as npt

from tactile_resonance.poles.basis import PolynomialBasis
from tactile_resonance.poles.bins import Problem
from tactile_resonance.poles.covariance import modes_in_band
from tactile_resonance.poles.joint_noise import NoiseBands
from tactile_resonance.poles.joint_transient import (
    default_transient_terms,
    transient_basis,
)
from tactile_resonance.poles.lacking import Directions
from tactile_resonance.poles.model import RationalModel, Variable
from tactile_resonance.poles.model_error import richer
from tactile_resonance.poles.structure import ModelStructure

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class JointLayout:
    """Bins, bases and groups of the joint estimator: what does not depend on the samples.

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
    left_out : tuple of int
        Bins that are neither: those of tones (`tones`).

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
    """

    sample_rate_hz: float
    samples_per_period: int
    periods: int
    harmonics: IntArray | None
    band_hz: tuple[float, float]
    structure: ModelStructure = field(default_factory=ModelStructure)
    transient_terms: int | None = None
    input_noise_ratio: float | None = None
    left_out: tuple[int, ...] = ()
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
            excited = np.isin(bins, whole_harmonics(self.harmonics) * self.periods)
        kept = ~np.isin(bins, self.left_out)
        others = self._between(bins, excited) & kept
        excited &= kept
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
        order = np.append(np.flatnonzero(others), np.flatnonzero(excited))
        problem = Problem(denominator.values[order], numerator.values, transient[order])
        fields = {
            "transient_terms": terms,
            "bins": bins,
            "excited_bins": bins[excited],
            "other_bins": bins[others],
            "problem": problem,
            "variable": variable,
            "denominator_basis": denominator,
            "numerator_basis": numerator,
            "numerator_on_others": numerator.at(x[others])[0],
            "noise_bands": NoiseBands.of(bins[others], bins[excited]),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @cached_property
    def order(self) -> IntArray:
        """Places of the bins of `problem` among all: the others first, then the excited ones."""
        return np.append(self.others_at, self.excited_at)

    @cached_property
    def excited_at(self) -> IntArray:
        """(K_e,) place of the excited bins among all."""
        return self.excited_bins - self.bins[0]

    @cached_property
    def others_at(self) -> IntArray:
        """(K_o,) place of the other bins among all."""
        return self.other_bins - self.bins[0]

    @property
    def level_known(self) -> bool:
        """Whether the noise of one record is told by more than the residuals."""
        return self.other_bins.size > 0 or self.input_noise_ratio is not None

    @cached_property
    def richer(self) -> JointLayout | None:
        """With one mode more; None where the band holds too few lines for it."""
        try:
            return JointLayout(
                self.sample_rate_hz,
                self.samples_per_period,
                self.periods,
                self.harmonics,
                self.band_hz,
                richer(self.structure),
                input_noise_ratio=self.input_noise_ratio,
                left_out=self.left_out,
            )
        except ValueError:
            return None

    @property
    def resolution_hz(self) -> float:
        """Spacing of the bins: one over the duration of the record."""
        return self.sample_rate_hz / (self.samples_per_period * self.periods)

    def frequency_hz(self, bins: IntArray) -> FloatArray:
        """Of bins."""
        return np.asarray(bins * self.resolution_hz, float)

    @cached_property
    def directions(self) -> Directions:
        """What a richer model has in addition, on the excited bins."""
        frequency_hz = self.frequency_hz(self.excited_bins)
        x = self.variable.of_frequency(frequency_hz)
        return Directions.on_lines(frequency_hz, x, self.structure.numerator_order)

    @cached_property
    def driven_bases(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Bases of A, B and C on the excited bins."""
        problem = self.problem
        of_a, of_c = (
            np.ascontiguousarray(basis[problem.undriven :])
            for basis in (problem.denominator, problem.transient)
        )
        return of_a, np.ascontiguousarray(problem.numerator), of_c

    def model_of(self, theta: FloatArray) -> RationalModel:
        """The model of coefficients (batch, n)."""
        a, b, _ = self.problem.sizes
        return RationalModel(
            denominator=np.concatenate([theta[:, :a], np.ones((theta.shape[0], 1))], axis=1),
            numerator=theta[:, a : a + b],
            transient=theta[:, a + b :],
            variable=self.variable,
            denominator_basis=self.denominator_basis,
            numerator_basis=self.numerator_basis,
        )

    def poles_in_band(self, theta: FloatArray) -> ComplexArray:
        """(batch, places) poles [rad/s] of coefficients (batch, n)."""
        roots = self.denominator_basis.roots(self.problem.split(theta)[0])
        return modes_in_band(self.variable.to_s(roots)[0], self.band_hz)

    def _between(self, bins: IntArray, excited: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """(K,) which bins show transient and noise alone."""
        return ~excited

    def _check(self) -> None:
        for name, least in (("samples_per_period", 1), ("periods", 1), ("transient_terms", 1)):
            value = getattr(self, name)
            if name == "transient_terms" and value is None:
                continue
            if not (isinstance(value, Integral) and int(value) >= least):
                raise ValueError(f"{name}: {value!r}, expected a whole number, at least {least}")
        rate_hz = _number(self.sample_rate_hz)
        if not 0 < rate_hz < np.inf:
            raise ValueError(f"sample_rate_hz: {self.sample_rate_hz!r}, expected above 0, finite")
        try:
            low, high = (_number(edge) for edge in self.band_hz)
        except (TypeError, ValueError):
            low = high = np.nan
        if not 0 <= low < high <= rate_hz / 2 * (1 + 1e-9):
            raise ValueError(
                f"band_hz: {self.band_hz!r}, expected (low, high) with 0 <= low < high <= "
                f"{rate_hz / 2:g} Hz, half the sample rate"
            )
        if not isinstance(self.structure, ModelStructure):
            raise ValueError(f"structure: {self.structure!r}, expected a ModelStructure")
        if self.structure.domain == "z" and self.structure.sample_rate_hz != rate_hz:
            raise ValueError(
                f"structure.sample_rate_hz: {self.structure.sample_rate_hz:g}, expected that of "
                f"the record, {rate_hz:g} Hz"
            )
        ratio = self.input_noise_ratio
        if ratio is not None and not 0 <= _number(ratio) < np.inf:
            raise ValueError(f"input_noise_ratio: {ratio!r}, expected 0 or above, finite")


def _number(value: object) -> float:
    """NaN where it is none."""
    return float(value) if isinstance(value, Real) else float("nan")


def whole_harmonics(harmonics: npt.ArrayLike) -> IntArray:
    """(F,) int.

    Raises
    ------
    ValueError
        If they are no whole numbers.
    """
    values = np.asarray(harmonics).ravel()
    if values.size == 0:
        return values.astype(np.int64)
    whole = values.dtype.kind in "iu"
    if values.dtype.kind == "f":
        whole = bool(np.isfinite(values).all() and (values % 1 == 0).all())
    if not whole:
        raise ValueError(
            f"harmonics: {values[:5].tolist()}... of type {values.dtype}, expected whole multiples "
            "of the sample rate over the samples per period"
        )
    return values.astype(np.int64)
