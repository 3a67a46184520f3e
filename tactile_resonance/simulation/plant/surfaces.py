# SPDX-License-Identifier: Apache-2.0
"""What lies on the simulated table: surfaces (flat, a sphere, a hollow); how living tissue moves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.vectors import Vector, added, dot, scaled, vector
from tactile_resonance.fields import Checked, Range, Seed, require


@dataclass(frozen=True)
class PlantSurface:
    """A plane, a sphere of tissue, touched from outside, or a hollow in tissue, touched from inside.

    Heights above a sphere are radial, so that a ball of radius r is pressed in by r less the height of its
    centre, exactly, wherever it is.

    Attributes
    ----------
    point_m, normal : (3,) arrays
        A place of it, and the direction out of the tissue there, of length 1.
    curvature_per_m : float
        Along any direction; 0 of a plane, below 0 of a hollow.
    """

    point_m: FloatArray
    normal: FloatArray
    curvature_per_m: float = 0.0

    @classmethod
    def tilted(cls, height_m: float, tilt_rad: float = 0.0, azimuth_rad: float = 0.0) -> PlantSurface:
        """Return the plane through (0, 0, height), its normal tilted from +z towards an azimuth."""
        sine = math.sin(tilt_rad)
        normal = [sine * math.cos(azimuth_rad), sine * math.sin(azimuth_rad), math.cos(tilt_rad)]
        return cls(np.array([0.0, 0.0, height_m]), np.array(normal))

    @cached_property
    def _floats(self) -> tuple[Vector, Vector]:
        return vector(self.point_m), vector(self.normal)

    def height_of(self, position_m: Vector) -> tuple[float, Vector]:
        """Height of a position above it [m], and the normal there.

        Raises
        ------
        ValueError
            In the centre of a sphere, which has no normal.
        """
        (x, y, z), normal = self._floats
        way = (position_m[0] - x, position_m[1] - y, position_m[2] - z)
        if self.curvature_per_m == 0.0:
            return dot(normal, way), normal
        # from the centre, or towards that of a hollow, in radii
        out = added(scaled(self.curvature_per_m, way), normal)
        away = math.hypot(*out)
        require(away > 0, "position_m", position_m, "a place beside the sphere's centre")
        return (away - 1) / self.curvature_per_m, scaled(1 / away, out)


def relative_radius_m(tip_radius_m: float, surface: PlantSurface) -> float:
    """Radius R of the ball that a flat surface would have to meet to be pressed alike [m].

    ``1 / R = 1 / r + k`` for a ball of radius r on a surface of curvature k (Hertz 1882; Johnson, *Contact
    Mechanics* (1985), section 4.2): smaller on a sphere, larger in a hollow. The tissue still yields as a
    half-space, which holds while the contact is small against the surface's own radius.

    Raises
    ------
    ValueError
        If the ball is not smaller than the hollow: it would touch along its rim.
    """
    flatter = 1 / tip_radius_m + surface.curvature_per_m
    accepted = f"below the radius of the hollow, {-1 / (surface.curvature_per_m or -1):g} m"
    require(flatter > 0, "tip_radius_m", tip_radius_m, accepted)
    return 1 / flatter


@dataclass(frozen=True)
class SurfaceMotion(Checked):
    """Displacement of a surface along its outward normal, as a function of time.

    Breath is ``b cos^{2n}(pi f t + phase)`` (Lujan, Larsen, Balter & Ten Haken, Med. Phys. 26 (1999) 715):
    0 and quiet at end-expiration, b at end-inspiration. The heartbeat is a sinusoid about it.

    Attributes
    ----------
    breath_m : float
        Peak to peak, b [m].
    breath_hz : float
        f [Hz].
    breath_power : int
        n, 1 to 3: the larger, the longer it is quiet at end-expiration.
    heart_m : float
        Peak to peak [m].
    heart_hz : float
    phase_seed : int
        Of both phases at time 0, uniform.
    """

    breath_m: Annotated[float, Range(0, 0.02)] = 0.0
    breath_hz: Annotated[float, Range(0.05, 2.0)] = 0.25
    breath_power: Annotated[int, Range(1, 3)] = 3
    heart_m: Annotated[float, Range(0, 0.005)] = 0.0
    heart_hz: Annotated[float, Range(0.3, 10.0)] = 1.2
    phase_seed: Seed = 1

    @cached_property
    def phases_rad(self) -> tuple[float, float]:
        """Of breath and heart at time 0; a breath is over after pi of the first."""
        breath, heart = np.random.default_rng(self.phase_seed).uniform(0, 1, 2).tolist()
        return math.pi * breath, 2 * math.pi * heart

    def displacement_m(self, time_s: float) -> float:
        """Of the surface at a time [m]; 0 is end-expiration between two heartbeats."""
        breath, heart = self.phases_rad
        breath += math.pi * self.breath_hz * time_s
        heart += 2 * math.pi * self.heart_hz * time_s
        rise = self.breath_m * math.cos(breath) ** (2 * self.breath_power)
        return rise + self.heart_m / 2 * math.sin(heart)
