# SPDX-License-Identifier: Apache-2.0
"""Data of points on the bins of a band, or on the lines of an FRF, and the noise they are weighted with.

Bins between harmonics of a periodic excitation show the noise on both channels. The records of a point pool
their noise.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.frf.spectra import power
from tactile_resonance.poles.likelihood import FEWEST_PIECES, TINY, Rules
from tactile_resonance.poles.noise_level import (
    BINS_PER_BAND,
    FALSE_ALARM,
    Pieces,
    are_flat,
    channels_of,
    flat_limit,
    model_variance,
    smooth_variance,
)

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan

# Disturbances that the response explains somewhat are taken for the generator's, unless one gain for all
# bins leaves so much less of the error.
MUCH_MORE = 1.5


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
        return plain.weighted(**variances) if variances else plain

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


def _pieces_between(bins: int, records: int) -> Pieces:
    """Pieces of `BINS_PER_BAND` values on bins between harmonics, or a few more, the last one longer."""
    size = -(-BINS_PER_BAND // records)
    return Pieces.of(bins, size, records, records)


@lru_cache(maxsize=64)
def rules_between(bins: int, records: int) -> Rules:
    """Of fits that find the noise on so many bins themselves, where it is flat."""
    pieces = _pieces_between(bins, records)
    return Rules(
        pieces=pieces.starts.size,
        size=pieces.size,
        chance=_correlation_limit(bins * records),
        flat=flat_limit(pieces.starts.size, pieces.dof),
    )


def with_noise(
    plan: JointPlan, data: BinData, theta: FloatArray
) -> tuple[BinData, FloatArray, IntArray]:
    """Data weighted with the noise that their bins between harmonics show.

    Parameters
    ----------
    plan : JointPlan
    data : BinData
        Weights do not matter.
    theta : (points, M, n) float
        Coefficients whose errors show it.

    Returns
    -------
    BinData
        With the variances, and without what came through the input.
    mean : (points, 2) float
        Variances of what remains on Y between harmonics, and of that on U which is not real excitation.
    kind : (points,) int
        Index into `noise_level.KINDS`.

    Notes
    -----
    Noise of the two voltmeters is independent. Where U, or what the response makes of it, and Y are correlated
    beyond chance the disturbance either went through the system (noise of the generator: then it is a known
    input, no measurement noise) or into both channels alike; the first is taken where it explains some of Y
    and the second not much more.
    """
    problem, records = plan.problem, data.records
    alpha, beta, gamma = problem.split(theta)
    others = data.order[: data.undriven]
    of_a = alpha[:, 0] @ problem.denominator[: data.undriven].T  # (points, K_o)
    transient = gamma @ problem.transient[: data.undriven].T / of_a[:, None]
    error = _bin_by_bin(data.y[..., others] - transient)  # (points, K_o M)
    u = _bin_by_bin(np.broadcast_to(data.u, data.y.shape)[..., others])
    response = (beta[:, 0] @ plan.numerator_on_bins[plan.others_at].T / of_a).repeat(records, axis=1)
    generator = common = seen = follows_input(error, u, response)
    rest, size, covariance = error, error.shape[1], np.empty((len(error), 0), complex)
    if seen.any():
        power_error, power_u, cross, correlated = _powers(error, u)
        by_g, gain = response * u, cross / np.maximum(power_u, TINY)
        rest_g, rest_alike = _mean_power(error - by_g), _mean_power(error - gain * u)
        generator = seen & (rest_g < power_error) & (rest_g <= MUCH_MORE * rest_alike)
        common = correlated & ~generator
        through = np.where(generator, by_g, np.where(common, gain * u, 0.0))
        rest = error - through
        if common.any():
            covariance = np.where(common, cross, 0.0)
    free = size / max(size - problem.sizes[2] * records / 2, 1.0)  # of what the transients have left
    pieces = _pieces_between(data.undriven, records)
    rest_power, kind = _by_piece(rest, pieces, free)
    input_power, kind_u = _by_piece(u, pieces, 1.0)
    measured = rest_power
    if common.any():
        measured = np.where(common, _by_piece(error, pieces, free)[0], rest_power)
    variance_u = np.where(generator, 0.0, input_power)
    beside = np.minimum(np.searchsorted(plan.others_at, plan.excited_at), data.undriven - 1)
    of_excited, rows = pieces.of_bin[beside], np.flatnonzero(generator)
    of_rest = _on(pieces.of_bin, rest_power)
    of_y = _on(of_excited, measured)
    mean = np.concatenate([_mean_power(rest) * free, variance_u.mean(-1, keepdims=True)], -1)
    kind = np.maximum(kind, np.where(generator[:, 0], 0, kind_u))
    if rows.size:  # an input that is known but for the noise of its voltmeter, which the response brings in
        sample, gain = (power(x[rows]).reshape(rows.size, -1, records).mean(-1) for x in (rest, response))
        curve, kind[rows] = smooth_variance(sample * free, gain, Pieces.of(data.undriven, pieces.size, records))
        flat, channels = kind[rows, None] == 0, channels_of(curve, gain)
        driven = channels[:, :1] + channels[:, 1:] * power(problem.response(theta[rows, 0]))
        of_rest = np.tile(of_rest, (1, data.undriven // of_rest.shape[1]))
        of_y = np.tile(of_y, (1, data.driven // of_y.shape[1]))
        of_rest[rows], of_y[rows] = curve, np.where(flat, driven, curve[:, beside])
        mean[rows] = np.where(flat, channels, mean[rows])
    if (generator | common).any():
        y = data.y.copy()
        y[..., others] -= through.reshape(len(y), -1, records).swapaxes(1, 2)
        data = data._replace(y=y)
    weighted = data.weighted(
        rest=np.where(of_rest > TINY, of_rest, 1.0),
        variance_y=np.where(of_y > TINY, of_y, 1.0),
        variance_u=_on(of_excited, variance_u),
        covariance_yu=covariance,
    )
    return weighted, mean, kind


def follows_input(error: ComplexArray, u: ComplexArray, response: ComplexArray) -> BoolArray:
    """(batch, 1) whether errors go with an input, or with what the response makes of it, beyond chance.

    All (batch, K), on undriven bins.
    """
    # over a mode the phase of the response turns; its size would let the few bins of a peak decide
    turned = response * u / np.maximum(np.abs(response), TINY)
    return _powers(error, u)[3] | _powers(error, turned)[3]


def _bin_by_bin(values: ComplexArray) -> ComplexArray:
    """(points, K M) of (points, M, K): the records of a bin side by side."""
    return np.ascontiguousarray(values.swapaxes(1, 2).reshape(len(values), -1))


def _on(pieces: IntArray, variance: FloatArray) -> FloatArray:
    """(points, 1) or (points, K) variance of bins from that of their pieces."""
    return variance if variance.shape[1] == 1 else np.ascontiguousarray(variance[:, pieces])


def _correlation_limit(size: int) -> float:
    """Squared correlation of so many complex samples that is beyond chance."""
    # chance exceeds x with (1 - x)^(n - 1)
    return float(1 - FALSE_ALARM ** (1 / max(size - 1, 1)))


def rough_noise(error: ComplexArray, u: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """(batch, 1) flat variances of Y and of U from the same; none of U where it shows in `error`."""
    of_error, of_u, _, correlated = _powers(error, u)
    return np.where(of_error > TINY, of_error, 1.0), np.where(correlated, 0.0, of_u)


def _powers(
    error: ComplexArray, u: ComplexArray
) -> tuple[FloatArray, FloatArray, ComplexArray, BoolArray]:
    """(batch, 1) mean powers of errors and inputs, of their product, and whether they are correlated."""
    power_error, power_u = _mean_power(error), _mean_power(u)
    cross = _mean_product(u, error)
    squared = np.abs(cross) ** 2 / np.maximum(power_error * power_u, TINY)
    return power_error, power_u, cross, np.asarray(squared > _correlation_limit(error.shape[1]))


def _by_piece(values: ComplexArray, pieces: Pieces, factor: float) -> tuple[FloatArray, IntArray]:
    """(batch, 1) or (batch, pieces) variance, flat unless a test says otherwise, and its kind in `KINDS`."""
    mean = _mean_power(values) * factor
    samples = pieces.means(power(values))
    if pieces.starts.size < FEWEST_PIECES or bool(are_flat(samples, pieces.dof).all()):
        return mean, np.zeros(mean.shape[0], np.int64)
    model = model_variance(samples * factor, pieces.dof)
    return np.where(model.kind[:, None] == 0, mean, model.variance), model.kind


def _mean_power(values: ComplexArray) -> FloatArray:
    """(batch, 1)."""
    return _mean_product(values, values).real


def _mean_product(x: ComplexArray, y: ComplexArray) -> ComplexArray:
    """(batch, 1) mean of x* y."""
    return np.asarray((x.conj()[:, None] @ y[..., None])[..., 0] / x.shape[-1])
