# SPDX-License-Identifier: Apache-2.0
"""A ball on soft tissue at the end of a spring: force, depth and stiffness.

Hertz, ``F = C u^(3/2)``, u the depth of the ball; with a beam of stiffness k in series the robot
goes the depth ``d = u + F / k``.
"""

from __future__ import annotations

import math

RIGID = math.inf
"""Stiffness of the beam where there is none."""


def force(depth_m: float, c: float, beam_n_per_m: float = RIGID) -> tuple[float, float, float]:
    """Return force [N], its slope over depth [N/m] and over ln C [N]; zeros out of contact.

    Parameters
    ----------
    depth_m : float
        How far the robot has come past the first touch [m].
    c : float
        C [N/m^1.5], above 0.
    beam_n_per_m : float
        Stiffness of the beam in series [N/m].
    """
    if depth_m <= 0:
        return 0.0, 0.0, 0.0
    root = math.sqrt(depth_m)  # of u
    share = 1.0
    if beam_n_per_m != RIGID:
        # C y^3 + k y^2 = k d for the root y of u: a cubic in 1 / y without square, whose one positive
        # solution is that of the cosine of a third of an angle (Viete), or of the hyperbolic one
        bent = 1.5 * math.sqrt(3.0) * c * root / beam_n_per_m
        third = math.cos(math.acos(bent) / 3) if bent < 1 else math.cosh(math.acosh(bent) / 3)
        root *= 0.5 * math.sqrt(3.0) / third
        share = beam_n_per_m / (1.5 * c * root + beam_n_per_m)
    tissue = 1.5 * c * root
    pressed = c * root**3
    return pressed, tissue * share, pressed * share


def depth(force_n: float, c: float, beam_n_per_m: float = RIGID) -> float:
    """Return the depth that the robot must go for a force [m]; 0 for no force."""
    if force_n <= 0:
        return 0.0
    return (force_n / c) ** (2 / 3) + force_n / beam_n_per_m
