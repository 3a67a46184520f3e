# SPDX-License-Identifier: Apache-2.0
"""The noise that bins between harmonics of a periodic excitation show on both channels, as weights.

The records of a point pool their noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles import likelihood
from tactile_resonance.poles.bins import BinData
from tactile_resonance.poles.noise_level import FALSE_ALARM, are_flat, model_variance

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan


# Bins whose powers are averaged before their variances are compared with each other.
BINS_PER_BAND = 8
# Fewer are not tested for being equal.
FEWEST_PIECES = 4
# Disturbances that the response explains somewhat are taken for the generator's, unless one gain for all
# bins leaves so much less of the error.
MUCH_MORE = 1.5
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class NoiseBands:
    """Pieces of the band within which the variance counts as constant.

    Attributes
    ----------
    of_others, of_excited : (K_o,), (K_e,) int
        Which piece a bin belongs to.
    starts : (pieces,) int
        First of the values on other bins in each piece.
    counts : (pieces,) int
        Values in each.
    size : int
        Bins of a piece.
    dof : int
        Complex degrees of freedom of the variance of a piece.
    """

    of_others: IntArray
    of_excited: IntArray
    starts: IntArray
    counts: IntArray
    size: int
    dof: int

    @classmethod
    def of(cls, others: IntArray, excited: IntArray, records: int = 1) -> NoiseBands:
        """Pieces of `BINS_PER_BAND` values on other bins, or a few more, the last one longer.

        Parameters
        ----------
        others, excited : (K_o,), (K_e,) int
            Bins, ascending.
        records : int
            Values on each bin, one after the other.
        """
        size = -(-BINS_PER_BAND // records)  # bins of a piece
        pieces = max(1, others.size // size)
        starts = np.arange(pieces) * (size * records)
        of_others = np.minimum(np.arange(others.size) // size, pieces - 1)
        of_excited = np.minimum(np.searchsorted(others, excited) // size, pieces - 1)
        counts = np.diff(np.append(starts, others.size * records))
        return cls(of_others, of_excited, starts, counts, size, size * records)


@dataclass(frozen=True, eq=False)
class JointNoise:
    """Noise of a batch of records.

    Attributes
    ----------
    variance_y, variance_u : (batch, 1) or (batch, pieces) float
        Of the noise on a bin of Y, and of that on U which is not real excitation.
    variance_rest : same shape
        Of what remains on bins between harmonics.
    covariance_yu : (batch, 1) complex or None
        None where no point shows any.
    through_input : (batch, K_o) complex or None
        What the disturbances seen on U explain of Y between harmonics; None where nothing.
    mean_variances : (batch, 2) float
    kind : (batch,) int
        Index into `noise_level.KINDS`.
    """

    variance_y: FloatArray
    variance_u: FloatArray
    variance_rest: FloatArray
    covariance_yu: ComplexArray | None
    through_input: ComplexArray | None
    mean_variances: FloatArray
    kind: IntArray

    @staticmethod
    def on(pieces: IntArray, variance: FloatArray) -> FloatArray:
        """(batch, 1) or (batch, K) variance of bins from that of their pieces."""
        return variance if variance.shape[1] == 1 else np.ascontiguousarray(variance[:, pieces])


def with_noise(
    plan: JointPlan, data: BinData, theta: FloatArray | None = None
) -> tuple[BinData, FloatArray, JointNoise]:
    """Data weighted with the noise that their bins between harmonics show.

    Parameters
    ----------
    plan : JointPlan
    data : BinData
        With variances of 1.
    theta : (points, M, n) float, optional
        Coefficients whose errors show it; when absent those of start values.

    Returns
    -------
    BinData
        With the variances, and without what came through the input.
    theta : (points, M, n) float
    JointNoise
    """
    bands, problem = plan.noise_bands(data.records), plan.problem
    if theta is None:
        limit = correlation_limit(data.records * data.undriven)
        theta, powers = likelihood.begin(
            problem.tables, problem.from_driven, data.arrays, limit, bands.size, bands.starts.size
        )
    else:
        powers = likelihood.undriven_powers(
            problem.tables, data.arrays, theta, bands.size, bands.starts.size
        )

    def signals() -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        alpha, beta, _ = problem.split(theta[:, 0])
        of_a = alpha @ problem.denominator[: problem.undriven].T
        g = np.asarray((beta @ plan.numerator_on_bins[plan.others_at].T) / of_a)
        error = likelihood.undriven_errors(problem.tables, data.arrays, theta)
        u = data.u[..., : data.undriven]
        return _bin_by_bin(error), _bin_by_bin(u), g.repeat(data.records, axis=1)

    noise = noise_between_harmonics(powers, signals, bands, problem.sizes[2] * data.records)
    return _weighted(data, noise, bands), theta, noise


def _weighted(data: BinData, noise: JointNoise, bands: NoiseBands) -> BinData:
    if noise.through_input is not None:
        y = data.y
        y[..., : data.undriven] -= noise.through_input.reshape(
            len(y), data.undriven, data.records
        ).swapaxes(1, 2)
        data = BinData.of(y, data.u, data.undriven, data.variance_y)
    covariance = noise.covariance_yu
    return replace(
        data,
        rest=noise.on(bands.of_others, noise.variance_rest)[:, None],
        variance_y=noise.on(bands.of_excited, noise.variance_y)[:, None],
        variance_u=noise.on(bands.of_excited, noise.variance_u)[:, None],
        covariance_yu=None if covariance is None else covariance[:, None],
    )


def _bin_by_bin(values: ComplexArray) -> ComplexArray:
    """(points, K M) of (points, M, K): the records of a bin side by side."""
    return np.ascontiguousarray(values.swapaxes(1, 2).reshape(len(values), -1))


def noise_between_harmonics(
    powers: FloatArray,
    signals: Callable[[], tuple[ComplexArray, ComplexArray, ComplexArray]],
    bands: NoiseBands,
    terms: int,
) -> JointNoise:
    """Variances of both channels, and what they have in common.

    Parameters
    ----------
    powers : (batch, 4, pieces) float
        Of Y without its transient, and of U, see `likelihood.undriven_powers`.
    signals : callable
        These two and the response there from a first fit, (batch, K_o) each; asked for only where the
        channels are alike.
    bands : NoiseBands
    terms : int
        Real coefficients that the transient has taken from `error`.

    Notes
    -----
    Noise of the two voltmeters is independent. Where U and Y are correlated beyond chance the
    disturbance either went through the system (noise of the generator: then it is a known input, no
    measurement noise) or into both channels alike; the first is taken where it explains some of Y and
    the second not much more.
    """
    size = int(bands.counts.sum())
    dof = max(size - terms / 2, 1.0)
    through = covariance = None
    sums = powers.sum(axis=-1)[:, :, None]
    power_error, power_u, re, im = (sums[:, k] for k in range(4))
    # how far both channels have anything in common
    squared = (re**2 + im**2) / np.maximum(power_error * power_u, TINY)
    correlated = squared > correlation_limit(size)
    power_error, power_u = power_error / size, power_u / size
    if not correlated.any():
        (total_power, kind_y), (input_power, kind_u) = (
            (mean, np.zeros(len(mean), np.int64)) for mean in (power_error * (size / dof), power_u)
        )
        means = [total_power, input_power]
        if not _is_flat(powers[:, :2], bands):
            total_power, kind_y = _pieces(powers[:, 0], power_error, bands, size / dof)
            input_power, kind_u = _pieces(powers[:, 1], power_u, bands, 1.0)
            means[1] = input_power.mean(-1, keepdims=True)
        variance_y = np.where(total_power > TINY, total_power, 1.0)  # no noise: any weights do
        return JointNoise(
            variance_y,
            input_power,
            variance_y,
            None,
            None,
            np.concatenate(means, -1),
            np.maximum(kind_y, kind_u),
        )
    of_error, of_u = powers[:, 0], powers[:, 1]
    error, u, response = signals()
    by_g, cross = response * u, (re + 1j * im) / size
    gain = cross / np.maximum(power_u, TINY)
    rest_g, rest_alike = _mean_power(error - by_g), _mean_power(error - gain * u)
    generator = correlated & (rest_g < power_error) & (rest_g <= MUCH_MORE * rest_alike)
    common = correlated & ~generator
    if common.any():
        covariance = np.where(common, cross, 0.0)
        through = np.where(common, gain * u, 0.0)
    if generator.any():
        through = np.where(generator, by_g, 0.0 if through is None else through)
    rest = error if through is None else error - through
    parts = rest.real**2 + rest.imag**2
    of_rest, power_rest = np.add.reduceat(parts, bands.starts, axis=-1), _mean_power(rest)
    total_power, _ = _pieces(of_error, power_error, bands, size / dof)
    rest_power, kind_rest = _pieces(of_rest, power_rest, bands, size / dof)
    input_power, kind_u = _pieces(of_u, power_u, bands, 1.0)
    kind = np.maximum(kind_rest, np.where(generator[:, 0], 0, kind_u))
    measured = np.where(generator, rest_power, np.where(common, total_power, rest_power))
    variance_u = np.where(generator, 0.0, input_power)
    return JointNoise(
        np.where(measured > TINY, measured, 1.0),
        variance_u,
        np.where(rest_power > TINY, rest_power, 1.0),
        covariance,
        through,
        np.concatenate([power_rest * (size / dof), variance_u.mean(-1, keepdims=True)], -1),
        kind,
    )


def correlation_limit(size: int) -> float:
    """Squared correlation of so many complex samples that is beyond chance."""
    # chance exceeds x with (1 - x)^(n - 1)
    return float(1 - FALSE_ALARM ** (1 / max(size - 1, 1)))


def rough_noise(error: ComplexArray, u: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """(batch, 1) flat variances of Y and of U from the same; none of U where it shows in `error`."""
    of_error, of_u = _mean_power(error), _mean_power(u)
    cross = np.mean(error * u.conj(), axis=-1, keepdims=True)
    squared = np.abs(cross) ** 2 / np.maximum(of_error * of_u, TINY)
    limit = correlation_limit(error.shape[1])
    return np.where(of_error > TINY, of_error, 1.0), np.where(squared > limit, 0.0, of_u)


def _is_flat(powers_of: FloatArray, bands: NoiseBands) -> bool:
    """Whether a test finds the powers (..., pieces) of all points flat over the band."""
    few = bands.starts.size < FEWEST_PIECES
    return few or bool(are_flat(powers_of / bands.counts, bands.dof).all())


def _pieces(
    powers_of: FloatArray, mean_power: FloatArray, bands: NoiseBands, factor: float
) -> tuple[FloatArray, IntArray]:
    """(batch, 1) or (batch, pieces) variance, and its kind as index into `KINDS`.

    Flat unless a test says otherwise.
    """
    mean, samples = mean_power * factor, powers_of / bands.counts
    if _is_flat(powers_of, bands):
        return mean, np.zeros(mean.shape[0], np.int64)
    model = model_variance(samples * factor, bands.dof)
    return np.where(model.kind[:, None] == 0, mean, model.variance), model.kind


def _mean_power(values: ComplexArray) -> FloatArray:
    """(batch, 1)."""
    return np.asarray(np.mean(values.real**2 + values.imag**2, axis=-1, keepdims=True))
