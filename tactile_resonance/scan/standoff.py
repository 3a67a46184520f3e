# SPDX-License-Identifier: Apache-2.0
"""How high above its next point the tip of a scan needs to be, from where the surface was touched near by.

How far a plane surface lies off its place is taken to be a plane again, little tilted (Bayesian linear
regression, Bishop, Pattern Recognition and Machine Learning, section 3.3); what the touches leave unknown of it
keeps the tip higher.
"""

from __future__ import annotations

import math

import numpy as np

from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.surface import Plane, Surface, TouchRequest

NEAR_M = 0.01
"""Beyond this nothing is known from a touch, and the tip goes along at the usual height."""
LEAST_M = 7e-4
"""Height above where the surface may be at most."""
STDS = 3.0
HEIGHT_STD_M, SLOPE_STD, ROUGH_M = 1e-3, 0.03, 5e-5
"""Standard deviations before any touch: of the surface about its place, of its tilt [rad], and of what is not
plane, unless the touches show more."""
STILL_M = 5e-5
"""A surface whose motion goes less than this to either side stays where it is: noise may look like 20 um."""
FLAT_M, ALIKE = 1e-4, 1e-6
"""Points lie in one plane where they are no further off it, and their normals have such a cosine to 1."""


class Standoffs:
    """Of one scan; nothing is known where the surface is not plane, or moves.

    Parameters
    ----------
    surface : Surface or TouchRequest
        Of the scene.
    """

    def __init__(self, surface: Surface | TouchRequest) -> None:
        self._plane = is_plane(surface)
        self._found: list[tuple[ScanPoint, float, float]] = []

    def add(self, point: ScanPoint, off_m: float, std_m: float) -> None:
        """Take a touch: how far above its place the surface was, and the standard deviation of that [m]."""
        if self._plane and math.isfinite(off_m) and math.isfinite(std_m):
            self._found.append((point, off_m, std_m))

    def forget(self) -> None:
        """Know nothing from now on: the surface was where it should not have been, or it moves."""
        self._plane = False

    def lowest_m(self, point: ScanPoint) -> float:
        """Height above a point from which its approach may begin [m]; infinite where that is not known."""
        if not (self._plane and self._found and is_along(self._found[-1][0], point)):
            return math.inf
        ways = np.array(
            [np.subtract(found.position_m, point.position_m) for found, *_ in self._found]
        )
        near = np.linalg.norm(ways, axis=1) <= NEAR_M
        off_m, std_m = np.array([entry[1:] for entry in self._found])[near].T  # (n,) each
        at = np.column_stack(
            [np.ones(near.sum()), ways[near, :2]]
        )  # (n, 3) of height and tilt here
        before = np.diag(np.array([HEIGHT_STD_M, SLOPE_STD, SLOPE_STD]) ** -2.0)
        rough_m = ROUGH_M
        for _ in range(2):
            weight = 1.0 / (std_m**2 + rough_m**2)
            covariance = np.linalg.inv(before + (at.T * weight) @ at)
            mean = covariance @ (at.T @ (weight * off_m))
            rough_m = max(ROUGH_M, float(np.sqrt(np.mean((off_m - at @ mean) ** 2))))
        std = math.sqrt(covariance[0, 0] + rough_m**2 + point.height_std_m**2)
        return max(LEAST_M, LEAST_M + float(mean[0]) + STDS * std)


def is_plane(surface: Surface | TouchRequest) -> bool:
    """Whether a surface is plane, as it is given or will be found."""
    touched = isinstance(surface, TouchRequest) and surface.form == "plane"
    return touched or isinstance(surface, Plane)


def is_along(last: ScanPoint, point: ScanPoint) -> bool:
    """Whether the tip goes to a point along the plane of the last one, no further than what is near."""
    way = np.subtract(point.position_m, last.position_m)
    alike = np.dot(last.normal, point.normal) > 1.0 - ALIKE
    flat = abs(np.dot(last.normal, way)) < FLAT_M
    return bool(alike and flat and np.linalg.norm(way) <= NEAR_M)
