# SPDX-License-Identifier: Apache-2.0
"""Regions of space, and how much of what lies in them a tip feels.

Where the modulus under the tip varies from place to place, the compliance it feels is, to first order in the
contrast, the mean of 1 / E weighted with the strain energy of the homogeneous contact. For any contrast this
mean is an upper bound of the compliance (principle of least complementary energy: the homogeneous stresses are
statically admissible), hence it never overstates what a stiff inclusion does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.contact.vectors import Vector
from tactile_resonance.fields import check_above_zero, require

Point = tuple[float, ...]


class Shape(Protocol):
    """A region of space."""

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell for positions (..., 2 or 3) [m] which lie inside, shape (...)."""
        ...


@dataclass(frozen=True)
class Disc:
    """A disc in x, y at any height: the surface of a round dish."""

    center_m: tuple[float, float]
    radius_m: float

    def __post_init__(self) -> None:
        check_above_zero(self, "radius_m")

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell which positions lie inside or on the edge."""
        distance = np.linalg.norm(position_m[..., :2] - np.asarray(self.center_m), axis=-1)
        return np.asarray(distance <= self.radius_m)


@dataclass(frozen=True)
class Box:
    """A box with edges along the axes; two coordinates per corner leave the height open."""

    low_m: Point
    high_m: Point

    def __post_init__(self) -> None:
        low, high = self.low_m, self.high_m
        require(len(low) in (2, 3), "low_m", low, "2 or 3 coordinates")
        above = len(high) == len(low) and all(a < b for a, b in zip(low, high, strict=True))
        require(above, "high_m", high, f"above low_m = {low} in every coordinate")

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell which positions lie inside or on the faces."""
        position = _coordinates(position_m, len(self.low_m))
        inside = (position >= np.asarray(self.low_m)) & (position <= np.asarray(self.high_m))
        return np.asarray(inside.all(axis=-1))


@dataclass(frozen=True)
class HalfSpace:
    """All positions with ``normal . (position - point) <= 0``."""

    point_m: Point
    normal: Point

    def __post_init__(self) -> None:
        require(len(self.point_m) in (2, 3), "point_m", self.point_m, "2 or 3 coordinates")
        good = len(self.normal) == len(self.point_m) and any(self.normal)
        require(good, "normal", self.normal, "a vector other than 0, of as many coordinates")

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell which positions lie on the side the normal points away from."""
        position = _coordinates(position_m, len(self.normal))
        return np.asarray((position - np.asarray(self.point_m)) @ np.asarray(self.normal) <= 0)


@dataclass(frozen=True)
class Sphere:
    """A ball; positions without a height are taken at height 0."""

    center_m: Vector
    radius_m: float

    def __post_init__(self) -> None:
        check_above_zero(self, "radius_m")

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell which positions lie inside or on the surface."""
        position = _coordinates(position_m, 3)
        way = position - np.asarray(self.center_m)
        return np.asarray(np.einsum("...i,...i", way, way) <= self.radius_m**2)


def _coordinates(position_m: FloatArray, count: int) -> FloatArray:
    """Cut off the height, or add height 0, so that the last axis has `count` coordinates."""
    missing = count - position_m.shape[-1]
    if missing <= 0:
        return position_m[..., :count]
    return np.concatenate([position_m, np.zeros((*position_m.shape[:-1], missing))], axis=-1)


@dataclass(frozen=True, kw_only=True)
class ShapeEntry:
    """Part of a file: one shape."""

    disc: Disc | None = None
    box: Box | None = None
    half_space: HalfSpace | None = None
    sphere: Sphere | None = None

    def shape(self) -> Shape:
        """Return the one that is given; ``ValueError`` if there is none, or more than one."""
        names = ("disc", "box", "half_space", "sphere")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        require(len(given) == 1, "shape", list(given), f"exactly one of {', '.join(names)}")
        (shape,) = given.values()
        return shape


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
