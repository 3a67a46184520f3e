# SPDX-License-Identifier: Apache-2.0
"""Eigenvalues and shapes of a uniform cantilever with a tip mass (Euler-Bernoulli), and that mass from them.

Free-vibration equation: Erturk & Inman, *Piezoelectric Energy Harvesting* (2011), appendix C.1, without rotary
inertia of the tip.
"""

from __future__ import annotations

import numpy as np
import scipy  # its parts are loaded where they are used first: scipy.optimize takes a node 0.15 s
from scipy import special

from tactile_resonance._typing import FloatArray
from tactile_resonance.calibration.model import Calibration

THEORY_STD = 1e-3
"""Relative: what glue, shear and a clamp that gives make of the frequencies and shapes of a real beam."""
CONTRADICTED = 1e-4
"""Probability of so large residuals by chance, below which modes are not those of such a beam."""


def frequency_equation(beta: float, mass_ratio: float) -> float:
    """Return the frequency equation divided by cosh(beta), so that it does not overflow.

    ``1/cosh + cos + mu beta (cos tanh - sin)``, zero at the eigenvalues.
    """
    # exp(-beta) form of 1 / cosh: no overflow at any beta
    sech = 2 * np.exp(-beta) / (1 + np.exp(-2 * beta))
    inertia = mass_ratio * beta * (np.cos(beta) * np.tanh(beta) - np.sin(beta))
    return float(sech + np.cos(beta) + inertia)


def cantilever_eigenvalues(mass_ratio: float, count: int) -> FloatArray:
    """Return the first `count` eigenvalues beta of a cantilever with tip mass, shape (count,).

    Parameters
    ----------
    mass_ratio : float
        Tip mass over beam mass, 0 or above.
    count : int
        Number of modes.

    Notes
    -----
    With growing tip mass root n falls from that of the bare cantilever (mu = 0) to that of a beam
    clamped at one end and pinned at the other (mu = infinity, ``tan = tanh``). Both bounds lie in
    ``((n - 1) pi, n pi)``, n = 1 ... count, and no other root does; at ``n pi`` the equation has
    the sign of ``cos(n pi)``, at ``(n - 1) pi`` the opposite: a bracket for every root.
    """
    if mass_ratio < 0:
        raise ValueError(f"mass_ratio: got {mass_ratio!r}; accepted is 0 or above")
    roots = [
        scipy.optimize.brentq(frequency_equation, n * np.pi, (n + 1) * np.pi, args=(mass_ratio,), xtol=1e-15)
        for n in range(count)
    ]
    return np.array(roots)


def mode_shape(beta: FloatArray, position: FloatArray) -> FloatArray:
    """Return unnormalised mode shapes, shape (n, x).

    ``cosh bx - cos bx - sigma (sinh bx - sin bx)`` with ``sigma = (cosh + cos) / (sinh + sin)`` at
    the tip (no bending moment there). The growing exponentials are joined beforehand,
    ``cosh bx - sigma sinh bx = exp(-bx) + (1 - sigma) sinh bx``, so that no large terms cancel.

    Parameters
    ----------
    beta : (n,) array
        Eigenvalues.
    position : (x,) array
        Positions over the free length, 0 (clamp) to 1 (tip).
    """
    sigma, growing = _shape_factors(beta)  # (n,), (n,)
    bx = beta[:, None] * position  # (n, x)
    decay, sharp = np.exp(-bx), np.exp(bx - beta[:, None])  # exp(-bx), exp(bx - b)
    # (1 - sigma) sinh bx, with (1 - sigma) = growing * exp(-b)
    rising = growing[:, None] * (sharp - decay * np.exp(-beta[:, None])) / 2
    return decay + rising - np.cos(bx) + sigma[:, None] * np.sin(bx)


def _shape_factors(beta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return sigma and ``(1 - sigma) exp(beta)``, both without overflow or cancellation."""
    fall = np.exp(-beta)
    denominator = (1 - fall**2) / 2 + np.sin(beta) * fall  # (sinh + sin) exp(-beta)
    sigma = ((1 + fall**2) / 2 + np.cos(beta) * fall) / denominator
    growing = (np.sin(beta) - np.cos(beta) - fall) / denominator
    return sigma, growing


def tip_shape(beta: FloatArray, beam_mass: float, tip_mass: float) -> tuple[FloatArray, FloatArray]:
    """Return mass-normalised deflection and slope (per unit of relative position) at the tip."""
    nodes, weights = np.polynomial.legendre.leggauss(16 * beta.size + 32)
    shape = mode_shape(beta, (nodes + 1) / 2)  # (n, x)
    deflection = mode_shape(beta, np.ones(1))[:, 0]
    modal_mass = beam_mass * (shape**2 @ weights) / 2 + tip_mass * deflection**2  # (n,)
    sigma, growing = _shape_factors(beta)
    fall = np.exp(-beta)
    slope = -fall + growing * (1 + fall**2) / 2 + np.sin(beta) + sigma * np.cos(beta)
    return deflection / np.sqrt(modal_mass), beta * slope / np.sqrt(modal_mass)


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

    def residual(x: FloatArray) -> FloatArray:
        """Of logarithms: rate, mass of the beam, mass of the tip over it."""
        ratio = float(np.exp(x[2]))
        beta = cantilever_eigenvalues(ratio, int(known[-1]) + 1)[known]
        shape = np.abs(tip_shape(beta, 1.0, ratio)[0])
        logs = np.concatenate([x[0] + 2 * np.log(beta), np.log(shape) - x[1] / 2])
        return np.asarray(whiten @ (logs - np.log(values)))

    # a bare cantilever's shapes are 2 at the tip, of a mass of 1
    start = [np.log(values[0] / 3.5), -2 * np.log(values[known.size] / 2), np.log(0.05)]
    found = scipy.optimize.least_squares(residual, start, diff_step=1e-6, bounds=([-50, -50, -12], 50))
    chance = float(special.chdtrc(values.size - 3, 2 * found.cost))
    if chance < CONTRADICTED:
        return nan, nan, "the modes are not those of a uniform cantilever with a point mass"
    of_x = np.linalg.inv(found.jac.T @ found.jac)
    mass = float(np.exp(found.x[1] + found.x[2]))
    std = mass * float(np.sqrt(of_x[1:, 1:].sum()))
    if std > mass / 4:
        return nan, nan, f"{1e6 * mass:.3g} +- {1e6 * std:.2g} mg is no statement"
    return mass, std, ""
