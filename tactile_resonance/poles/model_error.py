# SPDX-License-Identifier: Apache-2.0
"""What a model that leaves something out adds to the uncertainty of its poles."""

from __future__ import annotations

import numpy as np

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.modes import in_any_direction
from tactile_resonance.poles.plan import FitPlan
from tactile_resonance.poles.result import natural_frequency_and_damping

# A cost that noise alone exceeds once in a thousand fits counts as model error.
MODEL_ERROR_PROBABILITY = 1e-3


def systematic_of(
    plan: FitPlan,
    data: BinData,
    theta: FloatArray,
    wrong: BoolArray,
    plan_of_theta: FitPlan | None = None,
) -> FloatArray:
    """Outer products of what halves of the data, and one mode more, move each pole by where a model is wrong.

    Halves are those of the driven bins and, of several records, the first and the last ones. Where one of
    these fits has no such mode, or does not determine it, half its width stands for all: what lies nearer to a
    mode looks like part of it.

    Parameters
    ----------
    plan : FitPlan
    data : BinData
    theta : (points, M, n) float
        Of the fit, where those to halves begin.
    wrong : (points,) bool
    plan_of_theta : FitPlan, optional
        Over whose bases the coefficients are, where not of `plan`.

    Returns
    -------
    (points, places, 2, 2) float
        In (f0_hz, damping_ratio); 0 where the model is not wrong.
    """
    systematic = np.zeros((wrong.size, plan.structure.order // 2, 2, 2))
    if not wrong.any():
        return systematic
    data, theta = data.rows(np.flatnonzero(wrong)), theta[wrong]
    poles_rad_s = (plan_of_theta or plan).poles_in_band(theta[:, 0])
    poles = []
    for parity in (0, 1):
        left_out = np.arange(data.driven) % 2 == parity
        half = data.weighted(variance_y=np.where(left_out, np.inf, data.variance_y))
        poles.append(plan.compared(half, theta))
    moved = difference_of_halves(*poles)
    half_of = data.records // 2
    if half_of > 0:
        first, last = slice(0, half_of), slice(data.records - half_of, None)
        poles = [plan.compared(data.part(which), theta[:, which]) for which in (first, last)]
        moved = moved + difference_of_halves(*poles)
    if plan.richer is not None and data.lines.min() > plan.richer.structure.fewest_lines:
        moved = moved + difference_of_models(poles_rad_s, *plan.richer.with_covariance(data))
    half_width = in_any_direction(np.abs(poles_rad_s.real), poles_rad_s)
    known = np.isfinite(moved).all(axis=(-2, -1), keepdims=True)
    systematic[wrong] = np.where(known, moved, half_width)
    return systematic


def model_error_factor(
    residual: ComplexArray, cost: FloatArray, expected_cost: FloatArray
) -> FloatArray:
    """(batch,) factor from the covariance of noise to that of noise and model error.

    The excess of the cost shows how large the errors are; their correlation from line to line, how
    many of them act together: errors that keep their sign over L lines disturb a coefficient as L
    times fewer lines of independent errors would.

    Parameters
    ----------
    residual : (batch, F) complex
        Weighted.
    cost, expected_cost : (batch,) float
    """
    ratio = np.fmax(cost / expected_cost, 1.0)  # 1 where the level itself is from the residuals
    return ratio * correlation_length(residual)


def correlation_length(residual: ComplexArray) -> FloatArray:
    """(batch,) ``1 + 2 sum rho`` over the correlations of residuals (batch, F).

    Sokal's automatic window: the sum ends at the lag that exceeds five times itself.
    """
    lines = residual.shape[-1]
    padded = np.fft.fft(residual, 2 * lines, axis=-1)
    correlation = np.fft.ifft(np.abs(padded) ** 2, axis=-1).real[:, :lines]
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = correlation / correlation[:, :1]
    length = 2 * np.cumsum(np.nan_to_num(rho), axis=-1) - 1  # (batch, F)
    enough = np.arange(lines) >= 5 * length
    window = np.where(enough.any(axis=-1), np.argmax(enough, axis=-1), lines - 1)
    return np.maximum(np.take_along_axis(length, window[:, None], axis=-1)[:, 0], 1.0)


def difference_of_halves(even_rad_s: ComplexArray, odd_rad_s: ComplexArray) -> FloatArray:
    """Outer product of what even and odd lines differ by in (f0_hz, damping_ratio).

    What one wild line does shows in no residual of its neighbours; it does between halves of the
    lines.

    Parameters
    ----------
    even_rad_s, odd_rad_s : (..., places) complex
        Poles found from either half; NaN where a half does not have the mode.

    Returns
    -------
    (..., places, 2, 2) float
    """
    even, odd = (
        np.stack(natural_frequency_and_damping(p), axis=-1) for p in (even_rad_s, odd_rad_s)
    )
    difference = even - odd  # (..., places, 2)
    return np.asarray(difference[..., :, None] * difference[..., None, :])


def difference_of_models(
    poles_rad_s: ComplexArray, richer_rad_s: ComplexArray, covariance: FloatArray
) -> FloatArray:
    """Outer product of what a model with one mode more moves each pole by in (f0_hz, damping_ratio).

    Two modes nearer to each other than their widths are fitted by one between them so well that
    residuals say little about how far it is from either.

    Parameters
    ----------
    poles_rad_s : (..., places) complex
    richer_rad_s : (..., more places) complex
        NaN where there is no mode; the nearest one counts.
    covariance : (..., more places, 2, 2) float
        Of (f0_hz, damping_ratio) of the latter.

    Returns
    -------
    (..., places, 2, 2) float
        With the covariance of the nearest one; NaN where the richer model has or determines no mode.
    """
    distance = np.abs(richer_rad_s[..., None, :] - poles_rad_s[..., None])  # (..., places, more)
    nearest = np.argmin(np.where(np.isfinite(distance), distance, np.inf), axis=-1)
    other = np.take_along_axis(richer_rad_s, nearest, axis=-1)
    moved = difference_of_halves(poles_rad_s, other)
    return np.asarray(moved + np.take_along_axis(covariance, nearest[..., None, None], axis=-3))
