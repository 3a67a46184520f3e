# SPDX-License-Identifier: Apache-2.0
"""What a scene compiles to: points in order, with poses, what is measured there, and the time it takes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import counted
from tactile_resonance.scan.adaptive import known_points
from tactile_resonance.scan.clearance import is_along, is_plane
from tactile_resonance.scan.measurement import MeasurementDesign, Skipped, design_measurement
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.points import (
    LeftOut,
    ScanPoint,
    point_label,
    scan_points,
    tip_orientation,
)
from tactile_resonance.scan.scene import ScanScene
from tactile_resonance.scan.surface import Plane, Surface, TouchRequest

STEEPEST_RAD = np.pi / 3
TRAVEL_M_S = 0.05
CONTACT_S, NEAR_CONTACT_S = 2.2, 1.1
"""Of each point, as seen on the simulated bench: tare, approach, until the force is held, and back; the second
where the surface was touched near by."""


@dataclass(frozen=True)
class Plan:
    """What a scan will do; every stage of it reads this.

    Attributes
    ----------
    scene : ScanScene
        That it carries out.
    points : tuple of ScanPoint
        Of an adaptive scan the places among which it chooses.
    measurement : MeasurementDesign
        At each of them.
    left_out : tuple of Skipped
        Points, with the time saved; what is saved at each point that is left is the measurement's.
    """

    scene: ScanScene
    points: tuple[ScanPoint, ...]
    measurement: MeasurementDesign
    left_out: tuple[Skipped, ...] = ()

    @property
    def skipped(self) -> tuple[Skipped, ...]:
        """Points and work left out, with the time saved."""
        each = list(self.measurement.skipped)
        if near := self.near:
            at = counted(near, "point")
            what = f"rest for the tare, and height that the surface does not ask for, at {at}"
            why = "zero and plane are known from the point before"
            each.append(Skipped(what, why, near * (CONTACT_S - NEAR_CONTACT_S)))
        return (*self.left_out, *each)

    @cached_property
    def first_points(self) -> tuple[ScanPoint, ...]:
        """Those that are known before the first is touched: all, or the first touches of an adaptive scan."""
        adaptive = self.scene.adaptive
        if adaptive is None:
            return self.points
        first = enumerate(adaptive.first(self._places_m))
        return tuple(self._numbered(self.points[place], index) for index, place in first)

    @property
    def most_points(self) -> int:
        """That are touched."""
        adaptive = self.scene.adaptive
        return len(self.points) if adaptive is None else min(adaptive.most, len(self.points))

    @property
    def near(self) -> int:
        """How many points, of those known beforehand, follow one near by on a plane surface."""
        if not is_plane(self.scene.surface):
            return 0
        return sum(map(is_along, self.first_points, self.first_points[1:]))

    @cached_property
    def shortest_s(self) -> float:
        """With the fewest points and blocks [s]."""
        return self.duration_s(self.measurement.blocks.least, len(self.first_points))

    @cached_property
    def longest_s(self) -> float:
        """With the most [s]."""
        return self.duration_s(self.measurement.blocks.most)

    def duration_s(self, blocks: int, points: int | None = None) -> float:
        """Time of so many points, by default the most, with so many blocks each [s].

        Ways that are not known yet count as the mean of those that are.
        """
        position = np.array([point.position_m for point in self.first_points])
        travel_m = float(np.sum(np.linalg.norm(np.diff(position, axis=0), axis=1)))
        contact_s = len(position) * CONTACT_S - self.near * (CONTACT_S - NEAR_CONTACT_S)
        each_s = (travel_m / TRAVEL_M_S + contact_s) / len(position)
        count = self.most_points if points is None else points
        tests_s = sum(
            asked.longest_s * (len(asked.points) or count) for asked in self.scene.protocols
        )
        return count * (each_s + blocks * self.measurement.block_s) + tests_s

    def next_point(
        self, touched: Sequence[ScanPoint], results: Iterable[PointResult]
    ) -> ScanPoint | None:
        """The touch that an adaptive scan appends to those before; None where it is enough, or not adaptive.

        Parameters
        ----------
        touched : sequence of ScanPoint
            In order, all finished.
        results : iterable of PointResult
            Latest of each.
        """
        adaptive = self.scene.adaptive
        if adaptive is None:
            return None
        place_of = {point.position_m: place for place, point in enumerate(self.points)}
        before = [place_of[point.position_m] for point in touched]
        last = self.points[before[-1]]
        way_m = np.linalg.norm(self._places_m - self._places_m[before[-1]], axis=1)
        near = [is_along(last, point) for point in self.points]
        contact_s = np.where(near, NEAR_CONTACT_S, CONTACT_S)
        seconds = way_m / TRAVEL_M_S + contact_s
        seconds += self.measurement.blocks.least * self.measurement.block_s
        place = adaptive.next(self._places_m, before, known_points(results), seconds)
        return None if place is None else self._numbered(self.points[place], len(touched))

    @cached_property
    def _places_m(self) -> FloatArray:
        """(p, 2) of all points, seen from above."""
        return np.array([point.position_m[:2] for point in self.points])

    def _numbered(self, point: ScanPoint, index: int) -> ScanPoint:
        return replace(point, index=index, label=point_label(self.scene.name, index))

    def with_points(self, points: Sequence[ScanPoint], left: Sequence[LeftOut]) -> Plan:
        """The same with these points, renumbered, and what is left out of it noted.

        Raises
        ------
        ValueError
            If there is no point.
        """
        if not points:
            raise ValueError(f"positions: all {len(left)} are left out; the first: {left[0][1]}")
        each_s = self.longest_s / len(self.points)
        numbered = tuple(self._numbered(point, index) for index, point in enumerate(points))
        entries = [Skipped(f"the point at {_in_mm(point)}", why, each_s) for point, why in left]
        return replace(self, points=numbered, left_out=(*self.left_out, *entries))


def plan_points(scene: ScanScene, points: tuple[ScanPoint, ...]) -> Plan:
    """Plan of points that are known: of poses given, of a run that is continued."""
    return Plan(scene, points, design_measurement(scene))


def make_plan(scene: ScanScene, surface: Surface | None = None) -> Plan:
    """Points of a scene on its surface.

    Parameters
    ----------
    scene : ScanScene
    surface : Surface, optional
        In place of the scene's. Without it one that is to be found by touch is taken to be level, at the height
        at which it is expected.

    Raises
    ------
    ValueError
        If no position lies on it.
    """
    under = scene.surface if surface is None else surface
    if isinstance(under, TouchRequest):
        under = Plane((0.0, 0.0, under.expected_height_m))
    xy, given_z = scene.positions_m[:, :2], scene.positions_m[:, 2]
    height, normals = under.height_m(xy), under.normal(xy)
    z = np.where(np.isnan(given_z), height, given_z)
    off = np.isnan(z) | np.any(np.isnan(normals), axis=1)
    with np.errstate(invalid="ignore"):
        steep = ~off & (normals[:, 2] < np.cos(STEEPEST_RAD))
    kept = ~off & ~steep
    if not kept.any():
        raise ValueError(
            f"positions: got {len(xy)}, of which {int(off.sum())} beside the surface and {int(steep.sum())} "
            "too steep; accepted is one usable position or more"
        )
    turns = tip_orientation(normals[kept], scene.sensor.heading_rad)
    std = under.height_std_m(xy[kept])
    where = np.column_stack([xy[kept], z[kept]])
    plan = plan_points(scene, scan_points(scene.name, where, normals[kept], turns, std))
    each_s = CONTACT_S + plan.measurement.blocks.most * plan.measurement.block_s
    left_out = tuple(
        Skipped(counted(int(left.sum()), "point"), why, float(left.sum() * each_s))
        for left, why in (
            (off, "beside the surface"),
            (steep, f"steeper than {np.degrees(STEEPEST_RAD):.0f} degrees"),
        )
        if left.any()
    )
    return replace(plan, left_out=left_out)


def _in_mm(point: ScanPoint) -> str:
    x, y, _ = point.position_m
    return f"x = {1e3 * x:.2f}, y = {1e3 * y:.2f} mm"
