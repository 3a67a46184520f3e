# SPDX-License-Identifier: Apache-2.0
"""Fast local polynomial method: transient-free mean spectra and their noise covariance.

The spectrum of P consecutive periods has P - 1 bins between harmonics. A periodic excitation
leaves them to noise and transient. Around each excited line a polynomial in the bin offset is
fitted to the nearest of them, extrapolated to the line and subtracted, for input and output alike;
the residuals of the fit give the 2 x 2 noise covariance. The neighbours lie alike around all lines
but those at the ends of the spectrum, so the fit is one constant real matrix times the bins around
all lines.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.neighbours import Neighbourhood, neighbourhoods
from tactile_resonance.frf.record_transform import PairSpectrum, PairTransform, Place
from tactile_resonance.frf.result import ComplexArray
from tactile_resonance.frf.spectra import IntArray, PeriodicSpectra, checked_harmonics


@dataclass(frozen=True, eq=False)
class LocalPolynomialPlan:
    """Everything of the fast local polynomial method that does not depend on the samples.

    Parameters
    ----------
    harmonics : (F,) int
        Lines wanted, ascending, from 1 to below half of `samples_per_period`. Only these are
        computed; other lines may well be excited.
    samples_per_period : int
        N.
    periods : int
        P, at least 2.
    order : int
        Order of the polynomial for the transient. 2 suits most; a mode of damping ratio 1 % at high
        signal-to-noise ratio wants 4.
    dof : int
        Degrees of freedom of the covariance, at least.

    Attributes
    ----------
    transform : PairTransform
        From records to the bins near harmonics.
    groups : tuple of Neighbourhood
        Lines by pattern of neighbouring bins.
    noise_dof : int
        Degrees of freedom of the covariance: the neighbours are the nearest
        ``2 ceil((dof + order + 1) / 2)`` bins between harmonics, less ``order + 1``.
    correlation_lines : int
        See `PeriodicSpectra`.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.

    Examples
    --------
    >>> plan = LocalPolynomialPlan(np.arange(4, 4001), samples_per_period=20000, periods=8)
    >>> result = plan(u, y)  # u, y: (8, 20000)

    Notes
    -----
    For P = 2 a single bin lies between harmonics and the neighbours spread over several of them:
    the transient must be smooth over that range.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 7; Pintelon, Barbe, Vandersteen & Schoukens, MSSP 25 (2011) 2683-2704.
    """

    harmonics: IntArray
    samples_per_period: int
    periods: int
    order: int = 2
    dof: int = 6
    transform: PairTransform = field(init=False)
    groups: tuple[Neighbourhood, ...] = field(init=False)
    noise_dof: int = field(init=False)
    correlation_lines: int = field(init=False)
    _places: tuple[tuple[tuple[Place, Place], ...], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        harmonics = checked_harmonics(self.harmonics, self.samples_per_period)
        if self.periods < 2:
            raise ValueError(
                f"periods: {self.periods}, expected at least 2: a single period has no bins "
                "between harmonics to tell noise and transient from"
            )
        if self.order < 0:
            raise ValueError(f"order: {self.order}, expected at least 0")
        if self.dof < 1:
            raise ValueError(f"dof: {self.dof}, expected at least 1")
        groups = neighbourhoods(
            harmonics,
            self.samples_per_period,
            self.periods,
            self.order,
            self.dof,
            scale=1 / (self.samples_per_period * self.periods),
        )
        transform = PairTransform(
            self.samples_per_period,
            self.periods,
            np.unique(np.concatenate([group.offsets for group in groups])),
        )
        places = tuple(transform.places(group.centre_bins, group.offsets) for group in groups)
        object.__setattr__(self, "harmonics", harmonics)
        object.__setattr__(self, "transform", transform)
        object.__setattr__(self, "_places", places)
        object.__setattr__(self, "groups", groups)
        object.__setattr__(self, "noise_dof", groups[0].projector.shape[0] - 1)
        object.__setattr__(self, "correlation_lines", _correlation_lines(harmonics, groups))

    def __call__(self, u: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> PeriodicSpectra:
        """Spectra of records.

        Parameters
        ----------
        u, y : (..., P, N) float
            Actuator and sensor, P consecutive periods of N samples from the first sample on. All is
            computed in double precision; float32 records need no copy for that.

        Raises
        ------
        ValueError
            If the shapes do not fit the plan or a sample is not finite.
        """
        return self.from_transform(self.transformed(u, y))

    def transformed(self, u: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> PairSpectrum:
        """First half of a call: `transform` of records (..., P, N); ValueError where none fits."""
        shape = (self.periods, self.samples_per_period)
        for name, x in (("u", u), ("y", y)):
            if np.shape(x)[-2:] != shape:
                raise ValueError(
                    f"{name}: shape {np.shape(x)}, expected (..., {shape[0]}, {shape[1]})"
                )
        return self.transform(np.asarray(y), np.asarray(u))

    def from_transform(self, spectrum: PairSpectrum) -> PeriodicSpectra:
        """Second half of a call: the method itself."""

        def channels() -> Iterator[tuple[ComplexArray, ComplexArray]]:
            for group, places in zip(self.groups, self._places, strict=True):
                # the projector is real: it may as well work before the records are told apart
                if group.folded is None:
                    mixed = group.project(spectrum.gather(places))  # (..., 1 + dof, 2, L)
                else:
                    mixed = group.project_folded(*spectrum.gather_folded(places))
                direct, mirrored = mixed[..., 0, :], mixed[..., 1, :]
                np.conjugate(mirrored, out=mirrored)
                y = direct + mirrored
                yield y, np.subtract(direct, mirrored, out=direct)

        return self._assembled(channels(), 0.5, -0.5j / spectrum.scale)

    def from_bins(self, bins: Iterable[ComplexArray]) -> PeriodicSpectra:
        """Same as a call, from the bins around the lines.

        Parameters
        ----------
        bins : iterable over `groups` of (..., W, 2, L) complex
            Output and input, not scaled, at ``group.centre_bins + group.offsets[:, None]``.
        """

        def channels() -> Iterator[tuple[ComplexArray, ComplexArray]]:
            for group, group_bins in zip(self.groups, bins, strict=True):
                projected = group.project(group_bins)  # (..., 1 + dof, 2, L)
                yield projected[..., 0, :], projected[..., 1, :]

        return self._assembled(channels(), 1.0, 1.0)

    def _assembled(
        self,
        channels: Iterable[tuple[ComplexArray, ComplexArray]],
        unit_y: complex,
        unit_u: complex,
    ) -> PeriodicSpectra:
        """Result from the projected bins of both channels (..., 1 + dof, L), in the units given."""
        spectra = covariance = np.empty(0, complex)
        for group, (y, u) in zip(self.groups, channels, strict=True):
            if spectra.size == 0:
                spectra = np.empty((*y.shape[:-2], 2, self.harmonics.size), complex)
                covariance = np.empty((*y.shape[:-2], 2, 2, self.harmonics.size), complex)
            where = group.where
            spectra[..., 0, where] = unit_y * y[..., 0, :]
            spectra[..., 1, where] = unit_u * u[..., 0, :]
            y, u = y[..., 1:, :], u[..., 1:, :]  # residuals
            covariance[..., 0, 0, where] = abs(unit_y) ** 2 * _sum_of_squares(y)
            covariance[..., 1, 1, where] = abs(unit_u) ** 2 * _sum_of_squares(u)
            products = np.multiply(y, np.conjugate(u, out=u), out=u)  # in place: u is done with
            cross = unit_y * np.conj(unit_u) * products.sum(axis=-2)  # (..., L)
            covariance[..., 0, 1, where] = cross
            covariance[..., 1, 0, where] = cross.conj()
        if not np.isfinite(spectra.sum()):  # one number tells, at half the cost of looking at all
            raise ValueError("u, y: samples are not finite, expected a complete record")
        return PeriodicSpectra(
            harmonics=self.harmonics,
            samples_per_period=self.samples_per_period,
            periods=self.periods,
            spectra=spectra,
            covariance=covariance,
            noise_dof=self.noise_dof,
            correlation_lines=self.correlation_lines,
            method=f"fast local polynomial method, order {self.order}",
        )


def _sum_of_squares(residual: ComplexArray) -> npt.NDArray[np.floating]:
    """(..., L) sum of absolute squares of residuals (..., dof, L)."""
    parts = residual.view(residual.real.dtype)  # (..., dof, 2 L), real and imaginary alternate
    squares = np.einsum("...ij,...ij->...j", parts, parts)  # no complex product, no root
    return squares[..., 0::2] + squares[..., 1::2]


def _correlation_lines(harmonics: IntArray, groups: tuple[Neighbourhood, ...]) -> int:
    """Largest distance, in lines, between two lines that share a bin."""
    low = np.empty(harmonics.size, np.int64)
    high = np.empty(harmonics.size, np.int64)
    for group in groups:
        low[group.lines] = group.centre_bins + group.offsets.min()
        high[group.lines] = group.centre_bins + group.offsets.max()
    # the first bin of a line's neighbourhood rises with the line
    return int(np.max(np.searchsorted(low, high, side="right") - 1 - np.arange(harmonics.size)))
