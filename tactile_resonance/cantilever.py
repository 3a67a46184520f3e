# SPDX-License-Identifier: Apache-2.0
"""Eigenvalues and shapes of a uniform cantilever with a tip mass (Euler-Bernoulli).

Free-vibration equation: Erturk & Inman, *Piezoelectric Energy Harvesting* (2011), appendix C.1, without rotary
inertia of the tip.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from tactile_resonance._typing import FloatArray


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
        brentq(frequency_equation, n * np.pi, (n + 1) * np.pi, args=(mass_ratio,), xtol=1e-15)
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
