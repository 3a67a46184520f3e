# SPDX-License-Identifier: Apache-2.0
"""Poles and transient together, from all bins of the band of whole records: plans, made once per kind.

The DFT of P periods from any initial state is exactly ``Y = (B U + C) / A`` on every bin, excited
or not: the transient is a numerator C over the denominator of the system. Estimating C costs two
parameters a mode where removing the transient beforehand costs a quarter of the information
(Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
sections 6.3.2 and 9.12). The bins between harmonics bring the level of the noise on both channels.

Several realisations of the phases distinguish stochastic nonlinear distortion from noise, and from errors of
the model: the best linear approximation is what they have in common (ibid., chapter 4). Estimated are
one A and B and M numerators C of transients.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from numbers import Integral

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.fields import band, number, require, require_kind
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.poles.joint_fit import fit_records
from tactile_resonance.poles.judgement import assemble
from tactile_resonance.poles.model import PolynomialBasis
from tactile_resonance.poles.result import PolesBatch
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.poles.tables import FitPlan, Problem

# Beside those of the modes.
TERMS_OF_A_KNOCK = 4
# Part of a term of a further transient that the terms before do not have, from which it is one.
LEAST_NEW = 1e-3
METHOD = "joint maximum likelihood of poles and transient"


@dataclass(frozen=True, eq=False)
class JointPlan(FitPlan):
    """Poles from records of one kind, one a point: all that does not depend on the samples, made once.

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
    input_noise_ratio : float, optional
        Variance of the noise on a bin of U over that on a bin of Y. Needed for one period only:
        with several it is estimated.
    left_out : tuple of int
        Bins that are neither: those of tones (`tones`).
    knocks_s : tuple of float
        Instants [s] after the start from which on a further transient is fitted (`knocks`).

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.

    Examples
    --------
    >>> plan = JointPlan(50e3, 20000, 8, np.arange(4, 4001), (200.0, 300.0))
    >>> poles = plan(u, y)  # u, y: (..., 8, 20000)  # doctest: +SKIP
    """

    sample_rate_hz: float
    samples_per_period: int
    periods: int
    harmonics: IntArray | None
    band_hz: tuple[float, float]
    structure: ModelStructure = field(default_factory=ModelStructure)
    input_noise_ratio: float | None = None
    left_out: tuple[int, ...] = ()
    knocks_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("samples_per_period", "periods"):
            value = getattr(self, name)
            good = isinstance(value, Integral) and int(value) >= 1
            require(good, name, value, "a whole number, at least 1")
        rate_hz = number(self.sample_rate_hz, "sample_rate_hz")
        require(rate_hz > 0, "sample_rate_hz", rate_hz, "a number above 0")
        band(self.band_hz, most_hz=rate_hz / 2)
        require_kind(self.structure, "structure", ModelStructure)
        if self.structure.domain == "z":
            of_model = self.structure.sample_rate_hz
            accepted = f"that of the record, {rate_hz:g} Hz"
            require(of_model == rate_hz, "structure.sample_rate_hz", of_model, accepted)
        if self.input_noise_ratio is not None:
            ratio = number(self.input_noise_ratio, "input_noise_ratio")
            require(ratio >= 0, "input_noise_ratio", ratio, "a number, 0 or above")
        lines, fewest = self.excited_at.size, self.structure.fewest_lines
        if lines <= fewest:
            raise ValueError(
                f"band_hz: {self.band_hz} holds {lines} excited lines, "
                f"{self.structure.parameters} parameters need more than {fewest}"
            )
        if self.structure.delay:
            raise ValueError("structure: the joint estimator takes no delay")

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
        return self.from_bins(*self.transform(u, y))

    def transform(
        self, u: npt.NDArray[np.floating], y: npt.NDArray[np.floating]
    ) -> tuple[ComplexArray, ComplexArray]:
        """(..., K) bins of the band of records (..., P, N) of both channels, scaled by 1 / (P N)."""
        expected = (self.periods, self.samples_per_period)
        for name, samples in (("u", np.asarray(u)), ("y", np.asarray(y))):
            if samples.dtype.kind not in "iuf":
                raise ValueError(f"{name}: values of type {samples.dtype}, expected real numbers")
            if samples.shape[-2:] != expected:
                raise ValueError(
                    f"{name}: shape {samples.shape}, expected (..., {expected[0]}, {expected[1]})"
                )
        record = Spectrum.of(*np.broadcast_arrays(u, y))
        with np.errstate(invalid="ignore", over="ignore"):  # the status reports such samples
            here = record.bins[..., self.bins[0] : self.bins[-1] + 1]
        return here[..., 1, :], here[..., 0, :]

    def from_bins(self, u: ComplexArray, y: ComplexArray) -> PolesBatch:
        """Poles from the bins of the band of the DFT of whole records.

        Parameters
        ----------
        u, y : (..., K) complex
            At ``bins``.
        """
        u, y = self._checked(u, y)
        return self._poles(u[..., None, :], y[..., None, :], METHOD)

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def _poles(self, u: ComplexArray, y: ComplexArray, method: str) -> PolesBatch:
        *shape, records, size = y.shape
        u, y = (values.reshape(-1, records, size) for values in (u, y))
        return assemble(
            self,
            fit_records(self, u, y),
            tuple(shape),
            method,
            lambda plan, rows: fit_records(plan, u[rows], y[rows]).cost,
        )

    def _checked(self, u: ComplexArray, y: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Bins of both channels, of one shape (..., K)."""
        u, y = (np.asarray(values, complex) for values in (u, y))
        for name, values in (("u", u), ("y", y)):
            if values.shape[-1:] != self.bins.shape:
                raise ValueError(
                    f"{name}: shape {values.shape}, expected (..., {self.bins.size}) bins"
                )
        if u.shape == y.shape:
            return u, y
        try:
            shape = np.broadcast_shapes(u.shape, y.shape)
        except ValueError:
            raise ValueError(
                f"y: shape {y.shape}, expected leading axes like those of u, {u.shape}"
            ) from None
        return np.broadcast_to(u, shape), np.broadcast_to(y, shape)

    @cached_property
    def bins(self) -> IntArray:
        """(K,) all of the band, ascending, of the DFT of the whole record."""
        samples = self.samples_per_period * self.periods
        first = max(1, int(np.ceil(self.band_hz[0] / self.resolution_hz - 1e-9)))
        last = min((samples - 1) // 2, int(np.floor(self.band_hz[1] / self.resolution_hz + 1e-9)))
        return np.arange(first, last + 1)

    @cached_property
    def driven(self) -> BoolArray:
        """(K,) bins that are excited, left out or not."""
        if self.harmonics is None:
            return np.ones(self.bins.size, bool)
        return np.isin(self.bins, whole_harmonics(self.harmonics) * self.periods)

    @cached_property
    def _kept(self) -> BoolArray:
        return ~np.isin(self.bins, self.left_out)

    @cached_property
    def excited_at(self) -> IntArray:
        """(K_e,) places of the excited bins that are used among all."""
        return np.flatnonzero(self.driven & self._kept)

    @cached_property
    def others_at(self) -> IntArray:
        """(K_o,) places of the bins that show transient and noise alone."""
        return np.flatnonzero(self._between & self._kept)

    @cached_property
    def order(self) -> IntArray:
        """Places of the bins of `problem` among all: the others first, then the excited ones."""
        return np.append(self.others_at, self.excited_at)

    @cached_property
    def numerator_on_bins(self) -> ComplexArray:
        """(K, b) values of `numerator_basis` on all bins."""
        return self.numerator_basis.at(self.x, 0)[0]

    @cached_property
    def transient_on_bins(self) -> ComplexArray:
        """(K, c) basis of the transient's numerator on all bins.

        Samples of ``exp(p t)`` have the spectrum ``T / (1 - exp((p - s) T))``, aliases of ``1 / (s - p)``
        included: for n poles a polynomial of order n - 1 in 1/z over ``A(z)``, and ``A(s) / A(z)`` hardly
        depends on the poles. It is taken at pairs +-j w spread evenly over the band, one for each two poles,
        and at 0 for a last single one.
        """
        interval_s, order = 1 / self.sample_rate_hz, self.structure.order
        s = 2j * np.pi * self.frequency_hz
        terms = self.structure.transient_terms
        # a knock makes modes outside of the band ring too, and its instant is not known exactly
        most = max(terms, order + TERMS_OF_A_KNOCK)
        of_knock = PolynomialBasis.on_lines(np.exp(-s * interval_s), most - 1).values
        basis = of_knock[:, :terms]
        for instant_s in self.knocks_s:
            basis = np.append(basis, of_knock * np.exp(-s * instant_s)[:, None], axis=1)
            q, r = np.linalg.qr(np.ascontiguousarray(basis.T).view(float).T)
            new = np.abs(np.diagonal(r)) > LEAST_NEW * np.sqrt(len(basis))
            basis = np.ascontiguousarray(q.T[new]).view(complex).T * np.sqrt(len(basis))
        if self.structure.domain == "z":
            return basis * np.exp(s * interval_s * order)[:, None]
        pairs = order // 2
        low, high = self.band_hz
        w = 2 * np.pi * (low + (high - low) * (np.arange(pairs) + 0.5) / max(pairs, 1))
        factor = np.ones(s.shape, complex)
        for pole in (*(1j * w), *(-1j * w), *[0.0] * (order % 2)):
            step = (s - pole) * interval_s
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = -step / np.expm1(-step)
            factor *= np.where(np.abs(step) < 1e-12, 1.0, ratio)
        return basis * factor[:, None]

    @cached_property
    def problem(self) -> Problem:
        """What the fit is made of."""
        return Problem(
            self.denominator_basis.values[self.order],
            self.numerator_basis.values,
            self.transient_on_bins[self.order],
        )

    @property
    def level_known(self) -> bool:
        """Whether the noise of one record is known from more than the residuals."""
        return self.others_at.size > 0 or self.input_noise_ratio is not None

    def with_structure(self, structure: ModelStructure) -> JointPlan | None:
        """The plan of another structure; None where the band holds too few lines for it."""
        try:
            return replace(self, structure=structure)
        except ValueError:
            return None

    @property
    def resolution_hz(self) -> float:
        """Spacing of the bins: one over the duration of the record."""
        return self.sample_rate_hz / (self.samples_per_period * self.periods)

    @cached_property
    def frequency_hz(self) -> FloatArray:
        """(K,) of all bins."""
        return np.asarray(self.bins * self.resolution_hz, float)

    @property
    def _between(self) -> BoolArray:
        """(K,) which bins show transient and noise alone."""
        return ~self.driven


@dataclass(frozen=True, eq=False)
class PoleEstimator(JointPlan):
    """Poles from several records of one kind each; parameters are those of `JointPlan`.

    Of one period each there are no bins between harmonics: realisations then measure noise and
    distortion together, and `covariance` holds both. Input noise counts as none, or as
    `input_noise_ratio` of that of the output where given. `total_covariance` holds also what the
    poles of the realisations scatter by, see `levels.Spread`.

    Harmonics of the period that are not excited carry distortion and are not used. A single
    realisation cannot determine any of this, and is left to `JointPlan`.

    Examples
    --------
    Three points, each of two realisations of four periods: a resonance at 250, 251 and 252 Hz.

    >>> import numpy as np
    >>> u, y = np.empty((2, 3, 2, 4, 2000))  # (points, realisations, periods, samples per period)
    >>> s = 2j * np.pi * np.fft.rfftfreq(2000, 1 / 5e3)
    >>> for m in range(2):
    ...     multisine = tr.design_multisine(
    ...         sample_rate_hz=5e3, samples_per_period=2000, band_hz=(200.0, 300.0), realisation=m
    ...     )
    ...     u[:, m] = multisine.period()
    ...     for point, f0_hz in enumerate((250.0, 251.0, 252.0)):
    ...         w0 = 2 * np.pi * f0_hz
    ...         g = 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    ...         y[point, m] = np.fft.irfft(g * np.fft.rfft(multisine.period()))
    >>> y += 1e-3 * np.random.default_rng(0).standard_normal(y.shape)
    >>> plan = tr.PoleEstimator(5e3, 2000, 4, multisine.harmonics, (200.0, 300.0))
    >>> poles = plan(u, y)
    >>> poles.f0_hz.round(2)[:, 0].tolist()
    [250.0, 251.0, 252.0]
    """

    def from_bins(self, u: ComplexArray, y: ComplexArray) -> PolesBatch:
        """Poles from the bins of the band of the DFTs of whole records.

        Parameters
        ----------
        u, y : (..., M, K) complex
            At ``bins``, of M realisations.

        Returns
        -------
        PolesBatch
            With the leading axes but the last one. Its `fit` holds the coefficients of the M
            transients one after the other, its `coefficient_covariance` those of A and B alone.
        """
        u, y = self._checked(u, y)
        if y.ndim < 2:
            raise ValueError("u, y: one record, expected (..., M) records of M realisations")
        records = y.shape[-2]
        if records == 1:
            return self._single.from_bins(u[..., 0, :], y[..., 0, :])
        return self._poles(u, y, f"{METHOD}s, {records} realisations")

    @cached_property
    def _single(self) -> JointPlan:
        return JointPlan(*(getattr(self, f.name) for f in fields(self)))

    @property
    def _between(self) -> BoolArray:
        return np.asarray(~self.driven & (self.bins % self.periods != 0))


def whole_harmonics(harmonics: npt.ArrayLike) -> IntArray:
    """(F,) int.

    Raises
    ------
    ValueError
        If they are no whole numbers.
    """
    values = np.asarray(harmonics).ravel()
    if not (values.dtype.kind in "iuf" and np.isfinite(values).all() and (values % 1 == 0).all()):
        raise ValueError(
            f"harmonics: {values[:5].tolist()}... of type {values.dtype}, expected whole multiples "
            "of the sample rate over the samples per period"
        )
    return values.astype(np.int64)
