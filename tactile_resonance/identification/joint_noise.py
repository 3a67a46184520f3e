# SPDX-License-Identifier: Apache-2.0
"""The noise that the bins between harmonics of a periodic excitation show, on both channels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.noise_level import FALSE_ALARM, KINDS, is_flat, model_variance

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]

# Bins whose powers are averaged before their variances are compared with each other.
BINS_PER_BAND = 8
# Fewer are not tested for being equal.
FEWEST_PIECES = 4
# Disturbances that the response explains somewhat are taken for the generator's, unless one gain for all
# bins leaves so much less of the error.
MUCH_MORE = 1.5
TINY = float(np.finfo(float).tiny)
NAMES = np.array(KINDS)


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
    dof : int
        Complex degrees of freedom of the variance of a piece.
    """

    of_others: IntArray
    of_excited: IntArray
    starts: IntArray
    counts: IntArray
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
        return cls(of_others, of_excited, starts, counts, size * records)


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
    kind : (batch,) str
        flat, sloped or per line.
    """

    variance_y: FloatArray
    variance_u: FloatArray
    variance_rest: FloatArray
    covariance_yu: ComplexArray | None
    through_input: ComplexArray | None
    mean_variances: FloatArray
    kind: npt.NDArray[np.str_]

    @staticmethod
    def on(pieces: IntArray, variance: FloatArray) -> FloatArray:
        """(batch, 1) or (batch, K) variance of bins from that of their pieces."""
        return variance if variance.shape[1] == 1 else np.ascontiguousarray(variance[:, pieces])


def noise_between_harmonics(
    error: ComplexArray,
    u: ComplexArray,
    response: Callable[[], ComplexArray],
    bands: NoiseBands,
    terms: int,
) -> JointNoise:
    """Variances of both channels, and what they have in common.

    Parameters
    ----------
    error, u : (batch, K_o) complex
        Y without its transient, and U, between harmonics of the excitation.
    response : callable
        (batch, K_o) response there, from a first fit; asked for only where the channels are alike.
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
    through = covariance = None
    power_error, power_u, cross, correlated = _powers(error, u)
    if not correlated.any():
        if _are_flat(np.concatenate([error, u]), bands):
            total_power, input_power = power_error * (size / dof), power_u
            kind = np.full(error.shape[0], KINDS[0], NAMES.dtype)
        else:
            total_power, kind_y = _pieces(error, power_error, bands, size / dof)
            input_power, kind_u = _pieces(u, power_u, bands, 1.0)
            kind = NAMES[np.maximum(kind_y, kind_u)]
        variance_y = np.where(total_power > TINY, total_power, 1.0)  # no noise: any weights do
        means = [power_error * (size / dof), input_power.mean(-1, keepdims=True)]
        return JointNoise(
            variance_y, input_power, variance_y, None, None, np.concatenate(means, -1), kind
        )
    by_g = response() * u
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
    power_rest = _mean_power(rest)
    total_power, _ = _pieces(error, power_error, bands, size / dof)
    rest_power, kind_rest = _pieces(rest, power_rest, bands, size / dof)
    input_power, kind_u = _pieces(u, power_u, bands, 1.0)
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
        NAMES[kind],
    )


def rough_noise(error: ComplexArray, u: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """(batch, 1) flat variances of Y and of U from the same; none of U where it shows in `error`."""
    power_error, power_u, _, correlated = _powers(error, u)
    return (
        np.where(power_error > TINY, power_error, 1.0),
        np.where(correlated, 0.0, power_u),
    )


def _powers(
    error: ComplexArray, u: ComplexArray
) -> tuple[FloatArray, FloatArray, ComplexArray, npt.NDArray[np.bool_]]:
    """(batch, 1) mean powers of both, their mean product, and whether that is beyond chance."""
    size = error.shape[1]
    power_error, power_u = _mean_power(error), _mean_power(u)
    cross = np.einsum("bk,bk->b", error, u.conj())[:, None] / size
    squared = (cross.real**2 + cross.imag**2) / np.maximum(power_error * power_u, TINY)
    # a squared correlation of n complex samples exceeds x by chance with (1 - x)^(n - 1)
    return power_error, power_u, cross, squared > 1 - FALSE_ALARM ** (1 / max(size - 1, 1))


def _pieces(
    values: ComplexArray, mean_power: FloatArray, bands: NoiseBands, factor: float
) -> tuple[FloatArray, IntArray]:
    """(batch, 1) or (batch, pieces) variance, and its kind as index into `KINDS`.

    Flat unless a test says otherwise.
    """
    mean = mean_power * factor
    if _are_flat(values, bands):
        return mean, np.zeros(values.shape[0], np.int64)
    model = model_variance(_samples(values, bands) * factor, bands.dof)
    return np.where(model.kind[:, None] == 0, mean, model.variance), model.kind


def _are_flat(values: ComplexArray, bands: NoiseBands) -> bool:
    """Whether all of a batch have a flat variance, or too few pieces to tell."""
    return bands.starts.size < FEWEST_PIECES or is_flat(_samples(values, bands), bands.dof)


def _samples(values: ComplexArray, bands: NoiseBands) -> FloatArray:
    """(batch, pieces) mean powers."""
    parts = np.ascontiguousarray(values).view(float)  # real and imaginary ones in turn
    return np.asarray(np.add.reduceat(parts * parts, 2 * bands.starts, axis=-1) / bands.counts)


def _mean_power(values: ComplexArray) -> FloatArray:
    """(batch, 1)."""
    parts = np.ascontiguousarray(values).view(float)
    return np.einsum("bk,bk->b", parts, parts)[:, None] / values.shape[-1]
