# SPDX-License-Identifier: Apache-2.0
"""Lines of an FRF, or of spectra, that are fitted: checked, which count, and what they are weighted with."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.fields import band, number, require, require_kind
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.noise_level import VarianceModel, model_variance

# Of a covariance that is Hermitian and positive semidefinite but for rounding to single precision.
ROUNDING = 1e-5


def checked_frf(frf: FRF) -> FRF:
    """The FRF with arrays of double precision, its variances in the shape of its response.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.
    """
    require_kind(frf, "frf", FRF)
    g = _numbers(frf.g, "frf.g", complex)
    frequency_hz = checked_lines(frf.frequency_hz, "frf.frequency_hz")
    if g.shape[-1:] != frequency_hz.shape:
        raise ValueError(
            f"frf.g: shape {g.shape}, expected (..., {frequency_hz.size}), one for each line"
        )
    variances: dict[str, Any] = {}
    for name, dof_name in (("variance_noise", "noise_dof"), ("variance_total", "total_dof")):
        variance = variances[name] = getattr(frf, name)
        if variance is None:
            continue
        try:
            variances[name] = np.broadcast_to(np.asarray(variance, float), g.shape)
        except ValueError:
            raise ValueError(
                f"frf.{name}: shape {np.shape(variance)}, expected that of g, {g.shape}"
            ) from None
        _check_dof(getattr(frf, dof_name), f"frf.{dof_name}")
    return replace(frf, frequency_hz=frequency_hz, g=g, **variances)


def checked_spectra(
    frequency_hz: npt.ArrayLike, spectra: npt.ArrayLike, covariance: npt.ArrayLike, dof: int
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Lines (F,), spectra (..., 2, F) and covariance (..., 2, 2, F) of double precision.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.
    """
    lines_hz = checked_lines(frequency_hz, "frequency_hz")
    z, c = _numbers(spectra, "spectra", complex), _numbers(covariance, "covariance", complex)
    lines = lines_hz.size
    if z.shape[-2:] != (2, lines) or c.shape[-3:] != (2, 2, lines):
        raise ValueError(
            f"spectra, covariance: shapes {z.shape}, {c.shape}, "
            f"expected (..., 2, {lines}) and (..., 2, 2, {lines}), one for each line"
        )
    _check_dof(dof, "dof")
    y, u, yu, uy = (c[..., i, j, :] for i, j in ((0, 0), (1, 1), (0, 1), (1, 0)))
    with np.errstate(over="ignore", invalid="ignore"):
        product = np.sqrt(np.abs(y.real)) * np.sqrt(np.abs(u.real))
        real = np.abs(y.imag) <= ROUNDING * np.abs(y)
        real &= np.abs(u.imag) <= ROUNDING * np.abs(u)
        alike = np.abs(yu - uy.conj()) <= ROUNDING * product
        definite = (y.real >= 0) & (u.real >= 0) & (np.abs(yu) <= (1 + ROUNDING) * product)
    # lines of NaN are left out later
    wrong = np.isfinite(c).all(axis=(-3, -2)) & ~(real & alike & definite)
    if wrong.any():
        *_, line = np.argwhere(wrong)[0]
        matrix = c[tuple(np.argwhere(wrong)[0][:-1])][..., line].tolist()
        raise ValueError(
            f"covariance: {matrix} at {lines_hz[line]:g} Hz, expected a Hermitian matrix, "
            "[[E|dY|^2, E dY conj(dU)], [E dU conj(dY), E|dU|^2]], without negative variances"
        )
    try:
        c = np.broadcast_to(c, (*z.shape[:-2], 2, 2, lines))
    except ValueError:
        raise ValueError(
            f"covariance: shape {c.shape}, expected {(*z.shape[:-2], 2, 2, lines)} as spectra"
        ) from None
    return lines_hz, z, c


def checked_lines(frequency_hz: npt.ArrayLike, name: str) -> FloatArray:
    """(F,) float, ascending from 0 or above.

    Raises
    ------
    ValueError
        Names the first line that is not finite, negative or not above the one before.
    """
    lines_hz = _numbers(frequency_hz, name, float)
    if lines_hz.ndim != 1:
        raise ValueError(f"{name}: shape {lines_hz.shape}, expected (F,)")
    good = np.isfinite(lines_hz) & (lines_hz >= 0)
    good[1:] &= lines_hz[1:] > lines_hz[:-1]
    if not good.all():
        k = int(np.argmin(good))
        before = f" after {lines_hz[k - 1]:g}" if k else ""
        raise ValueError(f"{name}: {lines_hz[k]:g} Hz{before}, expected 0 or above, ascending")
    return lines_hz


def checked_band(
    frequency_hz: FloatArray, band_hz: tuple[float, float] | None
) -> tuple[float, float]:
    """(low, high): all lines where nothing is asked for.

    Raises
    ------
    ValueError
        If the band is no pair of ascending numbers.
    """
    if band_hz is None:
        lines_hz = frequency_hz if frequency_hz.size else np.full(1, np.nan)
        return float(lines_hz[0]), float(lines_hz[-1])
    return band(band_hz)


def _numbers(values: npt.ArrayLike, name: str, kind: type) -> npt.NDArray:
    """Array of a kind; ``ValueError`` naming the field where the values are no array of numbers."""
    try:
        return np.asarray(values, kind)
    except (TypeError, ValueError):
        require(False, name, values, "an array of numbers")
        raise


def _check_dof(dof: float, name: str) -> None:
    require(number(dof, name) >= 0, name, dof, "a number of degrees of freedom, 0 or above")


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
    level_known : (batch,) bool
        Whether there is a variance above 0 at all; points without are weighted alike on all lines.
    total_known : bool
        Whether the variance is of noise and distortion.
    noise : (batch, F) float or None
        Variance from noise alone, where it is known as well then.
    """

    data: BinData
    known: VarianceModel
    level_known: BoolArray
    total_known: bool = False
    noise: FloatArray | None = None


def lines_of_frf(frf: FRF) -> WeightedLines:
    """Of an FRF with (..., F) arrays as `checked_frf` leaves it; its lines are those of the band."""
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
