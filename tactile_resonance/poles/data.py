# SPDX-License-Identifier: Apache-2.0
"""Data of points on the bins of a band, or on the lines of an FRF."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray


class BinData(NamedTuple):
    """Data of points, of M records each, and what their errors are weighted with.

    On driven bins there is an input; those between harmonics of a periodic one hold the transient and
    noise alone. An FRF has driven bins with U = 1.

    Attributes
    ----------
    y, u : (points, M, K) complex
        Of u one point where all have the same; on undriven bins it is what is seen of noise.
    order : (bins,) int
        Places among K of the bins that are used, the undriven ones first.
    undriven : int
        How many of these there are.
    rest : (points, K_undriven or 1) float
        Variance of Y on undriven bins.
    variance_y : (points, K_driven or 1) float
        Of Y on driven bins; infinite where one is to be left out.
    variance_u : (points, K_driven, 1 or 0) float
        Of U; 0 long where it is exact.
    covariance_yu : (points, K_driven, 1 or 0) complex
        ``E dY conj(dU)``.
    """

    y: ComplexArray
    u: ComplexArray
    order: IntArray
    undriven: int
    rest: FloatArray
    variance_y: FloatArray
    variance_u: FloatArray
    covariance_yu: ComplexArray

    @classmethod
    def of(
        cls,
        y: npt.ArrayLike,
        u: npt.ArrayLike,
        order: IntArray | None = None,
        undriven: int = 0,
        **variances: npt.ArrayLike,
    ) -> BinData:
        """Data whose variances are those given, else 1 of Y and 0 of U; of all bins where none are named."""
        y = _plain(y, complex)
        places = np.arange(y.shape[-1]) if order is None else order
        one, none = np.ones((len(y), 1)), np.empty((len(y), 0))
        plain = cls(y, _plain(u, complex), places, undriven, one, one, none, none.astype(complex))
        return plain.weighted(**variances)

    def weighted(self, **variances: npt.ArrayLike) -> BinData:
        """With other variances, (points, bins or 1 or 0) each."""
        arrays: dict[str, Any] = {
            name: _plain(x, complex if name == "covariance_yu" else float)
            for name, x in variances.items()
        }
        return self._replace(**arrays)

    @property
    def records(self) -> int:
        """M."""
        return self.y.shape[1]

    @property
    def driven(self) -> int:
        """Number of driven bins."""
        return self.order.size - self.undriven

    @property
    def y_driven(self) -> ComplexArray:
        """(points, M, K_driven)."""
        return self.y[..., self.order[self.undriven :]]

    @property
    def u_driven(self) -> ComplexArray:
        """(points or 1, M, K_driven)."""
        return self.u[..., self.order[self.undriven :]]

    @property
    def variance(self) -> FloatArray:
        """(points, bins) of Y, in the order of the bins."""
        points, bins = len(self.y), self.order.size
        out = np.empty((points, bins))
        out[:, : self.undriven] = self.rest
        out[:, self.undriven :] = self.variance_y
        return out

    @property
    def lines(self) -> IntArray:
        """(points,) driven bins that are not left out."""
        used = np.isfinite(self.variance_y).sum(axis=1)
        return used if self.variance_y.shape[1] > 1 else used * self.driven

    def rows(self, which: slice | npt.NDArray) -> BinData:
        """Some of the points."""
        u = self.u if len(self.u) < len(self.y) else self.u[which]
        return self._replace(
            y=self.y[which],
            u=u,
            rest=self.rest[which],
            variance_y=self.variance_y[which],
            variance_u=self.variance_u[which],
            covariance_yu=self.covariance_yu[which],
        )

    def part(self, which: slice) -> BinData:
        """Some of the records."""
        y, u = self.y[:, which], self.u[:, which]
        return self._replace(y=_plain(y, complex), u=_plain(u, complex))

    def residual_variance(self, g: ComplexArray) -> FloatArray:
        """(points, K_driven or 1) variance of ``y - g u`` for a response g (points, K_driven)."""
        variance = self.variance_y
        if self.variance_u.size:
            variance = variance + self.variance_u * (g.real**2 + g.imag**2)
        if self.covariance_yu.size:
            variance = variance - 2 * np.real(self.covariance_yu * np.conj(g))
        return variance


def _plain(values: npt.ArrayLike, kind: type) -> npt.NDArray:
    """Contiguous and writable, as compiled functions take arrays."""
    array: npt.NDArray = np.ascontiguousarray(values, kind)
    return array if array.flags.writeable else array.copy()
