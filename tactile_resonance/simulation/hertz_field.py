# SPDX-License-Identifier: Apache-2.0
"""Stresses under a Hertz contact, and how much of what lies below a tip feels.

Where the modulus under the tip varies from place to place, the compliance it feels is, to first
order in the contrast, the mean of 1 / E weighted with the strain energy of the homogeneous contact.
For any contrast this mean is an upper bound of the compliance (principle of least complementary
energy: the homogeneous stresses are statically admissible), hence it never overstates what a stiff
inclusion does.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance.simulation.modal import FloatArray
from tactile_resonance.simulation.shapes import Shape


def hertz_stress(radial: ArrayLike, depth: ArrayLike) -> tuple[FloatArray, ...]:
    """Return (s_r, s_theta, s_z, tau_rz) below a sphere on an incompressible half-space.

    Closed form of Huber (1904), see Johnson, *Contact Mechanics* (1985), ch. 3.4, or
    Fischer-Cripps, *Introduction to Contact Mechanics* (2007), ch. 5.4.

    Parameters
    ----------
    radial, depth : (...) arrays
        In contact radii; depth above 0.

    Returns
    -------
    tuple of (...) arrays
        In units of the mean contact pressure, tension positive.
    """
    r, z = np.asarray(radial, dtype=float), np.asarray(depth, dtype=float)
    sum_ = r**2 + z**2 - 1
    root = np.sqrt(sum_**2 + 4 * z**2)
    # (sum + root) / 2 without cancellation where the sum is negative
    u = np.where(sum_ > 0, (sum_ + root) / 2, 2 * z**2 / (root - np.minimum(sum_, 0)))
    slant = z / np.sqrt(u)
    own = slant**3 * u / (u**2 + z**2)
    side = slant * (0.5 * u / (1 + u) + 1.5 * np.sqrt(u) * np.arctan(1 / np.sqrt(u)))
    s_r = 1.5 * (own + side - 2 * slant)
    s_theta = -1.5 * (slant + slant * 0.5 * u / (1 + u))
    s_theta = s_theta + 1.5 * slant * 1.5 * np.sqrt(u) * np.arctan(1 / np.sqrt(u))
    s_z = -1.5 * own
    tau = -1.5 * r * z**2 / (u**2 + z**2) * np.sqrt(u) / (1 + u)
    return s_r, s_theta, s_z, tau


def energy_density(radial: ArrayLike, depth: ArrayLike) -> FloatArray:
    """Return the strain energy density times G over the mean pressure squared, (...) array."""
    s_r, s_theta, s_z, tau = hertz_stress(radial, depth)
    mean = (s_r + s_theta + s_z) / 3
    square = (s_r - mean) ** 2 + (s_theta - mean) ** 2 + (s_z - mean) ** 2 + 2 * tau**2
    return np.asarray(square / 4)


@lru_cache(maxsize=1)
def energy_nodes() -> tuple[FloatArray, FloatArray]:
    """Return points (N, 3) below the contact, in contact radii, and their energies (N,), sum 1.

    Products of Gauss-Legendre rules in distance and polar angle, turned about the normal by the
    golden angle from one to the next, so that no plane of symmetry meets many points at once.
    """
    s, ws = np.polynomial.legendre.leggauss(64)
    t, wt = np.polynomial.legendre.leggauss(32)
    azimuths = 48
    s, ws = (s + 1) / 2, ws / 2
    distance, jacobian = s / (1 - s), 1 / (1 - s) ** 2
    angle = (t + 1) * np.pi / 4  # from the normal
    radial = np.outer(distance, np.sin(angle))  # (s, t)
    depth = np.outer(distance, np.cos(angle))
    weight = np.outer(ws * jacobian * distance**2, wt * np.sin(angle)) * energy_density(
        radial, depth
    )
    turn = np.arange(radial.size).reshape(radial.shape) * np.pi * (3 - np.sqrt(5))
    phi = turn[..., None] + 2 * np.pi / azimuths * np.arange(azimuths)  # (s, t, azimuths)
    points = np.stack(
        [
            radial[..., None] * np.cos(phi),
            radial[..., None] * np.sin(phi),
            np.broadcast_to(-depth[..., None], phi.shape),
        ],
        axis=-1,
    ).reshape(-1, 3)
    weights = np.broadcast_to(weight[..., None], phi.shape).ravel()
    return points, weights / weights.sum()


def energy_share(shape: Shape, surface_point_m: ArrayLike, contact_radius_m: float) -> float:
    """Return the share of the strain energy that lies inside a shape, 0 to 1.

    Parameters
    ----------
    shape : Shape
    surface_point_m : (3,) array
        Where the tip touches; the normal is +z.
    contact_radius_m : float
    """
    points, weights = energy_nodes()
    inside = shape.contains(np.asarray(surface_point_m) + contact_radius_m * points)
    return float(weights[inside].sum())
