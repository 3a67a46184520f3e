# SPDX-License-Identifier: Apache-2.0
"""The map: poles over the places where they were measured, with uncertainty and tissue."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy  # its parts are loaded where they are used first
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import require
from tactile_resonance.poles.result import ellipse, ellipse_radius
from tactile_resonance.record import Origin
from tactile_resonance.scan.adaptive import known_points
from tactile_resonance.scan.kriging import LEAST_POINTS, KrigedSurface, krige
from tactile_resonance.scan.level_set import Boundary, LevelSet, Raster, boundary_of
from tactile_resonance.scan.point_result import PointKind, PointOutcome, PointResult
from tactile_resonance.scan.points import on_a_line
from tactile_resonance.tissue.classify import UNKNOWN

LOW_RGB = (64, 105, 255)
HIGH_RGB = (255, 210, 50)


def shares(values: npt.ArrayLike, over: npt.ArrayLike) -> FloatArray:
    """(...) place of each value between the least of `over`, 0, and the largest, 1; 0 if these are equal.

    Values beyond them have the place of the nearer one.
    """
    low, span = np.min(over), np.ptp(over)
    v = np.asarray(values, float)
    return np.zeros_like(v) if span == 0 else np.clip((v - low) / span, 0.0, 1.0)


def colours(share: npt.ArrayLike) -> FloatArray:
    """(..., 3) red, green, blue from 0 to 1 for shares (...) from 0 to 1."""
    low, high = np.array(LOW_RGB) / 255, np.array(HIGH_RGB) / 255
    return np.asarray(low + np.asarray(share, float)[..., None] * (high - low))


_Cell = tuple[str, float, float, float]  # frame, and three whole numbers
SAME_PLACE_M = 1e-4
LONE_SPACING_M = 0.005
"""What a single point is taken to be apart from others where it is drawn [m]."""
_SEGMENTS, _LEAST_SEGMENTS = 36, 8  # of an ellipse: where there are many, each is a few pixels wide
_MOST_SEGMENTS = 36_000  # of all together, as far as the least allow
_CELLS = 80  # of the raster of a boundary, along its longer side


@dataclass(frozen=True, eq=False, slots=True)  # a map keeps one for each of its points
class MapPoint:
    """One place of the map.

    Attributes
    ----------
    result : PointResult
        What was found; its position and frame distinguish the place from others.
    position_m : (3,) float
        Where it is shown [m].
    normal : (3,) float
        Outward normal there.
    """

    result: PointResult
    position_m: FloatArray
    normal: FloatArray

    @classmethod
    def planned(cls, result: PointResult) -> MapPoint:
        """Shown where the point was planned."""
        return cls(result, result.position_m, result.normal)

    @classmethod
    def of_tip(cls, result: PointResult, origin: Origin) -> MapPoint:
        """Shown where the tip was, along its +z; ``ValueError`` where that is not known."""
        contact = origin.contact
        pose = contact.position_m and (*contact.position_m, *contact.orientation_xyzw)
        known = pose is not None and bool(np.all(np.isfinite(pose)))
        where = f"tip_pose of measurement {origin.measurement_id}"
        require(known, where, pose, "finite numbers, of a frame")
        normal = Rotation.from_quat(contact.orientation_xyzw).as_matrix()[:, 2]
        return cls(result, np.array(contact.position_m), normal)

    def seen_from(self, origin_m: FloatArray, rotation: Rotation) -> MapPoint:
        """The same shown in a frame whose origin (3,) and rotation in the present one are given."""
        place = rotation.inv().apply(self.position_m - origin_m)
        return replace(self, position_m=place, normal=rotation.inv().apply(self.normal))


@dataclass(frozen=True)
class EllipseScale:
    """How long a deviation of the pole is drawn in space."""

    m_per_hz: float
    m_per_damping: float


@dataclass(frozen=True, eq=False)
class MapSurface:
    """Natural frequency between the points.

    Attributes
    ----------
    position_m : (r, c, 3) float
        Rows and columns from the least x and y of the points to the largest.
    f0_hz, f0_std_hz : (r, c) float
    """

    position_m: FloatArray
    f0_hz: FloatArray
    f0_std_hz: FloatArray


@dataclass(frozen=True)
class PoleMap:
    """All points, each place once."""

    points: tuple[MapPoint, ...] = ()

    @cached_property
    def estimated(self) -> tuple[MapPoint, ...]:
        """Points with a pole."""
        return tuple(point for point in self.points if not point.result.failed)

    @cached_property
    def failures(self) -> tuple[MapPoint, ...]:
        """Points without."""
        return tuple(point for point in self.points if point.result.failed)

    @cached_property
    def f0_hz(self) -> FloatArray:
        """(n,) of the points with a pole [Hz]."""
        return np.array([point.result.f0_hz for point in self.estimated])

    @cached_property
    def positions_m(self) -> FloatArray:
        """(n, 3) of all points [m]."""
        return np.array([point.position_m for point in self.points]).reshape(-1, 3)

    @cached_property
    def spacing_m(self) -> float:
        """Typical distance to the next point [m]; `LONE_SPACING_M` with fewer than two points."""
        if len(self.points) < 2:
            return LONE_SPACING_M
        distances, _ = cKDTree(self.positions_m).query(self.positions_m, k=2)
        return float(np.median(distances[:, 1]))

    @cached_property
    def size_m(self) -> float:
        """Longer side seen along z, at least four spacings [m]: what is drawn refers to it."""
        return max(float(np.max(np.ptp(self.positions_m[:, :2], axis=0))), 4 * self.spacing_m)

    @property
    def simulated(self) -> bool:
        """Whether any point is from a simulation."""
        return any(point.result.simulated for point in self.points)

    def classes(self) -> tuple[str, ...]:
        """Tissue classes that were called, by name, `UNKNOWN` last."""
        names = {point.result.tissue_class for point in self.estimated} - {""}
        return tuple(sorted(names, key=lambda name: (name == UNKNOWN, name)))

    def ellipse_scale(self, probability: float = 0.95) -> EllipseScale:
        """Scale at which nine of ten ellipses stay within 0.4 of the spacing, rounded to 1, 2 or 5."""
        stds = np.array([p.result.std for p in self.with_ellipse])
        if not len(stds):
            return EllipseScale(self.spacing_m, self.spacing_m)
        largest = ellipse_radius(probability) * np.quantile(stds, 0.9, axis=0)
        wanted = 0.4 * self.spacing_m / np.maximum(largest, 1e-12)
        return EllipseScale(_round_down(wanted[0]), _round_down(wanted[1]))

    def ellipses(self, scale: EllipseScale, probability: float = 0.95) -> FloatArray:
        """(e, segments, 2, 3) lines of the ellipse of each point with a covariance [m].

        A pole's plane is not space: the ellipse is drawn about the point in the plane that touches the
        surface, deviations of f0 along the frame's x axis (its projection), those of the damping ratio
        across it, at the scale given. Points come in the order of `estimated`; those without a covariance
        are left out. Ends of the lines are on the ellipse: 36 of them, fewer where there are more than a
        thousand points, 8 at least.
        """
        points = self.with_ellipse
        segments = int(np.clip(_MOST_SEGMENTS // max(len(points), 1), _LEAST_SEGMENTS, _SEGMENTS))
        stretch = np.array([scale.m_per_hz, scale.m_per_damping])
        covariances = np.array([p.result.covariance for p in points]).reshape(-1, 2, 2)
        flat = ellipse(covariances * np.outer(stretch, stretch), segments + 1, probability)
        axes = tangent_axes(np.array([p.normal for p in points]).reshape(-1, 3))
        centres = np.array([p.position_m for p in points]).reshape(-1, 1, 3)
        loops = centres + flat.swapaxes(-1, -2) @ axes  # (e, segments + 1, 3)
        return np.stack([loops[:, :-1], loops[:, 1:]], axis=2)

    @cached_property
    def with_ellipse(self) -> tuple[MapPoint, ...]:
        """Points with a pole and its covariance."""
        return tuple(p for p in self.estimated if np.all(np.isfinite(p.result.covariance)))

    @property
    def placed(self) -> list[PointResult]:
        """Results of the points with a pole, at their places on the map."""
        return [
            replace(p.result, x_m=float(p.position_m[0]), y_m=float(p.position_m[1]))
            for p in self.estimated
        ]

    def krige(self) -> KrigedSurface | None:
        """Natural frequency over x, y; None where too few points have a covariance."""
        points = self.with_ellipse
        xy = np.array([p.position_m[:2] for p in points])
        if len(xy) < LEAST_POINTS or on_a_line(xy, SAME_PLACE_M):  # nothing is known beside it
            return None
        return krige(xy, [p.result.f0_hz for p in points], [p.result.f0_std_hz for p in points])

    def boundary(self, level_set: LevelSet) -> Boundary | None:
        """Boundary of what lies between two natural frequencies about the points; None as of `krige`.

        Frequencies are those at the nominal contact where these are known.
        """
        xy, f0_hz, std_hz = known_points(self.placed)
        if len(xy) < LEAST_POINTS or on_a_line(xy, SAME_PLACE_M):
            return None
        low, high = xy.min(axis=0) - self.spacing_m / 2, xy.max(axis=0) + self.spacing_m / 2
        box = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        raster = Raster.over(box, float(np.max(high - low)) / _CELLS)
        return boundary_of(krige(xy, f0_hz, std_hz), level_set, raster)

    def surface(self, cells: int = 40) -> MapSurface | None:
        """Kriged natural frequency on a grid over the points, `cells` along its longer side."""
        kriged = self.krige()
        if kriged is None:
            return None
        places = np.array([p.position_m for p in self.with_ellipse])
        known, heights = places[:, :2], places[:, 2]
        low, high = known.min(axis=0), known.max(axis=0)
        counts = np.maximum(np.rint(cells * (high - low) / np.max(high - low)), 1).astype(int)
        x, y = (np.linspace(low[k], high[k], counts[k] + 1) for k in range(2))
        xy = np.stack(np.meshgrid(x, y), axis=-1)  # (r, c, 2)
        value, std = kriged.predict(xy)
        z = scipy.interpolate.griddata(known, heights, xy, method="linear")
        z = np.where(np.isnan(z), scipy.interpolate.griddata(known, heights, xy, method="nearest"), z)
        return MapSurface(np.concatenate([xy, z[..., None]], axis=-1), value, std)


class GrowingMap:
    """A map while its points come; what one of them costs does not depend on how many there are."""

    def __init__(self, results: Iterable[PointResult] = ()) -> None:
        self._points: dict[MapPoint, None] = {}  # in the order in which they came
        self._at: defaultdict[_Cell, list[MapPoint]] = defaultdict(list)  # by place
        self._of_measurement: dict[int, MapPoint] = {}
        self._map: PoleMap | None = None
        for result in results:
            self.take(result)

    def __len__(self) -> int:
        return len(self._points)

    @property
    def map(self) -> PoleMap:
        """As it is now."""
        if self._map is None:
            self._map = PoleMap(tuple(self._points))
        return self._map

    def add(self, point: MapPoint) -> None:
        """Take a point; it replaces what its own measurement or place had before."""
        self.clear(point.result)
        if own := point.result.measurement_id:  # 0: it came to no measurement
            if own in self._of_measurement:
                self._remove(self._of_measurement[own])
            self._of_measurement[own] = point
        self._points[point] = None
        self._at[_cell(point.result)].append(point)
        self._map = None

    def take(self, result: PointResult) -> None:
        """Take one attempt at a point of a scan; one that does not count changes nothing."""
        if not counts(result):
            return
        if result.outcome is PointOutcome.SKIPPED:
            self.clear(result)
        else:
            self.add(MapPoint.planned(result))

    def clear(self, result: PointResult) -> None:
        """Leave nothing at the place of a result; of a skipped one nothing of its own point there."""
        skipped = result.outcome is PointOutcome.SKIPPED
        frame_id, x, y, z = _cell(result)
        place = result.x_m, result.y_m, result.z_m
        for dx, dy, dz in itertools.product((-1, 0, 1), repeat=3):
            for point in tuple(self._at.get((frame_id, x + dx, y + dy, z + dz), ())):
                other = point.result
                if skipped and other.index != result.index:
                    continue  # what another point of the plan found at this place stays
                if math.dist(place, (other.x_m, other.y_m, other.z_m)) <= SAME_PLACE_M:
                    self._remove(point)

    def _remove(self, point: MapPoint) -> None:
        del self._points[point]
        self._at[_cell(point.result)].remove(point)
        if self._of_measurement.get(point.result.measurement_id) is point:
            del self._of_measurement[point.result.measurement_id]
        self._map = None


def counts(result: PointResult) -> bool:
    """Whether an attempt at a point changes a map: one in free air or discarded does not."""
    return result.kind is PointKind.TISSUE and result.outcome is not PointOutcome.DISCARDED


def _cell(result: PointResult) -> _Cell:
    """Frame and cell of a place, the cells as wide as a place is; nothing is near one that is not known."""
    place = result.x_m, result.y_m, result.z_m
    known = all(map(math.isfinite, place))
    x, y, z = (math.floor(x / SAME_PLACE_M) if known else math.nan for x in place)
    return result.frame_id, x, y, z


def tangent_axes(normal: FloatArray) -> FloatArray:
    """(..., 2, 3) axes of the planes across normals (..., 3): the projection of x, and across it."""
    known = np.all(np.isfinite(normal), axis=-1, keepdims=True)
    normal = np.where(known, normal, [0.0, 0.0, 1.0])
    start = np.eye(3)[np.where(np.abs(normal[..., 0]) < 0.9, 0, 1)]
    first = start - np.sum(start * normal, axis=-1, keepdims=True) * normal
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(normal, first)], axis=-2)


def _round_down(value: float) -> float:
    """Largest 1, 2 or 5 times a power of ten that is not above."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)))
