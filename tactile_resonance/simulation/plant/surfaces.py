# SPDX-License-Identifier: Apache-2.0
"""What lies on the simulated table: surfaces (flat, a sphere, a hollow), a scene; how living tissue moves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.vectors import Vector, difference, dot, vector
from tactile_resonance.fields import Checked, Range, Seed, require

if TYPE_CHECKING:
    from tactile_resonance.contact.samples import Pose
    from tactile_resonance.simulation.tissue.hertz import Tissue
    from tactile_resonance.simulation.tissue.scene import PhantomScene


@dataclass(frozen=True)
class FlatSurface:
    """A flat surface through a point; `normal` points out of the tissue and has length 1."""

    point_m: FloatArray
    normal: FloatArray

    @classmethod
    def tilted(
        cls, height_m: float, tilt_rad: float = 0.0, azimuth_rad: float = 0.0
    ) -> FlatSurface:
        """Return the plane through (0, 0, height), its normal tilted from +z towards an azimuth."""
        sine = math.sin(tilt_rad)
        normal = [sine * math.cos(azimuth_rad), sine * math.sin(azimuth_rad), math.cos(tilt_rad)]
        return cls(np.array([0.0, 0.0, height_m]), np.array(normal))

    @property
    def curvature_per_m(self) -> float:
        """None [1/m]."""
        return 0.0

    @cached_property
    def _floats(self) -> tuple[Vector, Vector]:
        return vector(self.point_m), vector(self.normal)

    def height_of(self, position_m: Vector) -> tuple[float, Vector]:
        """Height of a position above the plane [m], and the normal."""
        (x, y, z), normal = self._floats
        return dot(normal, (position_m[0] - x, position_m[1] - y, position_m[2] - z)), normal


@dataclass(frozen=True)
class RoundSurface:
    """A sphere of tissue, touched from outside, or a hollow in tissue, touched from inside.

    Heights are radial, so that a ball of radius r is pressed in by r less the height of its centre, exactly,
    wherever it is.

    Attributes
    ----------
    centre_m : (3,) array
    radius_m : float
    hollow : bool
        Whether the tissue is outside of it.
    """

    centre_m: FloatArray
    radius_m: float
    hollow: bool = False

    def __post_init__(self) -> None:
        require(0 < self.radius_m < math.inf, "radius_m", self.radius_m, "a number above 0")

    @property
    def curvature_per_m(self) -> float:
        """Along any direction [1/m]; below 0 of a hollow."""
        return -1 / self.radius_m if self.hollow else 1 / self.radius_m

    @cached_property
    def _centre(self) -> Vector:
        return vector(self.centre_m)

    def height_of(self, position_m: Vector) -> tuple[float, Vector]:
        """Height of a position above the surface [m], and the normal there: from the centre, or towards it.

        Raises
        ------
        ValueError
            In the centre, which has no normal.
        """
        x, y, z = difference(position_m, self._centre)
        away = math.hypot(x, y, z)
        require(away > 0, "position_m", position_m, "a place beside the sphere's centre")
        sign = -1.0 if self.hollow else 1.0
        normal = sign * x / away, sign * y / away, sign * z / away
        return sign * (away - self.radius_m), normal


PlantSurface = FlatSurface | RoundSurface
"""The undisturbed surface of what lies on the table."""


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


@dataclass(frozen=True)
class LaidScene:
    """A scene on the table: its surface, at height 0, and what lies where.

    Attributes
    ----------
    scene : PhantomScene
    table : Pose
        Frame of the scene in the robot's base.
    """

    scene: PhantomScene
    table: Pose

    def surface(self) -> FlatSurface:
        """The undisturbed surface in the base."""
        return FlatSurface(self.table.position_m, self.table.rotation.apply([0.0, 0.0, 1.0]))

    def tissue_at(self, position_m: FloatArray) -> Tissue | None:
        """What the tip touches under a place (3,) in the base."""
        x, y, _ = self.table.rotation.inv().apply(position_m - self.table.position_m)
        return self.scene.tissue_at(np.array([x, y, 0.0]))
