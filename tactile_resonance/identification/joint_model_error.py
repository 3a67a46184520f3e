# SPDX-License-Identifier: Apache-2.0
"""What parts of the data and a richer model make of the poles that a joint fit found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.covariance import invert_normal, pole_quantities
from tactile_resonance.identification.joint_layout import JointLayout
from tactile_resonance.identification.model_error import (
    COMPARISON_ITERATIONS,
    difference_of_halves,
    difference_of_models,
)
from tactile_resonance.identification.problem import Problem
from tactile_resonance.identification.shared_points import minimise_shared
from tactile_resonance.identification.solver import minimise

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]


def systematic_of(layout: JointLayout, data: list[BinData], theta: FloatArray) -> FloatArray:
    """Outer products of what halves of the data, and one mode more, move each pole by.

    Halves are those of the excited bins and, of several realisations, the first and the last ones.

    Parameters
    ----------
    layout : JointLayout
    data : list of BinData
        Of a batch of records, or, of several realisations, of (batch M) rows.
    theta : (batch, n) or (batch, M, n) float
        The fit.

    Returns
    -------
    (batch, places, 2, 2) float
        In (f0_hz, damping_ratio).
    """
    *other, excited = data
    poles = []
    for parity in (0, 1):
        left_out = np.arange(excited.y.shape[1]) % 2 == parity
        half = replace(excited, variance_y=np.where(left_out, np.inf, excited.variance_y))
        poles.append(layout.poles_in_band(_fit(layout.problem, [*other, half], theta.shape, theta)))
    systematic = difference_of_halves(*poles)
    if theta.ndim == 3:
        systematic = systematic + _of_realisations(layout, data, theta)
    if layout.richer is not None:
        first = theta if theta.ndim == 2 else theta[:, 0]
        found, covariance = None, None
        if theta.ndim == 2:
            found, covariance = _richer_poles(layout.richer, data)
        else:
            found = layout.richer.poles_in_band(
                _fit(layout.richer.problem, [*other, excited], theta.shape, None)
            )
        systematic = systematic + difference_of_models(
            layout.poles_in_band(first), found, covariance
        )
    return systematic


def _richer_poles(layout: JointLayout, data: list[BinData]) -> tuple[ComplexArray, FloatArray]:
    """(batch, places) poles of a fit, and (batch, places, 2, 2) the covariance of their quantities."""
    solution = minimise(layout.problem, data, None, COMPARISON_ITERATIONS)
    inverse, _ = invert_normal(solution.normal.sum(axis=1))
    dof = max(sum(values.y.shape[1] for values in data) - inverse.shape[-1] / 2, 1)
    covariance = inverse * (solution.cost / (2 * dof))[:, None, None]
    quantities = pole_quantities(layout.model_of(solution.theta), layout.band_hz, covariance)
    return quantities["poles_rad_s"], quantities["covariance"]


def _of_realisations(layout: JointLayout, data: list[BinData], theta: FloatArray) -> FloatArray:
    """(batch, places, 2, 2) what the first and the last realisations make of the poles."""
    batch, records, _ = theta.shape
    order = np.arange(batch * records) % records
    poles = []
    for part in (order < records // 2, order >= records - records // 2):
        start = theta.reshape(batch * records, -1)[part].reshape(batch, records // 2, -1)
        half = [values.rows(part) for values in data]
        poles.append(layout.poles_in_band(_fit(layout.problem, half, start.shape, start)))
    return difference_of_halves(*poles)


def _fit(
    problem: Problem, data: list[BinData], shape: tuple[int, ...], start: FloatArray | None
) -> FloatArray:
    """(batch, n) coefficients; of several realisations those of the first."""
    if len(shape) == 2:
        return minimise(problem, data, start, COMPARISON_ITERATIONS).theta
    return minimise_shared(problem, data, shape[1], start, COMPARISON_ITERATIONS).theta[:, 0]
