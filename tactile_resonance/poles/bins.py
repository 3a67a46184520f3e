# SPDX-License-Identifier: Apache-2.0
"""Bins of the band: what the model ``Y = (B U + C) / A`` is made of on them, and data there.

A, B and C are polynomials with real coefficients over fixed bases, C the numerator of the transient. On
driven bins there is an input; bins between harmonics of a periodic input hold the transient and noise
alone. An FRF has driven bins with U = 1 and no C.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.likelihood import BLOCK, Arrays, planes
from tactile_resonance.poles.tables import Tables, compiled, from_planes, in_blocks


@dataclass(frozen=True, eq=False)
class Problem:
    """Basis functions on K bins, the undriven ones first.

    Attributes
    ----------
    denominator : (K, a + 1) complex
        The last coefficient of A is fixed at 1.
    numerator : (K_driven, b) complex
    transient : (K, c) complex
        Of no terms where there is no transient.
    """

    denominator: ComplexArray
    numerator: ComplexArray
    transient: ComplexArray

    @classmethod
    def of_lines(cls, denominator: ComplexArray, numerator: ComplexArray) -> Problem:
        """Driven bins without transient."""
        return cls(denominator, numerator, np.empty((denominator.shape[0], 0), complex))

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of free coefficients of A, B and C."""
        a, b, c = (x.shape[1] for x in (self.denominator, self.numerator, self.transient))
        return a - 1, b, c

    @property
    def undriven(self) -> int:
        """Number of bins without input."""
        return int(self.denominator.shape[0] - self.numerator.shape[0])

    @cached_property
    def tables(self) -> Tables:
        """For `likelihood`."""
        compiled()  # here and not in the first fit, whose time may matter
        return Tables.of(self.denominator, self.numerator, self.transient)

    @property
    def from_driven(self) -> bool:
        """Whether the driven bins hold equations enough for start values.

        Of a record of many periods they are a small part of all bins, and the most informative one.
        """
        return self.undriven > 0 and self.numerator.shape[0] >= sum(self.sizes)

    def split(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of A (with its last), B and C, each (..., terms), of theta (..., n)."""
        a, b, _ = self.sizes
        one = np.ones((*theta.shape[:-1], 1))
        return (
            np.concatenate([theta[..., :a], one], axis=-1),
            np.ascontiguousarray(theta[..., a : a + b]),
            np.ascontiguousarray(theta[..., a + b :]),
        )

    def response(self, theta: FloatArray) -> ComplexArray:
        """(batch, K_driven) B / A of coefficients (batch, n)."""
        alpha, beta, _ = self.split(theta)
        return np.asarray(beta @ self.numerator.T / (alpha @ self.denominator[self.undriven :].T))


ARRAYS = ("y_planes", "u_planes", "variance_y", "variance_u", "covariance_yu", "rest")


@dataclass(frozen=True, eq=False)
class BinData:
    """Data of points on the bins of a `Problem`, of M records each.

    Attributes
    ----------
    y_planes, u_planes : float arrays
        Of Y and U in the blocks of `likelihood.planes`; on undriven bins U is what is seen of noise.
    undriven, driven : int
        Numbers of bins.
    variance_y : (points, M or 1, K_driven or 1) float
        Of Y on driven bins; infinite where a bin is to be left out.
    variance_u, covariance_yu : same shape, or None
        Of U, and ``E dY conj(dU)``.
    rest : (points, M or 1, K_undriven or 1) float or None
        Variance of Y on undriven bins.
    """

    y_planes: FloatArray
    u_planes: FloatArray
    undriven: int
    driven: int
    variance_y: FloatArray
    variance_u: FloatArray | None = None
    covariance_yu: ComplexArray | None = None
    rest: FloatArray | None = None

    @classmethod
    def of(
        cls,
        y: npt.NDArray,
        u: npt.NDArray,
        undriven: int,
        *variances: Any,
        order: IntArray | None = None,
    ) -> BinData:
        """Data (points, M, K), of which the undriven bins come first, or do in `order`."""
        order = np.arange(y.shape[-1]) if order is None else order
        of_y, of_u = (planes(np.asarray(x, complex), order, undriven) for x in (y, u))
        return cls(of_y, of_u, undriven, order.size - undriven, *variances)

    @property
    def y(self) -> ComplexArray:
        """(points, M, K) the undriven bins first."""
        return from_planes(self.y_planes, self.undriven, self.driven)

    @property
    def u(self) -> ComplexArray:
        """(points, M, K)."""
        return from_planes(self.u_planes, self.undriven, self.driven)

    @property
    def records(self) -> int:
        """M."""
        return self.y_planes.shape[1]

    @property
    def y_driven(self) -> ComplexArray:
        """(points, M, K_driven) on driven bins."""
        return from_planes(self.y_planes[:, :, -self._driven_blocks :], 0, self.driven)

    @property
    def u_driven(self) -> ComplexArray:
        """(points, M, K_driven)."""
        return from_planes(self.u_planes[:, :, -self._driven_blocks :], 0, self.driven)

    @property
    def _driven_blocks(self) -> int:
        return -(-self.driven // BLOCK)

    @cached_property
    def arrays(self) -> Arrays:
        """For `likelihood`."""
        covariance = self.covariance_yu
        parts = [] if covariance is None else [covariance.real, covariance.imag]
        return Arrays(
            self.y_planes,
            self.u_planes,
            in_blocks([np.ones((len(self.y_planes), 1, 1)) if self.rest is None else self.rest]),
            in_blocks([self.variance_y]),
            in_blocks([] if self.variance_u is None else [self.variance_u], len(self.y_planes)),
            in_blocks(parts, len(self.y_planes)),
        )

    def rows(self, which: slice | npt.NDArray) -> BinData:
        """The data of some points."""

        def cut(array):
            return None if array is None else array[which]

        values = {name: cut(getattr(self, name)) for name in ARRAYS}
        return replace(self, **values)

    def part(self, which: slice) -> BinData:
        """Some of the records."""
        values: dict[str, Any] = {name: getattr(self, name) for name in ARRAYS}
        for name, array in values.items():
            if array is not None and array.shape[1] == self.records:
                values[name] = np.ascontiguousarray(array[:, which])
        return replace(self, **values)

    def residual_variance(self, g: ComplexArray) -> FloatArray:
        """(points, M or 1, K_driven or 1) variance of ``y - g u`` for a response g (points, K_driven)."""
        g = g[:, None]
        if self.variance_u is None:
            return self.variance_y
        variance = self.variance_y + self.variance_u * (g.real**2 + g.imag**2)
        if self.covariance_yu is not None:
            variance = variance - 2 * np.real(self.covariance_yu * np.conj(g))
        return variance
