# SPDX-License-Identifier: Apache-2.0
"""What the lines of an FRF, or of spectra, are weighted with, and which of them count."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.noise_level import VarianceModel, model_variance

# Degrees of freedom that stand for a covariance known exactly.
EXACT = 10**6
# Of the input's noise seen at the output.
LEAST_OUTPUT_NOISE = 1e-12


@dataclass(frozen=True, eq=False)
class WeightedLines:
    """Lines of a batch of points.

    Attributes
    ----------
    data : BinData
        With variances that are infinite on lines left out.
    known : VarianceModel
        What is known of these variances; says nothing of points without any.
    usable : (batch, F) bool
        Lines that are not left out.
    level_known : (batch,) bool
        Whether there is a variance above 0 at all; points without are weighted alike on all lines.
    total_known : bool
        Whether the variance is of noise and distortion.
    noise : (batch, F) float or None
        Variance from noise alone, where it is known as well then.
    """

    data: BinData
    known: VarianceModel
    usable: BoolArray
    level_known: BoolArray
    total_known: bool = False
    noise: FloatArray | None = None


def lines_of_frf(frf: FRF) -> WeightedLines:
    """Of an FRF with (..., F) arrays as `inputs.checked_frf` leaves it; its lines are those of the band."""
    flat_shape = math.prod(frf.g.shape[:-1]), frf.frequency_hz.size
    g = frf.g.reshape(flat_shape)
    usable = np.isfinite(g)
    level_known = np.full(flat_shape[0], frf.variance is not None and frf.dof > 0)
    variance = np.ones(flat_shape)
    if frf.variance is not None and frf.dof > 0:
        variance = frf.variance.reshape(flat_shape)
        weighted = usable & (variance > 0) & (variance < np.inf)
        if not weighted.all():
            level_known = np.asarray((usable & (variance > 0)).any(axis=-1))
            variance = np.where(level_known[:, None], variance, 1.0)
            usable = np.where(level_known[:, None], weighted, usable)
    if not usable.all():
        g = np.where(usable, g, 0.0)
        variance = np.where(usable, variance, np.nan)
    known = model_variance(variance, max(frf.dof, 1), g.real**2 + g.imag**2)
    weights = known.variance
    if not level_known.all():
        power = np.where(usable, _power(g, usable), np.inf)
        weights = np.where(level_known[:, None], weights, power)
    if frf.variance_total is None and frf.periods > 1:
        # noise is from bins between lines: neighbours share them where periods are few
        bins = (frf.periods - 1) * frf.realisations
        known = replace(known, independent_dof=min(frf.dof, bins))
    noise = frf.variance_noise
    return WeightedLines(
        BinData.of(g[:, None], np.ones((1, 1, g.shape[1])), variance_y=weights),
        known,
        usable,
        level_known,
        frf.variance_total is not None,
        None if noise is None or frf.variance_total is None else noise.reshape(flat_shape),
    )


def lines_of_spectra(
    spectra: ComplexArray, covariance: ComplexArray, dof: int, pooled: bool
) -> WeightedLines:
    """Of spectra (..., 2, F) with covariance (..., 2, 2, F); see `identify.identify_spectra`."""
    points, lines = math.prod(spectra.shape[:-2]), spectra.shape[-1]
    z = spectra.reshape(points, 2, lines)
    c = covariance.reshape(points, 2, 2, lines)
    usable = np.isfinite(z).all(axis=-2) & np.isfinite(c).all(axis=(-3, -2))
    noise_y, noise_u = (usable & (c[:, k, k].real > 0) for k in (0, 1))
    level_known = np.asarray((noise_y | noise_u).any(axis=-1))
    # lines of one channel without variance, beside others with one, are none of the noise's making
    usable &= noise_y | ~noise_y.any(axis=-1, keepdims=True)
    usable &= noise_u | ~noise_u.any(axis=-1, keepdims=True)
    z = np.where(usable[:, None], z, 0.0)
    c_yy, c_uu = (np.where(usable, c[:, k, k].real, 0.0) for k in (0, 1))
    c_yu = np.where(usable, c[:, 0, 1], 0.0)
    model_y, model_u = (_channel(x, usable, dof, pooled) for x in (c_yy, c_uu))
    known = replace(
        model_y,
        lines=usable.sum(axis=-1),
        dof=dof if dof > 0 else EXACT,
        kind=np.maximum(model_y.kind, model_u.kind),
    )
    together = known.kind[:, None] < 2
    smooth_y, smooth_u = (np.where(usable, m.variance, 0.0) for m in (model_y, model_u))
    both = np.sqrt(smooth_y * smooth_u)
    correlation = (c_yu / _or_one(both)).sum(axis=-1, keepdims=True)
    correlation /= np.maximum(known.lines[:, None], np.abs(correlation))  # 1 at most
    c_yu = np.where(together, correlation * both, c_yu)
    c_yy, c_uu = (np.where(together, *pair) for pair in ((smooth_y, c_yy), (smooth_u, c_uu)))
    power_y, power_u = (_power(x, usable) for x in (z[:, 0], z[:, 1]))
    # all the noise may be in the input, but weights of start values are from the output's
    c_yy = np.maximum(c_yy, LEAST_OUTPUT_NOISE * c_uu * power_y / power_u)
    c_yy = np.where(level_known[:, None], c_yy, power_y)
    return WeightedLines(
        BinData.of(
            z[:, :1],
            z[:, 1:],
            variance_y=np.where(usable, c_yy, np.inf),
            variance_u=c_uu,
            covariance_yu=c_yu,
        ),
        known,
        usable,
        level_known,
    )


def _channel(variance: FloatArray, usable: BoolArray, dof: int, pooled: bool) -> VarianceModel:
    """Of one channel: pooled over the band where a test allows it; exact ones line by line."""
    lines = usable.sum(axis=-1)
    if dof <= 0 or not pooled:
        return VarianceModel(variance, lines, max(dof, 1), np.full(lines.shape, 2))
    model = model_variance(np.where(usable, variance, np.nan), dof)
    # a channel without noise is as flat as any
    noisy = np.asarray((variance > 0).any(axis=-1))[:, None]
    return replace(model, variance=np.where(noisy, model.variance, 0.0))


def _power(values: ComplexArray, usable: BoolArray) -> FloatArray:
    """(batch, 1) mean square of the usable lines; 1 where there is none above 0."""
    power = np.where(usable, values.real**2 + values.imag**2, 0.0).sum(axis=-1, keepdims=True)
    return _or_one(power / np.maximum(usable.sum(axis=-1, keepdims=True), 1))


def _or_one(values: FloatArray) -> FloatArray:
    return np.where(values > 0, values, 1.0)
