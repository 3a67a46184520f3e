# SPDX-License-Identifier: Apache-2.0
"""The mass of the tip itself, from how the modes of a uniform cantilever lie to each other."""

from __future__ import annotations

import numpy as np
from scipy import optimize, stats

from tactile_resonance.calibration.model import Calibration
from tactile_resonance.cantilever import cantilever_eigenvalues, tip_shape

THEORY_STD = 1e-3
"""Relative: what glue, shear and a clamp that gives make of the frequencies and shapes of a real beam."""
CONTRADICTED = 1e-4


def tip_mass(calibration: Calibration) -> tuple[float, float, str]:
    """Mass of the tip [kg] and its standard deviation; NaN, and why, where the records do not determine it.

    The beam is taken for a uniform one with a point mass at its end: ratios of frequencies then follow from the
    ratio of the masses, and the shapes at the tip from the mass of the beam.
    """
    nan, model = float("nan"), calibration.model
    n = model.modes
    known = np.flatnonzero(calibration.determined[:n] & calibration.determined[3 * n : 4 * n])
    if known.size < 3:
        return nan, nan, "three modes of known shape at the tip, or more, are needed"
    values = np.concatenate([model.natural_rad_s[known], model.tip_deflection[known]])
    if not values.min() > 0:
        return nan, nan, "deflections at the tip are not all above 0"
    index = np.concatenate([known, 3 * n + known])
    covariance = calibration.covariance[np.ix_(index, index)] / np.outer(values, values)
    covariance = covariance + THEORY_STD**2 * np.eye(values.size)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))

    def residual(x: np.ndarray) -> np.ndarray:
        """Of logarithms: rate, mass of the beam, mass of the tip over it."""
        ratio = float(np.exp(x[2]))
        beta = cantilever_eigenvalues(ratio, int(known[-1]) + 1)[known]
        shape = np.abs(tip_shape(beta, 1.0, ratio)[0])
        logs = np.concatenate([x[0] + 2 * np.log(beta), np.log(shape) - x[1] / 2])
        return np.asarray(whiten @ (logs - np.log(values)))

    # a bare cantilever's shapes are 2 at the tip, of a mass of 1
    start = [np.log(values[0] / 3.5), -2 * np.log(values[known.size] / 2), np.log(0.05)]
    found = optimize.least_squares(residual, start, diff_step=1e-6, bounds=([-50, -50, -12], 50))
    chance = float(stats.chi2.sf(2 * found.cost, values.size - 3))
    if chance < CONTRADICTED:
        return nan, nan, "the modes are not those of a uniform cantilever with a point mass"
    of_x = np.linalg.inv(found.jac.T @ found.jac)
    mass = float(np.exp(found.x[1] + found.x[2]))
    std = mass * float(np.sqrt(of_x[1:, 1:].sum()))
    if std > mass / 4:
        return nan, nan, f"{1e6 * mass:.3g} +- {1e6 * std:.2g} mg is no statement"
    return mass, std, ""
