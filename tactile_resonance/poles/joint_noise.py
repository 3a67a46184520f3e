# SPDX-License-Identifier: Apache-2.0
"""The noise that bins between harmonics of a periodic excitation show on both channels, as weights.

The records of a point pool their noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import RULES
from tactile_resonance.poles.likelihood import FEWEST_PIECES, TINY, Rules
from tactile_resonance.poles.noise_level import FALSE_ALARM, are_flat, flat_limit, model_variance

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan


# Bins whose powers are averaged before their variances are compared with each other.
BINS_PER_BAND = 8
# Disturbances that the response explains somewhat are taken for the generator's, unless one gain for all
# bins leaves so much less of the error.
MUCH_MORE = 1.5


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

    @cached_property
    def rules(self) -> Rules:
        """Of fits that find the noise themselves, where it is flat."""
        return RULES._replace(
            pieces=self.starts.size,
            size=self.size,
            chance=correlation_limit(int(self.counts.sum())),
            flat=flat_limit(self.starts.size, self.dof),
        )

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
    plan: JointPlan, data: BinData, theta: FloatArray
) -> tuple[BinData, JointNoise]:
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
    JointNoise
    """
    bands, problem = plan.noise_bands(data.records), plan.problem
    alpha, beta, gamma = problem.split(theta)
    others = data.order[: data.undriven]
    of_a = alpha[:, 0] @ problem.denominator[: data.undriven].T  # (points, K_o)
    transient = gamma @ problem.transient[: data.undriven].T / of_a[:, None]
    u = np.broadcast_to(data.u, data.y.shape)[..., others]
    response = beta[:, 0] @ plan.numerator_on_bins[plan.others_at].T / of_a
    noise = noise_between_harmonics(
        _bin_by_bin(data.y[..., others] - transient),
        _bin_by_bin(u),
        response.repeat(data.records, axis=1),
        bands,
        problem.sizes[2] * data.records,
    )
    if noise.through_input is not None:
        y = data.y.copy()
        y[..., others] -= noise.through_input.reshape(len(y), -1, data.records).swapaxes(1, 2)
        data = data._replace(y=y)
    covariance = noise.covariance_yu
    weighted = data.weighted(
        rest=noise.on(bands.of_others, noise.variance_rest),
        variance_y=noise.on(bands.of_excited, noise.variance_y),
        variance_u=noise.on(bands.of_excited, noise.variance_u),
        covariance_yu=np.empty((len(data.y), 0)) if covariance is None else covariance,
    )
    return weighted, noise


def _bin_by_bin(values: ComplexArray) -> ComplexArray:
    """(points, K M) of (points, M, K): the records of a bin side by side."""
    return np.ascontiguousarray(values.swapaxes(1, 2).reshape(len(values), -1))


def noise_between_harmonics(
    error: ComplexArray,
    u: ComplexArray,
    response: ComplexArray,
    bands: NoiseBands,
    terms: int,
) -> JointNoise:
    """Variances of both channels, and what they have in common.

    Parameters
    ----------
    error, u : (batch, K_o) complex
        Y without its transient, and U.
    response : (batch, K_o) complex
        From a first fit.
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
    size = error.shape[1]
    dof = max(size - terms / 2, 1.0)
    power_error, power_u = _mean_power(error), _mean_power(u)
    cross = np.mean(error * u.conj(), axis=-1, keepdims=True)
    squared = np.abs(cross) ** 2 / np.maximum(power_error * power_u, TINY)
    correlated = squared > correlation_limit(size)
    by_g, gain = response * u, cross / np.maximum(power_u, TINY)
    rest_g, rest_alike = _mean_power(error - by_g), _mean_power(error - gain * u)
    generator = correlated & (rest_g < power_error) & (rest_g <= MUCH_MORE * rest_alike)
    common = correlated & ~generator
    through = np.where(generator, by_g, np.where(common, gain * u, 0.0))
    rest = error - through
    total_power, _ = _pieces(error, bands, size / dof)
    rest_power, kind_rest = _pieces(rest, bands, size / dof)
    input_power, kind_u = _pieces(u, bands, 1.0)
    measured = np.where(common, total_power, rest_power)
    variance_u = np.where(generator, 0.0, input_power)
    mean_rest = _mean_power(rest) * (size / dof)
    return JointNoise(
        np.where(measured > TINY, measured, 1.0),
        variance_u,
        np.where(rest_power > TINY, rest_power, 1.0),
        np.where(common, cross, 0.0) if common.any() else None,
        through if correlated.any() else None,
        np.concatenate([mean_rest, variance_u.mean(-1, keepdims=True)], -1),
        np.maximum(kind_rest, np.where(generator[:, 0], 0, kind_u)),
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


def _pieces(values: ComplexArray, bands: NoiseBands, factor: float) -> tuple[FloatArray, IntArray]:
    """(batch, 1) or (batch, pieces) variance, and its kind as index into `KINDS`.

    Flat unless a test says otherwise.
    """
    mean = _mean_power(values) * factor
    samples = np.add.reduceat(values.real**2 + values.imag**2, bands.starts, axis=-1) / bands.counts
    if bands.starts.size < FEWEST_PIECES or bool(are_flat(samples, bands.dof).all()):
        return mean, np.zeros(mean.shape[0], np.int64)
    model = model_variance(samples * factor, bands.dof)
    return np.where(model.kind[:, None] == 0, mean, model.variance), model.kind


def _mean_power(values: ComplexArray) -> FloatArray:
    """(batch, 1)."""
    return np.asarray(np.mean(values.real**2 + values.imag**2, axis=-1, keepdims=True))
