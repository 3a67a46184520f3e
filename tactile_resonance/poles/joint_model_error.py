# SPDX-License-Identifier: Apache-2.0
"""What parts of the data and a richer model make of the poles that a joint fit found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.poles.bins import BinData
from tactile_resonance.poles.covariance import pole_quantities
from tactile_resonance.poles.fit import minimise
from tactile_resonance.poles.joint_layout import JointLayout
from tactile_resonance.poles.likelihood import invert
from tactile_resonance.poles.model_error import (
    COMPARISON_ITERATIONS,
    difference_of_halves,
    difference_of_models,
)

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]


def systematic_of(layout: JointLayout, data: BinData, theta: FloatArray) -> FloatArray:
    """Outer products of what halves of the data, and one mode more, move each pole by.

    Halves are those of the excited bins and, of several realisations, the first and the last ones.

    Parameters
    ----------
    layout : JointLayout
    data : BinData
    theta : (points, M, n) float
        The fit.

    Returns
    -------
    (points, places, 2, 2) float
        In (f0_hz, damping_ratio).
    """
    poles = []
    for parity in (0, 1):
        left_out = np.arange(data.u_driven.shape[-1]) % 2 == parity
        half = replace(data, variance_y=np.where(left_out, np.inf, data.variance_y))
        poles.append(_poles(layout, half, theta))
    systematic = difference_of_halves(*poles)
    half_of = data.records // 2
    if half_of > 0:
        first, last = slice(0, half_of), slice(data.records - half_of, None)
        poles = [_poles(layout, data.part(which), theta[:, which]) for which in (first, last)]
        systematic = systematic + difference_of_halves(*poles)
    if layout.richer is not None:
        found, covariance = _richer_poles(layout.richer, data)
        here = layout.poles_in_band(theta[:, 0])
        systematic = systematic + difference_of_models(here, found, covariance)
    return systematic


def _poles(layout: JointLayout, data: BinData, start: FloatArray) -> ComplexArray:
    """(points, places) poles of a fit that others are compared with."""
    theta = minimise(layout.problem, data, start, COMPARISON_ITERATIONS).theta
    return layout.poles_in_band(theta[:, 0])


def _richer_poles(layout: JointLayout, data: BinData) -> tuple[ComplexArray, FloatArray | None]:
    """(points, places) poles of a fit, and (points, places, 2, 2) the covariance of their quantities.

    None of several records.
    """
    solution = minimise(layout.problem, data, None, COMPARISON_ITERATIONS)
    theta = solution.theta[:, 0]
    if data.records > 1:
        return layout.poles_in_band(theta), None
    inverse, _ = invert(solution.normal[:, 0].sum(axis=1))
    dof = max(data.y.shape[-1] - inverse.shape[-1] / 2, 1)
    covariance = inverse * (solution.cost / (2 * dof))[:, None, None]
    quantities = pole_quantities(layout.model_of(theta), layout.band_hz, covariance)
    return quantities["poles_rad_s"], quantities["covariance"]
