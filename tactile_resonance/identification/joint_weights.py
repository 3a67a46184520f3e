# SPDX-License-Identifier: Apache-2.0
"""What the bins of the joint estimator are weighted with: the noise between harmonics.

Data of a point are one row, or several where it is several records; these pool their noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.joint_layout import JointLayout
from tactile_resonance.identification.joint_noise import (
    JointNoise,
    NoiseBands,
    noise_between_harmonics,
    rough_noise,
)

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


def step_near(
    points: Any, theta: FloatArray, data: list[BinData], u_o: ComplexArray, records: int = 1
) -> FloatArray:
    """One undamped step from start values: residuals are then all but noise.

    With weights as the errors show them at the start.

    Parameters
    ----------
    points : OnePoint, ManyPoints or SharedPoints
    theta : (n,), (batch, n) or (batch, M, n) float
    data : list of BinData
        Bins between harmonics, and excited ones.
    u_o : (batch M, K_o) complex
        Input between harmonics.
    records : int
        M.
    """
    value = points.evaluate(theta)
    error = value.error_of(0)
    size = records * error.shape[1]
    noise = rough_noise(error.reshape(-1, size), u_o.reshape(-1, size))
    variance_y, variance_u = (v if records == 1 else v.repeat(records, axis=0) for v in noise)
    others, excited = data
    points.weigh(
        [
            BinData(others.y, None, variance_y),
            BinData(excited.y, excited.u, variance_y, variance_u),
        ]
    )
    gradient, normal = points.normals(points.weight(value))
    moved = theta - points.step(normal, gradient)[0]
    return np.where(np.isfinite(moved).all(axis=-1, keepdims=True), moved, theta)


def noise_of(
    layout: JointLayout,
    error: ComplexArray,
    theta: FloatArray,
    u_o: ComplexArray,
    bands: NoiseBands,
    records: int = 1,
) -> JointNoise:
    """The noise that the bins between harmonics show, pooled over the records of a point.

    Parameters
    ----------
    layout : JointLayout
    error, u_o : (batch M, K_o) complex
        Y without its transient, and U.
    theta : (batch, n) float
        Of which A and B count.
    bands : NoiseBands
        Of as many records.
    records : int
        M.
    """

    def response() -> ComplexArray:
        alpha, beta, _ = layout.problem.split(theta)
        g = np.asarray(
            (beta @ layout.numerator_on_others.T) / (alpha @ layout.problem.groups[0].denominator.T)
        )
        return g if records == 1 else g.repeat(records, axis=1)

    return noise_between_harmonics(
        _bin_by_bin(error, records),
        _bin_by_bin(u_o, records),
        response,
        bands,
        layout.problem.sizes[2] * records,
    )


def weighted(
    data: list[BinData], noise: JointNoise, bands: NoiseBands, records: int = 1
) -> list[BinData]:
    """Data with the variances of their noise, and without what came through the input."""
    others, excited = data
    y_o = others.y
    if noise.through_input is not None:
        y_o = y_o - _row_by_row(noise.through_input, records)

    def each(variance: npt.NDArray) -> npt.NDArray:
        return variance if records == 1 else variance.repeat(records, axis=0)

    covariance = noise.covariance_yu
    return [
        BinData(y_o, None, each(noise.on(bands.of_others, noise.variance_rest))),
        BinData(
            excited.y,
            excited.u,
            each(noise.on(bands.of_excited, noise.variance_y)),
            each(noise.on(bands.of_excited, noise.variance_u)),
            None if covariance is None else each(covariance),
        ),
    ]


def _bin_by_bin(values: ComplexArray, records: int) -> ComplexArray:
    """(batch, K M) of (batch M, K): the records of a bin side by side."""
    if records == 1:
        return values
    size = values.shape[1]
    return values.reshape(-1, records, size).swapaxes(1, 2).reshape(-1, size * records)


def _row_by_row(values: ComplexArray, records: int) -> ComplexArray:
    """(batch M, K) of (batch, K M)."""
    if records == 1:
        return values
    size = values.shape[1] // records
    return values.reshape(-1, size, records).swapaxes(1, 2).reshape(-1, size)
