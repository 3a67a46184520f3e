# SPDX-License-Identifier: Apache-2.0
"""What the bins of the joint estimator are weighted with: the noise between harmonics.

The records of a point pool their noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.poles import likelihood
from tactile_resonance.poles.bins import BinData
from tactile_resonance.poles.joint_layout import JointLayout
from tactile_resonance.poles.joint_noise import (
    JointNoise,
    NoiseBands,
    correlation_limit,
    noise_between_harmonics,
)

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


def begin(layout: JointLayout, data: BinData, bands: NoiseBands) -> tuple[FloatArray, JointNoise]:
    """Coefficients (points, M, n) near the minimum, and the noise between harmonics there.

    Parameters
    ----------
    layout : JointLayout
    data : BinData
        With variances of 1.
    bands : NoiseBands
        Of as many records.
    """
    limit = correlation_limit(data.records * data.undriven)
    problem = layout.problem
    theta, powers = likelihood.begin(
        problem.tables, problem.from_driven, data.arrays, limit, bands.size, bands.starts.size
    )
    return theta, _noise(layout, data, theta, bands, powers)


def noise_of(
    layout: JointLayout, data: BinData, theta: FloatArray, bands: NoiseBands
) -> JointNoise:
    """The noise that the bins between harmonics show, pooled over the records of a point.

    Parameters
    ----------
    layout : JointLayout
    data : BinData
    theta : (points, M, n) float
    bands : NoiseBands
        Of as many records.
    """
    tables, pieces = layout.problem.tables, bands.starts.size
    powers = likelihood.undriven_powers(tables, data.arrays, theta, bands.size, pieces)
    return _noise(layout, data, theta, bands, powers)


def _noise(
    layout: JointLayout, data: BinData, theta: FloatArray, bands: NoiseBands, powers: FloatArray
) -> JointNoise:
    records, problem = data.records, layout.problem

    def signals() -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        alpha, beta, _ = problem.split(theta[:, 0])
        of_a = alpha @ problem.denominator[: problem.undriven].T
        g = np.asarray((beta @ layout.numerator_on_others.T) / of_a)
        error = likelihood.undriven_errors(problem.tables, data.arrays, theta)
        u = data.u[..., : data.undriven]
        return _bin_by_bin(error), _bin_by_bin(u), g.repeat(records, axis=1)

    return noise_between_harmonics(powers, signals, bands, problem.sizes[2] * records)


def weighted(data: BinData, noise: JointNoise, bands: NoiseBands) -> BinData:
    """Data with the variances of their noise, and without what came through the input."""
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
