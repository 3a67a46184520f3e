# SPDX-License-Identifier: Apache-2.0
"""What a fit to lines is given, checked: shapes, axes and what each means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import band, number, require, require_kind
from tactile_resonance.frf.result import FRF

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
    variances: dict[str, FloatArray | None] = {}
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
    return replace(
        frf,
        frequency_hz=frequency_hz,
        g=g,
        variance_noise=variances["variance_noise"],
        variance_total=variances["variance_total"],
    )


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
